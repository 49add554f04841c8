//! A value is never bare: it comes with a reason where it is missing, a quality, and the time when it was true.

use std::fmt;

use serde::{Deserialize, Serialize};

/// How far a value may be trusted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Quality {
    /// Not usable for control.
    Bad,
    /// Usable with care: held, simulated, near a range limit.
    Uncertain,
    /// Usable.
    Good,
    /// Usable; a person put it there in the place of the instrument's or the loop's own.
    Forced,
}

/// Why there is no current value.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum NoData {
    /// Nothing was read since the host started.
    NeverRead,
    /// The device does not answer.
    CommsLost,
    /// The device answered with an error (for Modbus, an exception code).
    DeviceError(u8),
    /// The raw value is outside what the instrument can send, for example below 3.6 mA.
    OutOfRange,
    /// The value is not a finite number.
    NotFinite,
    /// The port is not connected to a point.
    NotConnected,
}

/// What a device means by an error code. Source: Modbus application protocol V1.1b3, section 7; devices send others too.
#[must_use]
pub const fn device_error_name(code: u8) -> &'static str {
    match code {
        1 => "illegal function",
        2 => "illegal data address",
        3 => "illegal data value",
        4 => "server device failure",
        5 => "acknowledge, still working",
        6 => "server device busy",
        7 => "negative acknowledge",
        8 => "memory parity error",
        10 => "gateway path unavailable",
        11 => "gateway target device failed to respond",
        _ => "unknown to the standard",
    }
}

impl fmt::Display for NoData {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NeverRead => f.write_str("not read since the host started"),
            Self::CommsLost => f.write_str("the device does not answer"),
            Self::DeviceError(code) => {
                write!(
                    f,
                    "the device answered with exception {code}, {}",
                    device_error_name(*code)
                )
            }
            Self::OutOfRange => f.write_str("the raw value is outside what the instrument can send"),
            Self::NotFinite => f.write_str("the value is not a finite number"),
            Self::NotConnected => f.write_str("not connected"),
        }
    }
}

/// One reading of a point, as a frame freezes it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Reading {
    /// The value in engineering units, or why there is none.
    pub value: Result<f64, NoData>,
    /// The last good value; what a controller sees where `value` is an error. 0 where there never was one.
    pub last_good: f64,
    /// How far it may be trusted.
    pub quality: Quality,
    /// Time of validity, in ns of the I/O server's clock: when the device sampled it.
    pub at_ns: u64,
    /// Has a new sample arrived since the last committed cycle?
    pub fresh: bool,
}

impl Reading {
    /// A good, fresh value.
    #[must_use]
    pub const fn good(value: f64, at_ns: u64) -> Self {
        Self {
            value: Ok(value),
            last_good: value,
            quality: Quality::Good,
            at_ns,
            fresh: true,
        }
    }

    /// No value, and why.
    #[must_use]
    pub const fn missing(reason: NoData, last_good: f64, at_ns: u64) -> Self {
        Self {
            value: Err(reason),
            last_good,
            quality: Quality::Bad,
            at_ns,
            fresh: false,
        }
    }

    /// What an unconnected port reads.
    #[must_use]
    pub const fn unconnected() -> Self {
        Self::missing(NoData::NotConnected, 0.0, 0)
    }

    /// The value if there is one, else the last good one.
    #[must_use]
    pub fn value_or_last(&self) -> f64 {
        self.value.unwrap_or(self.last_good)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_reason_has_its_words() {
        for (reason, words) in [
            (NoData::NeverRead, "not read since the host started"),
            (NoData::CommsLost, "the device does not answer"),
            (
                NoData::DeviceError(2),
                "the device answered with exception 2, illegal data address",
            ),
            (
                NoData::DeviceError(11),
                "the device answered with exception 11, gateway target device failed to respond",
            ),
            (
                NoData::DeviceError(200),
                "the device answered with exception 200, unknown to the standard",
            ),
            (NoData::NotConnected, "not connected"),
        ] {
            assert_eq!(reason.to_string(), words);
        }
    }
}
