//! Whose turn it is to write to a thing (an upload, a stream), within this process: a newer request takes over from an
//! older one, whose connection is often dead already.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use tokio::sync::watch;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use crate::error::{Error, Result};

/// The turns that are taken.
#[derive(Default)]
pub struct Turns(Mutex<HashMap<String, Taken>>);

struct Taken {
    wanted: CancellationToken,
    /// Closes when the turn ends.
    ended: watch::Receiver<()>,
}

/// A turn; it ends when this is dropped.
pub struct Turn {
    turns: Arc<Turns>,
    id: String,
    wanted: CancellationToken,
    _running: watch::Sender<()>,
}

impl Turns {
    /// Tells whoever has the turn to end it, waits for that at most `patience`, and takes it.
    pub async fn take(self: &Arc<Turns>, id: &str, patience: Duration) -> Result<Turn> {
        let deadline = Instant::now() + patience;
        loop {
            let mut ended = match self.try_take(id, true) {
                Ok(turn) => return Ok(turn),
                Err(ended) => ended,
            };
            // The channel never carries anything: it closes.
            if tokio::time::timeout_at(deadline, ended.changed()).await.is_err() {
                return Err(Error::Locked("another request is writing to it and does not let go".into()));
            }
        }
    }

    /// Takes the turn where nobody has it, and disturbs nobody.
    pub fn take_if_free(self: &Arc<Turns>, id: &str) -> Option<Turn> {
        self.try_take(id, false).ok()
    }

    fn try_take(self: &Arc<Turns>, id: &str, disturb: bool) -> std::result::Result<Turn, watch::Receiver<()>> {
        let mut taken = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(other) = taken.get(id) {
            if disturb {
                other.wanted.cancel();
            }
            return Err(other.ended.clone());
        }
        let (running, ended) = watch::channel(());
        let wanted = CancellationToken::new();
        taken.insert(id.into(), Taken { wanted: wanted.clone(), ended });
        Ok(Turn { turns: self.clone(), id: id.into(), wanted, _running: running })
    }
}

impl Turn {
    /// Cancelled when another request wants the turn.
    pub fn wanted(&self) -> &CancellationToken {
        &self.wanted
    }
}

impl Drop for Turn {
    fn drop(&mut self) {
        self.turns.0.lock().unwrap_or_else(PoisonError::into_inner).remove(&self.id);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_newer_request_takes_over_and_a_stubborn_one_is_locked() {
        let turns = Arc::new(Turns::default());
        let first = turns.take("a", Duration::ZERO).await.expect("free");
        let other = turns.take("b", Duration::ZERO).await.expect("another upload");
        assert!(turns.take_if_free("a").is_none() && turns.take_if_free("c").is_some());
        assert!(!first.wanted().is_cancelled());
        let refused = turns.take("a", Duration::from_millis(20)).await;
        assert!(matches!(refused, Err(Error::Locked(_))) && first.wanted().is_cancelled());
        let waiting = tokio::spawn({
            let turns = turns.clone();
            async move { turns.take("a", Duration::from_secs(5)).await.is_ok() }
        });
        tokio::time::sleep(Duration::from_millis(20)).await;
        drop(first);
        assert!(waiting.await.expect("runs"));
        assert!(!other.wanted().is_cancelled());
        assert!(turns.take("a", Duration::ZERO).await.is_ok(), "the turn that ended is free");
    }
}
