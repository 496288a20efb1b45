//! Files that people look at while a job runs → the store, beside the work: a store that is slow or away delays what
//! people see, never the processing.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};

use tokio::sync::Notify;
use tokio::task::JoinHandle;

use super::scratch::Scratch;
use crate::error::{Error, Result};
use crate::queue::Lease;
use crate::store::{Key, ProductName, Store};

/// Largest file that is shown, bytes: a tile of noise has a quarter of a megabyte.
const MOST_BYTES: u64 = 4 << 20;
/// Names that may wait. More come only when the store is away for long; then the newest are shown.
const MOST_NAMES: usize = 100_000;

/// Names that wait to be stored, each once: a file that changes again before its turn is stored once, as it is then.
#[derive(Default)]
struct Waiting {
    /// By turn.
    names: BTreeMap<u64, String>,
    turns: BTreeMap<String, u64>,
    next: u64,
}

impl Waiting {
    /// What comes again goes to the end: a file that describes others is stored after them.
    fn push(&mut self, name: String) {
        if let Some(turn) = self.turns.insert(name.clone(), self.next) {
            self.names.remove(&turn);
        }
        self.names.insert(self.next, name);
        self.next += 1;
        if self.names.len() > MOST_NAMES {
            self.pop();
        }
    }

    fn pop(&mut self) -> Option<String> {
        let (_, name) = self.names.pop_first()?;
        self.turns.remove(&name);
        Some(name)
    }
}

#[derive(Default)]
struct Shared {
    waiting: Mutex<Waiting>,
    more: Notify,
}

impl Shared {
    fn waiting(&self) -> std::sync::MutexGuard<'_, Waiting> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Stores files while the child goes on; ends with its attempt.
pub(super) struct Showcase {
    shared: Arc<Shared>,
    task: JoinHandle<()>,
}

impl Showcase {
    /// Begins to wait for names.
    pub(super) fn open(store: &Store, lease: &Lease, scratch: &Scratch) -> Showcase {
        let shared = Arc::new(Shared::default());
        let keeper = Keeper { store: store.clone(), job: lease.job.clone(), fence: lease.fence, folder: scratch.out() };
        let task = tokio::spawn(keeper.keep(shared.clone()));
        Showcase { shared, task }
    }

    /// Files of the product folder are new or have changed.
    pub(super) fn show(&self, names: Vec<String>) {
        let mut waiting = self.shared.waiting();
        names.into_iter().for_each(|name| waiting.push(name));
        drop(waiting);
        self.shared.more.notify_one();
    }

    /// Ends it; returns when nothing more is written.
    pub(super) async fn close(&mut self) {
        self.task.abort();
        let _ = (&mut self.task).await;
    }
}

impl Drop for Showcase {
    fn drop(&mut self) {
        self.task.abort();
    }
}

struct Keeper {
    store: Store,
    job: String,
    fence: i64,
    folder: PathBuf,
}

impl Keeper {
    async fn keep(self, shared: Arc<Shared>) {
        loop {
            let next = shared.waiting().pop();
            match next {
                Some(name) => {
                    // The child's own end brings the same file as a product: what fails here is late, not lost.
                    if let Err(error) = self.store_one(&name).await {
                        tracing::debug!(job = %self.job, name, %error, "a file could not be shown yet");
                    }
                }
                None => shared.more.notified().await,
            }
        }
    }

    async fn store_one(&self, text: &str) -> Result<()> {
        let name = ProductName::new(text);
        let name = name.ok_or_else(|| Error::Internal(format!("the child named a file {text:?}")))?;
        let file = self.folder.join(name.as_str());
        let facts = tokio::fs::symlink_metadata(&file).await.map_err(|e| Error::io(&file, e))?;
        if !facts.is_file() || facts.len() > MOST_BYTES {
            return Err(Error::Internal(format!("{text} is no small plain file")));
        }
        let bytes = tokio::fs::read(&file).await.map_err(|e| Error::io(&file, e))?;
        self.store.put_bytes(&Key::product(&self.job, self.fence, &name), bytes.into()).await.map(|_| ())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_comes_again_waits_once_at_the_end() {
        let mut waiting = Waiting::default();
        for name in ["a", "tiles.json", "b", "a", "tiles.json"] {
            waiting.push(name.into());
        }
        let order: Vec<String> = std::iter::from_fn(|| waiting.pop()).collect();
        assert_eq!(order, ["b", "a", "tiles.json"]);
        assert!(waiting.turns.is_empty());
    }
}
