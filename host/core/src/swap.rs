//! Going on with another revision while the loop runs: what is kept, how large the bump is, and when to go back.
//!
//! ```text
//! in force ── Revise(r) rides in a sample ──► hand over: same state | migrate | start(track)
//!     ▲                                          │ bump within the loop's limit?
//!     │ no: refused, the old one keeps the cycle │ yes
//!     │                                          ▼
//!     └──── a fault within n cycles ───────── probation(n) ──► done
//!           (same cycle, old component, start from what the actuators hold)
//! ```

use crate::{record::Record, spec::LoopSpec, wiring::Wiring};

/// How the controller's state comes over.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum HandOver {
    /// Component and parameters stay; so do the bytes.
    Same,
    /// `migrate`, and `start` with what the actuators hold where it declines.
    Migrate,
    /// `start` with what the actuators hold: the state speaks of other points.
    Start,
}

/// What a change from `old` to `new` asks of the state.
#[must_use]
pub fn hand_over(old: &LoopSpec, new: &LoopSpec) -> HandOver {
    if old.digest == new.digest && old.parameters == new.parameters && old.ports == new.ports {
        HandOver::Same
    } else if speaks_of_other_points(old, new) {
        HandOver::Start
    } else {
        HandOver::Migrate
    }
}

/// A port that is connected elsewhere now, and, within one component, one that is connected or let go: what the state
/// remembers of it would be taken for the new point's, and the output would jump by the difference. Ports that only one of
/// two components has are no part of a state that the other understands.
fn speaks_of_other_points(old: &LoopSpec, new: &LoopSpec) -> bool {
    let moved = |(port, point)| old.ports.get(port).is_some_and(|before| before != point);
    (old.digest == new.digest && old.ports != new.ports) || new.ports.iter().any(moved)
}

/// The bump of a switch, in % of span: how far the new outputs are from what the old controller would have sent in the
/// same cycle, for the worst output. `spans` has the span of each output. Infinite where the outputs cannot be compared.
#[must_use]
pub fn bump_percent(old_outputs: &[f64], new_outputs: &[f64], spans: &[f64]) -> f64 {
    if old_outputs.len() != new_outputs.len() || spans.len() != new_outputs.len() {
        return f64::INFINITY;
    }
    old_outputs
        .iter()
        .zip(new_outputs)
        .zip(spans)
        .map(|((old, new), span)| 100.0 * (new - old).abs() / span)
        // `max` would drop a NaN; a bump that cannot be told is not a small one.
        .fold(
            0.0,
            |worst: f64, b| if b.is_nan() { f64::INFINITY } else { worst.max(b) },
        )
}

/// The bump of a switch from the outputs of one revision to those of another, in % of span, for the worst one. Outputs are the
/// same where they drive the same point. One whose point the old revision did not drive is compared with `actuators`, what the
/// new one's actuators hold. One that drives no point moves nothing, and does not count.
#[must_use]
pub fn bump_between(
    (old, old_outputs): (&Wiring, &[f64]),
    (new, new_outputs): (&Wiring, &[f64]),
    actuators: &[f64],
) -> f64 {
    if new_outputs.len() != new.outputs.len() {
        return f64::INFINITY;
    }
    let before = new.outputs_from(old_outputs, old, actuators);
    let connected = |i: &usize| new.driven(*i).is_some();
    let of = |values: &[f64]| -> Vec<f64> {
        let each = values.iter().copied().enumerate();
        each.filter(|(i, _)| connected(i)).map(|(_, value)| value).collect()
    };
    let spans: Vec<f64> = (0..new_outputs.len()).filter(connected).map(|i| new.span(i)).collect();
    bump_percent(&of(&before), &of(new_outputs), &spans)
}

