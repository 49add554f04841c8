//! The mode that a block works in, beside the one that it was put in.
//!
//! The *target* is the loop's mode, and the remote setpoint where `remote-on` asks for it. The *actual* one is what inputs make of
//! it; the names are those of the Foundation Fieldbus blocks:
//!
//! ```text
//!   OOS ◄─ oos    Man ◄─ the loop's mode    IMan ◄─ the loop below    LO ◄─ track-on    Auto    Cas ◄─ remote-on, and it is good
//!   the first that holds, from the left
//! ```
//! Never: changes a mode. What a loop does when an input fails is its policy.

use bumpless_sdk::{Cycle, Io, Mode, Priority, Quality, Reading};

use crate::{
    block::is_on,
    table::{FF, OUT, PV, REMOTE_ON, REMOTE_SP, TRACK_ON},
};

/// The mode that a block works in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Actual {
    /// Nothing is looked at, and the output stays.
    OutOfService,
    /// The operator's output.
    Manual,
    /// The output follows the loop below, which does not take it.
    Initialisation,
    /// The output follows the track input.
    LocalOverride,
    /// The law, on the loop's setpoint.
    Automatic,
    /// The law, on the remote setpoint.
    Cascade,
}

impl Actual {
    /// The mode of a cycle. `initialises`: does the loop below not take the output?
    #[must_use]
    pub fn of(cycle: &Cycle, io: &Io<'_>, out_of_service: bool, initialises: bool) -> Self {
        if out_of_service {
            Self::OutOfService
        } else if matches!(cycle.mode, Mode::Manual) {
            Self::Manual
        } else if initialises {
            Self::Initialisation
        } else if is_on(io, TRACK_ON) {
            Self::LocalOverride
        } else if is_on(io, REMOTE_ON) && io.read_usable(REMOTE_SP).is_some() {
            Self::Cascade
        } else {
            Self::Automatic
        }
    }

    /// What to tell where this is not what the block was put in; none where it is.
    #[must_use]
    pub fn shed(self, cycle: &Cycle, io: &Io<'_>) -> Option<&'static str> {
        let target = if matches!(cycle.mode, Mode::Manual) {
            Self::Manual
        } else if is_on(io, REMOTE_ON) {
            Self::Cascade
        } else {
            Self::Automatic
        };
        if self == target {
            return None;
        }
        Some(match self {
            Self::OutOfService => "the block is out of service: the output stays",
            Self::Initialisation => "the loop below does not take the output: the output follows it (IMan)",
            Self::LocalOverride => "the output follows the track input (LO)",
            Self::Manual => "the output is the operator's (Man)",
            Self::Automatic => "the remote setpoint has no usable value: its last one stays (Auto instead of Cas)",
            Self::Cascade => "the setpoint is the remote one (Cas)",
        })
    }
}

/// Rests the output on an input that is not good: an uncertain measurement, or one that failed and is replaced?
pub(crate) fn is_doubtful(io: &Io<'_>) -> bool {
    let good = |reading: &Reading| reading.is_usable() && matches!(reading.quality, Quality::Good);
    let doubtful = |input| io.is_connected(input) && !good(&io.read(input));
    doubtful(PV) || doubtful(FF) || is_on(io, REMOTE_ON) && doubtful(REMOTE_SP) || !good(&io.held(OUT))
}

/// Raises or clears a bit of the alarms where it changed. Gives the bits.
pub(crate) fn tell(alarms: u8, bit: u8, name: &str, text: Option<&str>, io: &mut Io<'_>) -> u8 {
    match (alarms & bit != 0, text) {
        (false, Some(text)) => {
            io.raise(name, Priority::Low, text);
            alarms | bit
        }
        (true, None) => {
            io.clear(name);
            alarms & !bit
        }
        _ => alarms,
    }
}
