//! When the host that a loop prefers may have the loop back: not at once, and the later the more often it failed.
//!
//! Pure: looks in, a verdict out. Owns the count of a host's failures with one loop. Never: moves anything; the home does.
//!
//! ```text
//!            well                 well for wait(failures)
//!  away ───────────► waiting(since) ──────────────────────► "return" ──moved──► owner
//!    ▲ ◄───────────────── │                                                       │
//!    └── away ────────────┴──────────────◄── lost it without an order: failures+1 ┘
//!
//!  wait(n) = 5 s · 2ⁿ, at most 5 min; each 2 min as an owner take one failure back
//! ```
//! A host that comes and goes, and one that is slow but not dead, so that ownership is taken from it again and again, are the
//! same to the damping: either loses the loop without an order.

/// Shortest time that a preferred host must have been well before it gets a loop back, in ns: long enough for a host that
/// just started to have its components ready and its caches warm.
pub const RETURN_NS_MIN: u64 = 5_000_000_000;
/// Longest such time, in ns.
pub const RETURN_NS_MAX: u64 = 300_000_000_000;
/// Time as an owner that takes one failure back, in ns.
pub const FORGIVE_NS: u64 = 120_000_000_000;

/// How the preferred host is, at one look.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Standing {
    /// Not there, or not ready to step the revision in force.
    Away,
    /// On its way out in good order: it is drained, or a person moved the loop. It loses nothing by that.
    Excused,
    /// There and ready, while another host owns the loop.
    Ready,
    /// It owns the loop.
    Owner,
}

/// What to do after a look.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// Nothing.
    Stay,
    /// Look again then, in ns.
    LookAt(u64),
    /// Move the loop to it, between two cycles.
    Return,
}

/// One loop's memory of the host that it prefers. Times are ns of one steady clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Damping {
    failures: u32,
    ready_since_ns: Option<u64>,
    owner_since_ns: Option<u64>,
}

impl Damping {
    /// Takes a look at `now_ns`; looks come in their order.
    pub fn look(&mut self, now_ns: u64, standing: Standing) -> Verdict {
        match standing {
            Standing::Owner => {
                self.ready_since_ns = None;
                let since_ns = *self.owner_since_ns.get_or_insert(now_ns);
                if now_ns.saturating_sub(since_ns) >= FORGIVE_NS {
                    self.failures = self.failures.saturating_sub(1);
                    self.owner_since_ns = Some(now_ns);
                }
                Verdict::Stay
            }
            Standing::Excused => {
                self.owner_since_ns = None;
                self.ready_since_ns = None;
                Verdict::Stay
            }
            Standing::Away => {
                self.count_loss();
                self.ready_since_ns = None;
                Verdict::Stay
            }
            Standing::Ready => {
                self.count_loss();
                let since_ns = *self.ready_since_ns.get_or_insert(now_ns);
                let at_ns = since_ns.saturating_add(self.wait_ns());
                if now_ns >= at_ns {
                    Verdict::Return
                } else {
                    Verdict::LookAt(at_ns)
                }
            }
        }
    }

    /// How long it must be well now, in ns.
    #[must_use]
    pub fn wait_ns(&self) -> u64 {
        // 5 s · 2⁶ is beyond the longest wait already.
        (RETURN_NS_MIN << self.failures.min(6)).min(RETURN_NS_MAX)
    }

    fn count_loss(&mut self) {
        if self.owner_since_ns.take().is_some() {
            self.failures = self.failures.saturating_add(1);
            self.ready_since_ns = None;
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const S: u64 = 1_000_000_000;

    #[test]
    fn a_host_that_came_back_waits_and_one_that_flaps_waits_longer() {
        let mut damping = Damping::default();
        assert_eq!(damping.look(0, Standing::Ready), Verdict::LookAt(5 * S));
        assert_eq!(
            damping.look(3 * S, Standing::Away),
            Verdict::Stay,
            "gone before its time"
        );
        assert_eq!(
            damping.look(4 * S, Standing::Ready),
            Verdict::LookAt(9 * S),
            "the wait begins anew"
        );
        assert_eq!(damping.look(9 * S, Standing::Ready), Verdict::Return);
        let mut now = 10 * S;
        for wait in [10, 20, 40, 80, 160, 300, 300] {
            assert_eq!(damping.look(now, Standing::Owner), Verdict::Stay);
            // Slow, so that the ownership is taken from it, while it is there all the time.
            assert_eq!(
                damping.look(now + S, Standing::Ready),
                Verdict::LookAt(now + S + wait * S)
            );
            now += S + wait * S;
            assert_eq!(damping.look(now, Standing::Ready), Verdict::Return);
        }
    }

    #[test]
    fn good_order_costs_nothing_and_good_service_forgives() {
        let mut damping = Damping::default();
        damping.look(0, Standing::Owner);
        damping.look(S, Standing::Excused);
        assert_eq!(damping.look(2 * S, Standing::Ready), Verdict::LookAt(7 * S));
        damping.look(8 * S, Standing::Owner);
        damping.look(9 * S, Standing::Away);
        assert_eq!(damping.wait_ns(), 10 * S);
        for n in 0..=4 {
            damping.look(10 * S + n * 60 * S, Standing::Owner);
        }
        assert_eq!(damping.wait_ns(), 5 * S);
    }

    proptest! {
        /// However a host behaves: it is never given the loop within five seconds of the last time that it was not ready, and
        /// the wait is never longer than five minutes.
        #[test]
        fn never_early_and_never_for_ever(looks in prop::collection::vec((0u64..20, 0u8..4), 1..300)) {
            let (mut damping, mut now, mut not_ready) = (Damping::default(), 0, 0);
            for (after, standing) in looks {
                now += after * S;
                let standing = [Standing::Away, Standing::Excused, Standing::Ready, Standing::Owner][usize::from(standing)];
                let verdict = damping.look(now, standing);
                if standing != Standing::Ready {
                    prop_assert_eq!(verdict, Verdict::Stay);
                    not_ready = now;
                }
                match verdict {
                    Verdict::Return => prop_assert!(now >= not_ready + RETURN_NS_MIN),
                    Verdict::LookAt(at) => prop_assert!(at > now && at <= now + RETURN_NS_MAX),
                    Verdict::Stay => {}
                }
            }
        }
    }
}
