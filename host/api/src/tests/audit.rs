//! The audit trail over HTTP: what is asked arrives, an export is what stands on the disk, and a name goes with its request.

use axum::http::{Request, StatusCode, header};
use bumpless_core::{
    HostId,
    audit::{BEGINNING, Checker, bind},
};
use bumpless_deploy::{
    Error,
    alarms::{AlarmLoad, FrequentAlarm},
    audit::{Asker, AuditFilter, AuditFlaw, AuditLine, AuditList, AuditPage, AuditVerdict, Via},
    webhook::WebhookView,
};
use serde_json::json;
use tokio::sync::broadcast;

use super::{
    Bench,
    fake::{Fake, host},
    get,
};
use crate::{
    cell::Answer,
    trail::{self, Verdicts},
};

/// What was asked, and in whose name.
#[derive(Default)]
pub(crate) struct Trail {
    asked: Vec<(AuditFilter, Option<String>, Asker)>,
}

/// Three lines of the chain of host `h`, a minute apart.
fn lines() -> Vec<String> {
    let (mut prev, mut lines) = (BEGINNING, Vec::new());
    for n in 1..=3_u64 {
        let said = json!({
            "at": format!("2026-01-01T00:0{n}:00.000Z"), "what": "loop.setpoint", "by": "ann, of \"b\"", "via": "api",
            "from": "192.0.2.1:9", "loop": "l", "target": "", "asked": { "setpoint": n },
            "changes": [{ "field": "setpoint", "before": n - 1, "after": n }], "outcome": "done", "reason": "", "took_ms": 3,
        });
        let (line, link) = bind(&host(), n, prev, &said.to_string()).expect("an entry");
        prev = link.hash;
        lines.push(line);
    }
    lines
}

fn entry(line: &str) -> AuditLine {
    serde_json::from_str(line).expect("an entry")
}

impl trail::Trail for Fake {
    fn audit(&self, filter: AuditFilter, after: Option<String>) -> Answer<AuditList> {
        self.trail.lock().unwrap().asked.push((filter, after, Asker::current()));
        let list = AuditList {
            lines: lines().iter().rev().map(|line| entry(line)).collect(),
            next: Some("h:1".to_owned()),
            silent: vec![(HostId::new("gone").expect("valid"), "it is away".to_owned())],
        };
        self.answer(list)
    }

    fn audit_page(&self, _host: HostId, from: u64) -> Answer<AuditPage> {
        // One line a page, so that an export has to go on.
        let line = lines().into_iter().nth(usize::try_from(from).unwrap() - 1);
        let next = (from < 3).then_some(from + 1);
        self.answer(AuditPage {
            lines: line.into_iter().collect(),
            next,
        })
    }

    fn verify_audit(&self) -> Answer<Verdicts> {
        let verdict = AuditVerdict {
            host: host(),
            first: 1,
            last: 2,
            hash: "ab".repeat(32),
            bytes: 900,
            waiting: 0,
            flaw: Some(AuditFlaw {
                segment: "000000000001.jsonl".to_owned(),
                line: 3,
                reason: "entry 3 of host h was changed".to_owned(),
            }),
        };
        let away = HostId::new("gone").expect("valid");
        self.answer(vec![
            (host(), Ok(verdict)),
            (away, Err(Error::unreachable("it is away", ""))),
        ])
    }

    fn alarm_load(&self) -> Answer<(AlarmLoad, trail::Silent)> {
        let load = AlarmLoad {
            spans: (0..144).map(|n| if n == 143 { 12 } else { 0 }).collect(),
            stale: 1,
            by_priority: [9, 3, 0],
            frequent: vec![FrequentAlarm {
                loop_id: super::fake::loop_id("l"),
                alarm: "high".to_owned(),
                comings: 9,
                chattered: true,
            }],
            ..AlarmLoad::default()
        };
        self.answer((load, Vec::new()))
    }

    fn webhooks(&self) -> Answer<(Vec<WebhookView>, trail::Silent)> {
        let view = WebhookView {
            host: host(),
            name: "pager".to_owned(),
            to: "http://192.0.2.7/".to_owned(),
            waiting: 2,
            told: 5,
            failed: 3,
            refused: 0,
            dropped: 1,
            last_told_unix_ms: None,
            trouble: Some("it is away".to_owned()),
        };
        self.answer((vec![view], Vec::new()))
    }

    fn alarm_events(&self) -> broadcast::Receiver<std::sync::Arc<bumpless_deploy::alarms::AlarmEvent>> {
        self.alarm_news.subscribe()
    }
}

