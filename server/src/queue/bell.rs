//! Who waits for a change, and how word of one spreads: inside a process by a watch, between the processes on one
//! PostgreSQL by NOTIFY. The records are the truth; a ring that is lost only costs the wait until somebody looks anyway.

use std::time::Duration;

use sea_orm::sqlx;
use sea_orm::sqlx::postgres::{PgListener, PgPoolOptions};
use sea_orm::{ConnectionTrait, DbBackend};
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

use crate::db::Db;
use crate::error::Result;
use crate::metrics::metrics;

/// The name under which PostgreSQL passes rings on.
const CHANNEL: &str = "stria_bell";
/// Least time between two rings that one process sends to the others.
const SENT_AT_MOST_EVERY: Duration = Duration::from_millis(20);
/// A connection that says nothing for so long may be dead: another is made.
const QUIET: Duration = Duration::from_secs(300);
/// Time between two such connections.
const HEAR_AGAIN: Duration = Duration::from_secs(5);

/// Wakes whoever waits for a change.
#[derive(Clone)]
pub struct Bell {
    /// Rings from anywhere.
    heard: watch::Sender<u64>,
    /// Rings of this process: the others are told of these alone, or they would tell each other for ever.
    own: watch::Sender<u64>,
}

impl Bell {
    /// A new bell.
    pub fn new() -> Bell {
        Bell { heard: watch::Sender::new(0), own: watch::Sender::new(0) }
    }

    /// Something changed.
    pub fn ring(&self) {
        self.own.send_modify(|n| *n = n.wrapping_add(1));
        self.ring_here();
    }

    /// Hears every ring from now on, several at once as one.
    pub fn listen(&self) -> watch::Receiver<u64> {
        self.heard.subscribe()
    }

    fn ring_here(&self) {
        self.heard.send_modify(|n| *n = n.wrapping_add(1));
    }

    /// Carries rings between the processes on one PostgreSQL until asked to stop; with SQLite there is nobody else.
    pub async fn relay(self, db: Db, stop: CancellationToken) {
        if db.read().get_database_backend() != DbBackend::Postgres {
            return;
        }
        let name = Uuid::now_v7().to_string();
        tokio::select! {
            () = self.tell(&db, &name) => {}
            () = self.hear_again(&db, &name) => {}
            () = stop.cancelled() => {}
        }
    }

    async fn tell(&self, db: &Db, name: &str) {
        let mut own = self.own.subscribe();
        while own.changed().await.is_ok() {
            // Where the records do not answer, those who wait for them have other worries.
            if let Err(error) = db.read().execute_unprepared(&format!("NOTIFY {CHANNEL}, '{name}'")).await {
                tracing::debug!(%error, "a change was not told to the other processes");
            }
            tokio::time::sleep(SENT_AT_MOST_EVERY).await;
        }
    }

    async fn hear_again(&self, db: &Db, name: &str) {
        loop {
            if let Err(error) = self.hear(db, name).await {
                tracing::warn!(%error, "other processes' changes are not heard for now: they are found by looking");
            }
            tokio::time::sleep(HEAR_AGAIN).await;
        }
    }

    /// Hears the others on a connection of its own.
    async fn hear(&self, db: &Db, name: &str) -> Result<()> {
        let options = db.read().get_postgres_connection_pool().connect_options();
        let pool = PgPoolOptions::new().max_connections(1).connect_lazy_with((*options).clone());
        let heard = async {
            let mut listener = PgListener::connect_with(&pool).await?;
            listener.listen(CHANNEL).await?;
            // What was rung before is found by looking once.
            self.ring_here();
            while let Ok(ring) = tokio::time::timeout(QUIET, listener.try_recv()).await {
                // `None`: the connection broke and another was made; something may have been missed.
                if ring?.is_none_or(|ring| ring.payload() != name) {
                    metrics().rings_heard.inc();
                    self.ring_here();
                }
            }
            Ok::<(), sqlx::Error>(())
        };
        let ended = heard.await;
        pool.close().await;
        Ok(ended.map_err(|e| sea_orm::DbErr::Conn(sea_orm::RuntimeErr::SqlxError(e.into())))?)
    }
}

impl Default for Bell {
    fn default() -> Self {
        Bell::new()
    }
}
