//! The database: opening it, bringing it to this version's tables, and the one way to write.
//!
//! Every query is written with sea-orm's builders, so that SQLite and PostgreSQL are served by one set. On both, a
//! transaction that changes a job locks its row first: SQLite lets one writer in at a time anyway, PostgreSQL by
//! `FOR UPDATE`. What fails only because the database was away, or because another transaction was in the way, is
//! done again by [`retried`].

mod again;
mod place;
pub mod tables;

use std::ops::Deref;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use sea_orm::sqlx::sqlite::{SqliteJournalMode, SqliteSynchronous};
use sea_orm::{
    ConnectOptions, ConnectionTrait, Database, DatabaseConnection, DatabaseTransaction, DbBackend, DbErr,
    SqliteTransactionMode, Statement, TransactionOptions, TransactionTrait,
};
use tokio::sync::{Mutex, OwnedMutexGuard};

pub use again::{ANSWER_PATIENCE, is_passing, retried};
pub use place::DatabasePlace;

use crate::error::{Error, Result};

/// The migrations in order; the schema's version is the number of those that ran.
const MIGRATIONS: [&str; 8] = [
    include_str!("migrations/0001_records.sql"),
    include_str!("migrations/0002_job_order.sql"),
    include_str!("migrations/0003_arrivals.sql"),
    include_str!("migrations/0004_doors.sql"),
    include_str!("migrations/0005_batches.sql"),
    include_str!("migrations/0006_pins.sql"),
    include_str!("migrations/0007_defects.sql"),
    include_str!("migrations/0008_retention.sql"),
];

/// The version of the schema that this Stria makes.
pub fn schema_version() -> i64 {
    MIGRATIONS.len() as i64
}

/// Connections kept open: readers do not wait for each other, nor for the writer.
const MAX_CONNECTIONS: u32 = 8;

/// How long a write waits for another process's write, and anything for a connection.
const BUSY_TIMEOUT: Duration = Duration::from_secs(10);

/// How long a PostgreSQL that does not answer yet is waited for at the start.
const STARTING: Duration = Duration::from_secs(60);

/// What a PostgreSQL does for us when this process is paused or gone in the middle of a transaction: it must not hold
/// its locks for longer than this. No statement of ours takes nearly as long.
const SESSION: [(&str, &str); 6] = [
    ("idle_in_transaction_session_timeout", "15s"),
    ("lock_timeout", "10s"),
    ("statement_timeout", "60s"),
    ("tcp_keepalives_idle", "10"),
    ("tcp_keepalives_interval", "5"),
    ("tcp_keepalives_count", "3"),
];

/// The advisory lock under which the schema changes: "stria" in ASCII.
const MIGRATION_LOCK: i64 = 0x73_74_72_69_61;

/// The records' database.
#[derive(Clone)]
pub struct Db {
    connection: DatabaseConnection,
    /// SQLite's writers of this process queue here instead of in its busy loop, which sleeps between its tries.
    writer: Option<Arc<Mutex<()>>>,
}

/// A write transaction; it rolls back unless committed.
pub struct WriteTransaction {
    transaction: DatabaseTransaction,
    _turn: Option<OwnedMutexGuard<()>>,
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
    /// The records answer.
    pub async fn ping(&self) -> Result<()> {
        self.connection.execute_unprepared("SELECT 1").await?;
        Ok(())
    }

    /// Opens the records and brings them to this version's schema.
    pub async fn open(place: &DatabasePlace) -> Result<Db> {
        match place {
            DatabasePlace::Sqlite(path) => Db::open_sqlite(path).await,
            DatabasePlace::Postgres(url) => Db::open_postgres(place, url).await,
        }
    }

    /// Opens (or makes) the SQLite file.
    ///
    /// Write-ahead logging lets readers and the writer work side by side. `synchronous = FULL`, because a run that
    /// was answered with 201 must survive the loss of power: with NORMAL the last transactions may be gone.
    async fn open_sqlite(path: &Path) -> Result<Db> {
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
        let db = Db { connection, writer: Some(Arc::default()) };
        db.migrate(&path.display().to_string()).await?;
        Ok(db)
    }

    async fn open_postgres(place: &DatabasePlace, url: &str) -> Result<Db> {
        let connect = || async move {
            let mut options = ConnectOptions::new(url);
            options.max_connections(MAX_CONNECTIONS).acquire_timeout(BUSY_TIMEOUT).sqlx_logging(false);
            options.map_sqlx_postgres_opts(|o| o.options(SESSION).application_name("stria"));
            Ok(Database::connect(options).await?)
        };
        let connection = retried(STARTING, connect).await;
        let connection = connection.map_err(|e| Error::Internal(format!("--database {place}: {e}")))?;
        let db = Db { connection, writer: None };
        let name = place.to_string();
        retried(STARTING, || db.migrate(&name)).await?;
        Ok(db)
    }

    /// For reading.
    pub fn read(&self) -> &DatabaseConnection {
        &self.connection
    }

    /// Starts a write transaction. On SQLite it is an immediate one: a transaction that reads first and writes later
    /// could otherwise find the database changed under it. On PostgreSQL a reader of what it will change locks it.
    pub async fn write(&self) -> Result<WriteTransaction> {
        let turn = match &self.writer {
            Some(writer) => Some(writer.clone().lock_owned().await),
            None => None,
        };
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

    /// One process at a time brings the schema up; the others wait and find it done.
    async fn migrate(&self, name: &str) -> Result<()> {
        let transaction = self.write().await?;
        let backend = transaction.get_database_backend();
        if backend == DbBackend::Postgres {
            transaction.execute_unprepared(&format!("SELECT pg_advisory_xact_lock({MIGRATION_LOCK})")).await?;
        }
        transaction.execute_unprepared("CREATE TABLE IF NOT EXISTS schema_version (version BIGINT NOT NULL)").await?;
        let version: i64 = transaction
            .query_one_raw(Statement::from_string(backend, "SELECT COALESCE(MAX(version), 0) AS v FROM schema_version"))
            .await?
            .map(|row| row.try_get("", "v"))
            .transpose()?
            .unwrap_or(0);
        let done = usize::try_from(version).unwrap_or(usize::MAX);
        if done > MIGRATIONS.len() {
            return Err(Error::Internal(format!(
                "{name}: its schema has version {version}, this Stria knows versions up to {}; a newer Stria made it",
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
            Db::open(&DatabasePlace::Sqlite(path.clone())).await.expect("opens").close().await.expect("closes");
        }
        let db = Db::open(&DatabasePlace::Sqlite(path.clone())).await.expect("opens");
        let transaction = db.write().await.expect("begins");
        transaction.execute_unprepared("INSERT INTO schema_version (version) VALUES (999)").await.expect("inserts");
        transaction.commit().await.expect("commits");
        db.close().await.expect("closes");
        let message = Db::open(&DatabasePlace::Sqlite(path.clone())).await.err().expect("refused").to_string();
        assert!(message.contains("999") && message.contains("newer"), "{message}");
    }

    #[tokio::test]
    async fn a_file_that_is_no_database_is_named() {
        let dir = tempfile::tempdir().expect("folder");
        let path = dir.path().join("stria.db");
        std::fs::write(&path, "this is not a database, whatever its name says".repeat(50)).expect("writes");
        assert!(Db::open(&DatabasePlace::Sqlite(path.clone())).await.is_err());
    }
}
