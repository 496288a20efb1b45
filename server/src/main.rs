//! Stria: laser-line video in, measured 3D walls out. One binary, `stria`: the service and the command line.
//!
//! Who may know whom: `http/*` and `worker` never import each other; they meet in the records (`runs`, `db`), the
//! `queue` and the `store`. Only the `process` command runs the pipeline; workers start it as a child process.

mod cli;
mod config;
mod db;
mod error;
mod http;
mod incoming;
mod queue;
mod retention;
mod runs;
mod store;
mod wire;
mod worker;

use std::process::ExitCode;

fn main() -> ExitCode {
    cli::run()
}
