//! The routes against a cell in memory: what is asked arrives, what fails is a problem in words, and every answer has the
//! shape that the document promises.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

mod access;
pub(crate) mod alarms;
pub(crate) mod audit;
mod candidates;
pub(crate) mod fake;
mod field;
pub(crate) mod guests;
mod history;
mod hosts;
mod lab;
mod library;
mod metrics;
mod page;
mod programs;
mod rollouts;
mod sharing;
mod signing;

use std::sync::{Arc, atomic::Ordering};

use axum::{
    Router,
    body::Body,
    http::{Request, StatusCode, header},
};
use bumpless_core::{CommandBody, CommandId, Mode, Outcome, limits::COMPONENT_BYTES_MAX};
use bumpless_deploy::{Error as DeployError, Upload, Words};
use fake::Fake;
use futures_util::StreamExt as _;
use serde_json::{Value, json};
use tokio::sync::watch;
use tower::ServiceExt as _;

use crate::{
    limits::{FEEDS_MAX, JSON_BYTES_MAX},
    server::{App, Options, router},
};

/// A cell, its API, and the switch that stops it.
struct Bench {
    cell: Arc<Fake>,
    app: App,
    router: Router,
    stop: watch::Sender<bool>,
}

impl Bench {
    fn new() -> Self {
        Self::with(&Options::default())
    }

    fn with(options: &Options) -> Self {
        let cell = Arc::new(Fake::new());
        let (stop, stopped) = watch::channel(false);
        let app = App::new(Arc::clone(&cell) as _, options, stopped);
        let router = router(app.clone());
        Self {
            cell,
            app,
            router,
            stop,
        }
    }

    async fn ask(&self, request: Request<Body>) -> axum::response::Response {
        self.router
            .clone()
            .oneshot(request)
            .await
            .expect("a router always answers")
    }

    /// Status and the body's bytes.
    async fn bytes(&self, request: Request<Body>) -> (StatusCode, Vec<u8>) {
        let response = self.ask(request).await;
        let status = response.status();
        let bytes = axum::body::to_bytes(response.into_body(), usize::MAX).await;
        (status, bytes.expect("a body").to_vec())
    }

    /// Status and JSON (null where the body is none).
    async fn json(&self, request: Request<Body>) -> (StatusCode, Value) {
        let response = self.ask(request).await;
        let status = response.status();
        let bytes = axum::body::to_bytes(response.into_body(), usize::MAX)
            .await
            .expect("a body");
        (status, serde_json::from_slice(&bytes).unwrap_or(Value::Null))
    }
}

/// What the API answers to an example of the document: status and JSON.
pub(crate) async fn example_answer(method: &str, path: &str, request: Option<&Value>) -> (u16, Value) {
    let (faults, _asked) = tokio::sync::mpsc::channel(1);
    let bench = Bench::with(&Options {
        faults: Some(faults),
        ..Options::default()
    });
    let method = method.to_uppercase();
    let mut request = match request {
        Some(body) => send(&method, path, body),
        None => raw(&method, path, "application/json", ""),
    };
    if path.starts_with("/v1/access/") {
        access::in_session(&bench, &mut request);
    }
    let (status, answer) = bench.json(request).await;
    (status.as_u16(), answer)
}

fn get(path: &str) -> Request<Body> {
    Request::get(path).body(Body::empty()).expect("a request")
}

fn send(method: &str, path: &str, body: &Value) -> Request<Body> {
    Request::builder()
        .method(method)
        .uri(path)
        .header(header::CONTENT_TYPE, "application/json")
        .body(Body::from(body.to_string()))
        .expect("a request")
}

fn raw(method: &str, path: &str, content_type: &str, body: impl Into<Body>) -> Request<Body> {
    Request::builder()
        .method(method)
        .uri(path)
        .header(header::CONTENT_TYPE, content_type)
        .body(body.into())
        .expect("a request")
}

