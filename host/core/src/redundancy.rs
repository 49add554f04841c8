//! How many replicas a loop has left, and how they voted: part of every record, so that whoever reads one knows, and an
//! owner that takes over goes on from it.
//!
//! Never: decides who may step (`select`), or counts votes (`vote`).

use serde::{Deserialize, Serialize};

use crate::{name::HostId, record::Event};

/// What a cycle could count on.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
pub struct Redundancy {
    /// Replicas that could step, the owner itself among them; under a vote, those with a vote. 0 to 16.
    pub have: u8,
    /// Replicas that the loop asks for; under a vote, the number of votes. 0 where no cycle ran yet.
    pub want: u8,
    /// The vote's standing; none where the strategy is another.
    pub vote: Option<Standing>,
}

/// How the latest vote went, and who has none.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
pub struct Standing {
    /// Answers that counted in the cycle; 0 where it was not voted on, as in the cycle of a change.
    pub answers: u8,
    /// Of these, equal to the one that was taken.
    pub agreed: u8,
    /// Equal answers that were needed.
    pub needed: u8,
    /// Answers against a majority since the loop began.
    pub dissents: u64,
    /// Replicas that step along without a vote, longest first; at most 16.
    pub aside: Vec<Aside>,
}

/// A replica without a vote.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Aside {
    /// The host.
    pub host: HostId,
    /// Steps in a row that agreed with the majority.
    pub clean: u32,
    /// Answers against a majority since it was set aside, with the one that did it.
    pub dissents: u32,
}

impl Redundancy {
    /// Is every replica there that the loop asks for?
    #[must_use]
    pub const fn whole(&self) -> bool {
        self.have >= self.want
    }

    /// What people should hear of, going from the record before to this one. Coming back in part is no news.
    #[must_use]
    pub fn news(&self, before: Option<&Self>) -> Option<Event> {
        let before = before.filter(|b| b.want > 0);
        let fewer = before.is_none_or(|b| self.have < b.have || b.whole());
        match (self.whole(), before) {
            (false, _) if fewer => Some(Event::RedundancyLost {
                have: self.have,
                want: self.want,
            }),
            (true, Some(b)) if !b.whole() => Some(Event::RedundancyRestored { want: self.want }),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(have: u8, want: u8) -> Redundancy {
        Redundancy { have, want, vote: None }
    }

    #[test]
    fn each_loss_is_told_once_and_the_return_when_it_is_whole() {
        let lost = |have, want| Some(Event::RedundancyLost { have, want });
        for (before, now, news) in [
            (None, of(3, 3), None),
            (None, of(1, 3), lost(1, 3)),
            (Some(of(0, 0)), of(1, 3), lost(1, 3)),
            (Some(of(3, 3)), of(3, 3), None),
            (Some(of(3, 3)), of(2, 3), lost(2, 3)),
            (Some(of(2, 3)), of(2, 3), None),
            (Some(of(2, 3)), of(1, 3), lost(1, 3)),
            (Some(of(1, 3)), of(2, 3), None),
            (Some(of(2, 3)), of(3, 3), Some(Event::RedundancyRestored { want: 3 })),
            (Some(of(2, 2)), of(2, 3), lost(2, 3)),
        ] {
            assert_eq!(now.news(before.as_ref()), news, "{before:?} to {now:?}");
        }
    }
}
