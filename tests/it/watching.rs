//! What watches the cell from outside: metrics, the document of the API, the live feed.

use std::{collections::BTreeMap, time::Duration};

use bumpless_tests::{Api, Cell, CellOptions, Feed, first_order_loop, repository};
use serde_json::Value;

use crate::{names, whole};

/// Samples by name and labels. A reader of OpenMetrics text (1.0), as strict as the format.
fn parse(text: &str) -> BTreeMap<String, f64> {
    let mut samples = BTreeMap::new();
    let mut types = BTreeMap::new();
    let body = text.strip_suffix("# EOF\n").expect("the text ends with # EOF");
    for line in body.lines() {
        if let Some(comment) = line.strip_prefix("# ") {
            let (word, rest) = comment.split_once(' ').expect(line);
            let (name, what) = rest.split_once(' ').expect(line);
            match word {
                "TYPE" => assert!(types.insert(name, what).is_none(), "{name} is declared twice"),
                "HELP" | "UNIT" => assert!(!what.is_empty(), "{line}"),
                _ => panic!("{line}"),
            }
            continue;
        }
        let (name, value) = line.rsplit_once(' ').expect(line);
        let value: f64 = value.parse().expect(line);
        let family = name.split('{').next().expect(line);
        let ends = ["_total", "_bucket", "_count", "_sum", "_info"];
        let declared = types.contains_key(family)
            || ends
                .iter()
                .any(|end| family.strip_suffix(end).is_some_and(|f| types.contains_key(f)));
        assert!(declared, "{family} was not declared");
        assert!(family.starts_with("bumpless_"), "{line}");
        assert!(
            samples.insert(name.to_owned(), value).is_none(),
            "{name} is given twice"
        );
    }
    samples
}

#[track_caller]
fn sample(samples: &BTreeMap<String, f64>, name: &str) -> f64 {
    *samples
        .get(name)
        .unwrap_or_else(|| panic!("{name} is missing; there are {:?}", samples.keys()))
}

#[test]
fn metrics_count_the_document_fits_and_the_feed_resumes() {
    let mut cell = Cell::start(CellOptions::first_order("{ count = 2 }")).unwrap();
    let api = cell.api().unwrap();
    api.upload_stock(&["pid"]).unwrap();
    for n in 0..2 {
        api.apply(&first_order_loop(n, "pid", 50.0)).unwrap();
    }
    metrics_count(&api);
    owners_measure_steps(&cell);
    the_document_fits(&api);
    the_feed_resumes(&api);
    the_feed_in_rows_resumes_at_another_host(&mut cell);
}

fn metrics_count(api: &Api) {
    api.wait_for_loop("loop-0", "some cycles", |view| view["seq"].as_u64() > Some(5))
        .unwrap();
    let first = parse(&api.metrics().unwrap());
    let feed = api.live("?loops=loop-0").unwrap();
    let seq = whole(&feed.record().unwrap()["seq"]);
    feed.record_where("twenty cycles", |r| r["seq"].as_u64() >= Some(seq + 20))
        .unwrap();
    let second = parse(&api.metrics().unwrap());
    let taken = "bumpless_cycles_taken_total";
    assert!(sample(&second, taken) >= sample(&first, taken) + 20.0);
    assert!(sample(&second, "bumpless_records_total") >= sample(&first, "bumpless_records_total") + 20.0);
    for (name, value) in [
        ("bumpless_hosts_alive", 4.0_f64),
        ("bumpless_loops_home", 2.0),
        ("bumpless_loops_known", 2.0),
        ("bumpless_loops_owned", 0.0),
        ("bumpless_components", 1.0),
        ("bumpless_uploads_total", 1.0),
        ("bumpless_applies_total", 2.0),
        ("bumpless_fetches_corrupt_total", 0.0),
    ] {
        assert_eq!(
            sample(&second, name).to_bits(),
            value.to_bits(),
            "{name} = {}",
            second[name]
        );
    }
    // What was asked is counted by its outcome.
    assert_eq!(api.loop_view("nobody").unwrap_err().status(), 404);
    let third = parse(&api.metrics().unwrap());
    let missed = third
        .iter()
        .find(|(name, _)| name.contains("http_requests") && name.contains("404"));
    assert!(missed.is_some_and(|(_, count)| *count >= 1.0), "{missed:?}");
}

fn owners_measure_steps(cell: &Cell) {
    let steps: f64 = cell
        .controllers
        .iter()
        .map(|host| {
            let samples = parse(&host.api().metrics().unwrap());
            let counts = samples
                .iter()
                .filter(|(name, _)| name.starts_with("bumpless_step_seconds_count"));
            counts.map(|(_, count)| count).sum::<f64>()
        })
        .sum();
    assert!(steps >= 20.0, "{steps} steps were measured by their owners");
}

