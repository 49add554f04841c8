//! The parameters as named numbers, and the rules between them.
//!
//! Never: a range of a single parameter; the SDK and the host check those against the table.

use bumpless_sdk::{Fault, Parameters};

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
}

impl Tuning {
    /// From the values of the table.
    #[must_use]
    pub fn of(p: &Parameters<'_>) -> Self {
        let action = if p.choice(table::ACTION) == 1 {
            Action::Direct
        } else {
            Action::Reverse
        };
        let (k, td_s) = (p.of(table::K), p.of(table::TD));
        Self {
            gain: match action {
                Action::Reverse => k,
                Action::Direct => -k,
            },
            ti_s: p.of(table::TI),
            td_s,
            td_filter_s: td_s / p.of(table::N),
            beta: p.of(table::BETA),
            gamma: p.of(table::GAMMA),
            out_low: p.of(table::OUT_LOW),
            out_high: p.of(table::OUT_HIGH),
            out_rate_per_s: p.of(table::OUT_RATE),
            dead_band: p.of(table::DEAD_BAND),
            ff_gain: p.of(table::FF_GAIN),
            bias: p.of(table::BIAS),
            balance_s: p.of(table::BALANCE_TIME),
            pv_filter_s: p.of(table::PV_FILTER),
        }
    }

    /// The rules between parameters; [`Fault::BadParameter`] where one is broken.
    pub fn check(&self) -> Result<(), Fault> {
        if self.out_low < self.out_high {
            Ok(())
        } else {
            Err(Fault::bad_parameter("out-low must be less than out-high"))
        }
    }
}
