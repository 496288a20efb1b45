//! Fences around the process that decodes what strangers send: no network, and no files but its own.
//!
//! Two kinds, since a system may lack either. `unshare` starts the child in a network of its own, with nobody in it.
//! Landlock, which the child puts on itself before it reads a byte, takes away every file outside its folder and its
//! source, TCP, and signals to other processes. What a system does not allow is said: in the log at the start, by
//! `/readyz` and in the metrics.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::Stdio;

use landlock::{
    ABI, Access, AccessFs, AccessNet, CompatLevel, Compatible, PathBeneath, PathFd, PathFdError, Ruleset, RulesetAttr,
    RulesetCreatedAttr, RulesetStatus, Scope,
};
use tokio::process::Command;

use crate::metrics::{Fence, metrics};

/// What goes before the command of a child: `unshare` of util-linux, which becomes the child itself. The plainest
/// first: as root, as a user where user namespaces are allowed.
const NETWORK_WAYS: [&[&str]; 2] = [&["unshare", "--net", "--"], &["unshare", "--map-current-user", "--net", "--"]];

/// What a child may read of the system beside its own files: how many processors there are, and what they can do.
const SYSTEM_FILES: [&str; 6] = [
    "/proc/cpuinfo",
    "/proc/self",
    "/proc/sys/vm/overcommit_memory",
    "/sys/devices/system/cpu",
    "/sys/fs/cgroup",
    "/dev/urandom",
];

/// What a child inherits of this process's environment: its secrets (keys of the store, the records' password) stay here.
const VARIABLES: [&str; 7] = ["PATH", "LD_LIBRARY_PATH", "LANG", "LC_ALL", "TZ", "RUST_BACKTRACE", "LLVM_PROFILE_FILE"];

/// The files of the first version of Landlock (Linux 5.13) and all that followed up to renaming and truncating (6.2).
const FILES: ABI = ABI::V3;
/// TCP came with Linux 6.7, signals and abstract sockets with 6.12.
const REST: ABI = ABI::V6;

/// What this system allows to be taken away from a child.
#[derive(Clone, Debug)]
pub struct Confinement {
    network: &'static [&'static str],
    files: bool,
}

impl Confinement {
    /// Tries what works on this machine, once, and says what does not.
    pub async fn find() -> Confinement {
        let mut network: &[&str] = &[];
        for way in NETWORK_WAYS {
            let mut command = Command::new(way[0]);
            command.args(&way[1..]).arg("true").stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
            if command.status().await.is_ok_and(|status| status.success()) {
                network = way;
                break;
            }
        }
        let confinement = Confinement { network, files: files_can_be_fenced() };
        for (what, stands) in [("network", !network.is_empty()), ("files", confinement.files)] {
            metrics().fences.get_or_create(&Fence { what: what.into() }).set(i64::from(stands));
        }
        for lack in confinement.lacks() {
            tracing::warn!("{lack}");
        }
        confinement
    }

    /// What this system does not allow, in words for people; empty where both fences stand.
    pub fn lacks(&self) -> Vec<String> {
        let network = self.network.is_empty().then_some(
            "this system does not let a process give its network up (unshare --net): children that decode videos keep theirs",
        );
        let files = (!self.files)
            .then_some("this system has no Landlock: children that decode videos can read whatever this process can");
        network.into_iter().chain(files).map(Into::into).collect()
    }

    /// A child's command, with nothing of this process's environment that is not named here.
    pub fn command(&self, program: &Path) -> Command {
        let mut command = match self.network {
            [] => Command::new(program),
            [first, rest @ ..] => {
                let mut command = Command::new(first);
                command.args(rest).arg(program);
                command
            }
        };
        command.env_clear().envs(VARIABLES.iter().filter_map(|name| Some((name, std::env::var_os(name)?))));
        command
    }

    /// Whether a child is told to fence its files.
    pub fn fences_files(&self) -> bool {
        self.files
    }
}

/// Landlock on a thread that ends at once: the fence goes with it. It is believed when it is felt.
fn files_can_be_fenced() -> bool {
    let felt = std::thread::spawn(|| {
        let folder = std::env::temp_dir();
        keep_to(&[], &[]).is_ok() && std::fs::read_dir(folder).is_err()
    });
    felt.join().unwrap_or(false)
}

/// Puts the fence around this thread and all that it starts from now on: `read` may be read, in `folders` everything may
/// be done. It cannot be taken down.
///
/// # Errors
/// Where a path is not there, or this system has no Landlock.
pub fn keep_to(read: &[&Path], folders: &[&Path]) -> Result<(), String> {
    let fence = || -> Result<RulesetStatus, Box<dyn std::error::Error>> {
        let mut rules = Ruleset::default()
            .set_compatibility(CompatLevel::HardRequirement)
            .handle_access(AccessFs::from_all(ABI::V1))?
            .set_compatibility(CompatLevel::BestEffort)
            .handle_access(AccessFs::from_all(FILES))?
            .handle_access(AccessNet::from_all(REST))?
            .scope(Scope::from_all(REST))?
            .create()?;
        for path in read {
            rules = rules.add_rule(rule(path, false)?)?;
        }
        for folder in folders {
            rules = rules.add_rule(rule(folder, true)?)?;
        }
        // What a system does not have is not needed.
        for path in SYSTEM_FILES.map(PathBuf::from).iter().filter(|path| File::open(path).is_ok()) {
            rules = rules.add_rule(rule(path, false)?)?;
        }
        Ok(rules.restrict_self()?.ruleset)
    };
    match fence() {
        Ok(RulesetStatus::NotEnforced) => Err("this system has no Landlock".into()),
        Ok(RulesetStatus::FullyEnforced | RulesetStatus::PartiallyEnforced) => Ok(()),
        Err(e) => Err(format!("the files could not be fenced: {e}")),
    }
}