#[tokio::test]
async fn what_cannot_be_read_is_a_problem_that_says_why() {
    let bench = Bench::new();
    let long = "x".repeat(JSON_BYTES_MAX + 1);
    let table = [
        (get("/v1/nothing"), 404, "no-such-route", "/v1/nothing is no address"),
        (raw("PATCH", "/v1/loops", "text/plain", ""), 405, "method", "PATCH"),
        (
            raw("PUT", "/v1/loops/l", "application/json", "{"),
            400,
            "bad-request",
            "EOF",
        ),
        (
            send("PUT", "/v1/loops/l", &json!({"nam": "l"})),
            422,
            "invalid",
            "unknown field `nam`",
        ),
        (
            raw("PUT", "/v1/loops/l", "text/plain", "{}"),
            415,
            "content-type",
            "text/plain",
        ),
        (
            raw("PUT", "/v1/loops/l", "application/json", long),
            413,
            "too-large",
            "longer than 262144 bytes",
        ),
        (
            send("PUT", "/v1/loops/other", &fake::draft("l")),
            422,
            "invalid",
            "the body \"l\"",
        ),
        (get("/v1/loops/Loop"), 422, "invalid", "'L'"),
        (get("/v1/loops?limit=0"), 422, "invalid", "limit = 0"),
        (get("/v1/loops?lmit=5"), 400, "bad-request", "lmit"),
        (get("/v1/live?loops=,"), 422, "invalid", "0 loops"),
        (get("/v1/live?loops=A"), 422, "invalid", "'A'"),
        (
            send("POST", "/v1/loops/l/setpoint", &json!({"setpoint": "high"})),
            422,
            "invalid",
            "setpoint",
        ),
        (
            send("POST", "/v1/loops/l/mode", &json!({"mode": "auto"})),
            422,
            "invalid",
            "`manual` or `automatic`",
        ),
        (
            send("POST", "/v1/loops/l/output", &json!({"outputs": {}})),
            422,
            "invalid",
            "no output is named",
        ),
        (
            send("POST", "/v1/loops/l/output", &json!({"outputs": {"x": 1}})),
            422,
            "invalid",
            "no output port \"x\"",
        ),
        (
            send("POST", "/v1/loops/l/move", &json!({"host": "a b"})),
            422,
            "invalid",
            "' '",
        ),
        (
            raw("POST", "/v1/components", "application/json", "{}"),
            415,
            "content-type",
            "application/json",
        ),
        (
            raw("POST", "/v1/components", "application/wasm", ""),
            422,
            "invalid",
            "the body is empty",
        ),
        (
            raw(
                "POST",
                "/v1/components",
                "application/wasm",
                vec![0; COMPONENT_BYTES_MAX + 1],
            ),
            413,
            "too-large",
            "33554432",
        ),
        (
            raw(
                "POST",
                &format!("/v1/components?note={}", "x".repeat(513)),
                "application/wasm",
                "wasm",
            ),
            422,
            "invalid",
            "x-note is longer than 512",
        ),
        (get("/v1/components/none"), 404, "not-found", "no component"),
        (get("/v1/components?lable=x"), 400, "bad-request", "lable"),
        (
            raw("POST", "/v1/components?labels=stage", "application/wasm", "wasm"),
            422,
            "invalid",
            "label \"stage\" has no value",
        ),
        (
            raw("POST", "/v1/components?labels=a=1,a=2", "application/wasm", "wasm"),
            422,
            "invalid",
            "label \"a=2\" is given twice",
        ),
        (
            send("PATCH", "/v1/components/pid", &json!({"label": {}})),
            422,
            "invalid",
            "unknown field `label`",
        ),
        (
            send("PATCH", "/v1/components/pid", &json!({"note": "a\nb"})),
            422,
            "invalid",
            "control characters",
        ),
        (get("/v1/bundle?components=,"), 422, "invalid", "no component is named"),
        (
            raw("POST", "/v1/bundle", "application/wasm", "x"),
            415,
            "content-type",
            "application/wasm",
        ),
        (
            send("POST", "/v1/components/pid/call", &fake::call(0.0)),
            422,
            "invalid",
            "dt_ms = 0",
        ),
        (get("/v1/components/%ff"), 400, "bad-request", "the address"),
    ];
    for (request, status, kind, part) in table {
        let place = format!("{} {}", request.method(), request.uri());
        let place: String = place.chars().take(80).collect();
        let response = bench.ask(request).await;
        assert_eq!(response.status().as_u16(), status, "{place}");
        assert_eq!(
            response.headers()[header::CONTENT_TYPE],
            "application/problem+json",
            "{place}"
        );
        let body = axum::body::to_bytes(response.into_body(), usize::MAX)
            .await
            .expect("a body");
        let problem: Value = serde_json::from_slice(&body).expect("a problem is JSON");
        assert_eq!(problem["type"], format!("urn:bumpless:problem:{kind}"), "{place}");
        assert_eq!(problem["status"], status, "{place}");
        assert!(
            problem["detail"].as_str().expect("a detail").contains(part),
            "{place}: {problem}"
        );
    }
    assert_eq!(
        bench.cell.asked.load(Ordering::Relaxed),
        0,
        "nothing of this reached the cell"
    );
}