#[tokio::test]
async fn entries_are_listed_by_what_is_asked() {
    let bench = Bench::new();
    let query = "/v1/audit?from=2026-01-01T00:00:00Z&loop=l&by=ann&what=loop&outcome=done&limit=3&after=h:9";
    let request = Request::get(query)
        .header("x-by", "eve")
        .body(axum::body::Body::empty());
    let (status, body) = bench.json(request.expect("a request")).await;
    assert_eq!(status, StatusCode::OK, "{body}");
    let (filter, after, asker) = bench.cell.trail.lock().unwrap().asked.pop().expect("it arrived");
    assert_eq!(
        (filter.limit, filter.from_unix_ms, after.as_deref()),
        (3, Some(1_767_225_600_000), Some("h:9"))
    );
    assert_eq!(
        (filter.what.as_deref(), filter.by.as_deref(), filter.outcome.as_deref()),
        (Some("loop"), Some("ann"), Some("done"))
    );
    assert_eq!((asker.by.as_str(), asker.via), ("eve", Via::Api));
    let first = &body["entries"][0];
    assert_eq!(
        (&first["number"], &first["loop"], &first["host"]),
        (&json!(3), &json!("l"), &json!("h"))
    );
    assert_eq!(
        first["changes"],
        json!([{ "field": "setpoint", "before": 2, "after": 3 }])
    );
    assert_eq!(
        (&body["next"], &body["silent"][0]["host"]),
        (&json!("h:1"), &json!("gone"))
    );
    for bad in ["limit=0", "limit=1001", "from=soon", "to=1h"] {
        let (status, body) = bench.json(get(&format!("/v1/audit?{bad}"))).await;
        assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{bad}: {body}");
    }
    let (status, _) = bench.json(get("/v1/audit?who=ann")).await;
    assert_eq!(status, StatusCode::BAD_REQUEST);
}

async fn exported(bench: &Bench, query: &str) -> (String, String) {
    let response = bench.ask(get(&format!("/v1/audit/export?host=h{query}"))).await;
    assert_eq!(response.status(), StatusCode::OK);
    let kind = response.headers()[header::CONTENT_TYPE]
        .to_str()
        .expect("text")
        .to_owned();
    let bytes = axum::body::to_bytes(response.into_body(), usize::MAX)
        .await
        .expect("a body");
    (kind, String::from_utf8(bytes.to_vec()).expect("text"))
}

#[tokio::test]
async fn an_export_is_what_stands_on_the_disk_and_can_be_verified_elsewhere() {
    let bench = Bench::new();
    let (kind, text) = exported(&bench, "").await;
    assert_eq!(kind, "text/x-ndjson");
    let mut checker = Checker::default();
    for line in text.lines() {
        checker.look(line).expect("it fits");
    }
    checker.closed().expect("sealed");
    assert_eq!(text.lines().collect::<Vec<_>>()[..3], lines());
    let (_, window) = exported(&bench, "&from=2026-01-01T00:02:00Z&to=2026-01-01T00:03:00Z").await;
    let window: Vec<&str> = window.lines().collect();
    assert_eq!((window.len(), window[0]), (2, lines()[1].as_str()));
    assert!(window[1].starts_with("{\"seal\":\"h\",\"first\":2,"), "{}", window[1]);
    let (kind, table) = exported(&bench, "&format=csv").await;
    assert!(kind.starts_with("text/csv"), "{kind}");
    let mut reader = csv::Reader::from_reader(table.as_bytes());
    let rows: Vec<csv::StringRecord> = reader.records().collect::<Result<_, _>>().expect("a table");
    assert_eq!(
        (rows.len(), &rows[2][4], &rows[2][12]),
        (3, "ann, of \"b\"", "setpoint: 2 -> 3")
    );
    let (_, empty) = exported(&bench, "&from=2027-01-01T00:00:00Z").await;
    assert_eq!(empty, "");
    *bench.cell.refusal.lock().unwrap() = Some(Error::unreachable("it is away", ""));
    let (status, _) = bench.json(get("/v1/audit/export?host=h")).await;
    assert_eq!(status, StatusCode::SERVICE_UNAVAILABLE);
}

#[tokio::test]
async fn a_chain_that_does_not_fit_is_said_to_be_so() {
    let (status, body) = Bench::new().json(get("/v1/audit/verify")).await;
    assert_eq!((status, &body["good"]), (StatusCode::OK, &json!(false)));
    let chain = &body["chains"][0];
    assert_eq!((&chain["good"], &chain["flaw"]["line"]), (&json!(false), &json!(3)));
    assert_eq!(body["silent"][0]["host"], "gone");
}

#[tokio::test]
async fn the_load_of_operators_is_told_in_the_figures_of_the_standard() {
    let bench = Bench::new();
    let (status, body) = bench.json(get("/v1/alarms/metrics")).await;
    assert_eq!(status, StatusCode::OK, "{body}");
    let figures = [
        &body["comings"],
        &body["now_per_10_min"],
        &body["peak_per_10_min"],
        &body["floods"],
        &body["stale"],
    ];
    assert_eq!(figures, [&json!(12), &json!(12), &json!(12), &json!(1), &json!(1)]);
    assert_eq!(body["percent_by_priority"], json!([75.0, 25.0, 0.0]));
    assert_eq!(
        (&body["frequent"][0]["percent"], &body["chattering"]),
        (&json!(75.0), &json!(1))
    );
    let (_, body) = bench.json(get("/v1/webhooks")).await;
    let hook = &body["webhooks"][0];
    assert_eq!(
        (&hook["name"], &hook["waiting"], &hook["trouble"]),
        (&json!("pager"), &json!(2), &json!("it is away"))
    );
}