fn rule(path: &Path, write: bool) -> Result<PathBeneath<PathFd>, PathFdError> {
    let access = if write { AccessFs::from_all(FILES) } else { AccessFs::ReadFile | AccessFs::ReadDir };
    // A file has no entries to list or make.
    let access = if path.is_dir() { access } else { access & AccessFs::from_file(FILES) };
    Ok(PathBeneath::new(PathFd::new(path)?, access))
}

#[cfg(test)]
mod tests {
    use std::net::{TcpListener, TcpStream};

    use super::*;

    /// What a fenced thread found it may do.
    fn fenced<T: Send + 'static>(read: &Path, folder: &Path, attempt: impl FnOnce() -> T + Send + 'static) -> T {
        let (read, folder) = (read.to_path_buf(), folder.to_path_buf());
        let thread = std::thread::spawn(move || {
            keep_to(&[&read], &[&folder]).expect("this system has Landlock: Linux 5.13 or later with lsm=landlock");
            attempt()
        });
        thread.join().expect("it does not panic")
    }

    #[test]
    fn a_child_has_its_own_files_and_no_others() {
        let place = tempfile::tempdir().expect("folder");
        let (own, source) = (place.path().join("own"), place.path().join("source.mp4"));
        let (secret, link) = (place.path().join("secret"), own.join("link"));
        std::fs::create_dir(&own).expect("makes");
        std::fs::write(&source, "frames").expect("writes");
        std::fs::write(&secret, "token").expect("writes");
        std::os::unix::fs::symlink(&secret, &link).expect("links");
        let refused = |result: std::io::Result<Vec<u8>>| {
            assert_eq!(result.expect_err("refused").kind(), std::io::ErrorKind::PermissionDenied);
        };
        let tried = fenced(&source, &own, {
            let (own, source, secret) = (own.clone(), source.clone(), secret.clone());
            move || {
                std::fs::create_dir(own.join("out")).expect("its own folder");
                std::fs::write(own.join("out/depth.tif"), "1").expect("its own folder");
                std::fs::rename(own.join("out/depth.tif"), own.join("depth.tif")).expect("its own folder");
                assert_eq!(std::fs::read(&source).expect("its source"), b"frames");
                [
                    std::fs::read(&secret),
                    std::fs::read(&link),
                    std::fs::read("/etc/passwd"),
                    std::fs::read(std::env::current_exe().expect("a path")),
                    std::fs::write(&source, "other frames").map(|()| Vec::new()),
                    std::fs::write(source.with_extension("new"), "x").map(|()| Vec::new()),
                    std::fs::rename(&secret, own.join("mine")).map(|()| Vec::new()).map_err(|e| match e.kind() {
                        // Linux says so where a fence lies between the two.
                        std::io::ErrorKind::CrossesDevices => std::io::ErrorKind::PermissionDenied.into(),
                        _ => e,
                    }),
                ]
            }
        });
        tried.into_iter().for_each(refused);
        assert_eq!(std::fs::read(&secret).expect("this thread has no fence"), b"token");
    }

    #[test]
    fn a_child_reaches_no_server() {
        let listener = TcpListener::bind("127.0.0.1:0").expect("listens");
        let address = listener.local_addr().expect("an address");
        let place = tempfile::tempdir().expect("folder");
        TcpStream::connect(address).expect("this thread has no fence");
        let status = std::fs::read_to_string("/proc/self/status").expect("Linux");
        assert!(status.contains("NoNewPrivs"), "{status}");
        let tried = fenced(place.path(), place.path(), move || TcpStream::connect(address).map(|_| ()));
        // TCP can be fenced since Linux 6.7; `unshare` takes the network away on older ones (tests/service/confined.rs).
        let kernel = std::fs::read_to_string("/proc/sys/kernel/osrelease").expect("Linux");
        let mut numbers = kernel.split('.').map_while(|n| n.parse::<u32>().ok());
        if (numbers.next(), numbers.next()) >= (Some(6), Some(7)) {
            assert_eq!(tried.expect_err("refused").kind(), std::io::ErrorKind::PermissionDenied);
        }
    }

    #[test]
    fn a_childs_environment_holds_no_secret() {
        let confinement = Confinement { network: &[], files: false };
        let command = confinement.command(Path::new("stria"));
        let passed: Vec<_> = command.as_std().get_envs().filter(|(_, value)| value.is_some()).collect();
        assert!(passed.iter().all(|(name, _)| VARIABLES.iter().any(|known| name == known)), "{passed:?}");
        assert_eq!(confinement.lacks().len(), 2);
    }
}
