//! Looking back over HTTP: windows arrive as they were said, reports have the shape of the document.

use std::sync::Arc;

use axum::http::{StatusCode, header};
use bumpless_core::history::{Bucket, Layout, Row, Seen, Series};
use bumpless_deploy::{
    Error, Window,
    history::{Fineness, HistoryQuestion, HistoryView},
};
use serde_json::json;

use super::{Bench, get, send};

#[tokio::test]
async fn windows_arrive_as_they_were_said() {
    let bench = Bench::new();
    let table = [
        (get("/v1/loops/l/cycles"), Window::Last(100)),
        (get("/v1/loops/l/cycles?last=7"), Window::Last(7)),
        (
            get("/v1/loops/l/cycles?from_unix_us=5&to_unix_us=6"),
            Window::Between(5_000, 6_999),
        ),
        (send("POST", "/v1/loops/l/replay", &json!({})), Window::Last(1_000)),
        (
            send("POST", "/v1/loops/l/replay", &json!({"last": "30s"})),
            Window::Recent(30_000_000_000),
        ),
        (
            send(
                "POST",
                "/v1/loops/l/backtest",
                &json!({"component": "pid", "last": "5000"}),
            ),
            Window::Last(5_000),
        ),
    ];
    for (request, wanted) in table {
        let path = request.uri().to_string();
        let (status, body) = bench.json(request).await;
        assert_eq!(status, StatusCode::OK, "{path}: {body}");
        assert_eq!(bench.cell.windows.lock().unwrap().pop(), Some(wanted), "{path}");
    }
    for (request, part) in [
        (get("/v1/loops/l/cycles?last=5d"), "500ms, 30s, 10m, 2h"),
        (get("/v1/loops/l/cycles?last=5&from_unix_us=1"), "give one"),
        (get("/v1/loops/l/cycles?limit=0"), "limit = 0"),
        (
            send("POST", "/v1/loops/l/replay", &json!({"lst": "5"})),
            "unknown field `lst`",
        ),
        (
            send("POST", "/v1/loops/l/backtest", &json!({"last": "5"})),
            "missing field `component`",
        ),
        (
            send("POST", "/v1/loops/l/shadows", &json!({"component": "pid"})),
            "missing field `cycles`",
        ),
    ] {
        let (status, body) = bench.json(request).await;
        assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{body}");
        assert!(body.to_string().contains(part), "{part}: {body}");
    }
    assert!(bench.cell.windows.lock().unwrap().is_empty());
}

#[tokio::test]
async fn reports_are_plain_json() {
    let bench = Bench::new();
    let (_, cycles) = bench.json(get("/v1/loops/l/cycles?limit=2&state=true")).await;
    assert_eq!(
        (cycles["records"].as_array().unwrap().len(), &cycles["more"]),
        (2, &json!(true))
    );
    assert_eq!(
        (&cycles["records"][0]["seq"], &cycles["records"][0]["state"]),
        (&json!(1), &json!("AQID"))
    );

    let (_, replay) = bench.json(send("POST", "/v1/loops/l/replay", &json!({}))).await;
    assert_eq!(
        (&replay["compared"], &replay["equal"], &replay["unread"]),
        (&json!(9), &json!(8), &json!(1))
    );
    assert_eq!(replay["skipped"], json!([{"reason": "a switch", "cycles": 2}]));
    assert_eq!(
        replay["first_difference"],
        json!({"term": 2, "seq": 7, "text": "output out was 1, and is 2 now"})
    );
    assert_eq!((&replay["from_unix_us"], &replay["loop"]), (&json!(5_000), &json!("l")));

    let asked = json!({"component": "pid", "parameters": {"k": 2.0}});
    let (_, trial) = bench.json(send("POST", "/v1/loops/l/backtest", &asked)).await;
    assert_eq!(
        (&trial["verdict"], &trial["parameters"]),
        (&json!("differs"), &json!({"k": 2.0}))
    );
    assert_eq!(trial["bump_percent"], json!(null), "what is not finite is null");
    assert_eq!(trial["points"][0]["measurement"], json!(null));
    assert_eq!(
        (&trial["outputs"][0]["max_seq"], &trial["outputs"][0]["max_percent"]),
        (&json!(2), &json!(7.0))
    );

    let asked = json!({"component": "pid", "cycles": 200});
    let (status, shadow) = bench.json(send("POST", "/v1/loops/l/shadows", &asked)).await;
    assert_eq!((status, &shadow["cycles_wanted"]), (StatusCode::CREATED, &json!(200)));
    let (_, shadows) = bench.json(get("/v1/loops/l/shadows")).await;
    assert_eq!(shadows["shadows"].as_array().unwrap().len(), 1);
    let (status, _) = bench.json(get("/v1/loops/l/shadows/3")).await;
    assert_eq!(status, StatusCode::OK);
    let (status, problem) = bench.json(get("/v1/loops/l/shadows/three")).await;
    assert_eq!(status, StatusCode::BAD_REQUEST, "{problem}");
    let (status, _) = bench.json(send("DELETE", "/v1/loops/l/shadows/3", &json!({}))).await;
    assert_eq!(status, StatusCode::OK);
}

