//! What a candidate beside a loop shows, with numbers that JSON has no word for.

use bumpless_core::LoopId;
use bumpless_deploy::report::{
    CurvePoint, IndexReport, OutputReport, ShadowView, StepTimes, Trial, TrialReport, Verdict,
};

use super::fake::{digest, host};

/// A report of a trial.
pub(super) fn admission(verdict: bumpless_core::Verdict) -> bumpless_core::Admission {
    bumpless_core::Admission {
        checked_at_unix_ms: 1,
        host: host(),
        verdict,
        cycles: 400,
        steps: 300,
        step_p50_ns: 1_500,
        step_p99_ns: 2_500,
        step_worst_ns: 9_000,
        start_ns: 4_000,
        migrated: bumpless_core::Migrated::Declined,
        migrate_ns: 3_000,
        state_bytes: 40,
        memory_bytes: 1_048_576,
        compile_ms: None,
        findings: vec![bumpless_core::Finding {
            severity: bumpless_core::Severity::Refusal,
            text: "it trapped".to_owned(),
        }],
    }
}

pub(super) fn trial() -> Trial {
    Trial {
        component: "pid".into(),
        parameters: Default::default(),
    }
}

pub(super) fn shadow(id: LoopId, trial: Trial, cycles_wanted: u64) -> ShadowView {
    ShadowView {
        id: 1,
        cycles_wanted,
        missed: 0,
        started_at_unix_ms: 7,
        ended: None,
        complete: false,
        report: trial_report(id, trial),
    }
}

pub(super) fn trial_report(loop_id: LoopId, trial: Trial) -> TrialReport {
    TrialReport {
        loop_id,
        component: trial.component,
        digest: digest(),
        parameters: trial.parameters,
        dropped_parameters: vec!["kd".into()],
        dropped_ports: vec![],
        taken_over_by: Some("migrate".into()),
        anchored_anew: 0,
        from_ns: 1_000_000,
        to_ns: 2_000_000,
        cycles: 2,
        compared: 2,
        equal: 1,
        held: 0,
        faults: 0,
        first_fault: None,
        skipped: vec![],
        bump_percent: Some(f64::INFINITY),
        bump_limit_percent: 5.0,
        outputs: vec![OutputReport {
            port: "out".into(),
            unit: "%".into(),
            span: 100.0,
            max_percent: 7.0,
            max_at: (1, 2),
            mean_percent: 3.5,
            rms_percent: 5.0,
            recorded_travel: 1.0,
            candidate_travel: 8.0,
        }],
        steps: StepTimes::default(),
        indices: IndexReport::default(),
        verdict: Some(Verdict::Differs),
        reason: "out is up to 7 % away".into(),
        measured_port: Some("pv".into()),
        measured_unit: "bar".into(),
        cycles_per_point: 1,
        points: vec![CurvePoint {
            at_ns: 1_000_000,
            setpoint: 1.0,
            measurement: f64::NAN,
            recorded: vec![1.0],
            candidate: vec![8.0],
        }],
        unread: 0,
        stopped_early: None,
    }
}
