//! Rollouts over HTTP: what is asked arrives with its defaults, what cannot be is refused in words.

use axum::http::StatusCode;
use bumpless_deploy::{
    Error as DeployError,
    rollout::{LegView, OnFailure, RolloutView, Rule, Stage, State},
};
use serde_json::json;

use super::{
    Bench,
    fake::{digest, host, loop_id},
    get, send,
};

/// A rollout of one loop, which failed.
pub(super) fn rollout(id: String, state: State) -> RolloutView {
    RolloutView {
        id,
        host: host(),
        component: "pid@1.0.0".into(),
        digest: digest(),
        parameters: [("kp".to_owned(), 2.0)].into(),
        rule: Rule::default(),
        state,
        failure: Some("l: it trapped".into()),
        started_at_unix_ms: 5,
        ended_at_unix_ms: None,
        total: 1,
        done: 0,
        loops: vec![LegView {
            loop_id: loop_id("l"),
            stage: Stage::RolledBack,
            reason: "it trapped".into(),
            cycles_before: 200,
            cycles: 7,
            revision_before: 1,
            revision: Some(2),
            error_before: Some(0.5),
            error: Some(f64::NAN),
        }],
    }
}

#[tokio::test]
async fn a_rollout_arrives_as_it_was_asked_for() {
    let bench = Bench::new();
    let asked = json!({"component": "pid", "loops": ["l", "m"]});
    let (status, body) = bench.json(send("POST", "/v1/rollouts", &asked)).await;
    assert_eq!((status, &body["id"]), (StatusCode::CREATED, &json!("h.3")), "{body}");
    let draft = bench.cell.rollouts.lock().unwrap().pop().expect("it arrived");
    assert_eq!((draft.rule, draft.all_of), (Rule::default(), None));
    let names: Vec<&str> = draft.loops.iter().map(bumpless_core::LoopId::as_str).collect();
    assert_eq!(names, ["l", "m"]);
    let asked = json!({
        "component": "pid", "all_of": "pid@1.0.0", "parameters": {"kp": 3}, "cycles": 50, "factor": 1.5, "at_once": 4,
        "on_failure": "back",
    });
    let (status, _) = bench.json(send("POST", "/v1/rollouts", &asked)).await;
    assert_eq!(status, StatusCode::CREATED);
    let draft = bench.cell.rollouts.lock().unwrap().pop().expect("it arrived");
    let rule = Rule {
        cycles: 50,
        factor: 1.5,
        at_once: 4,
        on_failure: OnFailure::Back,
    };
    assert_eq!((draft.rule, draft.all_of.as_deref()), (rule, Some("pid@1.0.0")));
    assert_eq!(draft.parameters, [("kp".to_owned(), 3.0)].into());

    for (asked, part) in [
        (json!({"loops": ["l"]}), "missing field `component`"),
        (json!({"component": "pid", "loop": "l"}), "unknown field `loop`"),
        (json!({"component": "pid", "loops": ["L"]}), "use lower-case letters"),
        (
            json!({"component": "pid", "on_failure": "forth"}),
            "unknown variant `forth`",
        ),
        (json!({"component": "pid", "cycles": -1}), "u32"),
    ] {
        let (status, body) = bench.json(send("POST", "/v1/rollouts", &asked)).await;
        assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{body}");
        assert!(body.to_string().contains(part), "{part}: {body}");
    }
    assert!(bench.cell.rollouts.lock().unwrap().is_empty());
}

#[tokio::test]
async fn reports_are_plain_json() {
    let bench = Bench::new();
    let (_, list) = bench.json(get("/v1/rollouts")).await;
    assert_eq!(list["silent"], json!([{"host": "b", "reason": "it did not answer"}]));
    assert_eq!(
        (&list["rollouts"][0]["state"], &list["rollouts"][0]["total"]),
        (&json!("failed"), &json!(1))
    );
    let (status, shown) = bench.json(get("/v1/rollouts/plant.7")).await;
    assert_eq!((status, &shown["id"]), (StatusCode::OK, &json!("plant.7")));
    assert_eq!(
        shown["loops"],
        json!([{
            "loop": "l", "stage": "rolled-back", "reason": "it trapped", "cycles_before": 200, "cycles": 7,
            "revision_before": 1, "revision": 2, "error_before": 0.5, "error": null,
        }])
    );
    assert_eq!((&shown["cycles"], &shown["on_failure"]), (&json!(200), &json!("stop")));
    let (status, stopped) = bench.json(send("POST", "/v1/rollouts/plant.7/stop", &json!({}))).await;
    assert_eq!((status, &stopped["state"]), (StatusCode::OK, &json!("stopped")));
    let refusal = DeployError::not_found("host h has no rollout 7", "list the rollouts");
    *bench.cell.refusal.lock().unwrap() = Some(refusal);
    let (status, problem) = bench.json(get("/v1/rollouts/h.7")).await;
    assert_eq!(status, StatusCode::NOT_FOUND, "{problem}");
    assert!(problem.to_string().contains("no rollout 7"), "{problem}");
}
