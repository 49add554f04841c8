//! What leaves a loop, whatever the controller wants: finite, in range, at a bounded rate, manual over automatic.
//!
//! Outside the sandbox and pure. Never: asks the component anything.

use crate::spec::{Mode, OutputLimit};

/// The outputs that a cycle may send, and what was done to them.
#[derive(Debug, Clone, PartialEq)]
pub struct Guarded {
    /// One value per output.
    pub outputs: Vec<f64>,
    /// Bit i is set where output i met a limit.
    pub limited: u64,
}

/// One output towards `target`, from where it is held, within its limits. `dt_ns` bounds the change by the rate.
#[must_use]
pub fn approach(target: f64, held: f64, limit: &OutputLimit, dt_ns: u64) -> f64 {
    // A held value outside the limits (the limits were narrowed) is pulled in before the rate counts.
    let held = if held.is_finite() {
        held.max(limit.low).min(limit.high)
    } else {
        limit.safe
    };
    let target = if target.is_finite() {
        target.max(limit.low).min(limit.high)
    } else {
        held
    };
    match limit.rate_per_s {
        Some(rate_per_s) => {
            let step = rate_per_s * (dt_ns as f64 * 1e-9);
            target.max(held - step).min(held + step)
        }
        None => target,
    }
}

/// Decides the outputs of a good step. All slices have one entry per output port.
///
/// `wanted` is what the controller wrote (its last wish where it wrote nothing), `manual` what the operator set, `held`
/// what the actuators hold. In manual the operator's values count, within the same limits.
#[must_use]
pub fn guard(mode: Mode, wanted: &[f64], manual: &[f64], held: &[f64], limits: &[OutputLimit], dt_ns: u64) -> Guarded {
    let targets = match mode {
        Mode::Manual => manual,
        Mode::Automatic => wanted,
    };
    let mut limited = 0;
    let outputs = limits
        .iter()
        .enumerate()
        .map(|(i, limit)| {
            let held = held.get(i).copied().unwrap_or(f64::NAN);
            let target = targets.get(i).copied().unwrap_or(held);
            let output = approach(target, held, limit, dt_ns);
            // Bit equality on purpose: any change by the guard is worth a flag.
            if output.to_bits() != target.to_bits() {
                limited |= 1 << (i % 64);
            }
            output
        })
        .collect();
    Guarded { outputs, limited }
}

/// The outputs on the way to their safe values.
#[must_use]
pub fn towards_safe(held: &[f64], limits: &[OutputLimit], dt_ns: u64) -> Vec<f64> {
    limits
        .iter()
        .enumerate()
        .map(|(i, limit)| approach(limit.safe, held.get(i).copied().unwrap_or(f64::NAN), limit, dt_ns))
        .collect()
}

/// The outputs as they are, within their limits.
#[must_use]
pub fn hold(held: &[f64], limits: &[OutputLimit]) -> Vec<f64> {
    limits
        .iter()
        .enumerate()
        .map(|(i, limit)| {
            let held = held.get(i).copied().unwrap_or(f64::NAN);
            approach(held, held, limit, 0)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn limit() -> impl Strategy<Value = OutputLimit> {
        (
            -100.0..100.0f64,
            0.0..100.0f64,
            prop::option::of(0.001..1000.0f64),
            0.0..1.0f64,
        )
            .prop_map(|(low, span, rate_per_s, part)| OutputLimit {
                low,
                high: low + span,
                rate_per_s,
                safe: low + span * part,
            })
    }

    proptest! {
        #[test]
        fn outputs_are_finite_in_range_and_rate(
            l in limit(),
            wanted in prop::num::f64::ANY,
            held in prop::num::f64::ANY,
            manual in prop::num::f64::ANY,
            auto in any::<bool>(),
            dt_ns in 1u64..10_000_000_000,
        ) {
            let mode = if auto { Mode::Automatic } else { Mode::Manual };
            let g = guard(mode, &[wanted], &[manual], &[held], &[l], dt_ns);
            let out = g.outputs[0];
            prop_assert!(out.is_finite() && out >= l.low && out <= l.high, "{out}");
            if let (Some(rate), true) = (l.rate_per_s, held.is_finite() && (l.low..=l.high).contains(&held)) {
                prop_assert!((out - held).abs() <= rate * dt_ns as f64 * 1e-9 * (1.0 + 1e-9) + 1e-9 * held.abs().max(1.0));
            }
            let safe = towards_safe(&[held], &[l], dt_ns)[0];
            prop_assert!(safe >= l.low && safe <= l.high);
            let kept = hold(&[held], &[l])[0];
            prop_assert!(kept >= l.low && kept <= l.high);
        }
    }

    #[test]
    fn nan_holds_and_limits_are_flagged() {
        let l = OutputLimit {
            low: 0.0,
            high: 10.0,
            rate_per_s: None,
            safe: 0.0,
        };
        let g = guard(Mode::Automatic, &[f64::NAN], &[3.0], &[7.0], &[l], 1);
        assert_eq!((g.outputs[0], g.limited), (7.0, 1));
        let g = guard(Mode::Automatic, &[11.0], &[3.0], &[7.0], &[l], 1);
        assert_eq!((g.outputs[0], g.limited), (10.0, 1));
        let g = guard(Mode::Manual, &[11.0], &[3.0], &[7.0], &[l], 1);
        assert_eq!((g.outputs[0], g.limited), (3.0, 0));
    }
}
