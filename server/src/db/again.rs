//! What is done again: faults that pass by themselves.

use std::time::Duration;

use sea_orm::{DbErr, RuntimeErr, sqlx};
use tokio::time::Instant;
use uuid::Uuid;

use crate::error::Result;

/// How long a request is tried again before its sender is asked to come back: shorter than its answer may take.
pub const ANSWER_PATIENCE: Duration = Duration::from_secs(5);

/// The first wait; each further one is twice as long.
const FIRST_WAIT: Duration = Duration::from_millis(20);
/// The longest wait.
const LONGEST_WAIT: Duration = Duration::from_secs(1);

/// Does the work; where it fails in a way that passes by itself, does it again, until `patience` is over.
///
/// The work is one whole transaction, or it must be right to do it twice.
pub async fn retried<T, W, F>(patience: Duration, mut work: W) -> Result<T>
where
    W: FnMut() -> F,
    F: Future<Output = Result<T>>,
{
    let begun = Instant::now();
    let mut wait = FIRST_WAIT;
    loop {
        match work().await {
            Err(error) if error.is_passing() && begun.elapsed() + wait < patience => {
                tracing::debug!(%error, "it will be tried again");
                tokio::time::sleep(wait.mul_f64(0.5 + random_share())).await;
                wait = (wait * 2).min(LONGEST_WAIT);
            }
            other => return other,
        }
    }
}

/// 0 to 1, so that those who were in each other's way do not meet again. The last bits of a UUID are random.
fn random_share() -> f64 {
    (Uuid::now_v7().as_u128() & 0xffff) as f64 / f64::from(0x10000)
}

/// True where the same transaction may succeed in a moment: the database was away, or another transaction was in the
/// way, also by having just made (or deleted) the row that this one refers to.
pub fn is_passing(error: &DbErr) -> bool {
    let inner = match error {
        DbErr::ConnectionAcquire(_) => return true,
        DbErr::Conn(RuntimeErr::SqlxError(e))
        | DbErr::Exec(RuntimeErr::SqlxError(e))
        | DbErr::Query(RuntimeErr::SqlxError(e)) => e,
        _ => return false,
    };
    match inner.as_ref() {
        // A server that stops in the middle of an answer leaves half of it.
        sqlx::Error::Io(_) | sqlx::Error::PoolTimedOut | sqlx::Error::Protocol(_) | sqlx::Error::BeginFailed => true,
        sqlx::Error::Database(e) => e.code().is_some_and(|code| code_is_passing(&code)),
        _ => false,
    }
}

fn code_is_passing(code: &str) -> bool {
    // PostgreSQL: connections (08), serialization and deadlock (40), too many connections (53300), a lock not got
    // (55P03), a session or server that was ended (57P01 to 57P05, 25P03), a row made or gone in between (23503, 23505).
    // SQLite: busy (5 with its extensions), a row made or gone in between (787, 1555, 2067).
    let postgres = ["08", "40", "53300", "55P03", "57P0", "25P03", "23503", "23505"];
    let sqlite = ["5", "261", "517", "773", "787", "1555", "2067"];
    (code.len() == 5 && postgres.iter().any(|p| code.starts_with(p))) || sqlite.contains(&code)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::Error;

    fn passing() -> Error {
        Error::Records(DbErr::ConnectionAcquire(sea_orm::ConnAcquireErr::Timeout))
    }

    #[tokio::test]
    async fn only_what_passes_is_done_again() {
        let mut tries = 0;
        let done = retried(Duration::from_secs(5), || {
            tries += 1;
            let result = if tries < 3 { Err(passing()) } else { Ok(tries) };
            async { result }
        });
        assert_eq!(done.await.expect("the third try"), 3);
        let mut tries = 0;
        let failed: Result<()> = retried(Duration::from_secs(5), || {
            tries += 1;
            async { Err(Error::LeaseLost) }
        })
        .await;
        assert!(matches!(failed, Err(Error::LeaseLost)) && tries == 1);
        let ended: Result<()> = retried(Duration::from_millis(100), || async { Err(passing()) }).await;
        assert!(ended.is_err(), "patience ends");
    }

    #[test]
    fn codes_of_both_databases_are_told_apart() {
        for code in ["40001", "40P01", "57P01", "57P03", "08006", "53300", "5", "517", "2067"] {
            assert!(code_is_passing(code), "{code}");
        }
        for code in ["42601", "42P01", "22001", "1", "13", "26", "53100"] {
            assert!(!code_is_passing(code), "{code}");
        }
    }
}
