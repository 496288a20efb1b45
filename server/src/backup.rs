//! Copies of everything: the records as they were at one moment, and every file that they name, with its hash.
//!
//! A backup is a folder that needs no database to be read: `backup.json` says what is in it, `records/TABLE.jsonl` has
//! one row a line, `files/` the files under their keys. It goes back into SQLite or PostgreSQL, a folder or S3, whatever
//! it came from. Sessions and login codes are not in it, nor who works; a job that was at work waits again.

mod records;

use std::collections::BTreeMap;
use std::path::Path;

use futures::stream::{StreamExt, TryStreamExt};
use sea_orm::EntityTrait;
use serde::{Deserialize, Serialize};

use crate::db::Db;
use crate::db::tables::{job, product, run, source_segment};
use crate::error::{Error, Result};
use crate::source;
use crate::store::{Facts, Key, ProductName, Store, facts_of};

/// The form of backups that this Stria writes and reads.
const FORM: u32 = 1;
const SUMMARY: &str = "backup.json";
/// Files on their way at the same time.
const FILES_AT_ONCE: usize = 4;

/// What a backup holds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// The form of the backup.
    pub form: u32,
    /// The Stria that made it.
    pub software: String,
    /// The version of the records' schema.
    pub schema: i64,
    /// When the records were read.
    pub made_at: String,
    /// Rows by table.
    pub rows: BTreeMap<String, u64>,
    /// The files.
    pub files: Vec<FileOf>,
}

/// A file of a backup.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FileOf {
    /// Its key in the store.
    pub key: String,
    /// Its size, bytes.
    pub bytes: u64,
    /// Its SHA-256.
    pub sha256: String,
}

/// Copies everything into a new or empty folder.
pub async fn make(db: &Db, store: &Store, out: &Path) -> Result<Summary> {
    let folder = out.join("records");
    std::fs::create_dir_all(&folder).map_err(|e| Error::io(&folder, e))?;
    let made_at = crate::wire::time::to_text(crate::wire::time::now_ms());
    let rows = records::write_all(db, &folder).await?;
    let wanted = files_of(&folder)?;
    let copies = wanted.into_iter().map(|file| copy_out(db, store, out, file)).collect::<Vec<_>>();
    let files: Vec<Option<FileOf>> = futures::stream::iter(copies).buffered(FILES_AT_ONCE).try_collect().await?;
    let summary = Summary {
        form: FORM,
        software: format!("stria {}", env!("CARGO_PKG_VERSION")),
        schema: crate::db::schema_version(),
        made_at,
        rows,
        files: files.into_iter().flatten().collect(),
    };
    // Last: a folder without it is no backup.
    let text = serde_json::to_string_pretty(&summary).map_err(|e| Error::Internal(format!("the summary: {e}")))?;
    let path = out.join(SUMMARY);
    std::fs::write(&path, text).map_err(|e| Error::io(&path, e))?;
    Ok(summary)
}

/// Puts a backup into empty records and an empty store, then reads everything again.
pub async fn restore(db: &Db, store: &Store, from: &Path) -> Result<Summary> {
    let summary = check(from)?;
    if run::Entity::find().one(db.read()).await?.is_some() {
        return Err(Error::Conflict("the records hold runs already; a backup goes into empty ones".into()));
    }
    for file in &summary.files {
        let path = from.join("files").join(&file.key);
        let facts = store.copy_file(&path, &Key::of_backup(&file.key)).await?;
        same(file, &facts)?;
    }
    store.sync().await?;
    records::read_all(db, &from.join("records")).await?;
    for file in &summary.files {
        let size = store.size(&Key::of_backup(&file.key)).await?;
        same(file, &Facts { bytes: size, sha256: file.sha256.clone() })?;
    }
    let rows = records::count_all(db).await?;
    if rows != summary.rows {
        return Err(Error::Internal(format!("the records hold {rows:?} rows; the backup has {:?}", summary.rows)));
    }
    Ok(summary)
}