#[tokio::test]
async fn what_the_cell_refuses_keeps_its_words_and_cure() {
    let bench = Bench::new();
    *bench.cell.refusal.lock().unwrap() = Some(DeployError::Refused(Words::new("the output would bump", "raise it")));
    let (status, problem) = bench
        .json(send("POST", "/v1/loops/l/swap", &json!({"component": "pid"})))
        .await;
    assert_eq!(status, StatusCode::CONFLICT);
    assert_eq!(problem["detail"], "the output would bump");
    assert_eq!(problem["cure"], "raise it");
}

#[tokio::test]
async fn commands_arrive_whole_and_a_refused_one_is_no_success() {
    let bench = Bench::new();
    let (status, end) = bench
        .json(send("POST", "/v1/loops/l/setpoint", &json!({"setpoint": 1.5})))
        .await;
    assert_eq!((status, &end["seq"]), (StatusCode::OK, &json!(9)));
    let mut request = send("POST", "/v1/loops/l/mode", &json!({"mode": "manual"}));
    request.headers_mut().insert(
        "idempotency-key",
        "00000000-0000-0000-0000-0000000000ff".parse().unwrap(),
    );
    assert_eq!(bench.json(request).await.1["command_id"], format!("{:032x}", 255));
    bench
        .json(send("POST", "/v1/loops/l/output", &json!({"outputs": {"out": 40.0}})))
        .await;
    assert_eq!(
        *bench.cell.commands.lock().unwrap(),
        [
            (None, CommandBody::Setpoint(1.5)),
            (Some(CommandId(255)), CommandBody::Mode(Mode::Manual)),
            (None, CommandBody::Output(vec![40.0])),
        ]
    );
    *bench.cell.outcome.lock().unwrap() = Outcome::Refused("outside 0 to 2.5".to_owned());
    let (status, problem) = bench
        .json(send("POST", "/v1/loops/l/setpoint", &json!({"setpoint": 9.0})))
        .await;
    assert_eq!(status, StatusCode::CONFLICT);
    assert_eq!(problem["detail"], "outside 0 to 2.5");
    let mut request = send("POST", "/v1/loops/l/mode", &json!({"mode": "manual"}));
    request.headers_mut().insert("idempotency-key", "mine".parse().unwrap());
    let (status, problem) = bench.json(request).await;
    assert_eq!(status, StatusCode::BAD_REQUEST);
    assert!(problem["cure"].as_str().unwrap().contains("UUID"), "{problem}");
}

#[tokio::test]
async fn a_loop_shows_its_numbers_by_port_name_and_can_be_put_again() {
    let bench = Bench::new();
    let (status, shown) = bench.json(get("/v1/loops/l")).await;
    assert_eq!(status, StatusCode::OK);
    assert_eq!(
        (&shown["measured_port"], &shown["measurement"], &shown["measured_unit"]),
        (&json!("pv"), &json!(1.25), &json!("bar"))
    );
    assert_eq!(shown["outputs"], json!({"out": 30.0}));
    assert_eq!(shown["last"]["readings"][0]["port"], "pv");
    assert_eq!(shown["last"]["events"][0], json!({"kind": "limited", "port": "out"}));
    assert!(
        shown["last"].get("state").is_none(),
        "the state only comes when it is asked for"
    );
    let (_, with_state) = bench.json(get("/v1/loops/l?state=true")).await;
    assert_eq!(with_state["last"]["state"], "AQID");
    let (status, end) = bench.json(send("PUT", "/v1/loops/l", &shown["spec"])).await;
    assert_eq!((status, &end["revision"]), (StatusCode::CREATED, &json!(1)));
    let drafts = bench.cell.drafts.lock().unwrap();
    assert_eq!(drafts[0].component, "pid@1.0.0");
    assert_eq!(drafts[0].period_ms, 100.0);
}

