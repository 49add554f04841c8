//! What all routes share: keys, conditions, parts of lists, health.

use std::sync::atomic::Ordering;

use axum::{
    body::Body,
    http::{HeaderMap, Request, StatusCode, header},
};
use bumpless_core::Outcome;
use bumpless_deploy::Expect;
use serde_json::{Value, json};

use super::{Bench, fake, get, raw, send};
use crate::limits::JSON_BYTES_MAX;

fn with(mut request: Request<Body>, headers: &[(&'static str, &str)]) -> Request<Body> {
    for (name, value) in headers {
        request.headers_mut().insert(*name, value.parse().unwrap());
    }
    request
}

fn swap(key: &str, component: &str) -> Request<Body> {
    let request = send("POST", "/v1/loops/l/swap", &json!({ "component": component }));
    with(request, &[("idempotency-key", key)])
}

/// Status, headers and JSON.
async fn answer(bench: &Bench, request: Request<Body>) -> (StatusCode, HeaderMap, Value) {
    let response = bench.ask(request).await;
    let (status, headers) = (response.status(), response.headers().clone());
    let bytes = axum::body::to_bytes(response.into_body(), usize::MAX).await.unwrap();
    (status, headers, serde_json::from_slice(&bytes).unwrap_or(Value::Null))
}

#[tokio::test]
async fn a_change_with_a_key_acts_once_and_gets_its_answer_again() {
    let bench = Bench::new();
    let (status, first, body) = answer(&bench, swap("7", "pid")).await;
    assert_eq!(status, StatusCode::OK);
    assert!(first.get("idempotency-replayed").is_none());
    let (status, second, again) = answer(&bench, swap("7", "pid")).await;
    assert_eq!((status, &again), (StatusCode::OK, &body));
    assert_eq!(second["idempotency-replayed"], "true");
    assert_eq!(
        second[header::ETAG],
        first[header::ETAG],
        "the tag is part of the answer"
    );
    assert_eq!(bench.cell.asked.load(Ordering::Relaxed), 1, "the cell was asked once");
    // Another body, another address, another method: another request.
    for other in [
        swap("7", "pidplus"),
        with(
            send("POST", "/v1/loops/l/set", &json!({"component": "pid"})),
            &[("idempotency-key", "7")],
        ),
        with(raw("DELETE", "/v1/loops/l", "", ""), &[("idempotency-key", "7")]),
    ] {
        let (status, _, problem) = answer(&bench, other).await;
        assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY);
        assert_eq!(problem["type"], "urn:bumpless:problem:key-reused");
    }
    assert_eq!(bench.cell.asked.load(Ordering::Relaxed), 1);
    let (status, _, _) = answer(&bench, swap("8", "pid")).await;
    assert_eq!(status, StatusCode::OK);
    assert_eq!(bench.cell.asked.load(Ordering::Relaxed), 2, "a new key acts anew");
}

#[tokio::test]
async fn the_same_key_at_the_same_time_is_told_to_wait_and_what_failed_may_be_asked_again() {
    let bench = Bench::new();
    bench.cell.slow.store(true, Ordering::Relaxed);
    let router = bench.router.clone();
    let first = tokio::spawn(async move {
        use tower::ServiceExt as _;
        router.oneshot(swap("7", "pid")).await.unwrap().status()
    });
    while bench.cell.asked.load(Ordering::Relaxed) == 0 {
        tokio::task::yield_now().await;
    }
    let (status, headers, problem) = answer(&bench, swap("7", "pid")).await;
    assert_eq!(status, StatusCode::CONFLICT);
    assert_eq!(problem["type"], "urn:bumpless:problem:in-progress");
    assert_eq!(headers[header::RETRY_AFTER], "1");
    // The asker leaves: what began goes on, and whoever asks again gets its end.
    first.abort();
    assert!(first.await.expect_err("aborted").is_cancelled());
    bench.cell.slow.store(false, Ordering::Relaxed);
    bench.cell.go_on.notify_waiters();
    let status = loop {
        let (status, headers, _) = answer(&bench, swap("7", "pid")).await;
        if status != StatusCode::CONFLICT {
            assert_eq!(headers["idempotency-replayed"], "true");
            break status;
        }
        tokio::task::yield_now().await;
    };
    assert_eq!((status, bench.cell.asked.load(Ordering::Relaxed)), (StatusCode::OK, 1));
    // A refusal changes nothing, so it is not remembered.
    *bench.cell.outcome.lock().unwrap() = Outcome::Refused("outside 0 to 2.5".to_owned());
    let set = || {
        let request = send("POST", "/v1/loops/l/setpoint", &json!({ "setpoint": 9.0 }));
        with(request, &[("idempotency-key", "9")])
    };
    assert_eq!(answer(&bench, set()).await.0, StatusCode::CONFLICT);
    *bench.cell.outcome.lock().unwrap() = Outcome::Done;
    assert_eq!(answer(&bench, set()).await.0, StatusCode::OK);
}

#[tokio::test]
async fn keys_hold_for_uploads_too_and_bad_ones_are_refused() {
    let bench = Bench::new();
    let upload = |bytes: &'static str| {
        let request = raw("POST", "/v1/components", "application/wasm", bytes);
        with(request, &[("idempotency-key", "a0")])
    };
    assert_eq!(answer(&bench, upload("wasm")).await.0, StatusCode::CREATED);
    let (status, headers, _) = answer(&bench, upload("wasm")).await;
    assert_eq!(status, StatusCode::CREATED);
    assert!(
        headers[header::LOCATION]
            .to_str()
            .unwrap()
            .starts_with("/v1/components/")
    );
    assert_eq!(
        answer(&bench, upload("other")).await.2["type"],
        "urn:bumpless:problem:key-reused"
    );
    assert_eq!(bench.cell.uploads.lock().unwrap().len(), 1);
    assert_eq!(answer(&bench, swap("mine", "pid")).await.0, StatusCode::BAD_REQUEST);
    let long = "x".repeat(JSON_BYTES_MAX + 1);
    let long = with(
        raw("PUT", "/v1/loops/l", "application/json", long),
        &[("idempotency-key", "a1")],
    );
    assert_eq!(answer(&bench, long).await.0, StatusCode::PAYLOAD_TOO_LARGE);
}

