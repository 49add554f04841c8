//! Alarms: what stands, what a person has seen, what is kept quiet, and why.
//!
//! Owns: the definitions of alarms, the condition of each (limit, dead band, delays) and its life. Never: reads a clock; the
//! times are those of the records that are looked at, and of the requests of people.
//!
//! The life of one alarm, by ANSI/ISA-18.2 (IEC 62682) and OPC UA Part 9:
//!
//! ```text
//!                 condition comes
//!   normal ────────────────────────────► active, not acknowledged ◄───────────────┐ condition comes again
//!     ▲ ▲                                  │ ack           │ condition goes        │
//!     │ │  condition goes                  ▼               ▼                       │
//!     │ └──────────────────────── active, acknowledged   returned, not acknowledged┘
//!     │                                    │ (latching: condition goes)  │ ack
//!     │           reset                    ▼                             │
//!     └────────────────────────── latched ◄┄┄┄┄┄┄┄┄┄┄(latching)┄┄┄┄┄┄┄┄┄┄┤
//!     └──────────────────────────────────────────────────────────────────┘
//! ```
//!
//! Beside it, and without stopping it: *shelved* (a person, with a reason and an end), *suppressed* (by design: another alarm
//! explains it) and *out of service* (maintenance). What is quiet in one of these ways still lives its life, so that it is
//! known when it comes back.

use serde::{Deserialize, Serialize};

use crate::{
    frame::Priority,
    limits::{NAME_CHARS_MAX, TEXT_CHARS_MAX},
};

mod board;
mod condition;

pub use board::{Board, Change, Flood, Sight, Standing, What};
pub use condition::{Condition, Look};

/// Alarms of one loop: an operator who has more does not read them.
pub const ALARMS_PER_LOOP_MAX: usize = 64;
/// Longest time that an alarm may be shelved, in ns: one shift of twelve hours, as a plant's alarm philosophy usually says.
pub const SHELVE_NS_MAX: u64 = 12 * 3_600_000_000_000;
/// Longest delay of an alarm, in ns.
pub const DELAY_NS_MAX: u64 = 3_600_000_000_000;
/// Alarms within [`FLOOD_WINDOW_NS`] from which on it is a flood. Source: ANSI/ISA-18.2-2016, 16.6.2: more than ten in ten
/// minutes for one operator.
pub const FLOOD_ALARMS: usize = 10;
/// See [`FLOOD_ALARMS`], in ns.
pub const FLOOD_WINDOW_NS: u64 = 600_000_000_000;

/// What an alarm watches. Level limits hold for a port's value, in its unit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Kind {
    /// Value above the limit, most urgent.
    HiHi,
    /// Value above the limit.
    Hi,
    /// Value below the limit.
    Lo,
    /// Value below the limit, most urgent.
    LoLo,
    /// Distance between value and setpoint above the limit.
    Deviation,
    /// Change of the value above the limit, up or down, in units per second.
    Rate,
    /// The port's reading is not usable.
    BadQuality,
    /// Steps fail, or the policy decides the output.
    Fault,
    /// A step took longer than it may.
    Overrun,
    /// A replica did not answer, or fewer hosts hold the loop than it asks for.
    RedundancyLost,
    /// A replica answered otherwise than the majority.
    Dissent,
    /// Raised by the controller itself.
    Controller,
    /// A host's clock is off: by itself, or beside those of the other hosts.
    Clock,
    /// A host's disk is nearly full, or refuses what it is given.
    Disk,
    /// A loop runs a component that is not signed as the cell asks.
    Signature,
}

impl Kind {
    /// Does it compare a value with a limit?
    #[must_use]
    pub const fn has_limit(self) -> bool {
        matches!(
            self,
            Self::HiHi | Self::Hi | Self::Lo | Self::LoLo | Self::Deviation | Self::Rate
        )
    }

    /// Does it look at one port?
    #[must_use]
    pub const fn has_port(self) -> bool {
        self.has_limit() || matches!(self, Self::BadQuality)
    }
}

/// One alarm as it was decided upon: what an alarm philosophy calls its rationalisation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Definition {
    /// Its name, unique in the loop.
    pub name: String,
    /// What it watches.
    pub kind: Kind,
    /// The port, for kinds that look at one; the measured port where none is named.
    #[serde(default)]
    pub port: Option<String>,
    /// The limit in the port's unit; for rates, in units per second. Needed by kinds that have one.
    #[serde(default)]
    pub limit: Option<f64>,
    /// How far the value must come back within the limit before the condition goes; same unit, 0 or more.
    #[serde(default)]
    pub dead_band: f64,
    /// The condition must hold for so long before it counts, in s.
    #[serde(default)]
    pub on_delay_s: f64,
    /// And must be gone for so long, in s.
    #[serde(default)]
    pub off_delay_s: f64,
    /// How urgent it is.
    #[serde(default = "medium")]
    pub priority: Priority,
    /// Must a person reset it after it has gone?
    #[serde(default)]
    pub latching: bool,
    /// Alarms of one group: the first that comes while none stands is marked as the first out.
    #[serde(default)]
    pub group: Option<String>,
    /// Quiet, by design, while that alarm of the same loop stands: it explains this one.
    #[serde(default)]
    pub suppressed_by: Option<String>,
    /// What leads to it, in words.
    #[serde(default)]
    pub cause: String,
    /// What follows if nobody acts.
    #[serde(default)]
    pub consequence: String,
    /// What the operator is to do.
    #[serde(default)]
    pub response: String,
}

