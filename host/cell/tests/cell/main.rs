//! The bus with real sessions on loopback, several in this process.
//!
//! Owns: the harness that opens hosts and waits for what arrives. Never: sleeps to let something happen; a test waits for
//! the event, and a generous time-out makes it fail.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::needless_pass_by_value,
    reason = "tests"
)]

mod guarded;
mod joining;
mod lanes;
mod malformed;
mod nouns;
mod requests;

use std::{fmt::Debug, sync::Arc, time::Duration};

use bumpless_cell::{Arrival, Config, Error, Session};
use bumpless_core::{CellName, HostId};
use tokio::sync::mpsc;

use crate::nouns::host;

/// Longer than any of this takes on a busy machine; only a failure waits for it.
const PATIENCE: Duration = Duration::from_secs(30);
/// Arrivals that may wait for a test to look at them.
const ARRIVALS_MAX: usize = 65_536;

/// A host with a window on what reaches it.
pub(crate) struct Peer {
    pub(crate) session: Session,
    arrivals: mpsc::Receiver<Arrival>,
}

/// A host of the cell on a free loopback port.
pub(crate) fn config(cell: &str, name: &str, connect: &[&Peer]) -> Config {
    let mut config = Config::new(CellName::new(cell).unwrap(), host(name));
    config.connect = connect.iter().flat_map(|peer| peer.session.locators()).collect();
    config
}

impl Peer {
    pub(crate) async fn open(config: &Config) -> Result<Self, Error> {
        let (sender, arrivals) = mpsc::channel(ARRIVALS_MAX);
        let sink = Arc::new(move |arrival| {
            // Full or closed only when the test has failed or ended.
            let _ = sender.try_send(arrival);
        });
        Ok(Self {
            session: Session::open(config, sink).await?,
            arrivals,
        })
    }

    pub(crate) async fn join(cell: &str, name: &str, connect: &[&Self]) -> Self {
        Self::open(&config(cell, name, connect))
            .await
            .expect("the cell is joined")
    }

    /// The next arrival that `pick` takes; what comes before it is let go.
    pub(crate) async fn wait_for<T>(&mut self, what: &str, mut pick: impl FnMut(Arrival) -> Option<T>) -> T {
        let picked = async {
            while let Some(arrival) = self.arrivals.recv().await {
                if let Some(found) = pick(arrival) {
                    return found;
                }
            }
            panic!("the sink went away before {what} came");
        };
        tokio::time::timeout(PATIENCE, picked)
            .await
            .unwrap_or_else(|_| panic!("{what} did not come"))
    }

    pub(crate) async fn wait_up(&mut self, name: &str) {
        let wanted = host(name);
        self.wait_for(&format!("{name} up"), |arrival| match arrival {
            Arrival::HostUp(up) if up == wanted => Some(()),
            _ => None,
        })
        .await;
    }

    pub(crate) async fn wait_down(&mut self, name: &str) {
        let wanted = host(name);
        self.wait_for(&format!("{name} down"), |arrival| match arrival {
            Arrival::HostDown(down) if down == wanted => Some(()),
            _ => None,
        })
        .await;
    }

    /// Everything up to a notice with `last` from anyone, without comings and goings.
    pub(crate) async fn everything_before(&mut self, last: &[u8]) -> Vec<Arrival> {
        let mut before = Vec::new();
        self.wait_for("the last notice", |arrival| match arrival {
            Arrival::Notice { payload, .. } if payload == last => Some(()),
            Arrival::HostUp(_) | Arrival::HostDown(_) => None,
            other => {
                before.push(other);
                None
            }
        })
        .await;
        before
    }

    pub(crate) fn name(&self) -> &HostId {
        self.session.host()
    }
}

/// Two hosts that see each other.
pub(crate) async fn pair(cell: &str) -> (Peer, Peer) {
    let mut a = Peer::join(cell, "a", &[]).await;
    let mut b = Peer::join(cell, "b", &[&a]).await;
    a.wait_up("b").await;
    b.wait_up("a").await;
    (a, b)
}

/// The messages are equal, field by field, by their text.
#[track_caller]
pub(crate) fn same(found: &impl Debug, sent: &impl Debug) {
    assert_eq!(format!("{found:?}"), format!("{sent:?}"));
}
