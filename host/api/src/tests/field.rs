//! Points, forces and jobs over HTTP: what is asked arrives whole, what cannot be is refused in words.

use axum::http::{StatusCode, header};
use bumpless_core::{PointId, Quality};
use bumpless_deploy::{
    Error as DeployError, PointView, Words,
    commissioning::{
        Block, BusView, FieldEvent, ForceDraft, ForceView, JobDraft, JobState, JobTask, JobView, ScanPlan, Table,
    },
};
use serde_json::json;
use tokio::sync::broadcast;

use super::{
    Bench,
    fake::{Fake, host},
    get, send,
};
use crate::{cell::Answer, field::Field};

fn point(force: Option<ForceView>) -> PointView {
    PointView {
        id: PointId::new("line.out").unwrap(),
        host: host(),
        bus: "line".into(),
        unit: "%".into(),
        range: (0.0, 100.0),
        writable: true,
        value: Some(4.5),
        quality: if force.is_some() {
            Quality::Forced
        } else {
            Quality::Good
        },
        reason: String::new(),
        age_ms: 3,
        written_by: None,
        text: "valve".into(),
        force,
    }
}

fn job(draft: Option<JobDraft>) -> JobView {
    JobView {
        id: "h.1000001".into(),
        host: host(),
        bus: "line".into(),
        task: "read-block".into(),
        by: "ann".into(),
        key: draft.and_then(|draft| draft.key),
        state: JobState::Queued,
        ahead: 2,
        step: 0,
        steps: 1,
        reason: String::new(),
        result: vec![Block {
            unit_id: 1,
            table: Table::Input,
            address: 7,
            count: 1,
            values: vec![9],
        }],
        asked_unix_ms: 5,
        began_unix_ms: None,
        ended_unix_ms: None,
    }
}

impl Field for Fake {
    fn point(&self, _: PointId) -> Answer<PointView> {
        self.answer(point(None))
    }
    fn write_point(&self, _: PointId, value: f64, _: String) -> Answer<PointView> {
        self.answer(PointView {
            value: Some(value),
            ..point(None)
        })
    }
    fn force(&self, _: PointId, draft: ForceDraft) -> Answer<PointView> {
        self.answer(point(Some(ForceView {
            value: draft.value,
            since_unix_ms: 1_000,
            until_unix_ms: 1_000 + draft.seconds * 1_000,
            by: draft.by,
            why: draft.why,
        })))
    }
    fn unforce(&self, _: PointId, _: String) -> Answer<PointView> {
        self.answer(point(None))
    }
    fn buses(&self) -> Answer<Vec<BusView>> {
        self.answer(vec![BusView {
            host: host(),
            id: "line".into(),
            driver: "modbus-tcp".into(),
            connected: true,
            points: 3,
            polls: 10,
            writes: 2,
            errors: 0,
            last_error: None,
            latency_us: 400,
            jobs: vec![("set-range".into(), "0 to 150".into())],
            jobs_waiting: 1,
            master: None,
        }])
    }
    fn start_job(&self, draft: JobDraft) -> Answer<JobView> {
        let view = job(Some(draft.clone()));
        self.jobs.lock().unwrap().push(draft);
        self.answer(view)
    }
    fn jobs(&self) -> Answer<Vec<JobView>> {
        self.answer(vec![job(None)])
    }
    fn job(&self, _: String) -> Answer<JobView> {
        self.answer(job(None))
    }
    fn cancel_job(&self, _: String, _: String) -> Answer<JobView> {
        self.answer(JobView {
            state: JobState::Cancelled,
            ..job(None)
        })
    }
    fn field_events(&self) -> broadcast::Receiver<FieldEvent> {
        self.news.subscribe()
    }
}