#[tokio::test]
async fn the_loop_file_means_the_same_here_and_in_the_cell() {
    let text = fake::draft("l").to_string();
    let here: crate::types::LoopDraft = serde_json::from_str(&text).unwrap();
    let there: bumpless_deploy::LoopDraft = serde_json::from_str(&text).unwrap();
    assert_eq!(bumpless_deploy::LoopDraft::from(here.clone()), there);
    // And back: what one writes, the other reads.
    let again: bumpless_deploy::LoopDraft = serde_json::from_value(serde_json::to_value(&here).unwrap()).unwrap();
    assert_eq!(again, there);
}

#[tokio::test]
async fn long_lists_come_in_parts() {
    let bench = Bench::new();
    *bench.cell.loops.lock().unwrap() = ["c", "a", "b"].map(fake::view).to_vec();
    let (_, first) = bench.json(get("/v1/loops?limit=2")).await;
    assert_eq!(
        (&first["loops"][0]["name"], &first["loops"][1]["name"], &first["next"]),
        (&json!("a"), &json!("b"), &json!("b"))
    );
    assert!(first["loops"][0].get("last").is_none());
    let (_, rest) = bench.json(get("/v1/loops?limit=2&after=b")).await;
    assert_eq!((&rest["loops"][0]["name"], &rest["next"]), (&json!("c"), &Value::Null));
}

#[tokio::test]
async fn components_go_up_and_come_down() {
    let bench = Bench::new();
    let response = bench
        .ask(raw(
            "POST",
            "/v1/components?note=for%20p%C3%BCmps",
            "application/wasm",
            "wasm bytes",
        ))
        .await;
    assert_eq!(response.status(), StatusCode::CREATED);
    assert!(
        response.headers()[header::LOCATION]
            .to_str()
            .unwrap()
            .starts_with("/v1/components/")
    );
    let uploads = bench.cell.uploads.lock().unwrap().clone();
    let upload = Upload {
        by: "api".to_owned(),
        note: "for pümps".to_owned(),
        ..Upload::default()
    };
    assert_eq!(uploads, [(b"wasm bytes".to_vec(), upload)]);
    let response = bench.ask(get("/v1/components/pid/bytes")).await;
    assert_eq!(response.headers()[header::CONTENT_TYPE], "application/wasm");
    assert_eq!(
        response.headers()[header::CONTENT_DISPOSITION],
        "attachment; filename=\"pid-1.0.0.wasm\""
    );
    assert_eq!(
        bench.json(raw("DELETE", "/v1/components/pid", "", "")).await.0,
        StatusCode::NO_CONTENT
    );
    let (status, answer) = bench
        .json(send("POST", "/v1/components/pid/call", &fake::call(100.0)))
        .await;
    assert_eq!(
        (status, &answer["state"], &answer["outputs"]),
        (StatusCode::OK, &json!("BAU="), &json!({"out": 7.5}))
    );
}

#[tokio::test]
async fn the_feed_carries_records_says_what_it_lost_and_ends_with_the_host() {
    let bench = Bench::new();
    let response = bench.ask(get("/v1/live?loops=l")).await;
    assert_eq!(response.headers()[header::CONTENT_TYPE], "text/event-stream");
    let mut events = response.into_body().into_data_stream();
    let mut next = async || String::from_utf8(events.next().await.expect("an event").unwrap().to_vec()).unwrap();
    assert!(next().await.starts_with("event: hosts\n"), "the hosts come first");
    bench.cell.publish("other", 1);
    bench.cell.publish("l", 2);
    let event = next().await;
    assert!(
        event.starts_with("event: record\n") && event.contains("\"loop\":\"l\"") && event.contains("\"seq\":2"),
        "{event}"
    );
    for seq in 0..fake::FEED_CAPACITY as u64 + 3 {
        bench.cell.publish("l", 10 + seq);
    }
    let event = next().await;
    assert!(
        event.starts_with("event: lost\n") && event.contains("{\"records\":3}"),
        "{event}"
    );
    bench.stop.send(true).unwrap();
    assert!(events.next().await.is_none(), "a feed does not keep a stopping host");
}