#[tokio::test]
async fn a_loop_is_changed_only_as_it_was_read() {
    let bench = Bench::new();
    let (status, headers, _) = answer(&bench, get("/v1/loops/l")).await;
    assert_eq!(
        (status, &headers[header::ETAG]),
        (StatusCode::OK, &"\"r1\"".parse().unwrap())
    );
    let again = with(get("/v1/loops/l"), &[("if-none-match", "\"r1\"")]);
    let (status, headers, body) = answer(&bench, again).await;
    assert_eq!((status, body), (StatusCode::NOT_MODIFIED, Value::Null));
    assert_eq!(headers[header::ETAG], "\"r1\"");
    let draft = fake::draft("l");
    let changes = || {
        [
            send("PUT", "/v1/loops/l", &draft),
            send("POST", "/v1/loops/l/set", &json!({})),
            send("POST", "/v1/loops/l/swap", &json!({"component": "pid"})),
            send("POST", "/v1/loops/l/rollback", &json!({})),
            raw("DELETE", "/v1/loops/l", "", ""),
        ]
    };
    for (given, expect) in [
        (("if-match", "\"r1\""), Expect::OneOf(vec![1])),
        (("if-match", "*"), Expect::Something),
        (("if-none-match", "*"), Expect::Nothing),
    ] {
        for request in changes() {
            let place = format!("{} {} {given:?}", request.method(), request.uri());
            assert!(answer(&bench, with(request, &[given])).await.0.is_success(), "{place}");
            assert_eq!(
                bench.cell.expects.lock().unwrap().pop(),
                Some(expect.clone()),
                "{place}"
            );
        }
    }
    // Who is right is the home's to say.
    let words = bumpless_deploy::Words::new("loop l is at revision 2", "read it again");
    *bench.cell.refusal.lock().unwrap() = Some(bumpless_deploy::Error::Stale(words));
    for request in changes() {
        let (status, _, problem) = answer(&bench, with(request, &[("if-match", "\"r1\"")])).await;
        assert_eq!(status, StatusCode::PRECONDITION_FAILED);
        assert_eq!(problem["type"], "urn:bumpless:problem:precondition");
    }
}

