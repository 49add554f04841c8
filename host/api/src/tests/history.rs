//! Looking back over HTTP: windows arrive as they were said, reports have the shape of the document.

use axum::http::StatusCode;
use bumpless_deploy::Window;
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