#[tokio::test]
async fn places_for_feeds_are_counted_and_given_back() {
    let bench = Bench::new();
    let mut open = Vec::new();
    for _ in 0..FEEDS_MAX {
        open.push(bench.ask(get("/v1/live")).await);
    }
    assert!(open.iter().all(|response| response.status() == StatusCode::OK));
    let (status, problem) = bench.json(get("/v1/live")).await;
    assert_eq!(
        (status, &problem["type"]),
        (StatusCode::SERVICE_UNAVAILABLE, &json!("urn:bumpless:problem:busy"))
    );
    open.pop();
    assert_eq!(bench.ask(get("/v1/live")).await.status(), StatusCode::OK);
}

#[tokio::test]
async fn a_full_host_refuses_at_once_but_stays_healthy() {
    let bench = Bench::with(&Options {
        requests_max: 0,
        ..Options::default()
    });
    let response = bench.ask(get("/v1/hosts")).await;
    assert_eq!(response.status(), StatusCode::SERVICE_UNAVAILABLE);
    assert_eq!(response.headers()[header::RETRY_AFTER], "1");
    assert_eq!(bench.ask(get("/healthz")).await.status(), StatusCode::OK);
    assert_eq!(bench.ask(get("/readyz")).await.status(), StatusCode::OK);
}

#[tokio::test(start_paused = true)]
async fn a_silent_cell_is_a_timeout_and_what_began_goes_on() {
    let bench = Bench::new();
    bench.cell.slow.store(true, Ordering::Relaxed);
    let (status, problem) = bench
        .json(send("POST", "/v1/components/pid/call", &fake::call(100.0)))
        .await;
    assert_eq!(
        (status, &problem["type"]),
        (StatusCode::GATEWAY_TIMEOUT, &json!("urn:bumpless:problem:timeout"))
    );
    assert!(problem["detail"].as_str().unwrap().contains("5 s"), "{problem}");
    let (status, _) = bench
        .json(send("POST", "/v1/loops/l/swap", &json!({"component": "pid"})))
        .await;
    assert_eq!(status, StatusCode::GATEWAY_TIMEOUT);
    assert_eq!(bench.cell.finished.load(Ordering::Relaxed), 0);
    bench.cell.slow.store(false, Ordering::Relaxed);
    bench.cell.go_on.notify_waiters();
    while bench.cell.finished.load(Ordering::Relaxed) == 0 {
        tokio::task::yield_now().await;
    }
}

#[tokio::test]
async fn a_panic_is_an_answer() {
    let bench = Bench::new();
    bench.cell.panics.store(true, Ordering::Relaxed);
    let (status, problem) = bench.json(get("/v1/hosts")).await;
    assert_eq!(
        (status, &problem["type"]),
        (
            StatusCode::INTERNAL_SERVER_ERROR,
            &json!("urn:bumpless:problem:internal")
        )
    );
    bench.cell.panics.store(false, Ordering::Relaxed);
    assert_eq!(bench.json(get("/v1/hosts")).await.0, StatusCode::OK);
}

#[tokio::test]
async fn the_server_serves_and_stops() {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let (stop, stopped) = tokio::sync::oneshot::channel::<()>();
    let serving = tokio::spawn(async move {
        let shutdown = async { drop(stopped.await) };
        crate::server::serve_cell(listener, Arc::new(Fake::new()), &Options::default(), shutdown).await
    });
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
    let mut feed = tokio::net::TcpStream::connect(address).await.unwrap();
    feed.write_all(b"GET /v1/live HTTP/1.1\r\nhost: localhost\r\n\r\n")
        .await
        .unwrap();
    let mut first = [0; 17];
    feed.read_exact(&mut first).await.unwrap();
    assert_eq!(&first, b"HTTP/1.1 200 OK\r\n");
    stop.send(()).unwrap();
    // An open feed does not hold the stop up: both ends come on their own.
    feed.read_to_end(&mut Vec::new()).await.unwrap();
    serving.await.unwrap().expect("a stop is no failure");
}
