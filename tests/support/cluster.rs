//! Many machines on one: a PostgreSQL, an S3, and as many servers and workers as a test wants.

use std::path::PathBuf;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use tempfile::TempDir;

use super::postgres::{Held, Postgres};
use super::s3::{BUCKET, S3};
use super::server::{Server, children_of, signal};
use super::stria;

/// How long a process may take to end.
const PATIENCE: Duration = Duration::from_secs(60);

/// The engines that everything shares.
pub struct Cluster {
    /// The records' engine.
    pub postgres: Postgres,
    /// The files' engine.
    pub s3: S3,
    database: String,
}

impl Cluster {
    /// Starts both engines, empty.
    pub fn start() -> Cluster {
        let postgres = Postgres::start();
        let database = postgres.database("walls");
        Cluster { postgres, s3: S3::start(), database }
    }

    /// The flags under which programs find both.
    pub fn places(&self) -> Vec<String> {
        let store = format!("s3://{BUCKET}/site/a");
        ["--database", &self.database, "--store", &store].map(String::from).to_vec()
    }

    /// A server on them.
    pub fn server(&self, flags: &[&str]) -> Server {
        let places = self.places();
        let all: Vec<&str> = places.iter().map(String::as_str).chain(flags.iter().copied()).collect();
        Server::start_with(&all, &self.s3.variables())
    }

    /// A worker on them.
    pub fn worker(&self, flags: &[&str]) -> WorkerProcess {
        let mut arguments = self.places();
        arguments.extend(flags.iter().map(ToString::to_string));
        WorkerProcess::start(arguments, self.s3.variables())
    }

    /// Asks the records in SQL.
    pub fn ask(&self, sql: &str) -> Vec<String> {
        self.postgres.ask("walls", sql)
    }

    /// Holds the records' advisory lock of this number until what is returned goes.
    pub fn hold(&self, lock: u32) -> Held {
        self.postgres.hold("walls", lock)
    }

    /// Where the service's files lie in the bucket's folder.
    pub fn files(&self) -> PathBuf {
        self.s3.bucket().join("site/a")
    }
}

/// A running (or stopped) `stria work`.
pub struct WorkerProcess {
    data: TempDir,
    arguments: Vec<String>,
    variables: Vec<(String, String)>,
    process: Option<Child>,
}

impl WorkerProcess {
    fn start(arguments: Vec<String>, variables: Vec<(String, String)>) -> WorkerProcess {
        let data = tempfile::tempdir().expect("a temporary folder");
        let mut worker = WorkerProcess { data, arguments, variables, process: None };
        worker.start_again();
        worker
    }

    /// Starts it (again) on its folder.
    ///
    /// # Panics
    /// Where it cannot be started.
    pub fn start_again(&mut self) {
        let process = Command::new(stria())
            .arg("work")
            .args(&self.arguments)
            .arg("--data")
            .arg(self.data.path().join("data"))
            .env("STRIA_LOG", std::env::var("STRIA_LOG").unwrap_or_else(|_| "error".into()))
            .envs(self.variables.iter().map(|(name, value)| (name, value)))
            .stdout(Stdio::null())
            .spawn();
        self.process = Some(process.expect("the worker starts"));
    }

    /// Its process.
    ///
    /// # Panics
    /// Where it does not run.
    pub fn id(&self) -> u32 {
        self.process.as_ref().expect("it runs").id()
    }

    /// The processes that work on its jobs.
    pub fn children(&self) -> Vec<u32> {
        children_of(self.id())
    }

    /// What it has in its own folder beside its name.
    pub fn scratch(&self) -> PathBuf {
        self.data.path().join("data/scratch")
    }

    /// Ends it like the loss of power.
    ///
    /// # Panics
    /// Where it does not run.
    pub fn kill(&mut self) {
        let mut process = self.process.take().expect("it runs");
        process.kill().expect("it can be killed");
        process.wait().expect("it ends");
    }

    /// Asks it to stop; its exit status.
    ///
    /// # Panics
    /// Where it does not.
    pub fn stop(&mut self) -> ExitStatus {
        let mut process = self.process.take().expect("it runs");
        signal("TERM", process.id());
        let begun = Instant::now();
        loop {
            if let Some(status) = process.try_wait().expect("it can be waited for") {
                return status;
            }
            assert!(begun.elapsed() < PATIENCE, "the worker does not stop");
            std::thread::sleep(Duration::from_millis(20));
        }
    }
}

impl Drop for WorkerProcess {
    fn drop(&mut self) {
        if let Some(mut process) = self.process.take() {
            let _ = process.kill();
            let _ = process.wait();
        }
    }
}