#[tokio::test]
async fn notes_and_alarms_are_changed_only_as_they_were_read() {
    let bench = Bench::new();
    for (path, change) in [
        (
            "/v1/components/pid",
            send("PATCH", "/v1/components/pid", &json!({"note": "new"})),
        ),
        (
            "/v1/loops/l/alarms/high",
            send("PUT", "/v1/loops/l/alarms/high", &json!({"kind": "hi", "limit": 70.0})),
        ),
        ("/v1/components/pid", raw("DELETE", "/v1/components/pid", "", "")),
        (
            "/v1/loops/l/alarms/high",
            raw("DELETE", "/v1/loops/l/alarms/high", "", ""),
        ),
    ] {
        let (_, headers, _) = answer(&bench, get(path)).await;
        let tag = headers[header::ETAG].to_str().unwrap().to_owned();
        let (status, ..) = answer(&bench, with(get(path), &[("if-none-match", &tag)])).await;
        assert_eq!(status, StatusCode::NOT_MODIFIED, "{path}");
        let place = format!("{} {path}", change.method());
        let (parts, body) = change.into_parts();
        let body = axum::body::to_bytes(body, usize::MAX).await.unwrap();
        let again = || Request::from_parts(parts.clone(), Body::from(body.clone()));
        let before = bench.cell.relabels.lock().unwrap().len();
        let (status, _, problem) = answer(&bench, with(again(), &[("if-match", "\"0123456789abcdef\"")])).await;
        assert_eq!(status, StatusCode::PRECONDITION_FAILED, "{place}: {problem}");
        assert_eq!(
            bench.cell.relabels.lock().unwrap().len(),
            before,
            "{place}: nothing was done"
        );
        let (status, ..) = answer(&bench, with(again(), &[("if-match", &tag)])).await;
        assert!(status.is_success(), "{place}");
        assert!(
            answer(&bench, again()).await.0.is_success(),
            "{place}, without a condition"
        );
        let (status, ..) = answer(&bench, with(again(), &[("if-match", "high")])).await;
        assert_eq!(status, StatusCode::BAD_REQUEST, "{place}");
    }
    let (status, ..) = answer(&bench, get("/v1/loops/l/alarms/nothing")).await;
    assert_eq!(status, StatusCode::NOT_FOUND);
    let new = send(
        "PUT",
        "/v1/loops/l/alarms/nothing",
        &json!({"kind": "hi", "limit": 70.0}),
    );
    let (status, ..) = answer(&bench, with(new, &[("if-match", "*")])).await;
    assert_eq!(status, StatusCode::PRECONDITION_FAILED, "there is nothing to change");
    let (_, headers, _) = answer(&bench, get("/v1/components/pid/bytes")).await;
    let tag = headers[header::ETAG].to_str().unwrap().to_owned();
    let (status, ..) = answer(
        &bench,
        with(get("/v1/components/pid/bytes"), &[("if-none-match", &tag)]),
    )
    .await;
    assert_eq!(status, StatusCode::NOT_MODIFIED);
}

