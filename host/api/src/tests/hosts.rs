//! Hosts over HTTP: what an order to drain asks, and what cannot be asked.

use axum::http::StatusCode;
use bumpless_deploy::Check;
use serde_json::json;

use super::{Bench, get, send};

/// What a host looks at of itself, with one thing that may be unwell.
pub(super) fn checks(unwell: Option<&str>) -> Vec<Check> {
    ["bus", "cell", "store", "service", "io"]
        .map(|name| Check {
            name: name.to_owned(),
            good: unwell != Some(name),
            text: if unwell == Some(name) { "it is not" } else { "it is" }.to_owned(),
        })
        .to_vec()
}

#[tokio::test]
async fn orders_to_drain_arrive_with_what_was_said() {
    let bench = Bench::new();
    for (path, body, draining, kept) in [
        ("/v1/hosts/a/drain", json!({}), true, false),
        ("/v1/hosts/a/drain", json!({"keep": true}), true, true),
        ("/v1/hosts/a/undrain", json!({}), false, false),
    ] {
        let (status, end) = bench.json(send("POST", path, &body)).await;
        assert_eq!(status, StatusCode::OK, "{end}");
        assert_eq!(
            (
                &end["host"],
                &end["draining"],
                &end["kept"],
                &end["loops_owned"],
                &end["ready"]
            ),
            (&json!("a"), &json!(draining), &json!(kept), &json!(0), &json!(true)),
            "{path}"
        );
    }
    let (_, hosts) = bench.json(get("/v1/hosts")).await;
    assert_eq!(
        (&hosts["hosts"][0]["labels"], &hosts["hosts"][0]["drain_kept"]),
        (&json!(["east"]), &json!(false))
    );
}

#[tokio::test]
async fn what_is_no_host_and_no_order_is_refused_in_words() {
    let bench = Bench::new();
    for (path, body, part) in [
        ("/v1/hosts/A/drain", json!({}), "'A'"),
        ("/v1/hosts/a/drain", json!({"kept": true}), "kept"),
        ("/v1/hosts/a/drain", json!({"keep": 1}), "keep"),
    ] {
        let (status, problem) = bench.json(send("POST", path, &body)).await;
        assert!(status.is_client_error(), "{path}: {status}");
        assert!(problem.to_string().contains(part), "{path}: {problem}");
    }
}
