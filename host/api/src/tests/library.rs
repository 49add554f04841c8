//! The library's routes: labels, trials, where a component is, bundles.

use axum::http::{StatusCode, header};
use bumpless_deploy::Relabel;
use serde_json::{Value, json};

use super::{Bench, get, raw, send};
use crate::limits::{UPLOAD_PLACE_WAIT, UPLOADS_MAX, UPLOADS_WAITING_MAX};

#[tokio::test]
async fn uploads_carry_labels_and_force_and_a_dry_run_only_reports() {
    let bench = Bench::new();
    let path = "/v1/components?labels=stage%3Dpilot,line=3&force=true&by=ann";
    let (status, component) = bench.json(raw("POST", path, "application/wasm", "w")).await;
    assert_eq!(
        (status, &component["labels"]["stage"]),
        (StatusCode::CREATED, &json!("pilot"))
    );
    assert_eq!(
        (&component["hosts"], &component["admission"]),
        (&Value::Null, &Value::Null)
    );
    let upload = bench.cell.uploads.lock().unwrap().remove(0).1;
    assert!(
        upload.force && upload.by == "ann" && upload.labels.len() == 2,
        "{upload:?}"
    );
    let (status, component) = bench
        .json(raw("POST", "/v1/components?dry_run=true", "application/wasm", "w"))
        .await;
    assert_eq!(status, StatusCode::OK);
    let report = &component["admission"];
    assert_eq!(
        (
            &report["verdict"],
            &report["step_p99_us"],
            &report["migrated"],
            &report["compile_ms"]
        ),
        (&json!("refused"), &json!(2.5), &json!("declined"), &Value::Null)
    );
    assert_eq!(
        report["findings"][0],
        json!({"severity": "refusal", "text": "it trapped"})
    );
    assert!(bench.cell.uploads.lock().unwrap().is_empty(), "nothing was uploaded");
}

#[tokio::test(start_paused = true)]
async fn an_upload_waits_for_its_place_where_not_too_many_do() {
    let bench = Bench::new();
    let upload = || bench.json(raw("POST", "/v1/components", "application/wasm", "w"));
    let count = |n: usize| u32::try_from(n).unwrap();
    let places = bench.app.uploads.acquire_many(count(UPLOADS_MAX)).await.unwrap();
    let others = bench.app.uploads_waiting.acquire_many(count(UPLOADS_WAITING_MAX) - 1);
    let _others = others.await.unwrap();
    let mut waiting = Box::pin(upload());
    assert!(futures_util::poll!(&mut waiting).is_pending());
    let (status, refusal) = upload().await;
    assert_eq!(status, StatusCode::SERVICE_UNAVAILABLE, "no place to wait: {refusal}");
    drop(places);
    assert_eq!(waiting.await.0, StatusCode::CREATED);

    let _places = bench.app.uploads.acquire_many(count(UPLOADS_MAX)).await.unwrap();
    let before = tokio::time::Instant::now();
    assert_eq!(upload().await.0, StatusCode::SERVICE_UNAVAILABLE);
    assert_eq!(before.elapsed().as_secs(), UPLOAD_PLACE_WAIT.as_secs());
}

#[tokio::test]
async fn the_library_is_filtered_relabelled_and_says_where_a_component_is() {
    let bench = Bench::new();
    for (query, count) in [
        ("", 1),
        ("?label=stage", 1),
        ("?label=stage=pilot&name=pid", 1),
        ("?label=stage,line", 0),
        ("?label=stage=test", 0),
        ("?name=pi", 0),
        ("?text=PILOT", 1),
        ("?text=pump", 0),
    ] {
        let (_, list) = bench.json(get(&format!("/v1/components{query}"))).await;
        assert_eq!(list["components"].as_array().map(Vec::len), Some(count), "{query}");
    }
    let (_, shown) = bench.json(get("/v1/components/pid")).await;
    assert_eq!(
        shown["hosts"],
        json!([
            {"host": "a", "stage": "compiling", "reason": ""},
            {"host": "b", "stage": "failed", "reason": "no memory"},
            {"host": "h", "stage": "ready", "reason": ""},
        ])
    );
    let body = json!({"note": "", "labels": {"stage": "test", "line": null}, "by": "ann"});
    let (status, _) = bench.json(send("PATCH", "/v1/components/pid", &body)).await;
    assert_eq!(status, StatusCode::OK);
    let change = Relabel {
        by: "ann".to_owned(),
        note: Some(String::new()),
        labels: [("line".to_owned(), None), ("stage".to_owned(), Some("test".to_owned()))].into(),
    };
    assert_eq!(*bench.cell.relabels.lock().unwrap(), [change]);
}

#[tokio::test]
async fn bundles_go_out_and_come_in() {
    let bench = Bench::new();
    let response = bench.ask(get("/v1/bundle?components=pid,%20on-off@1.0.0")).await;
    assert_eq!(response.headers()[header::CONTENT_TYPE], "application/x-tar");
    let body = axum::body::to_bytes(response.into_body(), usize::MAX).await.unwrap();
    assert_eq!(body, "pid+on-off@1.0.0");
    let whole = bench.ask(get("/v1/bundle")).await;
    let body = axum::body::to_bytes(whole.into_body(), usize::MAX).await.unwrap();
    assert_eq!(body.len(), 64, "the library by digest: one component");
    let (status, answer) = bench
        .json(raw("POST", "/v1/bundle?force=true&by=ann", "application/x-tar", "tar"))
        .await;
    assert_eq!(status, StatusCode::OK);
    assert_eq!(
        *bench.cell.imports.lock().unwrap(),
        [(b"tar".to_vec(), "ann".to_owned(), true)]
    );
    let (taken, refused) = (&answer["components"][0], &answer["components"][1]);
    assert_eq!(
        (&taken["outcome"], &taken["component"]["name"]),
        (&json!("taken"), &json!("pid"))
    );
    assert_eq!(
        (
            &refused["outcome"],
            &refused["reason"],
            &refused["cure"],
            &refused["component"]
        ),
        (
            &json!("refused"),
            &json!("it is not whole"),
            &json!("export it again"),
            &Value::Null
        )
    );
}
