//! `stria token`: tokens and login addresses, straight in the records that a server uses.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Subcommand};
use reqwest::Url;

use super::engine::{PlaceArgs, block_on, wrong};
use super::{Failed, Outcome, Success};
use crate::auth::{Auth, NewToken, Scopes};
use crate::db::Db;
use crate::runs::Page;
use crate::wire::time::now_ms;

/// Make, list and revoke the tokens with which programs and people come in
#[derive(Args)]
#[command(
    after_help = "Scopes: ingest sends runs in; read looks at everything; operate changes, cancels and processes \
                        again; admin does everything.\nExample: stria token create robot-3 --scopes ingest,read"
)]
pub(super) struct Token {
    /// The folder of the server
    #[arg(long, value_name = "DIR", default_value = "stria-data", env = "STRIA_DATA", global = true)]
    data: PathBuf,
    #[command(flatten)]
    places: PlaceArgs,
    #[command(subcommand)]
    action: Action,
}

#[derive(Subcommand)]
enum Action {
    /// Make a token; its secret is printed this once, alone on stdout
    Create {
        /// Who will use it
        name: String,
        /// What it may do, with commas between
        #[arg(long, value_name = "A,B", default_value = "ingest,read")]
        scopes: String,
        /// Days until its time is over; never when absent
        #[arg(long, value_name = "D")]
        days: Option<u32>,
    },
    /// List all tokens, the newest first
    List,
    /// Shut a token out at once
    Revoke {
        /// Its id, from the list
        id: String,
    },
    /// Give a token a new secret; the old one goes on for a while
    Rotate {
        /// Its id, from the list
        id: String,
        /// Hours for which the old secret still opens
        #[arg(long, value_name = "H", default_value_t = 24)]
        overlap_h: u32,
    },
    /// Print an address that logs one browser in, once, within an hour
    Login {
        /// What the browser may do, with commas between
        #[arg(long, value_name = "A,B", default_value = "admin")]
        scopes: String,
        /// The server's address
        #[arg(long, value_name = "URL", default_value = "http://127.0.0.1:8420", env = "STRIA_SERVER")]
        server: Url,
    },
}

impl Token {
    pub(super) fn run(self) -> Outcome {
        let places = self.places.places(&self.data)?;
        if let crate::db::DatabasePlace::Sqlite(path) = &places.database
            && !path.is_file()
        {
            let path = path.display();
            return Err(Failed::Input(format!(
                "{path} is not there; expected --data (or --database) of a server that was started"
            )));
        }
        block_on(async {
            let db = Db::open(&places.database).await.map_err(wrong)?;
            let done = self.action.run(&Auth::new(db.clone())).await;
            db.close().await.map_err(wrong)?;
            done
        })
        .map(|()| Success::Done)
    }
}

impl Action {
    async fn run(self, auth: &Auth) -> Result<(), Failed> {
        match self {
            Action::Create { name, scopes, days } => {
                let expires_ms = days.map(|d| now_ms() + i64::from(d) * 86_400_000);
                let scopes = Scopes::parse(&scopes).map_err(wrong)?;
                show(&auth.create_token(&name, &scopes, expires_ms).await.map_err(wrong)?);
            }
            Action::List => list(auth).await?,
            Action::Revoke { id } => {
                let token = auth.revoke_token(&id).await.map_err(wrong)?;
                eprintln!("revoked: {} ({})", token.name, token.id);
            }
            Action::Rotate { id, overlap_h } => {
                let overlap = Duration::from_secs(u64::from(overlap_h) * 3600);
                show(&auth.rotate_token(&id, overlap).await.map_err(wrong)?);
            }
            Action::Login { scopes, server } => {
                let code = auth.create_login("login address", &Scopes::parse(&scopes).map_err(wrong)?).await;
                let mut url = server.join("/login").map_err(|e| Failed::Input(format!("--server {server}: {e}")))?;
                url.set_query(Some(&format!("code={}", code.map_err(wrong)?)));
                println!("{url}");
            }
        }
        Ok(())
    }
}

fn show(new: &NewToken) {
    let scopes: Vec<_> = new.token.scopes.iter().map(|s| s.as_str()).collect();
    eprintln!(
        "token {} for '{}', scopes {}; the secret is shown this once:",
        new.token.id,
        new.token.name,
        scopes.join(",")
    );
    println!("{}", new.secret);
}

async fn list(auth: &Auth) -> Result<(), Failed> {
    let mut cursor = None;
    println!("{:36}  {:7}  {:24}  {:24}  name", "id", "state", "scopes", "last used");
    loop {
        let page = Page::new(cursor, Some(Page::MAX)).map_err(wrong)?;
        let tokens = auth.tokens(&page).await.map_err(wrong)?;
        for token in tokens.items {
            let state = match (&token.revoked_at, token.valid) {
                (Some(_), _) => "revoked",
                (None, true) => "valid",
                (None, false) => "over",
            };
            let scopes: Vec<_> = token.scopes.iter().map(|s| s.as_str()).collect();
            let used = token.used_at.as_deref().unwrap_or("never");
            println!("{:36}  {state:7}  {:24}  {used:24}  {}", token.id, scopes.join(","), token.name);
        }
        match tokens.next_cursor {
            Some(next) => cursor = Some(next),
            None => return Ok(()),
        }
    }
}
