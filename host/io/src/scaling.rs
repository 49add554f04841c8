//! From raw numbers to engineering units and back, with the health that the signal itself tells.
//!
//! 4–20 mA follows NAMUR NE 43: 3.8 to 20.5 mA are measurements, 3.6 mA and less or 21 mA and more are failures, what is
//! between is a saturated measurement. 0–10 V has no live zero, so only a voltage well outside it tells of a failure.

use bumpless_core::{NoData, Quality};
use serde::{Deserialize, Serialize};

/// What carries a value, and so how its failures look.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum Signal {
    /// A plain number; nothing is known about its failures.
    #[default]
    #[serde(rename = "plain")]
    Plain,
    /// A current loop.
    #[serde(rename = "4-20ma")]
    Current,
    /// A voltage.
    #[serde(rename = "0-10v")]
    Voltage,
}

/// A failed transmitter sends at most this, in mA.
pub const FAILED_LOW_MA: f64 = 3.6;
/// Least measured current, in mA.
pub const MEASURED_LOW_MA: f64 = 3.8;
/// Greatest measured current, in mA.
pub const MEASURED_HIGH_MA: f64 = 20.5;
/// A failed transmitter sends at least this, in mA.
pub const FAILED_HIGH_MA: f64 = 21.0;

/// A straight line between raw numbers and engineering units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scaling {
    slope: f64,
    intercept: f64,
    low: f64,
    high: f64,
    signal: Signal,
    clamp: bool,
}

impl Scaling {
    /// `value = raw · scale + offset`; `low` and `high` are the point's range. None where the scale is 0 or a number is
    /// not finite.
    #[must_use]
    pub fn factor(scale: f64, offset: f64, low: f64, high: f64, clamp: bool) -> Option<Self> {
        let usable = scale != 0.0 && [scale, offset, low, high].iter().all(|n| n.is_finite()) && low < high;
        usable.then_some(Self {
            slope: scale,
            intercept: offset,
            low,
            high,
            signal: Signal::Plain,
            clamp,
        })
    }

    /// Raw numbers at the ends of the range, for a current loop those at 4 and 20 mA, for a voltage those at 0 and 10 V.
    /// None where a range is empty or a number is not finite.
    #[must_use]
    pub fn range(raw: [f64; 2], low: f64, high: f64, signal: Signal, clamp: bool) -> Option<Self> {
        let [raw_low, raw_high] = raw;
        let slope = (high - low) / (raw_high - raw_low);
        let intercept = low - raw_low * slope;
        let usable = slope != 0.0 && [slope, intercept, low, high].iter().all(|n| n.is_finite()) && low < high;
        usable.then_some(Self {
            slope,
            intercept,
            low,
            high,
            signal,
            clamp,
        })
    }

    /// What a raw number means, and how far it may be trusted.
    pub fn reading(&self, raw: f64) -> (Result<f64, NoData>, Quality) {
        let value = raw * self.slope + self.intercept;
        if !value.is_finite() {
            return (Err(NoData::NotFinite), Quality::Bad);
        }
        let fraction = (value - self.low) / (self.high - self.low);
        // Rounding must not turn a limit into its other side.
        let slack = 1e-9;
        let (failed, outside) = match self.signal {
            Signal::Plain => (false, !(-slack..=1.0 + slack).contains(&fraction)),
            Signal::Current => {
                let ma = current_ma(fraction);
                let failed = ma <= FAILED_LOW_MA + slack || ma >= FAILED_HIGH_MA - slack;
                (failed, ma < MEASURED_LOW_MA - slack || ma > MEASURED_HIGH_MA + slack)
            }
            Signal::Voltage => {
                // 5 % beyond either end: no sound 0–10 V output goes there.
                (!(-0.05..=1.05).contains(&fraction), !(-0.01..=1.01).contains(&fraction))
            }
        };
        if failed {
            return (Err(NoData::OutOfRange), Quality::Bad);
        }
        let shown = if self.clamp {
            value.max(self.low).min(self.high)
        } else {
            value
        };
        (Ok(shown), if outside { Quality::Uncertain } else { Quality::Good })
    }

    /// The raw number for a value; not rounded.
    #[must_use]
    pub fn raw(&self, value: f64) -> f64 {
        (value - self.intercept) / self.slope
    }
}

/// The current of a 4–20 mA loop at a fraction of its range, in mA.
#[must_use]
pub fn current_ma(fraction: f64) -> f64 {
    4.0 + 16.0 * fraction
}

