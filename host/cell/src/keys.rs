//! Every key expression of the cell, built and parsed in one place.
//!
//! Owns: the shape of the key space. Never: sends or receives.
//!
//! ```text
//! bumpless/<cell>/host/<to>/<lane>/<from>     one host to one host: sample, answer, step, step-answer, ping, pong
//! bumpless/<cell>/host/<to>/request/<from>    a query that a host answers
//! bumpless/<cell>/record/<loop>               what the arbiter took, to all who listen
//! bumpless/<cell>/vitals/<host>               how a host is
//! bumpless/<cell>/notice/<host>               something changed at a host
//! bumpless/<cell>/claim/<host>                what hosts of one name say to each other
//! bumpless/<cell>/roll/<host>                 who is in the cell and where each listens, as a host knows it
//! bumpless/<cell>/alive/<host>/<instance>     liveliness token of one life of a host
//! bumpless/<cell>/open/<door>/<host>          what programs that are no hosts may ask (see `door`)
//! ```
//!
//! The cell is in every key, so cells that share a network do not hear each other. The sender is in the key, so it needs
//! no bytes in the message. Names hold no character that means something in a key expression.

use bumpless_core::{CellName, HostId, LoopId};
use serde::{Deserialize, Serialize};

use crate::error::{Error, cut};
use crate::limits::REPORTED_KEY_CHARS_MAX;

/// First part of every key.
pub const PREFIX: &str = "bumpless";

/// What goes from one host to one host.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Lane {
    /// A frozen cycle, home to owner.
    Sample,
    /// A commit, or why there is none; owner to home.
    Answer,
    /// A step, owner to replica.
    Step,
    /// Its effects, replica to owner.
    StepAnswer,
    /// Is anyone there, and how long does it take?
    Ping,
    /// Yes.
    Pong,
}

impl Lane {
    /// All of them.
    pub const ALL: [Self; 6] = [
        Self::Sample,
        Self::Answer,
        Self::Step,
        Self::StepAnswer,
        Self::Ping,
        Self::Pong,
    ];

    /// The part of the key.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Sample => "sample",
            Self::Answer => "answer",
            Self::Step => "step",
            Self::StepAnswer => "step-answer",
            Self::Ping => "ping",
            Self::Pong => "pong",
        }
    }

    fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|lane| lane.name() == name)
    }
}

/// One life of a host: 128 random bits in hexadecimal. The order of two says nothing of their age: a start's date would need clocks
/// that agree.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Instance(String);

impl Instance {
    /// From two numbers that no other process draws.
    #[must_use]
    pub fn new(high: u64, low: u64) -> Self {
        Self(format!("{high:016x}{low:016x}"))
    }

    fn parse(text: &str) -> Option<Self> {
        Some(Self(text.to_owned())).filter(Self::is_sound)
    }

    /// Is it one, where it came from outside?
    pub(crate) fn is_sound(&self) -> bool {
        let digits = self.0.bytes().all(|b| b.is_ascii_digit() || (b'a'..=b'f').contains(&b));
        self.0.len() == 32 && digits
    }

    /// As text: 32 hexadecimal digits.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

/// One key, taken apart.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Key {
    /// From one host to one host.
    Direct {
        /// Who receives.
        to: HostId,
        /// What.
        lane: Lane,
        /// Who sends.
        from: HostId,
    },
    /// A query from one host to one host.
    Request {
        /// Who is asked.
        to: HostId,
        /// Who asks.
        from: HostId,
    },
    /// The records of a loop.
    Record(LoopId),
    /// The vitals of a host.
    Vitals(HostId),
    /// The notices of a host.
    Notice(HostId),
    /// What hosts of this name say to each other.
    Claim(HostId),
    /// Who a host has met, and where each listens.
    Roll(HostId),
    /// The token of one life of a host.
    Alive(HostId, Instance),
}

/// The key space of one cell.
#[derive(Debug, Clone)]
pub struct Keys {
    cell: CellName,
}

impl Keys {
    /// Of this cell.
    #[must_use]
    pub const fn new(cell: CellName) -> Self {
        Self { cell }
    }

