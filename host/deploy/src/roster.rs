//! Who is there, and how they are.
//!
//! Owns: liveliness and the latest vitals of each host, this one included.
//! Two lives of one host are told apart by what they say of their start, and not put in order by it: their machine's date
//! may have gone back between them.
//! Never: asks anybody. Liveliness alone decides who is there: vitals that are late say that a host is busy.
//!
//! ```text
//! unknown ──up──► there ──vitals──► there, known ──down──► gone (shown for ten minutes) ──► unknown
//! ```

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

use bumpless_cell::Vitals;
use bumpless_core::{
    HostId,
    chatter::{VITALS_MISSED_MAX, VITALS_NS_MIN, pause_ns},
    place::Candidate,
};
use parking_lot::Mutex;

use crate::{
    error::Error,
    limits::{GONE_SHOWN, HOSTS_MAX},
};

/// One host.
#[derive(Debug, Clone)]
pub(crate) struct Seen {
    pub(crate) there: bool,
    pub(crate) vitals: Option<Vitals>,
    pub(crate) changed: Instant,
    /// Start of the life before the present one, in ms of its own date: what it still sends counts no more.
    life_before: Option<u64>,
}

impl Seen {
    /// There, and heard of lately, for a cell of so many hosts.
    pub(crate) fn alive(&self, now: Instant, hosts: usize) -> bool {
        let missed = Duration::from_nanos(pause_ns(VITALS_NS_MIN, hosts).saturating_mul(VITALS_MISSED_MAX));
        self.there && self.vitals.is_some() && now.saturating_duration_since(self.changed) < missed
    }
}

/// All hosts.
#[derive(Debug)]
pub(crate) struct Roster {
    here: HostId,
    seen: Mutex<BTreeMap<HostId, Seen>>,
}

impl Roster {
    /// This host alone.
    pub(crate) fn new(own: Vitals) -> Self {
        let here = own.host.clone();
        let seen = Seen {
            there: true,
            vitals: Some(own),
            changed: Instant::now(),
            life_before: None,
        };
        Self {
            seen: Mutex::new(BTreeMap::from([(here.clone(), seen)])),
            here,
        }
    }

    fn change(&self, host: &HostId, edit: impl FnOnce(&mut Seen) -> bool) -> bool {
        let mut seen = self.seen.lock();
        let now = Instant::now();
        if !seen.contains_key(host) {
            seen.retain(|_, s| s.there || now.saturating_duration_since(s.changed) < GONE_SHOWN);
            if seen.len() >= HOSTS_MAX {
                return false;
            }
        }
        let entry = seen.entry(host.clone()).or_insert(Seen {
            there: false,
            vitals: None,
            changed: now,
            life_before: None,
        });
        entry.changed = now;
        edit(entry)
    }

    /// A host came. Says whether that was news.
    pub(crate) fn up(&self, host: &HostId) -> bool {
        self.change(host, |seen| !std::mem::replace(&mut seen.there, true))
    }

    /// A host went. Says whether that was news.
    pub(crate) fn down(&self, host: &HostId) -> bool {
        *host != self.here && self.change(host, |seen| std::mem::replace(&mut seen.there, false))
    }

    /// How a host is. Says whether its part in placement changed.
    pub(crate) fn vitals(&self, vitals: Vitals) -> bool {
        let host = vitals.host.clone();
        self.change(&host, |seen| {
            if let Some(old) = &seen.vitals {
                if old.started_at_ms == vitals.started_at_ms {
                    // Of one life the later counts.
                    if old.seq > vitals.seq {
                        return false;
                    }
                } else if seen.life_before == Some(vitals.started_at_ms) {
                    return false;
                } else {
                    seen.life_before = Some(old.started_at_ms);
                }
            }
            let part = |v: &Vitals| (v.roles, v.draining, v.labels.clone());
            let news = seen.vitals.as_ref().map(part) != Some(part(&vitals));
            seen.vitals = Some(vitals);
            news
        })
    }

    /// Everyone that is shown, by name.
    pub(crate) fn all(&self) -> Vec<(HostId, Seen)> {
        self.seen.lock().iter().map(|(h, s)| (h.clone(), s.clone())).collect()
    }

    /// Is there a host of that name, be it gone?
    ///
    /// # Errors
    /// [`Error::NotFound`].
    pub(crate) fn known(&self, host: &HostId) -> Result<(), Error> {
        if self.seen.lock().contains_key(host) {
            return Ok(());
        }
        Err(Error::not_found(
            format!("no host of the cell is named {host}"),
            "list the hosts for their names",
        ))
    }

    /// Is the host there?
    pub(crate) fn there(&self, host: &HostId) -> bool {
        self.seen.lock().get(host).is_some_and(|s| s.there)
    }

    /// Hosts that are there, other than this one.
    pub(crate) fn others(&self) -> Vec<HostId> {
        let seen = self.seen.lock();
        seen.iter()
            .filter(|(h, s)| s.there && **h != self.here)
            .map(|(h, _)| h.clone())
            .collect()
    }

    /// Hosts that serve points, this one included.
    pub(crate) fn with_io(&self) -> Vec<HostId> {
        self.filter(|v| v.roles.io)
    }

