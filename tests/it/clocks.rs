//! Nobody's clock matters: hosts whose dates are hours apart, dates that step while hosts run, and a life whose date went back.

use bumpless_tests::{Cell, CellOptions, HostProcess, first_order_loop};
use serde_json::Value;

use crate::{names, number, one_writer, text, whole};

const LOOP: &str = "loop-0";
const POINT: &str = "plant.0.out";
/// How far the dates of the controller hosts are off from the beginning, in h.
const APART_H: [(&str, i64); 3] = [("a", -11), ("b", 23), ("c", 4)];

fn lost(view: &Value) -> (&Value, &Value) {
    (&view["tally"]["lost"], &view["tally"]["takeovers"])
}

#[test]
#[allow(clippy::print_stderr, reason = "what was not run is said")]
fn dates_apart_and_stepping_cost_no_cycle_and_no_order() {
    let options = CellOptions {
        dates: true,
        heads: APART_H
            .iter()
            .map(|(host, hours)| ((*host).to_owned(), format!("clock_offset_s = {}\n", hours * 3_600)))
            .collect(),
        ..CellOptions::first_order("{ count = 1, tau_s = 1.0 }")
    };
    let mut cell = Cell::start(options).unwrap();
    let api = cell.api().unwrap();
    api.upload_stock(&["pid"]).unwrap();
    // Slow enough that a busy machine loses no cycle of itself.
    api.apply(&first_order_loop(0, "pid", 500.0)).unwrap();
    let before = api
        .wait_for_loop(LOOP, "all members and a first cycle", |view| {
            names(&view["members"]).len() == 3 && view["seq"].as_u64() > Some(0)
        })
        .unwrap();
    let feed = api.live(&format!("?loops={LOOP}")).unwrap();
    if cell.dates() {
        // Forth and back, by hours and by days; the home's too.
        let steps: [[(&str, i64); 4]; 2] = [
            [
                ("plant", 30 * 86_400),
                ("a", -7_200),
                ("b", 5 * 3_600),
                ("c", -40 * 86_400),
            ],
            [("plant", -86_400), ("a", 86_400), ("b", -23 * 3_600), ("c", 3_600)],
        ];
        for step in steps {
            for (host, by_s) in step {
                cell.host(host).unwrap().step_date(by_s).unwrap();
            }
            let from = whole(&api.loop_view(LOOP).unwrap()["seq"]);
            // Three seconds: the means is looked at once a second.
            feed.record_where("cycles after the step", |record| {
                record["seq"].as_u64() > Some(from + 6)
            })
            .unwrap();
        }
    } else {
        eprintln!("NOT RUN: dates that step, for there is no libfaketime here (Debian: faketime)");
    }
    let after = api.loop_view(LOOP).unwrap();
    assert_eq!(lost(&after), lost(&before), "cycles lost, and takeovers");
    assert_eq!(cell.journal().unwrap().cycles_missing(POINT), 0);

    // An order is kept over the owner's death, and the owner comes back with a date of last month.
    api.setpoint(LOOP, 47.0).unwrap();
    let owner = text(&after["owner"]);
    let host = cell.host(&owner).unwrap();
    host.kill9();
    host.set_head(format!("clock_offset_s = {}\n", -30 * 86_400));
    let taken = feed
        .record_where("a cycle of another owner", |record| record["owner"] != owner.as_str())
        .unwrap();
    assert!(
        (number(&taken["setpoint"]) - 47.0).abs() < 1e-9,
        "{}",
        taken["setpoint"]
    );
    cell.restart(&owner).unwrap();
    cell.wait_joined().unwrap();
    api.wait_for_loop(LOOP, "all members again", |view| names(&view["members"]).len() == 3)
        .unwrap();
    one_writer(&cell.journal().unwrap());

    // A component that was deleted at a host whose date is ahead comes in again at one whose date is behind.
    let (ahead, behind) = (cell.api_of("b").unwrap(), cell.api_of("a").unwrap());
    ahead.upload_stock(&["pidplus"]).unwrap();
    let known = |api: &bumpless_tests::Api| api.components().unwrap().iter().any(|c| c["name"] == "pidplus");
    let wait = |api: &bumpless_tests::Api, there: bool| {
        api.wait_until("the library to follow", |api| {
            if known(api) == there { Ok(()) } else { Err(there) }
        })
        .unwrap();
    };
    wait(&behind, true);
    ahead.delete("/v1/components/pidplus").unwrap();
    wait(&behind, false);
    behind.upload_stock(&["pidplus"]).unwrap();
    wait(&ahead, true);
    wait(&behind, true);
}

#[test]
fn a_second_host_of_a_name_leaves_whatever_the_dates_say() {
    let mut cell = Cell::start(CellOptions::first_order("{ count = 1 }").controllers(1)).unwrap();
    let (first, known) = (cell.host("a").unwrap().pid(), cell.plant.cell.clone());
    for days in [-30, 30] {
        let options = bumpless_tests::HostOptions {
            name: "a".to_owned(),
            cell: cell.name.clone(),
            connect: known.clone(),
            head: format!("clock_offset_s = {}\n", days * 86_400),
            // The shortest wait for a life before this one.
            cell_extra: "lease_ms = 300\n".to_owned(),
            ..Default::default()
        };
        let twin = HostProcess::start(options, &cell.folder().join(format!("twin{days}")));
        let gone = match twin {
            Err(error) => error.to_string(),
            // Where it joined before it could see the other it is told a moment later.
            Ok(mut twin) => {
                let status = twin.wait(std::time::Duration::from_secs(20)).unwrap();
                assert!(!status.success(), "it ends as one that failed: {status}");
                twin.stderr()
            }
        };
        assert!(gone.contains("name"), "{days} days off: {gone}");
    }
    let host = cell.host("a").unwrap();
    assert!(host.is_running() && host.pid() == first, "the one that was there stays");
    cell.wait_joined().unwrap();
}
