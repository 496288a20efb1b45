//! The command line: one file per command. A command returns its exit code; errors are said here, once.

mod backup;
mod bearer;
mod calibrate;
mod compare;
mod engine;
mod export;
mod inspect;
mod logging;
mod process;
mod progress;
mod send;
mod serve;
mod simulate;
mod token;
mod work;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

/// Turns the video of a camera and a line laser on a robot into a measured 3D wall.
#[derive(Parser)]
#[command(name = "stria", version, max_term_width = 110, propagate_version = true)]
#[command(after_help = "Exit codes: 0 done, 1 failed, 2 wrong usage or input, 3 done with warnings, 130 cancelled.")]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Process(process::Process),
    Compare(compare::Compare),
    Simulate(simulate::SimulateArgs),
    Calibrate(calibrate::Calibrate),
    Serve(serve::Serve),
    Work(work::Work),
    Token(token::Token),
    Backup(backup::Backup),
    Restore(backup::Restore),
    Send(send::Send),
    Export(export::Export),
    Inspect(inspect::Inspect),
    /// Prints the OpenAPI document of the HTTP interface.
    #[command(hide = true)]
    Openapi,
}

/// Why a command ended without success.
enum Failed {
    /// Wrong usage or input: exit code 2.
    Input(String),
    /// Everything else: exit code 1.
    Other(String),
    /// Somebody stopped it: exit code 130.
    Cancelled,
}

/// What a command ends with where it succeeds.
enum Success {
    Done,
    DoneWithWarnings,
}

type Outcome = Result<Success, Failed>;

impl From<stria_core::Error> for Failed {
    fn from(error: stria_core::Error) -> Failed {
        match error {
            stria_core::Error::Input { .. } => Failed::Input(error.to_string()),
            stria_core::Error::Cancelled => Failed::Cancelled,
            // A file that is not there was named by whoever called.
            stria_core::Error::Io { ref source, .. } if source.kind() == std::io::ErrorKind::NotFound => {
                Failed::Input(error.to_string())
            }
            other => Failed::Other(other.to_string()),
        }
    }
}

/// Reads the arguments, runs the command, says what went wrong.
pub fn run() -> ExitCode {
    // Clap ends the process itself: 0 after --help, 2 after wrong usage.
    let cli = Cli::parse();
    let outcome = match cli.command {
        Command::Process(command) => command.run(),
        Command::Compare(command) => command.run(),
        Command::Simulate(args) => simulate::run(&args).map(|()| Success::Done),
        Command::Calibrate(command) => command.run(),
        Command::Serve(command) => command.run(),
        Command::Work(command) => command.run(),
        Command::Token(command) => command.run(),
        Command::Backup(command) => command.run(),
        Command::Restore(command) => command.run(),
        Command::Send(command) => command.run(),
        Command::Export(command) => command.run(),
        Command::Inspect(command) => command.run(),
        Command::Openapi => print_openapi(),
    };
    match outcome {
        Ok(Success::Done) => ExitCode::SUCCESS,
        Ok(Success::DoneWithWarnings) => ExitCode::from(3),
        Err(Failed::Other(message)) => said(&message, 1),
        Err(Failed::Input(message)) => said(&message, 2),
        Err(Failed::Cancelled) => said("cancelled", 130),
    }
}

fn said(message: &str, code: u8) -> ExitCode {
    eprintln!("stria: {message}");
    ExitCode::from(code)
}

fn print_openapi() -> Outcome {
    let text = crate::http::openapi().to_pretty_json().map_err(|e| Failed::Other(e.to_string()))?;
    println!("{text}");
    Ok(Success::Done)
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    #[test]
    fn the_command_line_is_sound() {
        super::Cli::command().debug_assert();
    }
}
