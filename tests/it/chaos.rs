//! A short run of faults by a seed, under the checker: what must never happen does not, whatever is done.

use std::time::Duration;

use bumpless_tests::{
    Cell, CellOptions, Inflictor, Kind, Observer, Operator, Outcome, Profile, Schedule, Way, first_order_loop,
    kept_commands, unix_ns,
};
use serde_json::{Value, json};

use crate::{names, one_writer, whole};

const LOOPS: usize = 4;

#[test]
fn faults_of_many_kinds_break_no_promise() {
    let options = CellOptions {
        relayed: Some("a".to_owned()),
        ..CellOptions::first_order(&format!("{{ count = {LOOPS}, tau_s = 1.0 }}"))
    };
    let mut cell = Cell::start(options).unwrap();
    let api = cell.api().unwrap();
    api.upload_stock(&["pid"]).unwrap();
    let names: Vec<String> = (0..LOOPS).map(|n| format!("loop-{n}")).collect();
    for n in 0..LOOPS {
        let mut draft = first_order_loop(n, "pid", if n == 0 { 20.0 } else { 50.0 });
        draft["strategy"] = json!(if n % 2 == 0 { "round-robin" } else { "local" });
        api.apply(&draft).unwrap();
    }
    let mut inflictor = Inflictor { cell };
    inflictor.wait_well().unwrap();
    let started_ns = unix_ns();
    let observer = Observer::follow(&api, &names, started_ns).unwrap();
    let addresses: Vec<String> = inflictor.cell.hosts().map(|host| host.api.clone()).collect();
    let profile = Profile {
        levels: [40.0, 45.0],
        half: Duration::from_secs(1),
    };
    let operator = Operator::start(&addresses, &names, profile).unwrap();
    let kinds = [
        Kind::Pause,
        Kind::CutOneWay,
        Kind::Narrow,
        Kind::Kill,
        Kind::Date,
        Kind::HomeKill,
    ];
    for fault in Schedule::new(5, &kinds, 300, (50, 200)).take(kinds.len()) {
        inflictor
            .inflict(&fault)
            .unwrap_or_else(|error| panic!("{fault:?}: {error}"));
    }
    let orders = operator.finish();
    // Every loop writes once more after the last order, so the last record is in the feed by then.
    inflictor.wait_well().unwrap();
    let records = observer.finish();
    let mut journal = inflictor.cell.journal().unwrap();
    journal.undo_dates(started_ns);
    one_writer(&journal);
    let breaches: Vec<String> = kept_commands(&orders, &records, &names, &|_| false)
        .iter()
        .map(ToString::to_string)
        .collect();
    assert!(breaches.is_empty(), "{breaches:#?}");
    let done = orders.iter().filter(|order| order.outcome != Outcome::Unknown).count();
    assert!(
        done > LOOPS && records.len() > 100,
        "{done} of {} orders, {} records",
        orders.len(),
        records.len()
    );
    for n in 0..LOOPS {
        let writes = journal.between(&format!("plant.{n}.out"), started_ns, unix_ns()).len();
        assert!(writes > 20, "loop {n} wrote {writes} times");
    }
}

fn told(record: &Value, kinds: &[&str]) -> bool {
    let events = record["events"].as_array().map(Vec::as_slice).unwrap_or_default();
    events
        .iter()
        .any(|event| kinds.iter().any(|kind| event["kind"] == *kind))
}

#[test]
fn a_loop_whose_link_carries_too_little_goes_on_and_says_so() {
    let options = CellOptions {
        relayed: Some("a".to_owned()),
        ..CellOptions::first_order("{ count = 1, tau_s = 1.0 }")
    };
    let mut cell = Cell::start(options).unwrap();
    let api = cell.api().unwrap();
    api.upload_stock(&["pid"]).unwrap();
    let mut draft = first_order_loop(0, "pid", 50.0);
    draft["prefer"] = json!(["a"]);
    api.apply(&draft).unwrap();
    api.wait_for_loop("loop-0", "the host behind the relay to own it", |view| {
        view["owner"] == "a" && names(&view["members"]).len() == 3
    })
    .unwrap();
    let feed = api.live("?loops=loop-0").unwrap();
    feed.record_where("a cycle of its owner", |record| record["owner"] == "a")
        .unwrap();

    // A sample and a commit each have some hundred bytes, twenty times a second.
    let relay = cell.relay.as_ref().unwrap();
    for way in [Way::Away, Way::Back] {
        relay.narrow(way, Some(1_000));
    }
    let taken = feed
        .record_where("a cycle that somebody else runs", |record| record["owner"] != "a")
        .unwrap();
    assert!(told(&taken, &["took-over"]), "it says so: {}", taken["events"]);
    let from = whole(&taken["seq"]);
    let later = feed
        .record_where("two seconds more", |record| record["seq"].as_u64() > Some(from + 40))
        .unwrap();
    assert_ne!(later["stepped_by"], "a", "nobody waits for the narrow link");
    let lost = whole(&api.loop_view("loop-0").unwrap()["tally"]["lost"]);

    let relay = cell.relay.as_ref().unwrap();
    for way in [Way::Away, Way::Back] {
        relay.narrow(way, None);
    }
    feed.record_where("a step of the host whose link is wide again", |record| {
        record["stepped_by"] == "a"
    })
    .unwrap();
    let journal = cell.journal().unwrap();
    one_writer(&journal);
    assert!(lost < 20, "a takeover, and not a standstill: {lost} cycles lost");
}
