//! Hosts that are emptied, restarted one after the other, preferred, and cut off: what the loops feel of it.

use std::time::Duration;

use bumpless_tests::{Api, Cell, CellOptions, Way, first_order_loop, pause};
use serde_json::{Value, json};

use crate::{names, one_writer, text, whole};

/// Three slow loops, so that a busy machine costs no cycle, on a cell of so many controllers; each loop on all of them.
fn running_cell(controllers: usize, change: impl Fn(usize, &mut Value)) -> Cell {
    let options = CellOptions::first_order("{ count = 3, tau_s = 1.0 }").controllers(controllers);
    let mut cell = Cell::start(options).unwrap();
    let api = cell.api().unwrap();
    api.upload_stock(&["pid"]).unwrap();
    for n in 0..3 {
        let mut draft = first_order_loop(n, "pid", 500.0);
        draft["replicas"] = json!(controllers);
        change(n, &mut draft);
        api.apply(&draft).unwrap();
    }
    wait_members(&api, controllers);
    cell
}

fn wait_members(api: &Api, members: usize) {
    for n in 0..3 {
        api.wait_for_loop(&format!("loop-{n}"), "all members and an owner", |view| {
            names(&view["members"]).len() == members && view["owner"].is_string()
        })
        .unwrap();
    }
}

fn owners(api: &Api) -> Vec<String> {
    let owner = |n| text(&api.loop_view(&format!("loop-{n}")).unwrap()["owner"]);
    (0..3).map(owner).collect()
}

/// Nothing lost, nothing taken over: everything was handed over.
#[track_caller]
fn nothing_lost(cell: &Cell, api: &Api) {
    let journal = cell.journal().unwrap();
    one_writer(&journal);
    for n in 0..3 {
        let view = api.loop_view(&format!("loop-{n}")).unwrap();
        assert_eq!(view["tally"]["lost"], 0, "{}", view["tally"]);
        assert_eq!(journal.cycles_missing(&format!("plant.{n}.out")), 0);
    }
}

fn host(api: &Api, name: &str) -> Value {
    let hosts = api.hosts().unwrap();
    hosts.into_iter().find(|host| host["name"] == name).unwrap()
}

#[test]
fn a_drained_host_is_empty_and_stays_so_over_a_restart_only_if_that_was_said() {
    let mut cell = running_cell(2, |_, _| {});
    let api = cell.api().unwrap();
    for keep in [false, true] {
        // Whoever owns the first loop leaves; asked at another host than the one that leaves, and than the home.
        let leaves = owners(&api)[0].clone();
        let stays = if leaves == "a" { "b" } else { "a" };
        let order = json!({ "keep": keep });
        let end = cell
            .api_of(stays)
            .unwrap()
            .post(&format!("/v1/hosts/{leaves}/drain"), &order)
            .unwrap();
        assert_eq!(
            (&end["draining"], &end["kept"], &end["loops_owned"]),
            (&json!(true), &json!(keep), &json!(0)),
            "{end}"
        );
        assert_eq!(owners(&api), [stays, stays, stays]);
        let seen = host(&api, &leaves);
        assert_eq!(
            (&seen["draining"], &seen["drain_kept"]),
            (&json!(true), &json!(keep)),
            "{seen}"
        );
        // A new loop stays away from it, too.
        wait_members(&api, 1);

        cell.host(&leaves).unwrap().terminate().unwrap();
        cell.restart(&leaves).unwrap();
        cell.wait_joined().unwrap();
        if keep {
            assert_eq!(host(&cell.api_of(&leaves).unwrap(), &leaves)["draining"], true);
            assert_eq!(names(&api.loop_view("loop-0").unwrap()["members"]), [stays]);
            let end = api.post(&format!("/v1/hosts/{leaves}/undrain"), &json!({})).unwrap();
            assert_eq!(
                (&end["draining"], &end["ready"]),
                (&json!(false), &json!(true)),
                "{end}"
            );
        }
        wait_members(&api, 2);
        assert_eq!(host(&api, &leaves)["draining"], false);
    }
    nothing_lost(&cell, &api);
}

