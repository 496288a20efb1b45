//! The binary `stria`.

use clap::{Parser, Subcommand};

#[path = "cli/simulate.rs"]
mod simulate;

#[derive(Parser)]
#[command(name = "stria")]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Simulate(simulate::SimulateArgs),
}

fn main() -> std::process::ExitCode {
    let Command::Simulate(args) = Cli::parse().command;
    match simulate::run(&args) {
        Ok(()) => std::process::ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("stria: {error}");
            std::process::ExitCode::from(2)
        }
    }
}
