//! `stria send`: runs go to a server whatever the network does. A file, a folder that is watched, or live frames.
//!
//! The one rule: what the server has not confirmed stays on this machine, and what it has confirmed is not sent again.

mod backoff;
mod contact;
mod fields;
mod follow;
mod live;
mod report;
mod sent;
mod session;
mod spool;
mod state;
mod trouble;
mod tus;
mod watch;
mod websocket;

use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::{Args, ValueEnum};
use reqwest::Url;
use tokio_util::sync::CancellationToken;

use self::backoff::GiveUp;
use self::contact::Contact;
use self::fields::{Fields, RunArgs};
use self::report::Report;
use self::state::States;
use self::trouble::Trouble;
use self::tus::{Sender, Source};
use super::engine::{StopSignals, block_on, positive};
use super::{Failed, Outcome, Success};
use crate::config::GB;

const EXAMPLES: &str = "\
Examples:
  A file; the same command goes on where it was cut off, also after a reboot:
    stria send run.mp4 --server https://stria.example --asset 'Pipe 7' --rig rig.toml --wait
  A robot's recordings, as the network allows; confirmed ones move to recordings/sent:
    stria send recordings --watch --asset 'Pipe 7' --rig gr3 --limit-kbit-s 4000
  Live from a camera; what cannot be sent now waits on disk and arrives later, in order:
    ffmpeg -i /dev/video0 -f mpjpeg - |
      stria send - --live --stream robot7 --asset 'Pipe 7' --rig gr3

The token comes from STRIA_TOKEN or --token-file, never from an argument: every user of a machine sees those. Proxies \
are taken from HTTPS_PROXY and HTTP_PROXY (not by --live), an authority of your own for https from SSL_CERT_FILE. What \
is needed to go on is kept in $XDG_STATE_HOME/stria, else in ~/.local/state/stria.

Exit codes: 0 done, 1 failed, 2 wrong usage or refused by the server, 3 done with warnings, 130 stopped by a signal.";

/// Send runs to a server: a file, a folder that is watched, or live frames
#[derive(Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct Send {
    /// A video file; a folder with --watch; `-` with --live
    source: PathBuf,
    /// The server's address
    #[arg(long, value_name = "URL", default_value = "http://127.0.0.1:8420", env = "STRIA_SERVER")]
    server: Url,
    /// A file with the server's token, which only its owner may read [default: ~/.config/stria/token where it exists;
    /// STRIA_TOKEN holds the token itself]
    #[arg(long, value_name = "FILE", env = "STRIA_TOKEN_FILE")]
    token_file: Option<PathBuf>,
    /// Most kilobits a second on the network [default: as fast as it goes]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(8..=1_000_000))]
    limit_kbit_s: Option<u32>,
    /// Give up after so many hours without any progress; --watch never does
    #[arg(long, value_name = "H", default_value_t = 24.0)]
    give_up_h: f64,
    /// A connection on which nothing moves for so many seconds is given up and made anew
    #[arg(long, value_name = "S", default_value_t = 60.0)]
    stall_s: f64,
    /// Follow the job to its end and print where to look at the result
    #[arg(long, conflicts_with = "watch")]
    wait: bool,
    /// Print JSON for programs, one object a line
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    run: RunArgs,
    #[command(flatten)]
    watching: WatchArgs,
    #[command(flatten)]
    living: LiveArgs,
}

/// What only a watched folder has.
#[derive(Args)]
#[command(next_help_heading = "A watched folder")]
struct WatchArgs {
    /// Send every file of the folder, oldest first, and what comes later, until stopped. Names that begin with a dot or
    /// end with .part are left alone; what the server refuses moves to refused/, with a .txt that says why
    #[arg(long, conflicts_with = "live")]
    watch: bool,
    /// A file is whole when its size and time have not changed for so many seconds
    #[arg(long, value_name = "S", default_value_t = 5.0, requires = "watch")]
    settle_s: f64,
    /// Delete confirmed files instead of moving them to sent/
    #[arg(long, requires = "watch", conflicts_with = "keep_sent_gb")]
    delete_sent: bool,
    /// Keep so many GB of confirmed files in sent/; beyond it the oldest are deleted
    #[arg(long, value_name = "GB", default_value_t = 20.0, requires = "watch")]
    keep_sent_gb: f64,
    /// With --watch: warn when the files still to be sent pass so many GB. With --live: the most that waits on disk
    #[arg(long, value_name = "GB", default_value_t = 20.0)]
    spool_gb: f64,
}

/// What only a live stream has.
#[derive(Args)]
#[command(next_help_heading = "A live stream")]
struct LiveArgs {
    /// Send the frames on stdin as they come: MJPEG, as `ffmpeg -f mpjpeg -` writes it, or bare JPEGs one after another
    #[arg(long, requires = "stream")]
    live: bool,
    /// The stream's name: letters, digits, `.`, `_` and `-`
    #[arg(long, value_name = "NAME", requires = "live")]
    stream: Option<String>,
    /// When --spool-gb is reached: wait (stdin is not read on) or drop (new frames are left out and listed as missing)
    #[arg(long, value_enum, default_value = "wait", requires = "live")]
    when_full: WhenFull,
}

