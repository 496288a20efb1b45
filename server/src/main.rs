//! Stria: laser-line video in, measured 3D walls out. One binary, `stria`: the service and the command line.
//!
//! Who may know whom: `http/*` and `worker` never import each other; they meet in the records (`runs`, `db`), the
//! `queue` and the `store`. Only the `process` command runs the pipeline; workers start it as a child process.

pub mod auth;
pub mod backup;
pub mod batches;
pub mod cli;
pub mod config;
pub mod confinement;
pub mod db;
pub mod defects;
pub mod disk;
pub mod error;
pub mod http;
pub mod incoming;
pub mod live;
pub mod metrics;
pub mod mjpeg;
pub mod queue;
pub mod resumed_hash;
pub mod retention;
pub mod runs;
pub mod source;
pub mod store;
pub mod turns;
pub mod uploads;
pub mod wire;
pub mod worker;

use std::process::ExitCode;

fn main() -> ExitCode {
    cli::run()
}