#[tokio::test]
async fn every_list_comes_in_parts_with_a_link_and_bounds() {
    let bench = Bench::new();
    *bench.cell.loops.lock().unwrap() = ["c", "a", "b"].map(fake::view).to_vec();
    let (_, headers, body) = answer(&bench, get("/v1/loops?home=h&limit=2")).await;
    assert_eq!(
        headers[header::LINK],
        "</v1/loops?home=h&limit=2&after=b>; rel=\"next\""
    );
    assert_eq!(body["next"], "b");
    let (_, headers, body) = answer(&bench, get("/v1/loops?home=h&limit=2&after=b")).await;
    assert!(headers.get(header::LINK).is_none());
    assert_eq!((&body["loops"][0]["name"], &body["next"]), (&json!("c"), &Value::Null));
    let (_, headers, _) = answer(&bench, get("/v1/loops/l/cycles?limit=2")).await;
    assert!(headers.get(header::LINK).is_none() || headers[header::LINK].to_str().unwrap().contains("after="));
    for path in [
        "/v1/components",
        "/v1/loops",
        "/v1/loops/l/shadows",
        "/v1/loops/l/cycles",
        "/v1/rollouts",
        "/v1/alarms",
        "/v1/alarms/history",
        "/v1/hosts",
        "/v1/points",
        "/v1/buses",
        "/v1/jobs",
        "/v1/notices",
    ] {
        for limit in ["0", "10001"] {
            let (status, ..) = answer(&bench, get(&format!("{path}?limit={limit}"))).await;
            assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{path}?limit={limit}");
        }
        assert_eq!(
            answer(&bench, get(&format!("{path}?limit=1"))).await.0,
            StatusCode::OK,
            "{path}"
        );
    }
}

#[tokio::test]
async fn filters_leave_out_what_does_not_fit() {
    let bench = Bench::new();
    for (query, rows, there) in [
        ("/v1/loops?component=pid", "loops", true),
        ("/v1/loops?component=pid@1.0.0&owner=h&text=L", "loops", true),
        ("/v1/loops?component=pidplus", "loops", false),
        ("/v1/loops?owner=g", "loops", false),
        ("/v1/hosts?label=east&alive=true", "hosts", true),
        ("/v1/hosts?alive=false", "hosts", false),
        ("/v1/buses?connected=true", "buses", true),
        ("/v1/buses?host=g", "buses", false),
        ("/v1/jobs?state=queued&bus=line", "jobs", true),
        ("/v1/jobs?state=done", "jobs", false),
        ("/v1/rollouts?state=failed", "rollouts", true),
        ("/v1/rollouts?state=done", "rollouts", false),
        ("/v1/alarms?priority=high", "alarms", true),
        ("/v1/alarms?kind=lo", "alarms", false),
    ] {
        let (status, _, body) = answer(&bench, get(query)).await;
        assert_eq!(status, StatusCode::OK, "{query}");
        assert_eq!(!body[rows].as_array().unwrap().is_empty(), there, "{query}: {body}");
    }
}

#[tokio::test]
async fn health_says_what_does_not_hold() {
    let bench = Bench::new();
    for path in ["/livez", "/healthz"] {
        let (status, _, body) = answer(&bench, get(path)).await;
        assert_eq!((status, &body["alive"]), (StatusCode::OK, &json!(true)));
    }
    let (status, _, body) = answer(&bench, get("/readyz")).await;
    assert_eq!((status, &body["ready"]), (StatusCode::OK, &json!(true)));
    for name in ["bus", "cell", "store", "service"] {
        *bench.cell.unwell.lock().unwrap() = Some(name);
        let (status, headers, problem) = answer(&bench, get("/readyz")).await;
        assert_eq!(status, StatusCode::SERVICE_UNAVAILABLE, "{name}");
        assert_eq!(headers[header::CONTENT_TYPE], "application/problem+json");
        let detail = problem["detail"].as_str().unwrap();
        assert!(detail.contains(&format!("{name}: it is not")), "{detail}");
        let (status, _, body) = answer(&bench, get("/v1/hosts/h/health")).await;
        assert_eq!((status, &body["ready"]), (StatusCode::OK, &json!(false)), "{name}");
        assert_eq!(
            answer(&bench, get("/livez")).await.0,
            StatusCode::OK,
            "alive all the same"
        );
    }
}
