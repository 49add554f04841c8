//! Two hosts for one device: one writes, the other takes over when it dies or falls silent, and never do both.

use std::time::Instant;

use bumpless_tests::{
    Api,
    masters::{HANDOVER_MAX, LOOP, TwoMasters},
    wait_until,
};
use serde_json::{Value, json};

use crate::{number, text};

#[track_caller]
fn no_overlap(rig: &TwoMasters) {
    let overlaps = rig.overlaps();
    assert!(
        overlaps.is_empty(),
        "{} writes beside the master's: {overlaps:#?}",
        overlaps.len()
    );
}

#[test]
fn the_device_goes_over_with_its_loop_and_is_never_written_by_two() {
    let mut rig = TwoMasters::start(150).unwrap();
    let first = rig.writes().last().unwrap().master;
    let other = 1 - first;
    let api = rig.api(other).unwrap();
    api.setpoint(LOOP, 5_010.0).unwrap();
    let (before, epoch) = (api.loop_view(LOOP).unwrap(), rig.epoch());

    // Death.
    let at = Instant::now();
    rig.hosts[first].kill9();
    rig.wait_written_by(other, at).unwrap();
    no_overlap(&rig);
    let after = api
        .wait_for_loop(LOOP, "the new home", |view| {
            text(&view["home"]) == format!("io-{}", other + 1)
        })
        .unwrap();
    assert!(rig.epoch() > epoch);
    assert!(after["term"].as_u64() > before["term"].as_u64(), "{after}");
    assert_eq!(number(&after["setpoint"]), 5_010.0, "an acknowledged command is kept");

    // The dead one comes back: it stands by.
    rig.hosts[first].restart().unwrap();
    api.wait_until("both are there", |api| match api.hosts() {
        Ok(hosts) if hosts.iter().filter(|host| host["alive"] == true).count() == 2 => Ok(()),
        other => Err(other.map_err(|error| error.to_string())),
    })
    .unwrap();

    // Silence: the master is stopped, and goes on when another is master.
    let at = Instant::now();
    rig.hosts[other].pause().unwrap();
    let taken = rig.wait_written_by(first, at).unwrap();
    rig.hosts[other].resume().unwrap();
    let again = rig.api(first).unwrap();
    again
        .wait_for_loop(LOOP, "twenty cycles at the new home", |view| {
            text(&view["home"]) == format!("io-{}", first + 1)
                && rig
                    .writes()
                    .iter()
                    .filter(|write| write.at > taken.at && write.master == first)
                    .count()
                    > 20
        })
        .unwrap();
    no_overlap(&rig);
    again.setpoint(LOOP, 5_020.0).unwrap();
}

/// Waits until the loop has this home, and runs there.
fn runs_at(rig: &TwoMasters, host: usize) -> Api {
    let api = rig.api(host).unwrap();
    let home = format!("io-{}", host + 1);
    let found = api
        .wait_for_loop(LOOP, "the loop's home", |view| text(&view["home"]) == home)
        .unwrap();
    let seq = found["seq"].as_u64();
    api.wait_for_loop(LOOP, "cycles at the home", |view| {
        text(&view["home"]) == home && view["seq"].as_u64() > seq.map(|seq| seq + 5)
    })
    .unwrap();
    api
}

/// Waits until both hosts could be master, and know of so many forces.
fn both_know(api: &Api, forces: u64) {
    api.wait_until("both hosts with the same forces", |api| {
        let buses = api.get("/v1/buses").unwrap();
        let alike = |bus: &&Value| bus["redundant"]["ready"] == true && bus["redundant"]["forces"] == forces;
        let alike = buses["buses"].as_array().unwrap().iter().filter(alike).count();
        if alike == 2 { Ok(()) } else { Err(buses) }
    })
    .unwrap();
}

fn valve(api: &Api) -> Value {
    api.get("/v1/points/line.valve").unwrap()
}

#[test]
fn a_force_goes_over_with_the_mastership_and_ends_on_both() {
    const HELD: f64 = 1_234.0;
    let mut rig = TwoMasters::start(150).unwrap();
    let first = rig.writes().last().unwrap().master;
    let other = 1 - first;
    let api = rig.api(first).unwrap();
    api.wait_until("both are there", |api| match api.hosts() {
        Ok(hosts) if hosts.iter().filter(|host| host["alive"] == true).count() == 2 => Ok(()),
        other => Err(other.map_err(|error| error.to_string())),
    })
    .unwrap();
    let force = json!({"value": HELD, "seconds": 600, "by": "test", "why": "a valve is stroked"});
    api.post("/v1/points/line.valve/force", &force).unwrap();
    let device_holds = |rig: &TwoMasters, what: &str| {
        let held = || match rig.device.word(10) {
            word if f64::from(word) == HELD => Ok(()),
            word => Err(word),
        };
        wait_until(what, HANDOVER_MAX, held).unwrap();
    };
    device_holds(&rig, "the forced value");
    both_know(&api, 1);

    // The master dies: whoever comes next knows of the force, and no write of the loop reaches the device under it.
    let at = Instant::now();
    rig.hosts[first].kill9();
    let api = runs_at(&rig, other);
    let seen = valve(&api);
    assert_eq!(
        (&seen["quality"], number(&seen["value"]), &seen["force"]["why"]),
        (&json!("forced"), HELD, &json!("a valve is stroked")),
        "{seen}"
    );
    let after: Vec<_> = rig.writes().into_iter().filter(|write| write.at > at).collect();
    assert!(
        after.iter().all(|write| write.values == [HELD as u16]),
        "the loop wrote through the force: {after:?}"
    );

    // It ends where it is now, while the host that it began at is away. When that one is master again, it must not come back.
    api.post("/v1/points/line.valve/unforce", &json!({"by": "test"}))
        .unwrap();
    rig.hosts[first].restart().unwrap();
    both_know(&api, 0);
    rig.hosts[other].kill9();
    let api = runs_at(&rig, first);
    let seen = valve(&api);
    assert!(seen["force"].is_null() && seen["quality"] != "forced", "{seen}");
    no_overlap(&rig);
}

