//! What is measured: names and units by the conventions, and as docs/metrics.md and the dashboard have them.

use std::{
    collections::{BTreeMap, BTreeSet},
    fmt::Write as _,
    sync::Arc,
    time::Duration,
};

use serde_json::Value;
use tokio::sync::watch;

use super::{Bench, fake::Fake, get};
use crate::metrics::Metrics;

/// The text of a host that has met everything there is.
async fn scraped() -> String {
    let cell = Arc::new(Fake::new());
    let (stop, stopped) = watch::channel(false);
    let metrics = Arc::new(Metrics::new(Arc::clone(&cell) as _));
    let follower = tokio::spawn(Arc::clone(&metrics).follow(Arc::clone(&cell) as _, stopped));
    while cell.readers() == 0 {
        tokio::task::yield_now().await;
    }
    for seq in 1..=2 {
        cell.publish("l", seq);
    }
    metrics.answered("GET", "/v1/hosts", 200, Duration::from_millis(2));
    let line = "bumpless_loop_jitter_seconds_count{loop=\"l\"} 1\n";
    while !metrics.text().unwrap().contains(line) {
        tokio::task::yield_now().await;
    }
    stop.send(true).unwrap();
    follower.await.expect("the follower ends with the host");
    metrics.text().unwrap()
}

/// One family as a document has it.
#[derive(Debug, Default)]
struct Row {
    kind: String,
    unit: String,
    help: String,
    labels: BTreeSet<String>,
}

/// Families by the name that a query uses (histograms without a suffix), from a scrape.
fn rows(text: &str) -> BTreeMap<String, Row> {
    let mut rows: BTreeMap<String, Row> = BTreeMap::new();
    for line in text.lines() {
        if let Some(comment) = line.strip_prefix("# ") {
            let mut words = comment.splitn(3, ' ');
            let (what, name) = (words.next().unwrap(), words.next().unwrap_or_default());
            let rest = words.next().unwrap_or_default().to_owned();
            let row = rows.entry(name.to_owned()).or_default();
            match what {
                "HELP" => row.help = rest,
                "TYPE" => row.kind = rest,
                "UNIT" => row.unit = rest,
                _ => {}
            }
        } else if let Some((name, rest)) = line.split_once('{') {
            let labels: Vec<&str> = rest
                .split("=\"")
                .filter_map(|part| part.rsplit(['{', ',', '"']).next())
                .collect();
            let family = rows
                .keys()
                .rev()
                .find(|family| name.starts_with(family.as_str()))
                .cloned();
            let row = family.and_then(|family| rows.get_mut(&family)).expect("a family");
            let plain = labels[..labels.len() - 1].iter().filter(|label| **label != "le");
            row.labels.extend(plain.map(|label| (*label).to_owned()));
        }
    }
    rows.remove("");
    let named = |(family, row): (String, Row)| {
        let suffix = match row.kind.as_str() {
            "counter" => "_total",
            "info" => "_info",
            _ => "",
        };
        (format!("{family}{suffix}"), row)
    };
    rows.into_iter().map(named).collect()
}

#[tokio::test]
async fn metrics_are_open_metrics_with_units_and_labels() {
    let bench = Bench::new();
    bench.json(get("/v1/hosts")).await;
    let response = bench.ask(get("/metrics")).await;
    let body = axum::body::to_bytes(response.into_body(), usize::MAX).await.unwrap();
    let text = String::from_utf8(body.to_vec()).unwrap();
    for line in [
        "bumpless_cycles_taken_total 7\n",
        "bumpless_hosts_alive 1\n",
        "bumpless_host_alive{host=\"h\"} 1.0\n",
        "bumpless_loop_cycles_taken_total{loop=\"l\"} 5\n",
        "bumpless_loop_setpoint{loop=\"l\"} 1.5\n",
        "bumpless_host_memory_bytes{host=\"h\"} 1000000.0\n",
        "bumpless_http_request_seconds_count{method=\"GET\",route=\"/v1/hosts\"} 1\n",
        "bumpless_http_requests_total{method=\"GET\",status=\"200\"} 1\n",
        "# UNIT bumpless_cycle_seconds seconds\n",
    ] {
        assert!(text.contains(line), "{line} is missing in\n{text}");
    }
    assert!(text.ends_with("# EOF\n"));
}