/// A history of two seconds a page, up to the end that was asked for; none of loop `gone`.
pub(super) fn history(series: &Series, question: HistoryQuestion) -> Result<HistoryView, Error> {
    if *series == Series::Loop(super::fake::loop_id("gone")) {
        return Err(Error::not_found("no host has a history of loop gone", ""));
    }
    let s = 1_000_000_000;
    let to_ns = match question.fineness {
        Fineness::Step(_) => question.to_ns.min(question.from_ns + 2 * s),
        Fineness::Pieces(_) => question.to_ns.min(question.from_ns + 20 * s),
    };
    let layout = Arc::new(Layout {
        outputs: vec!["out".into()],
        period_ns: s / 10,
    });
    let row = |start_ns| {
        let mut bucket = Bucket::at(start_ns);
        bucket.take(&Seen {
            setpoint: 40.0,
            measurement: Some(39.0),
            outputs: &[7.0],
            step_ns: Some(20_000),
            ..Seen::default()
        });
        Row {
            step_ns: s,
            layout: Arc::clone(&layout),
            bucket,
        }
    };
    Ok(HistoryView {
        from_ns: question.from_ns,
        to_ns,
        width_ns: s,
        rows: (question.from_ns..to_ns).step_by(1_000_000_000).map(row).collect(),
        made_of: vec![(question.from_ns, to_ns, s)],
        gaps: vec![],
        sources: vec![super::fake::host()],
        silent: vec![],
    })
}

#[tokio::test]
async fn history_is_told_as_columns_and_as_files_that_have_all_pages() {
    let bench = Bench::new();
    let (status, body) = bench.json(get("/v1/loops/l/history?from=-5s&buckets=10")).await;
    assert_eq!(status, StatusCode::OK, "{body}");
    assert_eq!(body["at_unix_us"].as_array().unwrap().len(), 5);
    assert_eq!(
        (
            &body["loop"],
            &body["sources"][0],
            &body["outputs"]["out"]["mean"][4],
            &body["step_us"]["max"][0]
        ),
        (&json!("l"), &json!("h"), &json!(7.0), &json!(20.0))
    );
    let asked = bench.cell.histories.lock().unwrap().pop().unwrap();
    assert_eq!(
        (asked.to_ns - asked.from_ns, asked.fineness),
        (5_000_000_000, Fineness::Pieces(10))
    );
    // Seven seconds in pages of two.
    let mut request = get("/v1/points/tt-1/history?from=2023-11-14T22:13:13Z&step=1s");
    request
        .headers_mut()
        .insert(header::ACCEPT, "text/csv".parse().unwrap());
    let (status, text) = bench.bytes(request).await;
    let text = String::from_utf8(text).unwrap();
    assert_eq!(status, StatusCode::OK, "{text}");
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(lines.len(), 1 + 7, "{text}");
    assert!(lines[0].starts_with("time,duration_s,cycles") && lines[0].ends_with("out_out_mean"));
    assert!(lines[1].starts_with("2023-11-14T22:13:13.000000Z,1,1,") && lines[7].contains("22:13:19."));
    let (status, bytes) = bench.bytes(get("/v1/loops/l/history?format=parquet")).await;
    assert_eq!(status, StatusCode::OK);
    assert!(bytes.starts_with(b"PAR1") && bytes.ends_with(b"PAR1"));
    for (path, status, part) in [
        (
            "/v1/loops/l/history?step=1s&buckets=5",
            StatusCode::UNPROCESSABLE_ENTITY,
            "give one",
        ),
        (
            "/v1/loops/l/history?step=2s",
            StatusCode::UNPROCESSABLE_ENTITY,
            "use cycles, 1s",
        ),
        (
            "/v1/loops/l/history?from=monday",
            StatusCode::UNPROCESSABLE_ENTITY,
            "RFC 3339",
        ),
        (
            "/v1/loops/l/history?format=xml",
            StatusCode::UNPROCESSABLE_ENTITY,
            "parquet",
        ),
        ("/v1/loops/l/history?width=5", StatusCode::BAD_REQUEST, "width"),
        ("/v1/loops/gone/history", StatusCode::NOT_FOUND, "no host has"),
        (
            "/v1/loops/gone/history?format=csv",
            StatusCode::NOT_FOUND,
            "no host has",
        ),
    ] {
        let (found, body) = bench.json(get(path)).await;
        assert_eq!(found, status, "{path}: {body}");
        assert!(body.to_string().contains(part), "{path}: {body}");
    }
}
