//! What the operator's page lives on: its files, the feed in rows, curves, notices, faults of the demonstration.

use axum::{
    body::BodyDataStream,
    http::{StatusCode, header},
};
use bumpless_core::PointId;
use bumpless_deploy::commissioning::FieldEvent;
use futures_util::StreamExt as _;
use serde_json::{Value, json};
use tokio::sync::mpsc;

use super::{Bench, fake, get, send};
use crate::{
    server::Options,
    types::{Fault, FaultKind},
};

/// One event of a feed: name, id, data.
async fn next(events: &mut BodyDataStream) -> (String, String, Value) {
    let bytes = events.next().await.expect("an event").expect("no error");
    let text = String::from_utf8(bytes.to_vec()).expect("UTF-8");
    let field = |name: &str| {
        let line = text.lines().find_map(|line| line.strip_prefix(name));
        line.unwrap_or_default().trim().to_owned()
    };
    let data = serde_json::from_str(&field("data:")).expect("JSON");
    (field("event:"), field("id:"), data)
}

/// The next event of a name.
async fn named(events: &mut BodyDataStream, wanted: &str) -> (String, Value) {
    loop {
        let (name, id, data) = next(events).await;
        if name == wanted {
            return (id, data);
        }
    }
}

#[tokio::test]
async fn the_page_comes_under_a_strict_policy_and_its_files_are_kept() {
    let bench = Bench::new();
    let response = bench.ask(get("/")).await;
    assert_eq!(response.status(), StatusCode::OK);
    let policy = response.headers()[header::CONTENT_SECURITY_POLICY]
        .to_str()
        .expect("text")
        .to_owned();
    assert!(
        policy.starts_with("default-src 'none'") && policy.contains("frame-ancestors 'none'"),
        "{policy}"
    );
    assert!(!policy.contains("unsafe-eval"), "{policy}");
    let body = axum::body::to_bytes(response.into_body(), usize::MAX)
        .await
        .expect("a body");
    let text = String::from_utf8(body.to_vec()).expect("UTF-8");
    // The page where it was built, else how to build it; either way nothing from elsewhere.
    assert!(!text.contains("http://") && !text.contains("https://"), "{text}");
    if let Some(asset) = text.split('"').find(|part| part.starts_with("/assets/")) {
        assert!(!policy.contains("unsafe"), "{policy}");
        let response = bench.ask(get(asset)).await;
        assert_eq!(response.status(), StatusCode::OK);
        let kept = response.headers()[header::CACHE_CONTROL].to_str().expect("text");
        assert!(kept.contains("immutable"), "{kept}");
    } else {
        assert!(text.contains("cargo xtask page"), "{text}");
    }
    let (status, problem) = bench.json(get("/assets/none-12345678.js")).await;
    assert_eq!(
        (status, &problem["type"]),
        (StatusCode::NOT_FOUND, &json!("urn:bumpless:problem:no-such-route"))
    );
    let response = bench.ask(get("/addresses")).await;
    assert_eq!(response.status(), StatusCode::OK);
}

#[tokio::test(start_paused = true)]
async fn a_feed_in_rows_begins_with_all_loops_and_tells_the_newest_of_each() {
    let bench = Bench::new();
    let response = bench.ask(get("/v1/live?form=rows&every_ms=100&trace=l")).await;
    assert_eq!(response.headers()[header::CONTENT_TYPE], "text/event-stream");
    let mut events = response.into_body().into_data_stream();
    let (_, rows) = named(&mut events, "rows").await;
    assert_eq!(rows["loops"][0]["loop"], "l");
    assert_eq!(rows["loops"][0]["seq"], 9);
    let (_, loops) = named(&mut events, "loops").await;
    assert_eq!((&loops[0]["loop"], &loops[0]["members"]), (&json!("l"), &json!(["h"])));
    let (_, hosts) = named(&mut events, "hosts").await;
    assert_eq!(hosts["hosts"][0]["name"], "h");
    for seq in 10..14 {
        bench.cell.publish("l", seq);
    }
    bench.cell.publish("m", 3);
    let (_, rows) = named(&mut events, "rows").await;
    let seqs = |list: &Value| -> Vec<(String, u64)> {
        let rows = list.as_array().expect("rows").iter();
        rows.map(|row| {
            (
                row["loop"].as_str().expect("a name").to_owned(),
                row["seq"].as_u64().expect("a number"),
            )
        })
        .collect()
    };
    assert_eq!(seqs(&rows["loops"]), [("l".to_owned(), 13), ("m".to_owned(), 3)]);
    let traced: Vec<u64> = seqs(&rows["trace"]).into_iter().map(|(_, seq)| seq).collect();
    assert_eq!(
        traced,
        [10, 11, 12, 13],
        "each cycle of the traced loop, and of no other"
    );
    assert_eq!(rows["lost"], 0);

    // What happens to points and jobs comes in one event per beat.
    for value in [1.0, 2.0] {
        let written = FieldEvent::Written {
            point: PointId::new("line.out").expect("a name"),
            host: fake::host(),
            value,
            by: "ann".into(),
        };
        bench.cell.news.send(written).expect("somebody listens");
    }
    let (_, field) = named(&mut events, "field").await;
    assert_eq!(field["lost"], 0);
    let written = |n: usize| field["news"][n]["written"]["value"].clone();
    assert_eq!((written(0), written(1)), (json!(1.0), json!(2.0)), "{field}");

    // A reader that slept: what fell out of the channel is counted, and the newest of each loop is there all the same.
    for seq in 0..fake::FEED_CAPACITY as u64 + 3 {
        bench.cell.publish("l", 20 + seq);
    }
    let (_, rows) = named(&mut events, "rows").await;
    assert_eq!(rows["lost"], 3);
    assert_eq!(seqs(&rows["loops"]), [("l".to_owned(), 30)]);
    bench.stop.send(true).expect("somebody listens");
    while events.next().await.is_some() {}
}

