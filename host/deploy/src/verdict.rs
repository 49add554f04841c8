//! From figures to a verdict in one word, with its reason. Pure.
//!
//! Never: softens. A fault weighs more than any likeness, and the worst output of the worst cycle counts, not a mean.

use crate::report::{StepTimes, TrialReport, Verdict};

/// Differences up to this, in % of span, count as none.
const SAME_PERCENT: f64 = 0.01;

/// Times of steps from what each took, in ns.
pub(crate) fn times(steps_ns: &[u32]) -> StepTimes {
    let mut sorted = steps_ns.to_vec();
    sorted.sort_unstable();
    // The nearest rank: a time that really was.
    let at = |part: f64| {
        let rank = (sorted.len() as f64 * part).ceil() as usize;
        sorted
            .get(rank.saturating_sub(1))
            .map_or(0.0, |ns| f64::from(*ns) / 1e3)
    };
    StepTimes {
        p50_us: at(0.5),
        p99_us: at(0.99),
        worst_us: at(1.0),
    }
}

/// The verdict and its reason. A fault weighs more than any likeness.
pub(crate) fn judged(report: &TrialReport) -> (Option<Verdict>, String) {
    let worst = report
        .outputs
        .iter()
        .max_by(|a, b| a.max_percent.total_cmp(&b.max_percent));
    if let Some(fault) = &report.first_fault {
        let (term, seq) = fault.position;
        let reason = format!(
            "it faulted in {} of {} cycles, first in cycle {seq} of term {term}: {}",
            report.faults, report.cycles, fault.text
        );
        return (Some(Verdict::Fails), reason);
    }
    let (Some(worst), 1..) = (worst, report.compared) else {
        return (None, "no cycle could be compared".to_owned());
    };
    let limit = report.bump_limit_percent;
    let (term, seq) = worst.max_at;
    let (port, percent) = (&worst.port, worst.max_percent);
    if report.equal == report.compared {
        let reason = format!("all outputs of {} cycles are equal to the last bit", report.compared);
        (Some(Verdict::Same), reason)
    } else if percent <= SAME_PERCENT {
        let reason = format!("no output is farther away than {percent:.2e} % of its span");
        (Some(Verdict::Same), reason)
    } else if percent <= limit {
        let reason = format!(
            "{port} is at most {percent:.3} % of its span away, in cycle {seq} of term {term}; a swap may step by {limit} %"
        );
        (Some(Verdict::Close), reason)
    } else {
        let reason = format!(
            "{port} is up to {percent:.3} % of its span away, in cycle {seq} of term {term}; a swap may step by {limit} %"
        );
        (Some(Verdict::Differs), reason)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use std::collections::BTreeMap;

    use bumpless_core::LoopId;

    use super::*;
    use crate::report::{Finding, IndexReport, OutputReport};

    fn output(port: &str, max_percent: f64) -> OutputReport {
        OutputReport {
            port: port.into(),
            unit: String::new(),
            span: 100.0,
            max_percent,
            max_at: (3, 7),
            mean_percent: 0.0,
            rms_percent: 0.0,
            recorded_travel: 0.0,
            candidate_travel: 0.0,
        }
    }

    fn report(outputs: Vec<OutputReport>, compared: u64, equal: u64) -> TrialReport {
        TrialReport {
            loop_id: LoopId::new("l").unwrap(),
            component: String::new(),
            digest: bumpless_core::Digest::of(b""),
            parameters: BTreeMap::new(),
            dropped_parameters: vec![],
            dropped_ports: vec![],
            taken_over_by: None,
            anchored_anew: 0,
            from_ns: 0,
            to_ns: 0,
            cycles: 10,
            compared,
            equal,
            held: 0,
            faults: 0,
            first_fault: None,
            skipped: vec![],
            bump_percent: None,
            bump_limit_percent: 5.0,
            outputs,
            steps: StepTimes::default(),
            indices: IndexReport::default(),
            verdict: None,
            reason: String::new(),
            measured_port: None,
            measured_unit: String::new(),
            cycles_per_point: 1,
            points: vec![],
            unread: 0,
            stopped_early: None,
        }
    }

    #[test]
    fn verdicts_follow_the_worst_output_and_a_fault_is_worse_than_any() {
        let both = |worst| vec![output("a", 0.001), output("b", worst)];
        let mut faulty = report(both(0.0), 9, 9);
        (faulty.faults, faulty.first_fault) = (
            1,
            Some(Finding {
                position: (2, 5),
                text: "it trapped".into(),
            }),
        );
        let table = [
            (report(both(0.0), 9, 9), Some(Verdict::Same), "equal to the last bit"),
            (report(both(0.01), 9, 8), Some(Verdict::Same), "1.00e-2 %"),
            (report(both(4.9), 9, 8), Some(Verdict::Close), "b is at most 4.900 %"),
            (
                report(both(5.1), 9, 8),
                Some(Verdict::Differs),
                "b is up to 5.100 % of its span away, in cycle 7 of term 3",
            ),
            (
                report(both(f64::INFINITY), 9, 8),
                Some(Verdict::Differs),
                "b is up to inf %",
            ),
            (report(both(0.0), 0, 0), None, "no cycle could be compared"),
            (report(vec![], 9, 9), None, "no cycle could be compared"),
            (
                faulty,
                Some(Verdict::Fails),
                "faulted in 1 of 10 cycles, first in cycle 5 of term 2: it trapped",
            ),
        ];
        for (report, verdict, part) in table {
            let (found, reason) = judged(&report);
            assert_eq!(found, verdict, "{reason}");
            assert!(reason.contains(part), "{part}: {reason}");
        }
    }

    #[test]
    fn times_are_ranks() {
        assert_eq!(times(&[]), StepTimes::default());
        let hundred: Vec<u32> = (1..=100).rev().map(|us| us * 1000).collect();
        let told = times(&hundred);
        assert_eq!((told.p50_us, told.p99_us, told.worst_us), (50.0, 99.0, 100.0));
        assert_eq!(times(&[7_000]).p50_us, 7.0);
    }
}