#[test]
fn the_last_host_is_not_emptied_and_words_say_so() {
    let mut cell = running_cell(1, |_, _| {});
    let api = cell.api().unwrap();
    let end = api.post("/v1/hosts/a/drain", &json!({})).unwrap();
    assert_eq!(
        (&end["draining"], &end["loops_owned"]),
        (&json!(true), &json!(3)),
        "{end}"
    );
    let seq = whole(&api.loop_view("loop-0").unwrap()["seq"]);
    api.wait_for_loop("loop-0", "more cycles on the draining host", |view| {
        view["seq"].as_u64() > Some(seq + 3)
    })
    .unwrap();
    let problem = api.post("/v1/hosts/x/drain", &json!({})).unwrap_err();
    assert_eq!(problem.status(), 404, "{problem}");
    assert!(
        problem.to_string().contains("no host of the cell is named x"),
        "{problem}"
    );
    let problem = api.post("/v1/hosts/a/drain", &json!({ "kept": true })).unwrap_err();
    assert!([400, 422].contains(&problem.status()), "{problem}");
    nothing_lost(&cell, &api);
}

#[test]
fn every_controller_host_restarts_and_no_cycle_is_lost() {
    let mut cell = running_cell(3, |_, _| {});
    let api = cell.api().unwrap();
    for name in ["a", "b", "c"] {
        // As the guide says: empty it, stop it, start it, wait until it is ready for all again.
        let end = api.post(&format!("/v1/hosts/{name}/drain"), &json!({})).unwrap();
        assert_eq!(end["loops_owned"], 0, "{end}");
        cell.host(name).unwrap().terminate().unwrap();
        cell.restart(name).unwrap();
        cell.wait_joined().unwrap();
        let end = api.post(&format!("/v1/hosts/{name}/undrain"), &json!({})).unwrap();
        assert_eq!(end["ready"], true, "{end}");
        wait_members(&api, 3);
    }
    nothing_lost(&cell, &api);
}

#[test]
fn a_loop_goes_back_to_the_host_that_it_prefers_and_stays_where_a_person_puts_it() {
    let mut cell = running_cell(3, |n, draft| {
        if n == 0 {
            draft["prefer"] = json!(["b"]);
        }
    });
    let api = cell.api().unwrap();
    let owned_by = |name: &str| {
        api.wait_for_loop("loop-0", &format!("{name} as the owner"), |view| view["owner"] == name)
            .unwrap()
    };
    owned_by("b");
    assert_eq!(
        names(&api.loop_view("loop-0").unwrap()["members"])[0],
        "b",
        "the first member"
    );
    cell.host("b").unwrap().kill9();
    let taken = api
        .wait_for_loop("loop-0", "another owner", |view| {
            view["owner"] != "b" && view["owner"].is_string()
        })
        .unwrap();
    cell.restart("b").unwrap();
    let back = owned_by("b");
    // Between two cycles: one change of ownership, and no takeover.
    assert_eq!(back["tally"]["takeovers"], taken["tally"]["takeovers"]);
    assert_eq!(back["tally"]["lost"], taken["tally"]["lost"]);
    // A person's word counts more.
    api.move_owner("loop-0", "c").unwrap();
    owned_by("c");
    pause(Duration::from_secs(7));
    assert_eq!(api.loop_view("loop-0").unwrap()["owner"], "c");
    one_writer(&cell.journal().unwrap());
}

#[test]
fn a_host_that_is_cut_off_loses_its_loops_and_writes_nothing_more() {
    // A plant, `a` behind a relay, and `b` beside it; `a` is preferred, so it owns the loop.
    let options = CellOptions {
        relayed: Some("a".to_owned()),
        ..CellOptions::first_order("{ count = 1, tau_s = 1.0 }").controllers(2)
    };
    let mut cell = Cell::start(options).unwrap();
    let api = cell.api().unwrap();
    api.upload_stock(&["pid"]).unwrap();
    let mut draft = first_order_loop(0, "pid", 50.0);
    draft["prefer"] = json!(["a"]);
    draft["replicas"] = json!(2);
    api.apply(&draft).unwrap();
    for way in [Way::Back, Way::Away] {
        let before = api
            .wait_for_loop("loop-0", "two members and a as the owner", |view| {
                view["owner"] == "a" && names(&view["members"]).len() == 2
            })
            .unwrap();
        let relay = cell.relay.as_ref().unwrap();
        assert!(relay.bytes(Way::Away) > 0, "the link passes the relay");
        relay.stall(way, true);
        let cut = api
            .wait_for_loop("loop-0", "b as the owner", |view| view["owner"] == "b")
            .unwrap();
        assert!(whole(&cut["term"]) > whole(&before["term"]));
        // What waits in the relay arrives late, under an old ownership.
        pause(Duration::from_secs(1));
        relay.stall(way, false);
    }
    let journal = cell.journal().unwrap();
    one_writer(&journal);
    assert!(
        journal.longest_gap_ns("plant.0.out") < 2_000_000_000,
        "the loop went on without it"
    );
}
