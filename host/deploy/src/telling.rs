//! What this host tells all others by itself: how it is, and how far its copies of library and intents are.
//!
//! ```text
//! every 200 ms: measured ─► what others act on changed, or the pause is over? ─► told to all
//! ```
//! The pauses grow with the cell ([`chatter`]). Never: asks; waits for anybody.

use std::{
    sync::{Arc, atomic::Ordering},
    time::{Duration, Instant},
};

use bumpless_cell::{Probe, Vitals};
use bumpless_core::chatter::{self, STANDING_NS_MIN, VITALS_NS_MIN};

use crate::{
    beat::every,
    limits::VITALS_EVERY,
    room::Room,
    wire::{self, Notice},
};

/// When this host last told what.
#[derive(Debug, Default)]
pub(crate) struct LastTold {
    vitals: Option<(Instant, Vitals)>,
    standing: Option<Instant>,
}

/// Is there something in these vitals that others act on, and that they were not told?
fn is_news(before: &Vitals, now: &Vitals) -> bool {
    let acted_on = |v: &Vitals| (v.roles, v.draining, v.drain_kept, v.loops_owned, v.loops_held);
    acted_on(before) != acted_on(now) || before.ready != now.ready || before.labels != now.labels
}

impl LastTold {
    fn is_vitals_due(&self, vitals: &Vitals, hosts: usize, now: Instant) -> bool {
        let pause = Duration::from_nanos(chatter::pause_ns(VITALS_NS_MIN, hosts));
        // The beat is as long as the shortest pause; a beat that came a little early is meant all the same.
        self.vitals.as_ref().is_none_or(|(at, before)| {
            now.saturating_duration_since(*at) + VITALS_EVERY / 2 >= pause || is_news(before, vitals)
        })
    }

    fn is_standing_due(&self, hosts: usize, now: Instant) -> bool {
        let pause = Duration::from_nanos(chatter::pause_ns(STANDING_NS_MIN, hosts));
        self.standing
            .is_none_or(|at| now.saturating_duration_since(at) + VITALS_EVERY / 2 >= pause)
    }
}

impl Room {
    /// Tells all hosts. What is lost is found by the next comparison.
    pub(crate) fn announce(&self, notice: &Notice) {
        match wire::encode(notice) {
            Ok(bytes) => self.session.publish_notice(&bytes),
            Err(error) => tracing::warn!(%error, "a notice was not sent"),
        }
    }

    /// Tells all hosts how far this one is, so that they compare.
    pub(crate) fn announce_standing(&self) {
        self.told.lock().standing = Some(Instant::now());
        self.announce(&Notice::Standing {
            library: self.library_mark(),
            intents: self.intents_mark(),
        });
    }

    /// The same where it was not told for as long as the cell's size asks for.
    pub(crate) fn announce_standing_when_due(&self) {
        let hosts = self.session.hosts().len();
        if self.told.lock().is_standing_due(hosts, Instant::now()) {
            self.announce_standing();
        }
    }

    pub(crate) async fn tell_vitals(room: Arc<Self>, mut probe: Probe) {
        let mut tick = every(VITALS_EVERY);
        loop {
            tick.tick().await;
            let measured = probe.sample();
            {
                let mut own = room.own.lock();
                own.cpu = measured.cpu;
                own.cpu_process = measured.cpu_process;
                own.memory_bytes = measured.memory_bytes;
            }
            let (vitals, hosts) = (room.vitals(), room.session.hosts().len());
            if room.told.lock().is_vitals_due(&vitals, hosts, Instant::now()) {
                room.session.publish_vitals(&vitals);
                room.told.lock().vitals = Some((Instant::now(), vitals.clone()));
            }
            room.take_own(vitals);
        }
    }

    pub(crate) fn tell_vitals_now(&self) {
        let vitals = self.vitals();
        self.session.publish_vitals(&vitals);
        self.told.lock().vitals = Some((Instant::now(), vitals.clone()));
        self.take_own(vitals);
    }

    fn vitals(&self) -> Vitals {
        let mut own = self.own.lock();
        own.seq += 1;
        own.unix_ms = self.clock.unix_ms();
        own.ready = self.bench.ready();
        own.loops_owned = self.field.owned();
        own.loops_held = u32::try_from(self.holder.len()).unwrap_or(u32::MAX);
        own.draining = self.is_draining();
        own.drain_kept = self.drain_kept.load(Ordering::Acquire);
        own.clone()
    }

    /// What this host knows of itself.
    fn take_own(&self, vitals: Vitals) {
        self.field.set_host(&vitals);
        if self.roster.vitals(vitals) {
            self.poke();
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use bumpless_core::{Digest, HostId};

    use super::*;

    #[test]
    fn the_pause_grows_with_the_cell_and_news_does_not_wait() {
        let vitals = crate::roster::test_vitals(&HostId::new("a").unwrap());
        let start = Instant::now();
        let mut told = LastTold::default();
        assert!(
            told.is_vitals_due(&vitals, 1_000, start) && told.is_standing_due(1_000, start),
            "a first word"
        );
        (told.vitals, told.standing) = (Some((start, vitals.clone())), Some(start));
        for (hosts, vitals_ms, standing_ms) in [
            (2, 200, 1_000),
            (11, 200, 1_000),
            (101, 2_000, 2_000),
            (1_001, 20_000, 20_000),
        ] {
            let at = |ms: u64| start + Duration::from_millis(ms);
            assert!(!told.is_vitals_due(&vitals, hosts, at(vitals_ms / 2 - 1)), "{hosts}");
            assert!(told.is_vitals_due(&vitals, hosts, at(vitals_ms)), "{hosts}");
            assert!(!told.is_standing_due(hosts, at(standing_ms / 2 - 1)), "{hosts}");
            assert!(told.is_standing_due(hosts, at(standing_ms)), "{hosts}");
        }
        type Edit = fn(&mut Vitals);
        let edits: [(Edit, bool); 5] = [
            (|v| v.ready.push(Digest::of(b"x")), true),
            (|v| v.draining = true, true),
            (|v| v.loops_owned = 1, true),
            (|v| v.cpu = 0.9, false),
            (|v| v.seq = 9, false),
        ];
        for (edit, news) in edits {
            let mut now = vitals.clone();
            edit(&mut now);
            assert_eq!(told.is_vitals_due(&now, 1_000, start), news);
        }
    }
}