#[tokio::test]
async fn points_are_shown_written_and_forced() {
    let bench = Bench::new();
    let (status, body) = bench.json(get("/v1/points/line.out")).await;
    assert_eq!(
        (status, &body["quality"], &body["force"]),
        (StatusCode::OK, &json!("good"), &json!(null))
    );
    let write = json!({"value": 7.5, "by": "ann"});
    let (status, body) = bench.json(send("POST", "/v1/points/line.out/write", &write)).await;
    assert_eq!((status, &body["value"]), (StatusCode::OK, &json!(7.5)));
    let force = json!({"value": 50.0, "seconds": 60, "by": "ann", "why": "pump test"});
    let (status, body) = bench.json(send("POST", "/v1/points/line.out/force", &force)).await;
    assert_eq!((status, &body["quality"]), (StatusCode::OK, &json!("forced")));
    assert_eq!(
        body["force"],
        json!({"value": 50.0, "since_unix_ms": 1000, "until_unix_ms": 61000, "by": "ann", "why": "pump test"})
    );
    let (status, _) = bench
        .json(send("POST", "/v1/points/line.out/unforce", &json!({"by": "bob"})))
        .await;
    assert_eq!(status, StatusCode::OK);
    for (path, body, part) in [
        ("/v1/points/Line/write", &write, "contains 'L'"),
        ("/v1/points/line.out/force", &write, "missing field"),
        (
            "/v1/points/line.out/unforce",
            &json!({"by": "x", "why": "y"}),
            "unknown field",
        ),
    ] {
        let (status, problem) = bench.json(send("POST", path, body)).await;
        assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{problem}");
        assert!(problem["detail"].as_str().unwrap().contains(part), "{problem}");
    }
    let (status, body) = bench.json(get("/v1/buses")).await;
    assert_eq!(
        (status, &body["buses"][0]["jobs"][0]["name"]),
        (StatusCode::OK, &json!("set-range"))
    );
}

#[tokio::test]
async fn a_job_is_acknowledged_with_its_address() {
    let bench = Bench::new();
    let asked =
        json!({"bus": "line", "by": "ann", "key": "k1", "read_block": {"table": "input", "address": 7, "count": 1}});
    let response = bench.ask(send("POST", "/v1/jobs", &asked)).await;
    assert_eq!(response.status(), StatusCode::ACCEPTED);
    assert_eq!(response.headers()[header::LOCATION], "/v1/jobs/h.1000001");
    let draft = bench.cell.jobs.lock().unwrap().pop().expect("it arrived");
    assert_eq!(
        (draft.queue_ms, draft.timeout_ms, draft.host.as_ref()),
        (60_000, None, None)
    );
    assert_eq!(
        draft.task,
        JobTask::ReadBlock {
            unit_id: None,
            table: Table::Input,
            address: 7,
            count: 1
        }
    );
    let scan = json!({"bus": "line", "by": "ann", "scan": {"units": [3], "tables": ["coil"]}});
    bench.json(send("POST", "/v1/jobs", &scan)).await;
    let usual = ScanPlan::default();
    let expected = ScanPlan {
        units: vec![3],
        tables: vec![Table::Coil],
        ..usual
    };
    assert_eq!(
        bench.cell.jobs.lock().unwrap().pop().unwrap().task,
        JobTask::Scan(expected)
    );
    let (_, body) = bench.json(get("/v1/jobs/h.1000001")).await;
    assert_eq!(
        (&body["state"], &body["result"][0]["values"]),
        (&json!("queued"), &json!([9]))
    );
    let (_, body) = bench.json(get("/v1/jobs")).await;
    assert_eq!(body["jobs"][0]["ahead"], json!(2));
    let (status, body) = bench
        .json(send("POST", "/v1/jobs/h.1000001/cancel", &json!({"by": "bob"})))
        .await;
    assert_eq!((status, &body["state"]), (StatusCode::OK, &json!("cancelled")));
}

#[tokio::test]
async fn jobs_that_cannot_be_are_refused_in_words() {
    let bench = Bench::new();
    for (asked, part) in [
        (json!({"bus": "line", "by": "ann"}), "does nothing"),
        (
            json!({"bus": "line", "by": "ann", "name": "a", "scan": {}}),
            "several jobs",
        ),
        (
            json!({"bus": "line", "by": "ann", "name": "a", "host": "H"}),
            "host name",
        ),
        (
            json!({"bus": "line", "by": "ann", "read_block": {"table": "inputs", "address": 0, "count": 1}}),
            "unknown variant",
        ),
        (json!({"bus": "line", "name": "a"}), "missing field `by`"),
    ] {
        let (status, problem) = bench.json(send("POST", "/v1/jobs", &asked)).await;
        assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{problem}");
        assert!(problem["detail"].as_str().unwrap().contains(part), "{part}: {problem}");
    }
    *bench.cell.refusal.lock().unwrap() = Some(DeployError::Busy(Words::new("16 jobs wait for bus line", "wait")));
    let asked = json!({"bus": "line", "by": "ann", "name": "a"});
    let response = bench.ask(send("POST", "/v1/jobs", &asked)).await;
    assert_eq!(response.status(), StatusCode::SERVICE_UNAVAILABLE);
    assert_eq!(response.headers()[header::RETRY_AFTER], "1");
}