#[tokio::test(start_paused = true)]
async fn a_reader_goes_on_where_it_stopped() {
    let bench = Bench::new();
    // The fake's log has the cycles 1 to 3 of any loop.
    let response = bench.ask(get("/v1/live?form=rows&trace=l&after=1-0-4-0")).await;
    let mut events = response.into_body().into_data_stream();
    let (id, rows) = named(&mut events, "rows").await;
    let traced: Vec<u64> = rows["trace"]
        .as_array()
        .expect("rows")
        .iter()
        .filter_map(|row| row["seq"].as_u64())
        .collect();
    assert_eq!(traced, [1, 2, 3]);
    assert_eq!(id.split('-').count(), 4, "{id}");
    for (query, part) in [
        ("form=rows&after=x", "no id of an event"),
        ("form=rows&trace=A", "'A'"),
        ("form=rows&trace=a,b,c,d,e,f,g,h,i", "trace names 9 loops"),
        ("form=columns", "form"),
    ] {
        let (_, problem) = bench.json(get(&format!("/v1/live?{query}"))).await;
        assert!(problem["detail"].to_string().contains(part), "{query}: {problem}");
    }
}

#[tokio::test]
async fn curves_are_columns_of_equal_length() {
    let bench = Bench::new();
    let (status, trend) = bench
        .json(get("/v1/loops/l/trend?from_unix_us=0&to_unix_us=10000&points=10"))
        .await;
    assert_eq!(status, StatusCode::OK, "{trend}");
    assert_eq!(
        (&trend["cycles"], &trend["read_to_unix_us"]),
        (&json!(3), &json!(10_000))
    );
    let rows = trend["seq"].as_array().expect("a column").len();
    for column in [
        "at_unix_us",
        "setpoint",
        "measurement",
        "good",
        "automatic",
        "owner",
        "stepped_by",
        "step_us",
    ] {
        assert_eq!(trend[column].as_array().map(Vec::len), Some(rows), "{column}");
    }
    assert_eq!(trend["outputs"]["out"].as_array().map(Vec::len), Some(rows));
    assert_eq!(trend["hosts"], json!(["h"]));
    assert_eq!(trend["notices"][0]["kind"], "limited");
    for (query, part) in [
        ("from_unix_us=5&to_unix_us=5", "ends (5) before it begins (5)"),
        ("from_unix_us=1&to_unix_us=5&points=9", "points = 9"),
        ("from_unix_us=1", "to_unix_us"),
    ] {
        let (_, problem) = bench.json(get(&format!("/v1/loops/l/trend?{query}"))).await;
        assert!(problem["detail"].to_string().contains(part), "{query}: {problem}");
    }
}

#[tokio::test]
async fn faults_are_for_the_demonstration_alone() {
    let wish = json!({"host": "b", "fault": "pause", "seconds": 2});
    let bench = Bench::new();
    assert_eq!(bench.json(get("/v1/demo")).await.1, json!({"demo": false}));
    let (status, problem) = bench.json(send("POST", "/v1/demo/faults", &wish)).await;
    assert_eq!(status, StatusCode::CONFLICT, "{problem}");

    let (faults, mut asked) = mpsc::channel(1);
    let bench = Bench::with(&Options {
        faults: Some(faults),
        ..Options::default()
    });
    assert_eq!(bench.json(get("/v1/demo")).await.1, json!({"demo": true}));
    let response = bench.ask(send("POST", "/v1/demo/faults", &wish)).await;
    assert_eq!(response.status(), StatusCode::ACCEPTED);
    let (status, _) = bench.json(send("POST", "/v1/demo/faults", &wish)).await;
    assert_eq!(
        status,
        StatusCode::SERVICE_UNAVAILABLE,
        "one waits, and there is room for one"
    );
    assert_eq!(
        asked.recv().await,
        Some(Fault {
            fault: FaultKind::Pause,
            host: "b".into(),
            seconds: 2
        })
    );
    for (body, part) in [
        (json!({"host": "b", "fault": "melt"}), "unknown variant `melt`"),
        (json!({"host": "b b", "fault": "kill"}), "' '"),
        (json!({"host": "b", "fault": "pause", "seconds": 61}), "seconds = 61"),
    ] {
        let (status, problem) = bench.json(send("POST", "/v1/demo/faults", &body)).await;
        assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{problem}");
        assert!(problem["detail"].to_string().contains(part), "{part}: {problem}");
    }
}
