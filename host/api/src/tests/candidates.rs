//! What a candidate beside a loop shows, with numbers that JSON has no word for.

use bumpless_core::LoopId;
use bumpless_deploy::report::{
    CurvePoint, IndexReport, OutputReport, ShadowView, StepTimes, Trial, TrialReport, Verdict,
};

use super::fake::digest;

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
