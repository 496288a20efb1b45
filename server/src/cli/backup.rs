//! `stria backup` and `stria restore`.

use std::path::{Path, PathBuf};

use clap::Args;

use super::engine::{PlaceArgs, block_on, wrong};
use super::progress::size;
use super::{Failed, Outcome, Success};
use crate::backup::{self, Summary};
use crate::db::{DatabasePlace, Db};
use crate::store::Store;

/// Copy all records and files into a folder, while the server runs
#[derive(Args)]
#[command(after_help = "Example: stria backup --data stria-data --out /backups/2026-05-17")]
pub(super) struct Backup {
    /// The folder of the server
    #[arg(long, value_name = "DIR", default_value = "stria-data", env = "STRIA_DATA")]
    data: PathBuf,
    #[command(flatten)]
    places: PlaceArgs,
    /// The folder for the copy; it is made, or must be empty
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

/// Put a backup into an empty server, or check it
#[derive(Args)]
#[command(
    after_help = "The server must not run. A backup goes into SQLite or PostgreSQL, a folder or S3, whatever it \
                        came from; every file's hash is checked, before and after."
)]
pub(super) struct Restore {
    /// The folder of the copy
    from: PathBuf,
    /// The folder of the new server
    #[arg(long, value_name = "DIR", default_value = "stria-data", env = "STRIA_DATA")]
    data: PathBuf,
    #[command(flatten)]
    places: PlaceArgs,
    /// Only read the whole backup and say whether it is sound
    #[arg(long)]
    check: bool,
}

impl Backup {
    pub(super) fn run(self) -> Outcome {
        let places = self.places.places(&self.data)?;
        if let DatabasePlace::Sqlite(path) = &places.database
            && !path.is_file()
        {
            return Err(Failed::Input(format!(
                "{}: there are no records; expected the --data of a server",
                path.display()
            )));
        }
        if self.out.read_dir().is_ok_and(|mut entries| entries.next().is_some()) {
            return Err(Failed::Input(format!(
                "--out {}: not empty; expected a new or empty folder",
                self.out.display()
            )));
        }
        block_on(async {
            let db = Db::open(&places.database).await.map_err(wrong)?;
            let store = Store::open(&places.store).map_err(wrong)?;
            let summary = backup::make(&db, &store, &self.out).await.map_err(wrong)?;
            db.close().await.map_err(wrong)?;
            say("copied", &summary, &self.out);
            Ok(Success::Done)
        })
    }
}

impl Restore {
    pub(super) fn run(self) -> Outcome {
        if self.check {
            let summary = backup::check(&self.from).map_err(wrong)?;
            say("sound", &summary, &self.from);
            return Ok(Success::Done);
        }
        let places = self.places.places(&self.data)?;
        std::fs::create_dir_all(&self.data).map_err(|e| Failed::Other(format!("{}: {e}", self.data.display())))?;
        block_on(async {
            let db = Db::open(&places.database).await.map_err(wrong)?;
            let store = Store::open(&places.store).map_err(wrong)?;
            let summary = backup::restore(&db, &store, &self.from).await.map_err(wrong)?;
            db.close().await.map_err(wrong)?;
            say("restored and read again", &summary, &self.data);
            Ok(Success::Done)
        })
    }
}

fn say(what: &str, summary: &Summary, folder: &Path) {
    let rows = |table: &str| summary.rows.get(table).copied().unwrap_or(0);
    let bytes: u64 = summary.files.iter().map(|f| f.bytes).sum();
    println!(
        "{what}: {} runs, {} jobs, {} files with {}, as of {} ({})",
        rows("runs"),
        rows("jobs"),
        summary.files.len(),
        size(bytes),
        summary.made_at,
        folder.display()
    );
}
