//! How long to wait before the next try, and when to stop trying.

use std::time::{Duration, Instant};

/// The wait after the first trouble; each further one is twice as long.
const FIRST_WAIT: Duration = Duration::from_millis(500);
/// The longest wait, before jitter.
const LONGEST_WAIT: Duration = Duration::from_secs(30);
/// The longest wait that a server may ask for.
const LONGEST_ASKED: Duration = Duration::from_secs(600);

/// When trying ends.
#[derive(Clone, Copy, Debug)]
pub(super) enum GiveUp {
    /// After so long without any progress.
    After(Duration),
    /// A daemon has no better place to be.
    Never,
}

/// Counts the time without progress.
pub(super) struct Patience {
    give_up: GiveUp,
    since: Instant,
    wait: Duration,
}

impl Patience {
    pub(super) fn new(give_up: GiveUp) -> Patience {
        Patience { give_up, since: Instant::now(), wait: FIRST_WAIT }
    }

    /// Something got through: all is forgotten.
    pub(super) fn progress(&mut self) {
        *self = Patience::new(self.give_up);
    }

    /// How long to wait now; `None` when it has been tried for long enough. The server's own wish goes before ours.
    pub(super) fn next_wait(&mut self, asked: Option<Duration>) -> Option<Duration> {
        if let GiveUp::After(limit) = self.give_up
            && self.since.elapsed() >= limit
        {
            return None;
        }
        let wait = self.wait;
        self.wait = (self.wait * 2).min(LONGEST_WAIT);
        // A fleet that lost the same server must not come back in the same second.
        Some(match asked {
            Some(asked) => asked.min(LONGEST_ASKED).mul_f64(1.0 + 0.5 * random_share()),
            None => wait.mul_f64(0.5 + random_share()),
        })
    }
}

/// 0 to 1. The last bits of a UUID are random.
fn random_share() -> f64 {
    (uuid::Uuid::now_v7().as_u128() & 0xffff) as f64 / f64::from(0x10000)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn waits_grow_to_their_limit_and_begin_anew_after_progress() {
        let mut patience = Patience::new(GiveUp::Never);
        let bounds = [0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 30.0, 30.0];
        for bound in bounds {
            let wait = patience.next_wait(None).expect("it never gives up").as_secs_f64();
            assert!((0.5 * bound..1.5 * bound).contains(&wait), "{wait} s for {bound} s");
        }
        patience.progress();
        assert!(patience.next_wait(None).expect("it never gives up") < Duration::from_secs(1));
        let asked = patience.next_wait(Some(Duration::from_secs(5))).expect("it never gives up");
        assert!((5.0..7.5).contains(&asked.as_secs_f64()), "{asked:?}");
    }

    #[test]
    fn it_gives_up_at_its_limit_and_not_before() {
        let mut patience = Patience::new(GiveUp::After(Duration::from_millis(50)));
        assert!(patience.next_wait(None).is_some());
        std::thread::sleep(Duration::from_millis(60));
        assert!(patience.next_wait(None).is_none());
        patience.progress();
        assert!(patience.next_wait(None).is_some());
    }

    #[test]
    fn a_fleet_spreads_out() {
        let waits: Vec<_> = (0..50).map(|_| Patience::new(GiveUp::Never).next_wait(None)).collect();
        let different: std::collections::BTreeSet<_> = waits.iter().collect();
        assert!(different.len() > 40, "{different:?}");
    }
}
