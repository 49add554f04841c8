//! The parameters as named numbers, and the rules between them.
//!
//! Never: a range of a single parameter; the SDK and the host check those against the table.

use bumpless_sdk::{Fault, Parameter, Parameters};

use crate::table;

/// Which way the output goes when the measurement rises.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Action {
    /// Down: heating, filling.
    Reverse,
    /// Up: cooling, emptying.
    Direct,
}

/// The parameters; the table has their texts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tuning {
    /// Gain with its sign: negative for direct action. Output units per unit of the measurement.
    pub gain: f64,
    /// Integral time, s; 0 for none.
    pub ti_s: f64,
    /// Derivative time, s.
    pub td_s: f64,
    /// Derivative filter time, s.
    pub td_filter_s: f64,
    /// Setpoint weight of P.
    pub beta: f64,
    /// Setpoint weight of D.
    pub gamma: f64,
    /// Least output.
    pub out_low: f64,
    /// Greatest output.
    pub out_high: f64,
    /// Greatest change of the output per second; 0 for no limit.
    pub out_rate_per_s: f64,
    /// Half width of the dead band, in units of the measurement.
    pub dead_band: f64,
    /// Output units per unit of the feedforward.
    pub ff_gain: f64,
    /// Output at no error without integral action.
    pub bias: f64,
    /// Time constant of the return to the bias, s.
    pub balance_s: f64,
    /// Time constant of the measurement filter, s.
    pub pv_filter_s: f64,
    /// Least setpoint.
    pub sp_low: f64,
    /// Greatest setpoint.
    pub sp_high: f64,
    /// Greatest change of the setpoint per second; 0 for no limit.
    pub sp_rate_per_s: f64,
    /// Does the setpoint follow the measurement while something else decides the output?
    pub sp_track: bool,
    /// Below this output the integral does not lower it further.
    pub arw_low: f64,
    /// Above this output the integral does not raise it further.
    pub arw_high: f64,
}

/// A limit of this size is none.
pub(crate) const NO_LIMIT: f64 = 1e9;

/// A value, or the default of the table that a state of an older layout does not have yet.
fn value(p: &Parameters<'_>, parameter: Parameter) -> f64 {
    let value = p.of(parameter);
    // Values are within their ranges, so only a missing one is no number.
    if value.is_nan() {
        table::PARAMETERS
            .get(parameter.index())
            .map_or(value, |row| row.default)
    } else {
        value
    }
}

impl Tuning {
    /// A PI controller between two limits of its output; a negative gain for direct action.
    #[must_use]
    pub const fn pi(gain: f64, ti_s: f64, out_low: f64, out_high: f64) -> Self {
        Self {
            gain,
            ti_s,
            td_s: 0.0,
            td_filter_s: 0.0,
            beta: 1.0,
            gamma: 0.0,
            out_low,
            out_high,
            out_rate_per_s: 0.0,
            dead_band: 0.0,
            ff_gain: 1.0,
            bias: 0.0,
            balance_s: 60.0,
            pv_filter_s: 0.0,
            sp_low: -1e9,
            sp_high: 1e9,
            sp_rate_per_s: 0.0,
            sp_track: false,
            arw_low: -NO_LIMIT,
            arw_high: NO_LIMIT,
        }
    }

    /// From the values of the table, of a state in any layout.
    #[must_use]
    pub fn of(p: &Parameters<'_>) -> Self {
        Self::with_gains(p, [p.of(table::K), p.of(table::TI), p.of(table::TD)])
    }

    /// With another gain, integral and derivative time than the table's, in the table's form.
    #[must_use]
    pub fn with_gains(p: &Parameters<'_>, [k, ti_s, td_s]: [f64; 3]) -> Self {
        let (k, ti_s, td_s) = match value(p, table::FORM) as u8 {
            1 => series(k, ti_s, td_s),
            2 => parallel(k, ti_s, td_s),
            _ => (k, ti_s, td_s),
        };
        let action = if p.choice(table::ACTION) == 1 {
            Action::Direct
        } else {
            Action::Reverse
        };
        Self {
            gain: match action {
                Action::Reverse => k,
                Action::Direct => -k,
            },
            ti_s,
            td_s,
            td_filter_s: td_s / p.of(table::N),
            beta: p.of(table::BETA),
            gamma: p.of(table::GAMMA),
            out_low: p.of(table::OUT_LOW),
            out_high: p.of(table::OUT_HIGH),
            out_rate_per_s: p.of(table::OUT_RATE),
            dead_band: p.of(table::DEAD_BAND),
            ff_gain: p.of(table::FF_GAIN) * ff_scale(p),
            bias: p.of(table::BIAS),
            balance_s: p.of(table::BALANCE_TIME),
            pv_filter_s: p.of(table::PV_FILTER),
            sp_low: value(p, table::SP_LOW),
            sp_high: value(p, table::SP_HIGH),
            sp_rate_per_s: value(p, table::SP_RATE),
            sp_track: value(p, table::SP_TRACK) >= 1.0,
            arw_low: value(p, table::ARW_LOW),
            arw_high: value(p, table::ARW_HIGH),
        }
    }

    /// The output that a setpoint means in bypass: its place within its limits becomes the place within the output's; where the
    /// setpoint has no limits, it is the output.
    #[must_use]
    pub fn through(&self, setpoint: f64) -> f64 {
        if self.sp_low > -NO_LIMIT && self.sp_high < NO_LIMIT {
            let part = (setpoint - self.sp_low) / (self.sp_high - self.sp_low);
            self.out_low + part * (self.out_high - self.out_low)
        } else {
            setpoint
        }
    }

    /// The rules between parameters; [`Fault::BadParameter`] where one is broken.
    pub fn check(&self) -> Result<(), Fault> {
        if self.out_low >= self.out_high {
            return Err(Fault::bad_parameter("out-low must be less than out-high"));
        }
        if self.sp_low >= self.sp_high {
            return Err(Fault::bad_parameter("sp-low must be less than sp-high"));
        }
        if self.arw_low >= self.arw_high {
            return Err(Fault::bad_parameter("arw-low must be less than arw-high"));
        }
        if self.td_s.is_finite() {
            Ok(())
        } else {
            Err(Fault::bad_parameter(
                "k must be greater than 0 in the parallel form, or td 0",
            ))
        }
    }
}

/// What a gain of the feedforward in parts of the spans is in units of output per unit of feedforward: `FF_SCALE` of the
/// Foundation Fieldbus block. The zero of its scale only shifts the output, which the integral takes up.
fn ff_scale(p: &Parameters<'_>) -> f64 {
    let span = value(p, table::FF_SPAN);
    if span > 0.0 {
        (p.of(table::OUT_HIGH) - p.of(table::OUT_LOW)) / span
    } else {
        1.0
    }
}

/// The standard form of `K(1 + 1/(Ti·s))(1 + Td·s)`, where the derivative filter is counted on its own.
///
/// Source: Åström and Hägglund, Advanced PID Control (ISA, 2006), sec. 3.2.
fn series(k: f64, ti_s: f64, td_s: f64) -> (f64, f64, f64) {
    if ti_s > 0.0 {
        (k * (1.0 + td_s / ti_s), ti_s + td_s, ti_s * td_s / (ti_s + td_s))
    } else {
        (k, ti_s, td_s)
    }
}

/// The standard form of `k + 1/(ti·s) + td·s`: an integral time for a gain of one, and so a derivative time.
fn parallel(k: f64, ti_s: f64, td_s: f64) -> (f64, f64, f64) {
    (k, k * ti_s, if td_s > 0.0 { td_s / k } else { 0.0 })
}
