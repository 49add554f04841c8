//! When a loop goes back to a host that it prefers: once that host has been well for some time, and the later the more
//! often it failed.
//!
//! Owns: what one loop remembers of the hosts that it prefers. The waiting itself is the core's ([`damping`]). Never: moves a
//! loop away from where a person put it; takes a loop from an owner for one that it prefers no more than that.

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

use bumpless_core::{
    HostId,
    damping::{self, Damping, Verdict},
    place::Candidate,
};

/// Hosts that one loop remembers; those of its eight words, and as many again.
const REMEMBERED_MAX: usize = 16;

/// How long a person's move may take to be seen.
const SENT_WAIT: Duration = Duration::from_secs(5);

/// What a home sees of one loop.
pub(crate) struct Look<'a> {
    /// Hosts that may hold it.
    pub(crate) candidates: &'a [Candidate],
    /// What it prefers.
    pub(crate) prefer: &'a [String],
    /// Its members, best first.
    pub(crate) members: &'a [HostId],
    /// Its owner now.
    pub(crate) owner: Option<&'a HostId>,
    /// Can a host step the revision in force?
    pub(crate) ready: &'a dyn Fn(&HostId) -> bool,
    /// Is a host being emptied?
    pub(crate) draining: &'a dyn Fn(&HostId) -> bool,
}

/// One loop's memory.
#[derive(Debug, Clone, Default)]
pub(crate) struct Favourites {
    hosts: BTreeMap<HostId, Damping>,
    /// A person moved the loop there.
    sent: Option<(HostId, Instant)>,
}

impl Favourites {
    /// A person moved the loop; there it stays for as long as that host owns it.
    pub(crate) fn sent(&mut self, to: HostId, now: Instant) {
        self.sent = Some((to, now));
    }

    /// Looks, and says to which host the loop shall move now.
    pub(crate) fn look(&mut self, now_ns: u64, now: Instant, look: &Look<'_>) -> Option<HostId> {
        if let Some((to, since)) = &self.sent
            && look.owner != Some(to)
            && now.saturating_duration_since(*since) > SENT_WAIT
        {
            self.sent = None;
        }
        let preference = |host: &HostId| {
            let candidate = look.candidates.iter().find(|c| c.host == *host);
            candidate.map_or(look.prefer.len(), |c| c.preference(look.prefer))
        };
        for candidate in look.candidates {
            if candidate.preference(look.prefer) < look.prefer.len() && self.hosts.len() < REMEMBERED_MAX {
                self.hosts.entry(candidate.host.clone()).or_default();
            }
        }
        let owners = look.owner.map_or(usize::MAX, preference);
        let mut back: Option<(usize, HostId)> = None;
        for (host, damping) in &mut self.hosts {
            let own = preference(host);
            let standing = if look.owner == Some(host) {
                damping::Standing::Owner
            } else if (look.draining)(host) || self.sent.is_some() || own >= owners && look.members.contains(host) {
                damping::Standing::Excused
            } else if look.members.contains(host) && (look.ready)(host) {
                damping::Standing::Ready
            } else {
                damping::Standing::Away
            };
            if damping.look(now_ns, standing) == Verdict::Return
                && own < owners
                && back.as_ref().is_none_or(|(best, _)| own < *best)
            {
                back = Some((own, host.clone()));
            }
        }
        // A host that is gone and never failed is nothing to remember.
        self.hosts
            .retain(|host, damping| *damping != Damping::default() || preference(host) < look.prefer.len());
        back.map(|(_, host)| host)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    const S: u64 = 1_000_000_000;

    fn name(host: &str) -> HostId {
        HostId::new(host).unwrap()
    }

    /// Looks once a second; gives the second and the host of the first return. A capital is a host that drains.
    fn first_return(
        favourites: &mut Favourites,
        seconds: std::ops::Range<u64>,
        there: &str,
        owner: &str,
        prefer: &[&str],
    ) -> Option<(u64, String)> {
        let now = Instant::now();
        let prefer: Vec<String> = prefer.iter().map(ToString::to_string).collect();
        let staying: Vec<HostId> = there
            .chars()
            .filter(char::is_ascii_lowercase)
            .map(|c| name(&c.to_string()))
            .collect();
        let candidates: Vec<Candidate> = staying
            .iter()
            .map(|host| Candidate {
                host: host.clone(),
                labels: if host.as_str() == "c" {
                    vec!["east".to_owned()]
                } else {
                    vec![]
                },
            })
            .collect();
        for second in seconds {
            let look = Look {
                candidates: &candidates,
                prefer: &prefer,
                members: &staying,
                owner: Some(&name(owner)),
                ready: &|_| true,
                draining: &|host| there.contains(&host.as_str().to_uppercase()),
            };
            if let Some(host) = favourites.look(second * S, now + Duration::from_secs(second), &look) {
                return Some((second, host.to_string()));
            }
        }
        None
    }

    #[test]
    fn the_preferred_host_gets_its_loop_back_after_a_while() {
        let mut favourites = Favourites::default();
        assert_eq!(first_return(&mut favourites, 0..60, "bc", "b", &["a"]), None);
        let back = first_return(&mut favourites, 60..90, "abc", "b", &["a"]);
        assert_eq!(back, Some((65, "a".to_owned())), "five seconds after it came");
        assert_eq!(first_return(&mut favourites, 66..90, "abc", "a", &["a"]), None);
        // It dies, and comes again: twice as long.
        assert_eq!(first_return(&mut favourites, 90..95, "bc", "b", &["a"]), None);
        let back = first_return(&mut favourites, 95..200, "abc", "b", &["a"]);
        assert_eq!(back, Some((105, "a".to_owned())));
    }

    #[test]
    fn a_drained_host_and_a_persons_move_are_no_failures() {
        let mut favourites = Favourites::default();
        assert_eq!(first_return(&mut favourites, 0..10, "abc", "a", &["a"]), None);
        assert_eq!(first_return(&mut favourites, 10..20, "Abc", "b", &["a"]), None);
        let back = first_return(&mut favourites, 20..60, "abc", "b", &["a"]);
        assert_eq!(back, Some((25, "a".to_owned())));
        assert_eq!(first_return(&mut favourites, 26..30, "abc", "a", &["a"]), None);
        favourites.sent(name("b"), Instant::now() + Duration::from_secs(30));
        assert_eq!(
            first_return(&mut favourites, 30..500, "abc", "b", &["a"]),
            None,
            "there it stays"
        );
        let back = first_return(&mut favourites, 500..560, "abc", "c", &["a"]);
        assert_eq!(back, Some((505, "a".to_owned())), "until that host has lost it");
    }

    #[test]
    fn of_several_the_best_and_never_one_that_is_no_better() {
        let mut favourites = Favourites::default();
        assert_eq!(
            first_return(&mut favourites, 0..60, "abc", "b", &["east", "a"]),
            Some((5, "c".to_owned()))
        );
        assert_eq!(
            first_return(&mut Favourites::default(), 0..60, "abc", "c", &["east", "a"]),
            None
        );
        assert_eq!(first_return(&mut Favourites::default(), 0..60, "ab", "b", &[]), None);
        let all_alike = first_return(&mut Favourites::default(), 0..60, "ab", "b", &["b", "a"]);
        assert_eq!(all_alike, None);
    }
}