/// Reads a whole backup: form, rows, every file's hash.
pub fn check(from: &Path) -> Result<Summary> {
    let path = from.join(SUMMARY);
    let text = std::fs::read_to_string(&path).map_err(|e| Error::io(&path, e))?;
    let bad =
        |what: String| Error::field("backup", format!("{}: {what}", path.display()), "a backup made by stria backup");
    let summary: Summary = serde_json::from_str(&text).map_err(|e| bad(e.to_string()))?;
    if summary.form != FORM || summary.schema > crate::db::schema_version() {
        let (form, schema) = (summary.form, summary.schema);
        return Err(bad(format!(
            "its form is {form} and its schema {schema}: a newer Stria made it ({})",
            summary.software
        )));
    }
    for (table, rows) in &summary.rows {
        let path = from.join("records").join(format!("{table}.jsonl"));
        let found = std::fs::read_to_string(&path).map_err(|e| Error::io(&path, e))?.lines().count() as u64;
        if found != *rows {
            return Err(bad(format!("{table} has {found} rows instead of {rows}")));
        }
    }
    for file in &summary.files {
        let path = from.join("files").join(&file.key);
        same(file, &facts_of(&path).map_err(|e| Error::io(&path, e))?)?;
    }
    Ok(summary)
}

fn same(file: &FileOf, found: &Facts) -> Result<()> {
    if (file.bytes, &file.sha256) == (found.bytes, &found.sha256) {
        return Ok(());
    }
    Err(Error::Internal(format!(
        "{} has {} bytes with the SHA-256 {}; the backup says {} bytes with {}",
        file.key, found.bytes, found.sha256, file.bytes, file.sha256
    )))
}

/// Every file that the records name: sources, products. Recording segments are in the whole recording of a done job.
fn files_of(folder: &Path) -> Result<Vec<(Key, Facts)>> {
    let facts = |bytes: i64, sha256: String| Facts { bytes: bytes.unsigned_abs(), sha256 };
    let mut files = Vec::new();
    let mut extensions = std::collections::HashMap::new();
    for row in records::lines::<run::Entity>(folder)? {
        let row: run::Model = row?;
        if row.source_kind == source::FILE {
            files.push((Key::source(&row.id, &row.source_extension), facts(row.source_bytes, row.source_sha256)));
        } else {
            extensions.insert(row.id, row.source_extension);
        }
    }
    for row in records::lines::<source_segment::Entity>(folder)? {
        let row: source_segment::Model = row?;
        let number = u32::try_from(row.number);
        if let (Some(extension), Ok(number)) = (extensions.get(&row.run_id), number) {
            let key = Key::source_segment(&row.run_id, number, row.fence, extension);
            files.push((key, facts(row.bytes, row.sha256)));
        }
    }
    let mut fences = std::collections::HashMap::new();
    for row in records::lines::<job::Entity>(folder)? {
        let row: job::Model = row?;
        if let Some(fence) = row.result_fence {
            fences.insert(row.id, fence);
        }
    }
    for row in records::lines::<product::Entity>(folder)? {
        let row: product::Model = row?;
        let name = ProductName::new(&row.name);
        if let (Some(fence), Some(name)) = (fences.get(&row.job_id), name) {
            files.push((Key::product(&row.job_id, *fence, &name), facts(row.bytes, row.sha256)));
        }
    }
    Ok(files)
}

/// Copies a file out and checks it; `None` where its run was deleted since the records were read.
async fn copy_out(db: &Db, store: &Store, out: &Path, (key, facts): (Key, Facts)) -> Result<Option<FileOf>> {
    let path = out.join("files").join(key.as_str());
    let folder = path.parent().unwrap_or(out);
    tokio::fs::create_dir_all(folder).await.map_err(|e| Error::io(folder, e))?;
    match store.copy_out(&key, &facts, &path).await {
        Ok(()) => Ok(Some(FileOf { key: key.as_str().into(), bytes: facts.bytes, sha256: facts.sha256 })),
        Err(Error::Store(object_store::Error::NotFound { .. })) if !records::still_names(db, &key).await? => {
            tracing::warn!(key = key.as_str(), "was deleted while the backup was made");
            Ok(None)
        }
        Err(error) => Err(error),
    }
}
