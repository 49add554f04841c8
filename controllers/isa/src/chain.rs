//! A chain of loops: what a block reports to the loop above, whose output is its remote setpoint, and hears from the loop below.
//!
//! ```text
//!   loop above ── out ──► a point ── remote-sp ──► loop below ── out ──► actuator
//!       ▲                                              │
//!       └───────── message "bkcal-N": value, flags ◄───┘       bkcal-in = N above, bkcal-out = N below
//! ```
//! BKCAL_OUT and BKCAL_IN of the Foundation Fieldbus PID block. The value resets the integral above; while the loop below does
//! not follow its remote setpoint, the output above follows the value, so that the way back has no bump; while more or less
//! setpoint would be of no use there, the integral above does not go that way.
//!
//! ```text
//!           a report                    some cycles without one
//!   Silent ─────────► Heard ──────────────────────────────────► Silent: the output above holds
//! ```
//! The report is 10 bytes: [`FORM`], the flags, the value (IEEE 754, little endian). It goes as a message and not as an output,
//! for in manual outputs are the operator's. Never: waits for a report, or sends one that nobody asked for.

use bumpless_sdk::{Io, Parameters};
use serde::{Deserialize, Serialize};

use crate::{
    law::{Memory, Phase},
    table::{BKCAL_BAND, BKCAL_IN, BKCAL_OUT, BKCAL_VALUE},
    tuning::Tuning,
};

/// First byte of a report; another value is another form.
pub const FORM: u8 = 0xBC;
/// The loop below does not follow its remote setpoint: the one above must follow the value.
pub const INITIALISE: u8 = 1;
/// More setpoint would be of no use below.
pub const NO_RISE: u8 = 1 << 1;
/// Less setpoint would be of no use below.
pub const NO_FALL: u8 = 1 << 2;
/// The loop below has seen nothing yet: the value says nothing.
pub const NO_VALUE: u8 = 1 << 3;

/// Cycles without a report after which the loop below counts as silent: a message may be lost, fifty in a row are not.
const SILENT_CYCLES: u8 = 50;

/// A report of the loop below.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// What the loop below goes by, in the unit of its setpoint.
    pub value: f64,
    /// [`INITIALISE`], [`NO_RISE`], [`NO_FALL`], [`NO_VALUE`].
    pub flags: u8,
    /// Cycles since it was heard.
    silent: u8,
}

impl Report {
    /// From a message's bytes; none where they are no report.
    #[must_use]
    pub fn decode(bytes: &[u8]) -> Option<Self> {
        let [FORM, flags, value @ ..] = bytes else { return None };
        let value = f64::from_le_bytes(value.try_into().ok()?);
        value.is_finite().then_some(Self {
            value,
            flags: *flags,
            silent: 0,
        })
    }

    /// As a message's bytes.
    #[must_use]
    pub fn encode(value: f64, flags: u8) -> [u8; 10] {
        let mut bytes = [FORM, flags, 0, 0, 0, 0, 0, 0, 0, 0];
        for (to, from) in bytes.iter_mut().skip(2).zip(value.to_le_bytes()) {
            *to = from;
        }
        bytes
    }

    /// Does a flag stand?
    #[must_use]
    pub const fn has(&self, flag: u8) -> bool {
        self.flags & flag != 0
    }
}

/// The state of a block's links.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Links {
    /// The last report from below; none before the first, and when there was none for long.
    pub below: Option<Report>,
    /// Limits of the output that are reported now, [`LOW`] and [`HIGH`].
    limits: u8,
}

const LOW: u8 = 1;
const HIGH: u8 = 1 << 1;

/// Name of the topic of a link.
fn topic(number: u32) -> String {
    let mut text = String::from("bkcal-");
    // By hand: the formatting of the standard library would be larger than the whole law.
    let mut of_ten = 1000;
    let mut begun = false;
    while of_ten > 0 {
        let digit = number / of_ten % 10;
        begun |= digit > 0 || of_ten == 1;
        if begun {
            text.push(char::from(b'0' + digit as u8));
        }
        of_ten /= 10;
    }
    text
}

impl Links {
    /// Takes the newest report from below. Says whether there is a loop below at all.
    pub(crate) fn hear(&mut self, p: &Parameters<'_>, io: &mut Io<'_>) -> bool {
        let number = p.of(BKCAL_IN) as u32;
        if number == 0 {
            self.below = None;
            return false;
        }
        let wanted = topic(number);
        let mut heard = None;
        while let Some(message) = io.receive() {
            if message.topic == wanted {
                heard = Report::decode(&message.data).or(heard);
            }
        }
        self.below = heard.or_else(|| {
            let before = self.below?;
            (before.silent < SILENT_CYCLES).then_some(Report {
                silent: before.silent + 1,
                ..before
            })
        });
        true
    }

    /// Reports to the loop above, where there is one. `cascade`: is its output followed?
    pub(crate) fn report(&mut self, memory: &Memory, t: &Tuning, p: &Parameters<'_>, cascade: bool, io: &mut Io<'_>) {
        let number = p.of(BKCAL_OUT) as u32;
        if number == 0 {
            return;
        }
        let band = (t.out_high - t.out_low) * p.of(BKCAL_BAND) / 100.0;
        let stands = |limit: u8, beyond: f64| beyond >= 0.0 || self.limits & limit != 0 && beyond > -band;
        let low = stands(LOW, t.out_low - memory.output);
        let high = stands(HIGH, memory.output - t.out_high);
        self.limits = if low { LOW } else { 0 } | if high { HIGH } else { 0 };
        // With a negative gain more setpoint means less output.
        let (rises, falls) = if t.gain < 0.0 { (low, high) } else { (high, low) };
        let unseen = matches!(memory.phase, Phase::New);
        let mut flags = 0;
        for (flag, stands) in [
            (INITIALISE, !cascade),
            (NO_RISE, rises || memory.setpoint >= t.sp_high),
            (NO_FALL, falls || memory.setpoint <= t.sp_low),
            (NO_VALUE, unseen),
        ] {
            flags |= if stands { flag } else { 0 };
        }
        let value = if p.choice(BKCAL_VALUE) == 1 {
            memory.pv
        } else {
            memory.setpoint
        };
        io.publish(&topic(number), &Report::encode(value, flags));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_link_has_its_topic() {
        for (number, text) in [
            (1, "bkcal-1"),
            (20, "bkcal-20"),
            (407, "bkcal-407"),
            (9999, "bkcal-9999"),
        ] {
            assert_eq!(topic(number), text);
        }
    }

    #[test]
    fn a_report_goes_and_comes_and_anything_else_is_none() {
        let report = Report::decode(&Report::encode(-12.5, INITIALISE | NO_FALL));
        let report = report.map(|r| (r.value, r.has(INITIALISE), r.has(NO_RISE), r.has(NO_FALL)));
        assert_eq!(report, Some((-12.5, true, false, true)));
        for bad in [
            &[][..],
            &[FORM],
            &[FORM, 0, 1, 2],
            &[0; 10],
            &Report::encode(f64::NAN, 0),
        ] {
            assert_eq!(Report::decode(bad), None, "{bad:?}");
        }
    }
}