const fn medium() -> Priority {
    Priority::Medium
}

/// What is wrong with a definition or a request.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum AlarmError {
    /// Not a name.
    #[error("alarm {0:?}: a name has 1 to 64 of the characters a-z A-Z 0-9 . _ -")]
    Name(String),
    /// A limit is missing, not finite, or given where none belongs.
    #[error("alarm {name:?}: {reason}")]
    Definition {
        /// The alarm.
        name: String,
        /// In words.
        reason: &'static str,
    },
    /// Too many.
    #[error("a loop has at most {ALARMS_PER_LOOP_MAX} alarms; remove one first")]
    TooMany,
    /// Not there.
    #[error("the loop has no alarm {0:?}; list its alarms for their names")]
    Unknown(String),
    /// Not in the right state.
    #[error("alarm {name:?} {reason}")]
    State {
        /// The alarm.
        name: String,
        /// In words.
        reason: &'static str,
    },
    /// Shelving needs an end and a reason.
    #[error("alarm {0:?} is shelved with a reason, for 1 s to 12 h")]
    Shelve(String),
}

impl Definition {
    /// An alarm with nothing but what it watches; the rest is changed by whoever needs it.
    #[must_use]
    pub fn new(name: &str, kind: Kind, priority: Priority) -> Self {
        Self {
            name: name.to_owned(),
            kind,
            port: None,
            limit: None,
            dead_band: 0.0,
            on_delay_s: 0.0,
            off_delay_s: 0.0,
            priority,
            latching: false,
            group: None,
            suppressed_by: None,
            cause: String::new(),
            consequence: String::new(),
            response: String::new(),
        }
    }

    /// Checks everything that needs nothing but the definition.
    ///
    /// # Errors
    /// [`AlarmError::Name`], [`AlarmError::Definition`].
    pub fn check(&self) -> Result<(), AlarmError> {
        let names = [Some(&self.name), self.group.as_ref(), self.suppressed_by.as_ref()];
        if let Some(bad) = names.into_iter().flatten().find(|name| !is_name(name)) {
            return Err(AlarmError::Name(bad.clone()));
        }
        let wrong = |reason| {
            Err(AlarmError::Definition {
                name: self.name.clone(),
                reason,
            })
        };
        if self.kind.has_limit() != self.limit.is_some() {
            return wrong("level, deviation and rate alarms have a limit, others have none");
        }
        if self.limit.is_some_and(|limit| !limit.is_finite()) {
            return wrong("the limit must be a finite number");
        }
        if matches!(self.kind, Kind::Deviation | Kind::Rate) && self.limit.is_some_and(|limit| limit <= 0.0) {
            return wrong("the limit of a deviation or a rate must be greater than 0");
        }
        if self.port.is_some() && !self.kind.has_port() {
            return wrong("alarms of this kind belong to the whole loop, not to a port");
        }
        if !(self.dead_band >= 0.0 && self.dead_band.is_finite()) {
            return wrong("dead_band must be 0 or more");
        }
        if matches!(self.kind, Kind::Deviation | Kind::Rate) && self.limit.is_some_and(|limit| self.dead_band >= limit)
        {
            return wrong("dead_band must be less than the limit, or the alarm would never go");
        }
        let delay = 0.0..=DELAY_NS_MAX as f64 / 1e9;
        if !(delay.contains(&self.on_delay_s) && delay.contains(&self.off_delay_s)) {
            return wrong("delays are 0 to 3600 s");
        }
        let texts = [&self.cause, &self.consequence, &self.response];
        if texts.into_iter().any(|text| text.chars().count() > TEXT_CHARS_MAX) {
            return wrong("cause, consequence and response have at most 512 characters each");
        }
        if self.suppressed_by.as_ref() == Some(&self.name) {
            return wrong("an alarm cannot suppress itself");
        }
        Ok(())
    }
}

fn is_name(name: &str) -> bool {
    (1..=NAME_CHARS_MAX).contains(&name.len())
        && name
            .chars()
            .all(|c| c.is_ascii_alphanumeric() || matches!(c, '.' | '_' | '-'))
}

/// Where an alarm is in its life.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum State {
    /// Nothing is wrong.
    Normal,
    /// It stands, and nobody has seen it.
    Active,
    /// It stands, and somebody has seen it.
    Acknowledged,
    /// It is gone, and nobody has seen it.
    Returned,
    /// It is gone and waits for a reset.
    Latched,
}

impl State {
    /// Does the condition stand?
    #[must_use]
    pub const fn stands(self) -> bool {
        matches!(self, Self::Active | Self::Acknowledged)
    }

    /// Must somebody still see it?
    #[must_use]
    pub const fn waits_for_ack(self) -> bool {
        matches!(self, Self::Active | Self::Returned)
    }
}

/// Kept quiet by a person, for a time.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Shelf {
    /// Until when, in ns of the home's clock.
    pub until_ns: u64,
    /// Who.
    pub by: String,
    /// Why.
    pub reason: String,
}

#[cfg(test)]
mod tests;