    /// The text of a key.
    #[must_use]
    pub fn build(&self, key: &Key) -> String {
        let cell = &self.cell;
        match key {
            Key::Direct { to, lane, from } => format!("{PREFIX}/{cell}/host/{to}/{}/{from}", lane.name()),
            Key::Request { to, from } => format!("{PREFIX}/{cell}/host/{to}/request/{from}"),
            Key::Record(id) => format!("{PREFIX}/{cell}/record/{id}"),
            Key::Vitals(host) => format!("{PREFIX}/{cell}/vitals/{host}"),
            Key::Notice(host) => format!("{PREFIX}/{cell}/notice/{host}"),
            Key::Claim(host) => format!("{PREFIX}/{cell}/claim/{host}"),
            Key::Roll(host) => format!("{PREFIX}/{cell}/roll/{host}"),
            Key::Alive(host, instance) => format!("{PREFIX}/{cell}/alive/{host}/{}", instance.0),
        }
    }

    /// A door of a host.
    pub(crate) fn door(&self, door: &str, host: &HostId) -> String {
        format!("{PREFIX}/{}/open/{door}/{host}", self.cell)
    }

    /// Takes a text apart.
    ///
    /// # Errors
    /// [`Error::Key`] says what is wrong with it: another cell, a part too many, a name that is none.
    pub fn parse(&self, text: &str) -> Result<Key, Error> {
        self.parse_parts(text).map_err(|reason| Error::Key {
            key: cut(text, REPORTED_KEY_CHARS_MAX),
            reason,
        })
    }

    fn parse_parts(&self, text: &str) -> Result<Key, &'static str> {
        let mut parts = text.split('/');
        let mut next = || parts.next().ok_or("it ends too early");
        if next()? != PREFIX {
            return Err("it does not begin with \"bumpless\"");
        }
        if next()? != self.cell.as_str() {
            return Err("it names another cell");
        }
        let key = match next()? {
            "host" => {
                let to = host(next()?)?;
                match next()? {
                    "request" => Key::Request {
                        to,
                        from: host(next()?)?,
                    },
                    lane => {
                        let lane = Lane::from_name(lane).ok_or("it names a lane that this host does not know")?;
                        Key::Direct {
                            to,
                            lane,
                            from: host(next()?)?,
                        }
                    }
                }
            }
            "record" => Key::Record(LoopId::new(next()?).map_err(|_| "the loop's name is no name")?),
            "vitals" => Key::Vitals(host(next()?)?),
            "notice" => Key::Notice(host(next()?)?),
            "claim" => Key::Claim(host(next()?)?),
            "roll" => Key::Roll(host(next()?)?),
            "alive" => {
                let id = host(next()?)?;
                Key::Alive(
                    id,
                    Instance::parse(next()?).ok_or("the instance is not 32 hexadecimal digits")?,
                )
            }
            _ => return Err("it names a kind that this host does not know"),
        };
        match parts.next() {
            Some(_) => Err("it has a part too many"),
            None => Ok(key),
        }
    }

    /// Every sender's messages to `to` on `lane`.
    #[must_use]
    pub fn to_host(&self, to: &HostId, lane: Lane) -> String {
        format!("{PREFIX}/{}/host/{to}/{}/*", self.cell, lane.name())
    }

    /// Every sender's requests to `to`.
    #[must_use]
    pub fn requests_to(&self, to: &HostId) -> String {
        format!("{PREFIX}/{}/host/{to}/request/*", self.cell)
    }

    /// Every loop's records.
    #[must_use]
    pub fn all_records(&self) -> String {
        format!("{PREFIX}/{}/record/*", self.cell)
    }

    /// Every host's vitals.
    #[must_use]
    pub fn all_vitals(&self) -> String {
        format!("{PREFIX}/{}/vitals/*", self.cell)
    }

    /// Every host's notices.
    #[must_use]
    pub fn all_notices(&self) -> String {
        format!("{PREFIX}/{}/notice/*", self.cell)
    }

    /// Every host's roll calls.
    #[must_use]
    pub fn all_rolls(&self) -> String {
        format!("{PREFIX}/{}/roll/*", self.cell)
    }

    /// Every token.
    #[must_use]
    pub fn all_alive(&self) -> String {
        format!("{PREFIX}/{}/alive/*/*", self.cell)
    }

    /// Every token of one host.
    #[must_use]
    pub fn lives_of(&self, id: &HostId) -> String {
        format!("{PREFIX}/{}/alive/{id}/*", self.cell)
    }
}

