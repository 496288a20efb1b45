//! A PostgreSQL of a test's own: own folder, own port, not as root. It can be taken away and brought back.

use std::io::{BufRead, BufReader, Write};
use std::net::TcpListener;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use tempfile::TempDir;

use super::server::signal;

/// How long it may take to start or to stop.
const PATIENCE: Duration = Duration::from_secs(60);

/// A running (or stopped) PostgreSQL.
pub struct Postgres {
    folder: TempDir,
    programs: PathBuf,
    user: Option<(u32, u32)>,
    port: u16,
    process: Option<Child>,
}

impl Postgres {
    /// Makes a cluster on a new folder and starts it.
    ///
    /// # Panics
    /// Where PostgreSQL is missing or does not start.
    pub fn start() -> Postgres {
        let folder = tempfile::Builder::new().prefix("stria-postgres-").tempdir().expect("a temporary folder");
        let user = is_root().then(postgres_user);
        if let Some((user, group)) = user {
            std::os::unix::fs::chown(folder.path(), Some(user), Some(group)).expect("root may give a folder away");
        }
        let port = TcpListener::bind("127.0.0.1:0").and_then(|l| l.local_addr()).expect("a free port").port();
        let mut postgres = Postgres { folder, programs: programs(), user, port, process: None };
        let data = postgres.data();
        let made = postgres.run("initdb", &["-D", plain(&data), "-U", "stria", "-A", "trust", "-N", "-E", "UTF8"]);
        assert!(made.status.success(), "initdb: {}", String::from_utf8_lossy(&made.stderr));
        postgres.start_again();
        postgres
    }

    fn data(&self) -> PathBuf {
        self.folder.path().join("data")
    }

    fn command(&self, program: &str) -> Command {
        let mut command = Command::new(self.programs.join(program));
        // Its user may not enter the folder that the test runs in.
        command.current_dir(self.folder.path());
        if let Some((user, group)) = self.user {
            command.uid(user).gid(group);
        }
        command
    }

    fn run(&self, program: &str, arguments: &[&str]) -> Output {
        self.command(program).args(arguments).output().expect("a program of PostgreSQL starts")
    }

    /// Starts it (again) and waits until it answers.
    ///
    /// # Panics
    /// Where it does not.
    pub fn start_again(&mut self) {
        let log = std::fs::File::create(self.folder.path().join("log")).expect("a log file");
        let process = self
            .command("postgres")
            .args(["-D", plain(&self.data()), "-p", &self.port.to_string(), "-k", plain(self.folder.path())])
            // Only the machine's own failure is lost sooner without fsync, not that of a process.
            .args(["-c", "listen_addresses=127.0.0.1", "-c", "fsync=off", "-c", "max_connections=200"])
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(log)
            .spawn()
            .expect("PostgreSQL starts");
        self.process = Some(process);
        let begun = Instant::now();
        while !self.run("pg_isready", &["-h", "127.0.0.1", "-p", &self.port.to_string()]).status.success() {
            let log = || std::fs::read_to_string(self.folder.path().join("log")).unwrap_or_default();
            assert!(begun.elapsed() < PATIENCE, "PostgreSQL does not answer: {}", log());
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// Ends it at once, in the middle of whatever it does.
    ///
    /// # Panics
    /// Where it does not end.
    pub fn stop_hard(&mut self) {
        let Some(mut process) = self.process.take() else { return };
        signal("QUIT", process.id());
        process.wait().expect("it ends");
    }

    /// Makes a new empty database; its URL.
    ///
    /// # Panics
    /// Where that fails.
    pub fn database(&self, name: &str) -> String {
        let made = self.run("createdb", &["-h", "127.0.0.1", "-p", &self.port.to_string(), "-U", "stria", name]);
        assert!(made.status.success(), "createdb: {}", String::from_utf8_lossy(&made.stderr));
        format!("postgres://stria@127.0.0.1:{}/{name}", self.port)
    }

    /// Asks it in SQL; one line a row, columns with `|` between them.
    ///
    /// # Panics
    /// Where it refuses.
    pub fn ask(&self, database: &str, sql: &str) -> Vec<String> {
        let answer = self.run(
            "psql",
            &["-h", "127.0.0.1", "-p", &self.port.to_string(), "-U", "stria", "-d", database, "-AtXc", sql],
        );
        assert!(answer.status.success(), "{sql}: {}", String::from_utf8_lossy(&answer.stderr));
        String::from_utf8_lossy(&answer.stdout).lines().map(Into::into).collect()
    }

    /// Takes an advisory lock, and holds it until what is returned goes.
    ///
    /// # Panics
    /// Where it is not given.
    pub fn hold(&self, database: &str, lock: u32) -> Held {
        let mut session = self
            .command("psql")
            .args(["-h", "127.0.0.1", "-p", &self.port.to_string(), "-U", "stria", "-d", database, "-AtX"])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("psql starts");
        let words = session.stdin.as_mut().expect("it was asked for");
        writeln!(words, "SELECT 'held' FROM pg_advisory_lock({lock});").expect("psql listens");
        let mut answer = String::new();
        BufReader::new(session.stdout.as_mut().expect("it was asked for")).read_line(&mut answer).expect("an answer");
        assert_eq!(answer.trim(), "held");
        Held(session)
    }
}

/// A session that holds a lock.
pub struct Held(Child);

impl Drop for Held {
    fn drop(&mut self) {
        // Its session ends with its input.
        drop(self.0.stdin.take());
        let _ = self.0.wait();
    }
}

impl Drop for Postgres {
    fn drop(&mut self) {
        if let Some(mut process) = self.process.take() {
            signal("QUIT", process.id());
            let _ = process.wait();
        }
    }
}

/// Where Debian keeps the newest PostgreSQL.
fn programs() -> PathBuf {
    let versions = std::fs::read_dir("/usr/lib/postgresql").into_iter().flatten().flatten();
    let number = |path: &PathBuf| path.file_name().and_then(|n| n.to_str()?.parse::<u32>().ok());
    let newest = versions.map(|e| e.path()).filter(|path| path.join("bin/initdb").exists()).max_by_key(number);
    newest.expect("PostgreSQL is missing: run docker/set-up.sh, or install Debian's package postgresql").join("bin")
}

fn is_root() -> bool {
    use std::os::unix::fs::MetadataExt;
    std::fs::metadata("/proc/self").is_ok_and(|own| own.uid() == 0)
}

/// PostgreSQL refuses to run as root; its Debian package brings a user for it.
fn postgres_user() -> (u32, u32) {
    let users = std::fs::read_to_string("/etc/passwd").expect("a list of users");
    let line =
        users.lines().find(|line| line.starts_with("postgres:")).expect("the user postgres: run docker/set-up.sh");
    let number = |i: usize| line.split(':').nth(i).and_then(|n| n.parse().ok()).expect("a user has numbers");
    (number(2), number(3))
}

fn plain(path: &Path) -> &str {
    path.to_str().expect("a plain path")
}