/// The probation that the next record carries: it counts down and ends by itself.
#[must_use]
pub fn probation_after(before: Option<&Record>) -> Option<(u64, u32)> {
    before
        .and_then(|r| r.probation)
        .and_then(|(revision, left)| (left > 1).then(|| (revision, left - 1)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::record::test_record;

    #[test]
    fn bump_is_the_worst_output_in_percent_of_its_span() {
        assert_eq!(bump_percent(&[50.0, 5.0], &[50.5, 5.0], &[100.0, 10.0]), 0.5);
        assert_eq!(bump_percent(&[50.0, 5.0], &[50.5, 6.0], &[100.0, 10.0]), 10.0);
        assert_eq!(bump_percent(&[50.0], &[f64::NAN], &[100.0]), f64::INFINITY);
        assert_eq!(bump_percent(&[50.0], &[50.0, 1.0], &[100.0, 1.0]), f64::INFINITY);
    }

    #[test]
    fn outputs_are_compared_by_the_point_that_they_drive() {
        let wiring = |points: &[Option<&str>]| Wiring {
            points: points
                .iter()
                .map(|p| p.map(|p| crate::PointId::new(p).expect("valid")))
                .collect(),
            outputs: (0..=u8::MAX).zip(points).map(|(i, _)| i).collect(),
            limits: points
                .iter()
                .map(|_| crate::OutputLimit {
                    low: 0.0,
                    high: 100.0,
                    rate_per_s: None,
                    safe: 0.0,
                })
                .collect(),
            required_inputs: vec![],
            parameters: vec![],
            connected: 0,
        };
        let (a, b, c) = (Some("v.a"), Some("v.b"), Some("v.c"));
        let old = wiring(&[a, b]);
        for (new, outputs, actuators, manual, bump) in [
            // The same two valves under ports of another order: nothing moves.
            (wiring(&[b, a]), [60.0, 20.0], [0.0, 0.0], vec![60.0, 20.0], 0.0),
            (wiring(&[b, a]), [20.0, 60.0], [0.0, 0.0], vec![60.0, 20.0], 40.0),
            // Another valve: compared with what it holds, whatever the old one's was.
            (wiring(&[c, b]), [7.0, 60.0], [7.0, 0.0], vec![7.0, 60.0], 0.0),
            (wiring(&[c, b]), [20.0, 60.0], [7.0, 0.0], vec![7.0, 60.0], 13.0),
            // A port without a point moves nothing.
            (wiring(&[a, None]), [20.0, 9e9], [0.0, 3.0], vec![20.0, 3.0], 0.0),
        ] {
            assert_eq!(
                new.outputs_from(&[20.0, 60.0], &old, &actuators),
                manual,
                "{:?}",
                new.points
            );
            let got = bump_between((&old, &[20.0, 60.0]), (&new, &outputs), &actuators);
            assert_eq!(got, bump, "{:?}", new.points);
        }
        assert_eq!(bump_between((&old, &[1.0, 2.0]), (&old, &[1.0]), &[0.0]), f64::INFINITY);
        assert_eq!(
            bump_between((&old, &[1.0, 2.0]), (&old, &[1.0, f64::NAN]), &[0.0, 0.0]),
            f64::INFINITY
        );
    }

    #[test]
    fn a_state_that_speaks_of_other_points_is_not_carried_over() {
        let spec = |digest: &[u8], ports: &[(&str, &str)], k: f64| LoopSpec {
            digest: crate::Digest::of(digest),
            ports: ports
                .iter()
                .map(|(port, point)| ((*port).to_owned(), crate::PointId::new(point).expect("valid")))
                .collect(),
            parameters: [("k".to_owned(), k)].into(),
            ..crate::intent::test_spec()
        };
        let pid = spec(b"pid", &[("pv", "p.1"), ("out", "p.2")], 1.0);
        for (new, expected) in [
            (pid.clone(), HandOver::Same),
            (spec(b"pid", &[("pv", "p.1"), ("out", "p.2")], 2.0), HandOver::Migrate),
            (spec(b"plus", &[("pv", "p.1"), ("out", "p.2")], 1.0), HandOver::Migrate),
            (
                spec(b"cascade", &[("pv", "p.1"), ("inner", "p.3"), ("out", "p.2")], 1.0),
                HandOver::Migrate,
            ),
            (spec(b"pid", &[("pv", "p.3"), ("out", "p.2")], 1.0), HandOver::Start),
            (spec(b"plus", &[("pv", "p.1"), ("out", "p.3")], 1.0), HandOver::Start),
            (
                spec(b"pid", &[("pv", "p.1"), ("ff", "p.3"), ("out", "p.2")], 1.0),
                HandOver::Start,
            ),
        ] {
            assert_eq!(hand_over(&pid, &new), expected, "{:?}", new.ports);
        }
    }

    #[test]
    fn probation_ends() {
        let mut record = test_record();
        record.probation = Some((3, 2));
        assert_eq!(probation_after(Some(&record)), Some((3, 1)));
        record.probation = Some((3, 1));
        assert_eq!(probation_after(Some(&record)), None);
        assert_eq!(probation_after(None), None);
    }
}
