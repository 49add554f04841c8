//! What the host tells systemd: ready, alive, stopping.
//!
//! ```text
//!  joined, API answers ─► READY=1 ─► every third of WatchdogSec: have all workers come round lately? ─ yes ─► WATCHDOG=1
//!                                          └ no ─► nothing, and a line in the log ─► systemd kills and starts the host
//!  SIGTERM ─► STOPPING=1
//! ```
//! The sign of life is that of the cycle's threads, not of this task: a host that answers its API and runs no cycles is dead. Without
//! systemd (no `NOTIFY_SOCKET`) nothing is sent, and no task runs.
//! Never: decides what is done with a host that does not come round; the unit says so.

use std::time::Duration;

use sd_notify::NotifyState;
use tokio::task::JoinHandle;

/// Signs of life in the time that systemd waits for one: two may get lost.
const SIGNS: u32 = 3;

/// The connection to systemd. Dropped, it sends no more signs of life.
#[derive(Debug)]
pub(crate) struct Systemd {
    watchdog: Option<JoinHandle<()>>,
}

fn send(states: &[NotifyState<'_>]) {
    if let Err(error) = sd_notify::notify(states) {
        tracing::warn!(%error, "systemd could not be told");
    }
}

impl Systemd {
    /// Says that the host is ready, and from now on that it lives. `stands_still_ns` is for how long its cycles stand still.
    pub(crate) fn ready(stands_still_ns: impl Fn() -> u64 + Send + Sync + 'static, api: &str) -> Self {
        send(&[
            NotifyState::Ready,
            NotifyState::Status(&format!("running; API on {api}")),
        ]);
        let watchdog = sd_notify::watchdog_enabled().map(|limit| tokio::spawn(watch(limit, stands_still_ns)));
        Self { watchdog }
    }

    /// Says that the host stops. From here on the unit's `TimeoutStopSec` counts, so signs of life end only with the host.
    pub(crate) fn stopping(&self) {
        send(&[NotifyState::Stopping, NotifyState::Status("draining")]);
    }
}

impl Drop for Systemd {
    fn drop(&mut self) {
        if let Some(watchdog) = &self.watchdog {
            watchdog.abort();
        }
    }
}

/// May a sign of life be sent, where systemd waits for one for `limit`? Workers that have nothing to do come round each second.
fn lives(stands_still_ns: u64, limit: Duration) -> bool {
    let still = Duration::from_nanos(stands_still_ns);
    still <= (limit / 2).max(Duration::from_secs(2))
}

async fn watch(limit: Duration, stands_still_ns: impl Fn() -> u64) {
    let mut turns = tokio::time::interval((limit / SIGNS).max(Duration::from_millis(10)));
    turns.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    loop {
        turns.tick().await;
        let still_ns = stands_still_ns();
        if lives(still_ns, limit) {
            send(&[NotifyState::Watchdog]);
        } else {
            tracing::error!(
                still_ms = still_ns / 1_000_000,
                "a worker of the cycles hangs; systemd gets no sign of life"
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_worker_that_hangs_ends_the_signs_of_life() {
        let limit = Duration::from_secs(10);
        for (still_ms, wanted) in [(0, true), (1_100, true), (5_000, true), (5_001, false), (60_000, false)] {
            assert_eq!(lives(still_ms * 1_000_000, limit), wanted, "{still_ms}");
        }
        // Napping workers come round each second, however short systemd waits.
        assert!(lives(1_500_000_000, Duration::from_millis(500)));
    }
}
