//! Two cells on one machine, with the same names of hosts, loops and points, do not know of each other.

use bumpless_tests::{Cell, CellOptions, first_order_loop};

use crate::{one_writer, text};

#[test]
fn two_cells_on_one_machine_do_not_see_each_other() {
    let options = || CellOptions::first_order("{ count = 1 }").controllers(1);
    let mut first = Cell::start(options()).unwrap();
    let mut second = Cell::start(options()).unwrap();
    // Even where a host of one cell is told to connect to the other, no message crosses.
    let across = second.plant.cell.clone();
    let home = first.plant.cell.clone();
    let host = &mut first.controllers[0];
    host.set_connect([home, across].concat());
    host.restart().unwrap();
    first.wait_joined().unwrap();
    second.wait_joined().unwrap();

    let (here, there) = (first.api().unwrap(), second.api().unwrap());
    here.upload_stock(&["pid"]).unwrap();
    here.apply(&first_order_loop(0, "pid", 50.0)).unwrap();
    let feed = here.live("").unwrap();
    for _ in 0..20 {
        assert_eq!(feed.record().unwrap()["loop"], "loop-0");
    }
    let points = |api: &bumpless_tests::Api| -> Vec<String> {
        let rows = api.points().unwrap();
        rows.iter()
            .map(|p| format!("{}@{}", text(&p["name"]), text(&p["host"])))
            .collect()
    };
    assert_eq!(points(&here), points(&there), "the same names in both, each its own");
    assert_eq!(there.hosts().unwrap().len(), 2);
    assert!(there.loops().unwrap().is_empty());
    assert!(there.components().unwrap().is_empty());
    assert!(
        second.journal().unwrap().writes.is_empty(),
        "nobody wrote to the neighbour's actuator"
    );
    let journal = first.journal().unwrap();
    assert!(journal.of("plant.0.out").count() > 10);
    one_writer(&journal);
}