/// What happens to frames that find the disk's share full.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(super) enum WhenFull {
    Wait,
    Drop,
}

/// What every way of sending needs.
struct Desk {
    contact: Contact,
    states: States,
    report: Report,
    fields: Fields,
    stop: CancellationToken,
}

impl Send {
    pub(super) fn run(self) -> Outcome {
        let report = Report::new(self.json);
        let outcome = self.send(&report);
        if let Err(failed) = &outcome {
            report.failed(failed);
        }
        outcome
    }

    fn send(&self, report: &Report) -> Outcome {
        let give_up = Duration::from_secs_f64(positive("--give-up-h", self.give_up_h, 1e5, "h")? * 3600.0);
        let stall = Duration::from_secs_f64(positive("--stall-s", self.stall_s, 86_400.0, "s")?);
        let desk = Desk {
            contact: Contact::new(&self.server, self.token_file.as_deref(), self.limit_kbit_s, stall)?,
            states: States::open(&self.server)?,
            report: report.clone(),
            fields: self.run.fields()?,
            stop: CancellationToken::new(),
        };
        if let Some(warning) = desk.contact.warning() {
            report.warning(warning);
        }
        block_on(async {
            let mut signals = StopSignals::listen().map_err(|e| Failed::Other(format!("signals: {e}")))?;
            let stop = desk.stop.clone();
            let heard = tokio::spawn(async move {
                signals.next().await;
                stop.cancel();
                signals.next().await;
                std::process::exit(130);
            });
            let outcome = self.go(&desk, GiveUp::After(give_up)).await;
            heard.abort();
            outcome
        })
    }

    async fn go(&self, desk: &Desk, give_up: GiveUp) -> Outcome {
        let is_pipe = self.source == Path::new("-");
        let folder = !is_pipe && self.source.is_dir();
        let spool_bytes = gigabytes("--spool-gb", self.watching.spool_gb)?;
        match (&self.living.stream, is_pipe, self.watching.watch, folder) {
            (Some(stream), true, _, _) => {
                let options = live::Options { spool_bytes, when_full: self.living.when_full, give_up, wait: self.wait };
                live::run(desk, stream, &options).await
            }
            (Some(_), false, _, _) => self.wrong("expected `-`: --live reads the frames from stdin"),
            (None, true, _, _) => self.wrong("stdin is sent with --live --stream NAME"),
            (None, false, true, false) => self.wrong("is no folder; --watch expected one"),
            (None, false, false, true) => self.wrong(
                "is a folder; expected a video file, or --watch to send the files in it (a folder of images can be \
                 processed here with `stria process`)",
            ),
            (None, false, true, true) => {
                let options = watch::Options {
                    settle: Duration::from_secs_f64(positive("--settle-s", self.watching.settle_s, 86_400.0, "s")?),
                    keep_sent_bytes: (positive("--keep-sent-gb", self.watching.keep_sent_gb, 1e6, "GB")? * GB as f64)
                        as u64,
                    delete_sent: self.watching.delete_sent,
                    spool_bytes,
                };
                watch::run(desk, &self.source, &options).await
            }
            (None, false, false, false) => self.send_file(desk, give_up).await,
        }
    }

    fn wrong(&self, words: &str) -> Outcome {
        Err(Failed::Input(format!("{}: {words}", self.source.display())))
    }

    async fn send_file(&self, desk: &Desk, give_up: GiveUp) -> Outcome {
        let source = Source::open(&self.source)?;
        source.lock()?;
        let sender = Sender { desk, give_up };
        let sent = sender.send(&source, self.run.recorded_at).await;
        if let Err(Trouble::Refused { .. } | Trouble::Changed(_)) = &sent {
            desk.states.forget(&source);
        }
        let sent = sent?;
        let page = desk.contact.page(&sent.run);
        desk.report.sent(&source.name, source.bytes, &sent.run, &sent.job, page.as_str());
        let outcome =
            if self.wait { follow::follow(desk, &sent.run, &sent.job, give_up).await } else { Ok(Success::Done) };
        // Only now: until its result was said, the same command finds this run again instead of making another.
        if !matches!(outcome, Err(Failed::Cancelled)) || !self.wait {
            desk.states.forget(&source);
        }
        outcome
    }
}

fn gigabytes(name: &str, value: f64) -> Result<u64, Failed> {
    /// Several of the largest frames must find room.
    const LEAST_GB: f64 = 0.2;
    if value < LEAST_GB {
        return Err(Failed::Input(format!("{name} is {value} GB; expected at least {LEAST_GB} GB")));
    }
    Ok((positive(name, value, 1e6, "GB")? * GB as f64) as u64)
}
