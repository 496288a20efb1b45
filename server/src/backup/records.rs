//! The records as lines of JSON, table by table.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufRead, BufReader, BufWriter, Write};
use std::path::Path;

use sea_orm::{
    AccessMode, ActiveModelTrait, ActiveValue::Set, ColumnTrait, DatabaseTransaction, EntityName, EntityTrait,
    IntoActiveModel, IsolationLevel, Iterable, PaginatorTrait, PrimaryKeyToColumn, QueryFilter, QueryOrder,
    TransactionTrait,
};
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::db::Db;
use crate::db::tables::{
    asset, audit, batch, batch_run, defect, idempotency_key, inspection, job, log_line, pin, product, retention_rules,
    rig, run, segment, source_segment, token, unpublished,
};
use crate::error::{Error, Result};
use crate::store::Key;
use crate::wire::JobState;

/// Rows that are read at once.
const PAGE: u64 = 5000;
/// Rows of one INSERT.
const ROWS_AT_ONCE: usize = 200;

/// Does something with every table that a backup holds, those first that others refer to.
macro_rules! each_table {
    ($do:ident($($argument:expr),*) into $rows:ident) => {
        each_table!(@ $do($($argument),*) $rows: rig asset run source_segment pin batch batch_run job product segment log_line
            defect inspection retention_rules idempotency_key unpublished token audit)
    };
    (@ $do:ident $arguments:tt $rows:ident: $($table:ident)*) => {
        $(each_table!(one $do $arguments $rows $table);)*
    };
    (one $do:ident ($($argument:expr),*) $rows:ident $table:ident) => {
        let count = $do::<$table::Entity>($($argument),*).await?;
        $rows.insert($table::Entity.table_name().to_string(), count);
    };
}

/// Writes all tables as they are at one moment.
pub(super) async fn write_all(db: &Db, folder: &Path) -> Result<BTreeMap<String, u64>> {
    let moment = db.read().begin_with_config(Some(IsolationLevel::RepeatableRead), Some(AccessMode::ReadOnly)).await?;
    let mut rows = BTreeMap::new();
    each_table!(write(&moment, folder) into rows);
    moment.commit().await?;
    Ok(rows)
}

async fn write<E>(moment: &DatabaseTransaction, folder: &Path) -> Result<u64>
where
    E: EntityTrait,
    E::Model: Serialize + Send + Sync,
{
    let path = path_of::<E>(folder);
    let failed = |e| Error::io(&path, e);
    let mut out = BufWriter::new(File::create(&path).map_err(failed)?);
    let mut query = E::find();
    for column in E::PrimaryKey::iter() {
        query = query.order_by_asc(column.into_column());
    }
    let mut pages = query.paginate(moment, PAGE);
    let mut count = 0;
    while let Some(rows) = pages.fetch_and_next().await? {
        for row in rows {
            let line = serde_json::to_string(&row).map_err(|e| Error::Internal(format!("{}: {e}", path.display())))?;
            writeln!(out, "{line}").map_err(failed)?;
            count += 1;
        }
    }
    out.into_inner().map_err(|e| Error::io(&path, e.into_error()))?.sync_all().map_err(failed)?;
    Ok(count)
}

/// Reads all tables into empty records, in one transaction.
pub(super) async fn read_all(db: &Db, folder: &Path) -> Result<()> {
    let t = db.write().await?;
    let mut rows = BTreeMap::new();
    each_table!(read(&t, folder) into rows);
    // Whoever was at work then is not at work now.
    let waits =
        job::ActiveModel { state: Set(JobState::Queued.as_str().into()), not_before_ms: Set(0), ..Default::default() };
    let ran = job::Column::State.eq(JobState::Running.as_str());
    job::Entity::update_many().set(waits).filter(ran).exec(&*t).await?;
    let closed = run::ActiveModel { source_open: Set(0), ..Default::default() };
    run::Entity::update_many().set(closed).exec(&*t).await?;
    t.commit().await
}

async fn read<E>(t: &DatabaseTransaction, folder: &Path) -> Result<u64>
where
    E: EntityTrait,
    E::Model: DeserializeOwned + IntoActiveModel<E::ActiveModel>,
    E::ActiveModel: ActiveModelTrait<Entity = E> + Send,
{
    let mut part = Vec::new();
    let mut count = 0;
    for row in lines::<E>(folder)? {
        part.push(row?.into_active_model());
        count += 1;
        if part.len() == ROWS_AT_ONCE {
            E::insert_many(std::mem::take(&mut part)).exec_without_returning(t).await?;
        }
    }
    if !part.is_empty() {
        E::insert_many(part).exec_without_returning(t).await?;
    }
    Ok(count)
}

/// Rows by table.
pub(super) async fn count_all(db: &Db) -> Result<BTreeMap<String, u64>> {
    let mut rows = BTreeMap::new();
    each_table!(count(db) into rows);
    Ok(rows)
}

async fn count<E>(db: &Db) -> Result<u64>
where
    E: EntityTrait,
    E::Model: Send + Sync,
{
    Ok(E::find().count(db.read()).await?)
}

/// The rows of a table in a backup.
pub(super) fn lines<E>(folder: &Path) -> Result<impl Iterator<Item = Result<E::Model>>>
where
    E: EntityTrait,
    E::Model: DeserializeOwned,
{
    let path = path_of::<E>(folder);
    let file = File::open(&path).map_err(|e| Error::io(&path, e))?;
    Ok(BufReader::new(file).lines().enumerate().map(move |(i, line)| {
        let line = line.map_err(|e| Error::io(&path, e))?;
        serde_json::from_str(&line).map_err(|e| {
            let found = format!("{} line {}: {e}", path.display(), i + 1);
            Error::field("backup", found, "a row of this table")
        })
    }))
}

fn path_of<E: EntityTrait>(folder: &Path) -> std::path::PathBuf {
    folder.join(format!("{}.jsonl", E::default().table_name()))
}

/// Whether the run or job of a file is still in the records.
pub(super) async fn still_names(db: &Db, key: &Key) -> Result<bool> {
    let mut words = key.as_str().split('/');
    Ok(match (words.next(), words.next()) {
        (Some("runs"), Some(id)) => run::Entity::find_by_id(id).one(db.read()).await?.is_some(),
        (Some("jobs"), Some(id)) => job::Entity::find_by_id(id).one(db.read()).await?.is_some(),
        _ => false,
    })
}

/// Every table of the schema is in a backup, or is here with its reason.
#[cfg(test)]
#[tokio::test]
async fn no_table_is_forgotten() {
    use sea_orm::ConnectionTrait;
    // An upload in pieces goes on where its bytes are; a stream that was open then is not open now.
    let left_out = ["schema_version", "workers", "sessions", "login_codes", "uploads", "upload_parts", "streams"];
    let folder = tempfile::tempdir().expect("folder");
    let place = crate::db::DatabasePlace::Sqlite(folder.path().join("stria.db"));
    let db = Db::open(&place).await.expect("opens");
    let backend = db.read().get_database_backend();
    let sql = "SELECT name FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite_%'";
    let rows = db.read().query_all_raw(sea_orm::Statement::from_string(backend, sql)).await.expect("lists");
    let names: Vec<String> = rows.iter().map(|row| row.try_get("", "name").expect("a name")).collect();
    let kept = count_all(&db).await.expect("counts");
    for name in names {
        assert!(kept.contains_key(&name) != left_out.contains(&name.as_str()), "{name}");
    }
}
