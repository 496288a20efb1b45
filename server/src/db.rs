//! The database: opening it, bringing it to this version's tables, and the one way to write.
//!
//! Every query is written with sea-orm's builders, so that SQLite and PostgreSQL are served by one set.

pub mod tables;

use std::ops::Deref;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use sea_orm::sqlx::sqlite::{SqliteJournalMode, SqliteSynchronous};
use sea_orm::{
    ConnectOptions, ConnectionTrait, Database, DatabaseConnection, DatabaseTransaction, DbErr, SqliteTransactionMode,
    Statement, TransactionOptions, TransactionTrait,
};
use tokio::sync::{Mutex, OwnedMutexGuard};

use crate::error::{Error, Result};

/// The migrations in order; the schema's version is the number of those that ran.
const MIGRATIONS: [&str; 1] = [include_str!("migrations/0001_records.sql")];

/// Connections kept open: readers do not wait for each other, nor for the writer.
const MAX_CONNECTIONS: u32 = 8;

/// How long a write waits for another process's write.
const BUSY_TIMEOUT: Duration = Duration::from_secs(10);

/// The records' database.
#[derive(Clone)]
pub struct Db {
    connection: DatabaseConnection,
    /// Writers of this process queue here instead of in SQLite's busy loop, which sleeps between its tries.
    writer: Arc<Mutex<()>>,
}

/// A write transaction: it has the database's write lock from its start, and rolls back unless committed.
pub struct WriteTransaction {
    transaction: DatabaseTransaction,
    _turn: OwnedMutexGuard<()>,
}

impl Deref for WriteTransaction {
    type Target = DatabaseTransaction;

    fn deref(&self) -> &DatabaseTransaction {
        &self.transaction
    }
}

impl WriteTransaction {
    /// Makes everything written since the start durable and visible, at once.
    pub async fn commit(self) -> Result<()> {
        Ok(self.transaction.commit().await?)
    }
}

impl Db {
    /// Opens (or makes) the SQLite file and brings it to this version's schema.
    ///
    /// Write-ahead logging lets readers and the writer work side by side. `synchronous = FULL`, because a run that
    /// was answered with 201 must survive the loss of power: with NORMAL the last transactions may be gone.
    pub async fn open_sqlite(path: &Path) -> Result<Db> {
        let file = path.to_path_buf();
        let mut options = ConnectOptions::new("sqlite:stria.db");
        options.max_connections(MAX_CONNECTIONS).acquire_timeout(BUSY_TIMEOUT).sqlx_logging(false);
        options.map_sqlx_sqlite_opts(move |o| {
            o.filename(&file)
                .create_if_missing(true)
                .journal_mode(SqliteJournalMode::Wal)
                .synchronous(SqliteSynchronous::Full)
                .busy_timeout(BUSY_TIMEOUT)
                .foreign_keys(true)
        });
        let connection = Database::connect(options).await.map_err(|e| match e {
            DbErr::Conn(inner) => {
                Error::Internal(format!("{}: cannot be opened as a database: {inner}", path.display()))
            }
            other => Error::Records(other),
        })?;
        let db = Db { connection, writer: Arc::default() };
        db.migrate(path).await?;
        Ok(db)
    }

    /// For reading.
    pub fn read(&self) -> &DatabaseConnection {
        &self.connection
    }

    /// Starts a write transaction. On SQLite it is an immediate one: a transaction that reads first and writes later
    /// could otherwise find the database changed under it.
    pub async fn write(&self) -> Result<WriteTransaction> {
        let turn = self.writer.clone().lock_owned().await;
        let options = TransactionOptions {
            sqlite_transaction_mode: Some(SqliteTransactionMode::Immediate),
            ..TransactionOptions::default()
        };
        let transaction = self.connection.begin_with_options(options).await?;
        Ok(WriteTransaction { transaction, _turn: turn })
    }

    /// Ends all connections; SQLite folds its write-ahead log into the file.
    pub async fn close(self) -> Result<()> {
        Ok(self.connection.close().await?)
    }

    async fn migrate(&self, path: &Path) -> Result<()> {
        let transaction = self.write().await?;
        transaction.execute_unprepared("CREATE TABLE IF NOT EXISTS schema_version (version BIGINT NOT NULL)").await?;
        let backend = transaction.get_database_backend();
        let version: i64 = transaction
            .query_one_raw(Statement::from_string(backend, "SELECT COALESCE(MAX(version), 0) AS v FROM schema_version"))
            .await?
            .map(|row| row.try_get("", "v"))
            .transpose()?
            .unwrap_or(0);
        let done = usize::try_from(version).unwrap_or(usize::MAX);
        if done > MIGRATIONS.len() {
            return Err(Error::Internal(format!(
                "{}: its schema has version {version}, this Stria knows versions up to {}; a newer Stria made it",
                path.display(),
                MIGRATIONS.len()
            )));
        }
        for migration in &MIGRATIONS[done..] {
            transaction.execute_unprepared(migration).await?;
        }
        if done < MIGRATIONS.len() {
            let insert = format!("INSERT INTO schema_version (version) VALUES ({})", MIGRATIONS.len());
            transaction.execute_unprepared(&insert).await?;
        }
        transaction.commit().await
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_schema_is_made_once_and_a_newer_one_refused() {
        let dir = tempfile::tempdir().expect("folder");
        let path = dir.path().join("stria.db");
        for _ in 0..2 {
            Db::open_sqlite(&path).await.expect("opens").close().await.expect("closes");
        }
        let db = Db::open_sqlite(&path).await.expect("opens");
        let transaction = db.write().await.expect("begins");
        transaction.execute_unprepared("INSERT INTO schema_version (version) VALUES (999)").await.expect("inserts");
        transaction.commit().await.expect("commits");
        db.close().await.expect("closes");
        let message = Db::open_sqlite(&path).await.err().expect("refused").to_string();
        assert!(message.contains("999") && message.contains("newer"), "{message}");
    }

    #[tokio::test]
    async fn a_file_that_is_no_database_is_named() {
        let dir = tempfile::tempdir().expect("folder");
        let path = dir.path().join("stria.db");
        std::fs::write(&path, "this is not a database, whatever its name says".repeat(50)).expect("writes");
        assert!(Db::open_sqlite(&path).await.is_err());
    }
}