#[tokio::test]
async fn times_are_observed_from_the_cycles_that_this_host_owned() {
    let cell = Arc::new(Fake::new());
    let (stop, stopped) = watch::channel(false);
    let metrics = Arc::new(Metrics::new(Arc::clone(&cell) as _));
    let follower = tokio::spawn(Arc::clone(&metrics).follow(Arc::clone(&cell) as _, stopped));
    while cell.readers() == 0 {
        tokio::task::yield_now().await;
    }
    cell.publish("l", 1);
    cell.publish("l", 2);
    let line = "bumpless_step_seconds_count{host=\"h\"} 2\n";
    while !metrics.text().unwrap().contains(line) {
        tokio::task::yield_now().await;
    }
    stop.send(true).unwrap();
    follower.await.expect("the follower ends with the host");
}

#[tokio::test]
async fn names_and_units_follow_the_conventions() {
    for (name, row) in rows(&scraped().await) {
        let good = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_';
        assert!(name.starts_with("bumpless_") && name.chars().all(good), "{name}");
        assert!(!row.help.is_empty(), "{name} has no help");
        assert_eq!(row.kind == "counter", name.ends_with("_total"), "{name}: {}", row.kind);
        for unit in ["seconds", "bytes", "ratio"] {
            let suffixed = name.trim_end_matches("_total").ends_with(&format!("_{unit}"));
            assert_eq!(suffixed, row.unit == unit, "{name}: {:?}", row.unit);
        }
        for word in [
            "_ms", "_us", "_ns", "_percent", "_milli", "_kib", "_mib", "_mb", "_minutes",
        ] {
            assert!(!name.contains(word), "{name}: base units only");
        }
        if row.kind == "histogram" {
            assert_eq!(row.unit, "seconds", "{name}");
        }
        assert!(row.labels.len() <= 2, "{name}: {:?}", row.labels);
    }
}

#[tokio::test]
async fn the_document_lists_every_metric() {
    const BEGIN: &str = "<!-- metrics -->\n";
    const END: &str = "<!-- /metrics -->\n";
    let mut table = String::from("| metric | type | unit | labels | what |\n|---|---|---|---|---|\n");
    for (name, row) in rows(&scraped().await) {
        let labels: Vec<String> = row.labels.iter().map(|label| format!("`{label}`")).collect();
        let help = row.help.trim_end_matches('.');
        let unit = if row.unit.is_empty() { "–" } else { &row.unit };
        let _infallible = writeln!(
            table,
            "| `{name}` | {} | {unit} | {} | {help} |",
            row.kind,
            labels.join(", ")
        );
    }
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/metrics.md");
    let text = std::fs::read_to_string(path).expect("docs/metrics.md");
    let (before, rest) = text.split_once(BEGIN).expect("the mark before the table");
    let (_, after) = rest.split_once(END).expect("the mark after the table");
    let now = format!("{before}{BEGIN}{table}{END}{after}");
    if std::env::var_os("UPDATE_EXPECT").is_some() {
        std::fs::write(path, &now).expect("docs/metrics.md can be written");
    } else {
        assert!(
            text == now,
            "docs/metrics.md is not what /metrics says: run this test with UPDATE_EXPECT=1"
        );
    }
}

/// Every query of a dashboard.
fn queries(value: &Value, found: &mut Vec<String>) {
    match value {
        Value::Object(map) => {
            for (key, value) in map {
                match value {
                    Value::String(text) if ["expr", "query", "definition"].contains(&key.as_str()) => {
                        found.push(text.clone());
                    }
                    other => queries(other, found),
                }
            }
        }
        Value::Array(rows) => rows.iter().for_each(|row| queries(row, found)),
        _ => {}
    }
}

#[tokio::test]
async fn the_dashboard_asks_for_what_is_measured() {
    let rows = rows(&scraped().await);
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/grafana/bumpless.json");
    let text = std::fs::read_to_string(path).expect("docs/grafana/bumpless.json");
    let dashboard: Value = serde_json::from_str(&text).expect("it is JSON");
    let mut asked = Vec::new();
    queries(&dashboard, &mut asked);
    let word = |c: char| c.is_ascii_alphanumeric() || c == '_';
    let names: BTreeSet<&str> = asked
        .iter()
        .flat_map(|query| query.split(|c| !word(c)))
        .filter(|name| name.starts_with("bumpless_"))
        .collect();
    assert!(names.len() > 20, "{names:?}");
    let plain = |name: &str| {
        let of_histogram = ["_bucket", "_sum", "_count"]
            .iter()
            .find_map(|end| name.strip_suffix(end));
        rows.contains_key(name)
            || of_histogram.is_some_and(|base| rows.get(base).is_some_and(|row| row.kind == "histogram"))
    };
    let unknown: Vec<&&str> = names.iter().filter(|name| !plain(name)).collect();
    assert!(unknown.is_empty(), "the dashboard asks for {unknown:?}");
}
