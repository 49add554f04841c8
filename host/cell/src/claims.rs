//! Which of two hosts with one name stays: the one that joined first, by what passed on each one's own steady clock.
//!
//! Pure: claims in, a verdict out. Never: compares dates; reads a clock.
//!
//! ```text
//! a namesake's token ─► both say every 200 ms for how long they have been in the cell
//!    heard: the other for longer ─► leave
//!           for less, or as long ─► stay; after ten claims of a namesake that stays too, the greater instance leaves
//! ```
//! A claim takes time on its way, so each side hears the other as a little younger than it is. Both may then stay for a moment, and
//! never leave both: if A hears B as older than itself, B joined before A.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::{keys::Instance, wire::Letter};

/// Bytes of an encoded claim: a version, 32 digits and a number.
const CLAIM_BYTES_MAX: usize = 64;

/// Claims of a namesake after which neither can be said to be older: two seconds.
const EVEN_CLAIMS_MAX: u32 = 10;

/// Claims said to a namesake that is never heard: half a minute. It stands still, or is a token that outlives its host.
const UNHEARD_MAX: u32 = 150;

/// Namesakes at once; a name that more hosts have is a mistake that the first of them shows.
const NAMESAKES_MAX: usize = 16;

/// What one life of a host says to another that has its name.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Claim {
    /// Which life.
    pub(crate) instance: Instance,
    /// How long it has been in the cell, in µs of its own steady clock.
    pub(crate) joined_for_us: u64,
}

impl Letter for Claim {
    const NAME: &'static str = "claim to a name";
    const BYTES_MAX: usize = CLAIM_BYTES_MAX;
    fn check(&self) -> Result<(), String> {
        if self.instance.is_sound() {
            Ok(())
        } else {
            Err("its instance is not 32 hexadecimal digits".to_owned())
        }
    }
}

#[derive(Debug, Default)]
struct Namesake {
    heard: u32,
    /// Claims said since it was heard last.
    unheard: u32,
}

/// The namesakes that are there, as far as this host knows.
#[derive(Debug, Default)]
pub(crate) struct Claims {
    namesakes: BTreeMap<Instance, Namesake>,
    /// Somebody says this host's claims.
    speaking: bool,
    left: bool,
}

impl Claims {
    /// A namesake is there. True where somebody must begin to say this host's claims.
    pub(crate) fn appear(&mut self, other: &Instance) -> bool {
        if self.left {
            return false;
        }
        if self.namesakes.len() < NAMESAKES_MAX {
            self.namesakes.entry(other.clone()).or_default();
        }
        !std::mem::replace(&mut self.speaking, true)
    }

    /// It went.
    pub(crate) fn vanish(&mut self, other: &Instance) {
        self.namesakes.remove(other);
    }

    /// Must a claim be said now? Once false, [`Claims::appear`] begins anew.
    pub(crate) fn speak(&mut self) -> bool {
        for namesake in self.namesakes.values_mut() {
            namesake.unheard += 1;
        }
        self.namesakes.retain(|_, namesake| namesake.unheard <= UNHEARD_MAX);
        self.speaking = !self.left && !self.namesakes.is_empty();
        self.speaking
    }

    /// A namesake's claim, where this host has been in the cell for `joined_for_us`. True where this host must leave, once.
    pub(crate) fn hear(&mut self, own: &Instance, joined_for_us: u64, claim: &Claim) -> bool {
        if self.left || claim.instance == *own {
            return false;
        }
        let heard = self.namesakes.get_mut(&claim.instance).map_or(0, |namesake| {
            namesake.unheard = 0;
            namesake.heard = namesake.heard.saturating_add(1);
            namesake.heard
        });
        let even = heard > EVEN_CLAIMS_MAX && claim.instance < *own;
        self.left = claim.joined_for_us > joined_for_us || even;
        self.left
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn claim(number: u64, joined_for_us: u64) -> Claim {
        Claim {
            instance: Instance::new(0, number),
            joined_for_us,
        }
    }

    #[test]
    fn who_joined_first_stays_whatever_its_instance() {
        for (own, other) in [(1, 2), (2, 1)] {
            let (me, mut claims) = (Instance::new(0, own), Claims::default());
            assert!(claims.appear(&Instance::new(0, other)), "somebody must speak");
            assert!(!claims.appear(&Instance::new(0, other)), "and one is enough");
            assert!(claims.speak());
            assert!(!claims.hear(&me, 1_000_000, &claim(other, 999_990)), "it joined later");
            assert!(
                claims.hear(&me, 1_000_000, &claim(other, 1_000_010)),
                "it joined before"
            );
            assert!(
                !claims.hear(&me, 1_000_000, &claim(other, 2_000_000)),
                "left once is left"
            );
            assert!(!claims.speak() && !claims.appear(&Instance::new(0, other)));
        }
    }

    #[test]
    fn of_two_that_joined_at_once_exactly_one_leaves_in_the_end() {
        // Each hears the other 300 µs late, and so as younger.
        let (low, high) = (Instance::new(0, 1), Instance::new(0, 2));
        let (mut of_low, mut of_high) = (Claims::default(), Claims::default());
        of_low.appear(&high);
        of_high.appear(&low);
        let mut left = Vec::new();
        for round in 1..=20 {
            let now_us = round * 200_000;
            if of_low.speak() && of_high.hear(&high, now_us + 300, &claim(1, now_us)) {
                left.push("high");
            }
            if of_high.speak() && of_low.hear(&low, now_us + 300, &claim(2, now_us)) {
                left.push("low");
            }
        }
        assert_eq!(left, ["high"]);
    }

    #[test]
    fn nobody_speaks_for_ever_to_one_that_is_not_heard() {
        let mut claims = Claims::default();
        claims.appear(&Instance::new(0, 7));
        assert_eq!((0..1_000).filter(|_| claims.speak()).count(), UNHEARD_MAX as usize);
        assert!(claims.appear(&Instance::new(0, 7)), "it begins anew");
        claims.vanish(&Instance::new(0, 7));
        assert!(!claims.speak());
    }

    #[test]
    fn own_claims_and_bad_ones_count_for_nothing() {
        let (me, mut claims) = (Instance::new(0, 1), Claims::default());
        assert!(!claims.hear(&me, 5, &claim(1, 9)), "its own");
        let bytes = crate::wire::encode(&claim(2, u64::MAX)).map(|bytes| bytes.len());
        assert!(bytes.is_ok_and(|bytes| bytes <= CLAIM_BYTES_MAX));
        let forged: Result<Claim, _> = crate::wire::decode(&[crate::wire::VERSION, 1, b'x', 0]);
        assert!(forged.is_err_and(|error| error.to_string().contains("32 hexadecimal digits")));
    }
}