#[test]
fn a_standby_whose_own_way_is_cut_says_so() {
    let rig = TwoMasters::start(150).unwrap();
    let first = rig.writes().last().unwrap().master;
    let other = 1 - first;
    let api = rig.api(first).unwrap();
    let name = format!("io-{}", other + 1);
    let standby = |wanted: bool| {
        api.wait_until("the standby's state", |api| {
            let buses = api.get("/v1/buses").unwrap();
            let own = buses["buses"]
                .as_array()
                .unwrap()
                .iter()
                .find(|bus| bus["host"] == name.as_str());
            match own {
                Some(bus) if bus["redundant"]["ready"] == wanted && bus["redundant"]["epoch"].is_null() => Ok(()),
                _ => Err(buses.clone()),
            }
        })
        .unwrap();
    };
    standby(true);
    let feed = api.live("").unwrap();
    let told = |ready: bool| {
        let event = feed
            .event_where("the standby's word", |event| {
                event.name == "field" && event.data["standby"]["ready"] == ready
            })
            .unwrap();
        assert_eq!(event.data["standby"]["host"], name.as_str(), "{event:?}");
        event.data["standby"]["reason"].as_str().unwrap().to_owned()
    };
    rig.device.cut(Some(other));
    standby(false);
    assert!(!told(false).is_empty());
    // The loop goes on meanwhile: it is the other one's way that is cut.
    let before = rig.writes().len();
    wait_until("writes of the master", HANDOVER_MAX, || match rig.writes().len() {
        now if now > before => Ok(()),
        now => Err(now),
    })
    .unwrap();
    rig.device.cut(None);
    standby(true);
    assert_eq!(told(true), "");
    no_overlap(&rig);
}

#[test]
fn many_clients_and_both_hosts_share_one_device_s_queue() {
    const CLIENTS: usize = 6;
    const EACH: usize = 8;
    let rig = TwoMasters::start(150).unwrap();
    let apis = [rig.api(0).unwrap(), rig.api(1).unwrap()];
    // Each client asks the host that is nearer to it; the master does all of it, one after the other.
    let ends: Vec<(Vec<String>, usize)> = std::thread::scope(|scope| {
        let client = |n: usize| {
            let api = apis[n % 2].clone();
            move || {
                let (mut ids, mut full) = (Vec::new(), 0);
                for wish in 0..EACH {
                    let address = 100 + 10 * n as u16;
                    let body = json!({
                        "bus": "line", "by": format!("client {n}"), "key": format!("{n}-{wish}"),
                        "write_block": {"table": "holding", "address": address, "values": [wish, n], "verify": true},
                    });
                    let id = wait_until("a place in the queue", HANDOVER_MAX, || {
                        let headers = [("content-type", "application/json")];
                        let answer = api
                            .send("POST", "/v1/jobs", &headers, body.to_string().as_bytes())
                            .unwrap();
                        match answer.status {
                            202 => Ok(text(&answer.json()["id"])),
                            // A full queue refuses, and drops nothing.
                            503 => {
                                full += 1;
                                Err(answer.json())
                            }
                            other => panic!("{other}: {}", answer.json()),
                        }
                    })
                    .unwrap();
                    ids.push(id);
                }
                (ids, full)
            }
        };
        let clients: Vec<_> = (0..CLIENTS).map(|n| scope.spawn(client(n))).collect();
        clients.into_iter().map(|client| client.join().unwrap()).collect()
    });
    let ids: std::collections::BTreeSet<&String> = ends.iter().flat_map(|(ids, _)| ids).collect();
    assert_eq!(ids.len(), CLIENTS * EACH, "each wish is one job");
    for id in ids {
        let done = wait_until("the job's end", HANDOVER_MAX, || {
            let job = apis[0].get(&format!("/v1/jobs/{id}")).unwrap();
            if matches!(text(&job["state"]).as_str(), "queued" | "running") {
                Err(job)
            } else {
                Ok(job)
            }
        })
        .unwrap();
        assert_eq!(done["state"], "done", "{done}");
    }
    for n in 0..CLIENTS as u16 {
        let first = 100 + 10 * n;
        // Of one client's wishes the last one stands, so their order was kept.
        assert_eq!(
            (rig.device.word(first), rig.device.word(first + 1)),
            (EACH as u16 - 1, n)
        );
    }
    no_overlap(&rig);
}
