//! The child decodes what strangers send: it gets no network, where the system allows that to be taken away.

use std::path::Path;
use std::process::Stdio;

use tokio::process::Command;

/// What goes before the command of a child: `unshare` of util-linux, which becomes the child itself.
#[derive(Clone, Debug)]
pub struct Confinement(&'static [&'static str]);

/// The ways, the plainest first: as root, as a user where user namespaces are allowed.
const WAYS: [&[&str]; 2] = [&["unshare", "--net", "--"], &["unshare", "--map-current-user", "--net", "--"]];

impl Confinement {
    /// The first way that works on this machine; without one the child shares our network, and the log says so.
    pub async fn find() -> Confinement {
        for way in WAYS {
            let mut command = Command::new(way[0]);
            command.args(&way[1..]).arg("true").stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
            if command.status().await.is_ok_and(|status| status.success()) {
                return Confinement(way);
            }
        }
        tracing::warn!(
            "this system does not let a process give its network up: children that decode videos keep theirs"
        );
        Confinement(&[])
    }

    /// A child's command.
    pub(super) fn command(&self, program: &Path) -> Command {
        match self.0 {
            [] => Command::new(program),
            [first, rest @ ..] => {
                let mut command = Command::new(first);
                command.args(rest).arg(program);
                command
            }
        }
    }
}