fn host(text: &str) -> Result<HostId, &'static str> {
    HostId::new(text).map_err(|_| "the host's name is no name")
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]

    use proptest::prelude::*;
    use zenoh::key_expr::KeyExpr;

    use super::*;

    fn keys() -> Keys {
        Keys::new(CellName::new("mill").unwrap())
    }

    fn any_key() -> impl Strategy<Value = Key> {
        let host = || "[a-z0-9_-][a-z0-9_.-]{0,63}".prop_map(|text| HostId::new(text).unwrap());
        let lane = prop::sample::select(&Lane::ALL[..]);
        prop_oneof![
            (host(), lane, host()).prop_map(|(to, lane, from)| Key::Direct { to, lane, from }),
            (host(), host()).prop_map(|(to, from)| Key::Request { to, from }),
            "[a-z0-9_-][a-z0-9_.-]{0,63}".prop_map(|text| Key::Record(LoopId::new(text).unwrap())),
            host().prop_map(Key::Vitals),
            host().prop_map(Key::Notice),
            host().prop_map(Key::Claim),
            host().prop_map(Key::Roll),
            (host(), any::<u64>(), any::<u64>()).prop_map(|(id, at, r)| Key::Alive(id, Instance::new(at, r))),
        ]
    }

    proptest! {
        #[test]
        fn every_key_comes_back_and_is_a_key_expression(key in any_key()) {
            let text = keys().build(&key);
            prop_assert_eq!(keys().parse(&text).unwrap(), key);
            prop_assert!(KeyExpr::try_from(text).is_ok());
        }

        #[test]
        fn any_text_is_parsed_or_refused(text in ".{0,80}", tail in "[a-z/*.-]{0,60}") {
            let _ = keys().parse(&text);
            let _ = keys().parse(&format!("bumpless/mill/{tail}"));
        }
    }

    #[test]
    fn subscriptions_meet_their_keys_and_no_other_cell() {
        let host = |text| HostId::new(text).unwrap();
        let meets = |wide: &str, key: &str| {
            KeyExpr::try_from(wide)
                .unwrap()
                .intersects(&KeyExpr::try_from(key).unwrap())
        };
        let (ours, theirs) = (keys(), Keys::new(CellName::new("mill-2").unwrap()));
        for lane in Lane::ALL {
            let wide = ours.to_host(&host("a"), lane);
            let key = Key::Direct {
                to: host("a"),
                lane,
                from: host("b"),
            };
            assert!(meets(&wide, &ours.build(&key)), "{wide}");
            assert!(!meets(&wide, &theirs.build(&key)), "{wide}");
            assert!(
                !meets(
                    &wide,
                    &ours.build(&Key::Direct {
                        to: host("c"),
                        lane,
                        from: host("b")
                    })
                ),
                "{wide}"
            );
            for other in Lane::ALL.into_iter().filter(|&other| other != lane) {
                assert!(!meets(
                    &wide,
                    &ours.build(&Key::Direct {
                        to: host("a"),
                        lane: other,
                        from: host("b")
                    })
                ));
            }
        }
        let token = Key::Alive(host("a"), Instance::new(1, 2));
        assert!(
            meets(&ours.all_alive(), &ours.build(&token)) && meets(&ours.lives_of(&host("a")), &ours.build(&token))
        );
        assert!(!meets(&ours.lives_of(&host("b")), &ours.build(&token)));
        assert!(meets(&ours.all_records(), "bumpless/mill/record/p1"));
        assert!(meets(&ours.all_vitals(), "bumpless/mill/vitals/a"));
        assert!(meets(&ours.all_notices(), "bumpless/mill/notice/a"));
    }

    #[test]
    fn bad_keys_are_refused_with_a_reason() {
        for (text, reason) in [
            ("", "begin with"),
            ("bumpless", "too early"),
            ("bumpless/other/record/p1", "another cell"),
            ("bumpless/mill/record", "too early"),
            ("bumpless/mill/record/P1", "loop's name"),
            ("bumpless/mill/record/p1/x", "too many"),
            ("bumpless/mill/host/a/sample", "too early"),
            ("bumpless/mill/host/a/sample/*", "host's name"),
            ("bumpless/mill/host/a/simple/b", "a lane"),
            ("bumpless/mill/alive/a/7", "32 hexadecimal"),
            ("bumpless/mill/gossip/a", "a kind"),
        ] {
            let error = keys().parse(text).expect_err(text).to_string();
            assert!(error.contains(reason), "{text}: {error}");
        }
    }
}