/// The nearest of the 2^bits − 1 steps of a converter whose full scale is 0 to `full`. `bits` is 1 to 52.
#[must_use]
pub fn quantised(value: f64, full: f64, bits: u32) -> f64 {
    let steps = ((1_u64 << bits.clamp(1, 52)) - 1) as f64;
    (value / full * steps).round().max(0.0).min(steps) * full / steps
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use super::*;

    #[test]
    fn current_loops_follow_namur() {
        // 0 to 2.5 bar on a card that counts 0 to 20,000 µA.
        let scaling = Scaling::range([4000.0, 20_000.0], 0.0, 2.5, Signal::Current, false).unwrap();
        let cases = [
            (0.0, Err(NoData::OutOfRange), Quality::Bad),
            (3600.0, Err(NoData::OutOfRange), Quality::Bad),
            (3700.0, Ok(-0.046_875), Quality::Uncertain),
            (3800.0, Ok(-0.031_25), Quality::Good),
            (4000.0, Ok(0.0), Quality::Good),
            (12_000.0, Ok(1.25), Quality::Good),
            (20_000.0, Ok(2.5), Quality::Good),
            (20_500.0, Ok(2.578_125), Quality::Good),
            (20_900.0, Ok(2.640_625), Quality::Uncertain),
            (21_000.0, Err(NoData::OutOfRange), Quality::Bad),
            (65_535.0, Err(NoData::OutOfRange), Quality::Bad),
            (f64::NAN, Err(NoData::NotFinite), Quality::Bad),
        ];
        for (raw, value, quality) in cases {
            let (got, got_quality) = scaling.reading(raw);
            let near = match (got, value) {
                (Ok(a), Ok(b)) => (a - b).abs() < 1e-9,
                (a, b) => a == b,
            };
            assert!(
                near && got_quality == quality,
                "{raw}: {got:?} {got_quality:?}, wanted {value:?} {quality:?}"
            );
        }
    }

    #[test]
    fn voltages_plain_numbers_and_clamps() {
        let voltage = Scaling::range([0.0, 27_648.0], 0.0, 100.0, Signal::Voltage, false).unwrap();
        assert_eq!(voltage.reading(13_824.0), (Ok(50.0), Quality::Good));
        assert_eq!(voltage.reading(32_767.0), (Err(NoData::OutOfRange), Quality::Bad));
        assert_eq!(voltage.reading(28_500.0).1, Quality::Uncertain);

        let plain = Scaling::factor(0.1, -40.0, 0.0, 100.0, false).unwrap();
        assert_eq!(plain.reading(600.0), (Ok(20.0), Quality::Good));
        assert_eq!(plain.reading(300.0), (Ok(-10.0), Quality::Uncertain));
        assert!((plain.raw(20.0) - 600.0).abs() < 1e-9);
        let clamped = Scaling::factor(0.1, -40.0, 0.0, 100.0, true).unwrap();
        assert_eq!(clamped.reading(300.0), (Ok(0.0), Quality::Uncertain));
    }

    #[test]
    fn lines_without_slope_are_refused() {
        assert!(Scaling::factor(0.0, 0.0, 0.0, 1.0, false).is_none());
        assert!(Scaling::factor(1.0, f64::NAN, 0.0, 1.0, false).is_none());
        assert!(Scaling::factor(1.0, 0.0, 1.0, 1.0, false).is_none());
        assert!(Scaling::range([5.0, 5.0], 0.0, 1.0, Signal::Plain, false).is_none());
        assert!(Scaling::range([0.0, f64::INFINITY], 0.0, 1.0, Signal::Plain, false).is_none());
        // A falling line is a line.
        assert_eq!(
            Scaling::range([100.0, 0.0], 0.0, 1.0, Signal::Plain, false)
                .unwrap()
                .reading(25.0),
            (Ok(0.75), Quality::Good)
        );
    }

    #[test]
    fn converters_round_to_their_steps() {
        assert!((quantised(10.0, 20.0, 12) - 10.0).abs() < 20.0 / 4095.0);
        assert!((quantised(25.0, 20.0, 12) - 20.0).abs() < 1e-12);
        assert!(quantised(-1.0, 20.0, 12).abs() < 1e-12);
        let step = quantised(0.006, 20.0, 12);
        assert!((step - 20.0 / 4095.0).abs() < 1e-12, "{step}");
    }
}