    /// Hosts that may hold loops: there, with the role, not being emptied. Where only hosts that are being emptied are
    /// left, those: a loop that runs on a leaving host is better than one that does not run.
    pub(crate) fn eligible(&self) -> Vec<Candidate> {
        let mut all: Vec<(Candidate, bool)> = {
            let seen = self.seen.lock();
            let there = seen.iter().filter(|(_, s)| s.there);
            let known = there.filter_map(|(h, s)| s.vitals.as_ref().map(|v| (h, v)));
            let candidate = |(host, vitals): (&HostId, &Vitals)| {
                let candidate = Candidate {
                    host: host.clone(),
                    labels: vitals.labels.clone(),
                };
                (candidate, vitals.draining)
            };
            known.filter(|(_, v)| v.roles.control).map(candidate).collect()
        };
        if all.iter().any(|(_, draining)| !draining) {
            all.retain(|(_, draining)| !draining);
        }
        all.into_iter().map(|(candidate, _)| candidate).collect()
    }

    /// Is the host being emptied, as far as it said?
    pub(crate) fn draining(&self, host: &HostId) -> bool {
        let seen = self.seen.lock();
        let vitals = seen.get(host).and_then(|s| s.vitals.as_ref());
        vitals.is_some_and(|v| v.draining)
    }

    fn filter(&self, wanted: impl Fn(&Vitals) -> bool) -> Vec<HostId> {
        let seen = self.seen.lock();
        let good = |s: &Seen| s.there && s.vitals.as_ref().is_some_and(&wanted);
        seen.iter().filter(|(_, s)| good(s)).map(|(h, _)| h.clone()).collect()
    }
}

/// Twice the pause for each failure, within bounds.
pub(crate) fn back_off(tries: u32) -> Duration {
    let (least, most) = crate::limits::BACK_OFF;
    least.saturating_mul(1 << tries.saturating_sub(1).min(16)).min(most)
}

/// Vitals of a host of which nothing is known.
#[cfg(test)]
pub(crate) fn test_vitals(host: &HostId) -> Vitals {
    Vitals {
        host: host.clone(),
        seq: 0,
        started_at_ms: 1,
        roles: bumpless_cell::Roles::default(),
        api: None,
        cpu: 0.0,
        cpu_process: 0.0,
        memory_bytes: 0,
        ready: Vec::new(),
        loops_owned: 0,
        loops_held: 0,
        draining: false,
        drain_kept: false,
        unix_ms: 0,
        labels: Vec::new(),
        version: String::new(),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use bumpless_cell::Roles;

    use super::*;

    fn vitals(host: &str, seq: u64, draining: bool) -> Vitals {
        Vitals {
            seq,
            roles: Roles {
                io: host == "io",
                control: host != "io",
            },
            draining,
            ..test_vitals(&HostId::new(host).unwrap())
        }
    }

    #[test]
    fn liveliness_decides_and_draining_hosts_are_the_last_resort() {
        let name = |h: &str| HostId::new(h).unwrap();
        let roster = Roster::new(vitals("io", 1, false));
        let eligible = |roster: &Roster| -> Vec<HostId> { roster.eligible().into_iter().map(|c| c.host).collect() };
        assert_eq!((roster.with_io(), eligible(&roster)), (vec![name("io")], vec![]));
        roster.vitals(vitals("a", 1, false));
        assert!(eligible(&roster).is_empty(), "vitals alone do not make a host be there");
        assert!(roster.up(&name("a")) && !roster.up(&name("a")));
        assert!(roster.up(&name("b")) && roster.vitals(vitals("b", 5, false)));
        assert_eq!(eligible(&roster), [name("a"), name("b")]);
        assert!(roster.vitals(vitals("b", 6, true)), "draining is news");
        assert!(!roster.vitals(vitals("b", 5, false)), "older vitals are not");
        assert_eq!(eligible(&roster), [name("a")]);
        assert!(roster.down(&name("a")) && !roster.down(&name("a")));
        assert_eq!(eligible(&roster), [name("b")]);
        assert!(!roster.down(&name("io")), "this host never goes");
        assert_eq!(roster.others(), [name("b")]);
    }

    #[test]
    fn a_life_whose_date_went_back_is_believed_and_the_life_before_is_not() {
        let name = |h: &str| HostId::new(h).unwrap();
        let life = |started_at_ms, seq, draining| Vitals {
            started_at_ms,
            ..vitals("b", seq, draining)
        };
        let roster = Roster::new(vitals("a", 1, false));
        roster.up(&name("b"));
        let draining = || roster.draining(&name("b"));
        // A day passes, and the host stops in good order.
        roster.vitals(life(86_400_000, 900, true));
        assert!(draining());
        roster.down(&name("b"));
        // It comes back with its date a day earlier.
        roster.up(&name("b"));
        assert!(roster.vitals(life(5, 1, false)));
        assert!(!draining(), "what the new life says counts");
        assert!(
            !roster.vitals(life(86_400_000, 901, true)),
            "what the old one still sent comes too late"
        );
        assert!(!draining());
        // And again, to a date before that of the first life.
        assert!(roster.vitals(life(3, 1, true)) && draining());
        assert!(!roster.vitals(life(5, 2, false)) && draining());
    }

    #[test]
    fn pauses_double_up_to_a_minute() {
        let ms: Vec<u128> = [1, 2, 3, 8, 40].map(|n| back_off(n).as_millis()).to_vec();
        assert_eq!(ms, [500, 1_000, 2_000, 60_000, 60_000]);
    }
}