fn the_document_fits(api: &Api) {
    let answer = api.send("GET", "/openapi.json", &[], &[]).unwrap();
    let kept = std::fs::read_to_string(repository().join("docs/openapi.json")).unwrap();
    assert!(
        answer.text() == kept,
        "docs/openapi.json is not what the host says: run `cargo xtask openapi`"
    );
    let document: Value = serde_json::from_str(&kept).unwrap();
    // Each address that can be asked without a body answers with a status that the document has.
    let paths = document["paths"].as_object().unwrap();
    for (path, methods) in paths {
        let Some(get) = methods.get("get") else { continue };
        if path == "/v1/live" {
            continue;
        }
        let asked = path.replace("{name}", "loop-0").replace("{reference}", "pid");
        let answer = api.send("GET", &asked, &[], &[]).unwrap();
        let responses = &get["responses"];
        let named = &responses[answer.status.to_string()];
        // Errors that operations share stand in one place.
        let shared = named["$ref"].as_str();
        let shared = shared.and_then(|to| document.pointer(to.trim_start_matches('#')));
        let response = shared.unwrap_or(named);
        assert!(
            response.is_object(),
            "GET {asked} answers {}, which is not in the document",
            answer.status
        );
        let kind = answer.headers.get("content-type").cloned().unwrap_or_default();
        let plain = kind.split(';').next().unwrap_or_default();
        assert!(
            response["content"][plain].is_object(),
            "GET {asked} answers {kind}: {response}"
        );
        // What the document says is there, is there.
        let schema = &response["content"][plain]["schema"];
        let Some(name) = schema["$ref"]
            .as_str()
            .and_then(|r| r.strip_prefix("#/components/schemas/"))
        else {
            continue;
        };
        let body = answer.json();
        for key in names(&document["components"]["schemas"][name]["required"]) {
            assert!(body.get(&key).is_some(), "GET {asked}: {key} is missing in {body}");
        }
    }
    assert!(paths.len() > 15, "{} paths", paths.len());
}

fn the_feed_resumes(api: &Api) {
    let feed = api.live("?loops=loop-1").unwrap();
    let first = feed.next(Duration::from_secs(10)).unwrap();
    assert_eq!(first.name, "hosts", "who is there comes at once");
    assert_eq!(first.data["hosts"].as_array().map(Vec::len), Some(4));
    let record = feed.record().unwrap();
    assert_eq!(record["loop"], "loop-1");
    let last = whole(&record["seq"]);
    drop(feed);
    let feed = api.live("?loops=loop-1").unwrap();
    let mut before = last;
    for _ in 0..20 {
        let seq = whole(&feed.record().unwrap()["seq"]);
        assert!(seq > before, "{seq} after {before}");
        before = seq;
    }
    // Thinned out: at least 200 ms between two records of a loop of 50 ms.
    let thin = api.live("?loops=loop-1&every_ms=200").unwrap();
    let times: Vec<u64> = (0..5).map(|_| whole(&thin.record().unwrap()["at_unix_us"])).collect();
    let quiet = times.windows(2).filter(|pair| pair[1] - pair[0] >= 200_000).count();
    assert!(quiet >= 3, "{times:?}");
    let with_state = api.live("?loops=loop-1&state=true").unwrap().record().unwrap();
    assert!(with_state["state"].is_string() && record["state"].is_null());
}

/// The rows of the traced loop as they come, until `enough` of their cycles; the last id too.
fn traced(api: &Api, last_event_id: Option<&str>, enough: usize) -> (Vec<u64>, String) {
    let url = format!("{}/v1/live?form=rows&trace=loop-1&every_ms=100", api.base());
    let feed = Feed::open(&url, last_event_id).unwrap();
    let mut seqs = Vec::new();
    loop {
        let event = feed.next(Duration::from_secs(10)).unwrap();
        if event.name == "rows" {
            let rows = event.data["trace"].as_array().unwrap();
            seqs.extend(rows.iter().map(|row| whole(&row["seq"])));
            assert_eq!(event.data["lost"], 0, "nobody was too slow");
            if seqs.len() >= enough {
                return (seqs, event.id);
            }
        }
    }
}

#[track_caller]
fn no_gap(seqs: &[u64]) {
    assert!(
        seqs.windows(2).all(|pair| pair[1] == pair[0] + 1),
        "a cycle is missing or comes twice: {seqs:?}"
    );
}

/// A page whose host dies goes on at another: what it missed comes from the log of the loop's home.
fn the_feed_in_rows_resumes_at_another_host(cell: &mut Cell) {
    let plant = cell.api().unwrap();
    let (first, id) = traced(&plant, None, 10);
    no_gap(&first);
    let last = *first.last().unwrap();
    plant
        .wait_for_loop("loop-1", "cycles that nobody reads", |view| {
            view["seq"].as_u64() > Some(last + 20)
        })
        .unwrap();
    let other = cell.api_of("a").unwrap();
    let (second, _) = traced(&other, Some(&id), 40);
    let both: Vec<u64> = first.into_iter().chain(second).collect();
    no_gap(&both);
    // What it met before it was asked is remembered: the first owner at least.
    let told = plant.get("/v1/notices").unwrap();
    let first_owner = told["notices"]
        .as_array()
        .unwrap()
        .iter()
        .any(|notice| notice["kind"] == "took-over");
    assert!(first_owner, "{told}");
}
