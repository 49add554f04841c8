//! The owner's host dies in each phase of everything that can be done to a running loop, and the phase is seen to be on when it
//! dies.
//!
//! | phase | how it is known to be on | what must hold |
//! |---|---|---|
//! | upload: compiling, trial | a compiling child, or a thread of a trial, of the owner's process | the component is in the library whole, or not at all |
//! | distribution | the component's own list of hosts: the owner compiles it | every host has it in the end |
//! | backtest, replay | a thread of a rehearsal in the home's process | the report comes, and is whole |
//! | prepared: swap, structure, rollback by hand, fallback | the loop has a pending revision; a frozen standby keeps it so | whole old or whole new, as it was told |
//! | switched | the record of the switch | the new revision, and its probation goes on |
//! | canary | the rollout watches this loop | the rollout ends, and each loop is where it says |
//!
//! In all of them the loop goes on under another owner, and its actuator has one writer.

use std::{
    fs,
    thread::JoinHandle,
    time::{Duration, Instant},
};

use bumpless_tests::{Api, Cell, CellOptions, Error, Feed, first_order_loop, pause, wait_until};
use serde_json::{Value, json};

use crate::{names, one_writer, text, whole};

const LOOP: &str = "loop-0";
/// Nothing here takes longer unless something is broken.
const PATIENCE: Duration = Duration::from_secs(60);

/// What is known at the moment of the kill.
struct Scene {
    /// The home's: it lives on.
    api: Api,
    /// The one who dies.
    owner: String,
    owner_api: Api,
    owner_pid: u32,
    home_pid: u32,
    /// Records since before the phase began.
    feed: Feed,
    /// The loop before.
    before: Value,
}

/// One line of the table.
struct Phase {
    name: &'static str,
    /// Begins it and waits for its end, in a thread of its own: the home's API, the owner's.
    begin: fn(&Api, &Api) -> Result<Value, Error>,
    /// Is it on?
    is_on: fn(&Scene) -> bool,
    /// When a standby is frozen; it stays so until the owner is dead, so that what waits for all members cannot end before.
    freeze: Option<fn(&Scene) -> bool>,
    /// What must hold when the loop has another owner and the asker was told how it ended.
    holds: fn(&Scene, &Result<Value, Error>),
}

/// Has the process a child, as while a component is compiled?
fn has_child(pid: u32) -> bool {
    let Ok(threads) = fs::read_dir(format!("/proc/{pid}/task")) else {
        return false;
    };
    let children = |entry: fs::DirEntry| fs::read_to_string(entry.path().join("children")).unwrap_or_default();
    threads.flatten().any(|entry| !children(entry).trim().is_empty())
}

/// Has the process a thread of this name?
fn has_thread(pid: u32, name: &str) -> bool {
    let Ok(threads) = fs::read_dir(format!("/proc/{pid}/task")) else {
        return false;
    };
    let named = |entry: fs::DirEntry| fs::read_to_string(entry.path().join("comm")).unwrap_or_default();
    threads.flatten().any(|entry| named(entry).trim() == name)
}

fn is_pending(scene: &Scene) -> bool {
    scene.api.loop_view(LOOP).unwrap()["pending_revision"].is_u64()
}

fn has_event(record: &Value, kind: &str) -> bool {
    let mut events = record["events"].as_array().into_iter().flatten();
    events.any(|event| event["kind"] == kind)
}

/// Three hosts that control, a loop at rest under `pid`, and the stock laws that the phases need.
fn running(loops: usize) -> (Cell, Api) {
    let options = CellOptions::first_order(&format!("{{ count = {}, tau_s = 1.0 }}", loops + 1));
    let mut cell = Cell::start(options).unwrap();
    let api = cell.api().unwrap();
    api.upload_stock(&["pid", "pidplus", "cascade"]).unwrap();
    for n in 0..loops {
        api.apply(&first_order_loop(n, "pid", 50.0)).unwrap();
    }
    (cell, api)
}

/// All three hosts hold the loop, and have every component ready: what a phase waits for is its own work.
fn ready(api: &Api) -> Value {
    api.wait_until("every component ready on every host", |api| {
        let waiting: Vec<Value> = api.components().unwrap();
        let short = |c: &&Value| c["ready_on"].as_array().is_none_or(|hosts| hosts.len() < 4);
        match waiting.iter().find(short) {
            None => Ok(()),
            Some(component) => Err(component["ready_on"].clone()),
        }
    })
    .unwrap();
    api.wait_for_loop(LOOP, "three members, an owner, nothing pending", |view| {
        names(&view["members"]).len() == 3 && view["owner"].is_string() && view["pending_revision"].is_null()
    })
    .unwrap()
}

/// Runs one line of the table.
fn dies_in(cell: &mut Cell, api: &Api, phase: &Phase) {
    let before = ready(api);
    let owner = text(&before["owner"]);
    let standby = names(&before["members"])
        .into_iter()
        .find(|name| *name != owner)
        .unwrap();
    let scene = Scene {
        api: api.clone(),
        owner_api: cell.api_of(&owner).unwrap(),
        owner_pid: cell.host(&owner).unwrap().pid().unwrap(),
        home_pid: cell.plant.pid().unwrap(),
        feed: api.live(&format!("?loops={LOOP}")).unwrap(),
        owner,
        before,
    };
    let asked = reach(cell, phase, &scene, &standby);
    cell.host(&scene.owner).unwrap().kill9();
    if phase.freeze.is_some() {
        cell.host(&standby).unwrap().resume().unwrap();
    }
    let killed_at = whole(&scene.before["seq"]);
    scene
        .feed
        .record_within(PATIENCE, &format!("{}: another owner", phase.name), |record| {
            record["owner"] != scene.owner.as_str() && whole(&record["seq"]) > killed_at + 5
        })
        .unwrap();
    let end = asked.join().unwrap();
    (phase.holds)(&scene, &end);
    cell.restart(&scene.owner).unwrap();
    cell.wait_joined().unwrap();
}

/// Begins the phase, as often as it takes until it is seen to be on; gives what waits for its end.
fn reach(cell: &mut Cell, phase: &Phase, scene: &Scene, standby: &str) -> JoinHandle<Result<Value, Error>> {
    let started = Instant::now();
    let (mut ends, mut freeze) = (Vec::new(), phase.freeze);
    let mut look = |cell: &mut Cell| {
        if freeze.is_some_and(|now| now(scene)) {
            cell.host(standby).unwrap().pause().unwrap();
            freeze = None;
        }
        freeze.is_none()
    };
    loop {
        let (api, owner_api, begin) = (scene.api.clone(), scene.owner_api.clone(), phase.begin);
        look(cell);
        let asked = std::thread::spawn(move || begin(&api, &owner_api));
        while !asked.is_finished() {
            if look(cell) && (phase.is_on)(scene) && !asked.is_finished() {
                return asked;
            }
            assert!(
                started.elapsed() < PATIENCE,
                "{}: never on; ends so far: {ends:?}",
                phase.name
            );
            pause(Duration::from_millis(1));
        }
        // Over before anybody looked; what only reads can be asked for again, and everything else ends here.
        ends.push(asked.join().unwrap().map(|_| "done").map_err(|error| error.to_string()));
        assert!(ends.len() < 50, "{}: over too soon: {ends:?}", phase.name);
    }
}

/// The loop is whole: what it was, or all of the draft, as its asker was told.
fn old_or_new(scene: &Scene, end: &Result<Value, Error>, new: &Value) {
    let view = scene
        .api
        .wait_for_loop(LOOP, "nothing pending", |view| {
            view["pending_revision"].is_null() && view["owner"] != scene.owner.as_str()
        })
        .unwrap();
    match end {
        Ok(end) => {
            assert_eq!(view["revision"], end["revision"], "{end}: {view}");
            let component = text(&new["component"]);
            assert!(text(&view["component"]).starts_with(&format!("{component}@")), "{view}");
            assert_eq!(view["spec"]["ports"], new["ports"], "{view}");
            assert_eq!(view["spec"]["parameters"], new["parameters"], "{view}");
            assert_eq!(view["spec"]["period_ms"], new["period_ms"], "{view}");
        }
        Err(error) => {
            assert_eq!(view["revision"], scene.before["revision"], "{error}: {view}");
            assert_eq!(view["spec"], scene.before["spec"], "{error}: {view}");
        }
    }
    // What is in force is what steps.
    let steps = |record: &Value| record["revision"] == view["revision"] && !has_event(record, "policy-held");
    scene.feed.record_where("a step of what is in force", steps).unwrap();
}

fn unchanged(scene: &Scene) {
    let view = scene.api.loop_view(LOOP).unwrap();
    assert_eq!(
        (&view["revision"], &view["spec"], &view["pending_revision"]),
        (&scene.before["revision"], &scene.before["spec"], &Value::Null)
    );
}

/// Whether the upload was told to be done or not: it is there as a whole, or may come again.
fn there_or_not(scene: &Scene, name: &str) {
    unchanged(scene);
    let there = |api: &Api| api.components().unwrap().iter().any(|c| c["name"] == name);
    if !there(&scene.api) {
        scene.api.upload_stock(&[name]).unwrap();
    }
    let bytes = scene
        .api
        .send("GET", &format!("/v1/components/{name}/bytes"), &[], &[])
        .unwrap();
    let file = bumpless_tests::components().unwrap().join(format!("{name}.wasm"));
    assert!(
        bytes.status == 200 && bytes.body == fs::read(file).unwrap(),
        "{}",
        bytes.status
    );
}

fn cascade() -> Value {
    let mut draft = first_order_loop(0, "cascade", 20.0);
    draft["ports"]["inner-pv"] = json!("plant.1.pv");
    draft["parameters"] = json!({ "k": 0.01, "ti": 60.0, "inner-k": 0.01, "inner-ti": 60.0 });
    draft
}

fn upload(api: &Api, name: &str) -> Result<Value, Error> {
    api.upload_stock(&[name]).map(|()| Value::Null)
}

#[test]
fn of_an_upload_and_its_way_to_the_hosts() {
    let (mut cell, api) = running(1);
    let table = [
        Phase {
            name: "an upload is compiled on the owner",
            begin: |_, owner| upload(owner, "mpc"),
            is_on: |scene| has_child(scene.owner_pid),
            freeze: None,
            holds: |scene, end| {
                assert!(end.is_err(), "the host that was asked is dead: {end:?}");
                there_or_not(scene, "mpc");
            },
        },
        Phase {
            name: "an upload is tried on the owner",
            begin: |_, owner| upload(owner, "fuzzy"),
            is_on: |scene| has_thread(scene.owner_pid, "bl-trial"),
            freeze: None,
            holds: |scene, end| {
                assert!(end.is_err(), "the host that was asked is dead: {end:?}");
                there_or_not(scene, "fuzzy");
            },
        },
        Phase {
            name: "a component is on its way to the owner",
            begin: |home, _| {
                upload(home, "smith")?;
                // Its asker waits until every host that is there has it.
                wait_until("smith ready on two hosts", PATIENCE, || {
                    let shown = home.get("/v1/components/smith").map_err(|error| error.to_string())?;
                    match shown["ready_on"].as_array().map_or(0, Vec::len) {
                        0 | 1 => Err(shown["ready_on"].to_string()),
                        _ => Ok(shown),
                    }
                })
            },
            is_on: |scene| {
                let shown = scene.api.get("/v1/components/smith").unwrap_or_default();
                let mut hosts = shown["hosts"].as_array().into_iter().flatten();
                hosts.any(|one| one["host"] == scene.owner.as_str() && one["stage"] == "compiling")
            },
            freeze: None,
            holds: |scene, end| {
                assert!(end.is_ok(), "{end:?}");
                there_or_not(scene, "smith");
            },
        },
    ];
    for phase in &table {
        dies_in(&mut cell, &api, phase);
    }
    // Those that came back have everything too.
    ready(&api);
    one_writer(&cell.journal().unwrap());
}

#[test]
fn of_a_look_at_what_was_recorded() {
    let (mut cell, api) = running(1);
    api.wait_for_loop(LOOP, "some hundred cycles", |view| view["seq"].as_u64() > Some(200))
        .unwrap();
    let table = [
        Phase {
            name: "a backtest",
            begin: |home, _| {
                let asked = json!({ "component": "pidplus", "last": "100000" });
                home.post(&format!("/v1/loops/{LOOP}/backtest"), &asked)
            },
            is_on: |scene| has_thread(scene.home_pid, "rehearsal"),
            freeze: None,
            holds: |scene, end| {
                let report = end.as_ref().unwrap();
                assert!(
                    whole(&report["compared"]) > 190 && report["first_fault"].is_null(),
                    "{report}"
                );
                unchanged(scene);
            },
        },
        Phase {
            name: "a replay",
            begin: |home, _| home.post(&format!("/v1/loops/{LOOP}/replay"), &json!({ "last": "100000" })),
            is_on: |scene| has_thread(scene.home_pid, "rehearsal"),
            freeze: None,
            holds: |scene, end| {
                let report = end.as_ref().unwrap();
                assert!(
                    whole(&report["compared"]) > 190 && report["compared"] == report["equal"],
                    "{report}"
                );
                unchanged(scene);
            },
        },
    ];
    for phase in &table {
        dies_in(&mut cell, &api, phase);
    }
    one_writer(&cell.journal().unwrap());
}

#[test]
fn of_a_change_by_hand() {
    let (mut cell, api) = running(1);
    let table = [
        Phase {
            name: "a swap is prepared",
            begin: |home, _| home.swap(LOOP, "pidplus"),
            is_on: is_pending,
            freeze: Some(|_| true),
            holds: |scene, end| old_or_new(scene, end, &first_order_loop(0, "pidplus", 50.0)),
        },
        Phase {
            name: "another structure is prepared",
            begin: |home, _| home.apply(&cascade()),
            is_on: is_pending,
            freeze: Some(|_| true),
            holds: |scene, end| old_or_new(scene, end, &cascade()),
        },
        Phase {
            name: "a switch is in its record",
            begin: |home, _| {
                let end = home.apply(&first_order_loop(0, "pid", 50.0))?;
                // Its asker looks until the probation is over.
                home.wait_for_loop(LOOP, "the end of the probation", |view| {
                    view["revision"] == end["revision"] && view["last"]["probation_cycles_left"].is_null()
                })?;
                Ok(end)
            },
            is_on: |scene| {
                let records = scene.feed.drain().into_iter().map(|event| event.data);
                records.into_iter().any(|record| has_event(&record, "revised"))
            },
            freeze: None,
            holds: |scene, end| {
                assert!(end.is_ok(), "it was in force: {end:?}");
                old_or_new(scene, end, &first_order_loop(0, "pid", 50.0));
            },
        },
        Phase {
            name: "a rollback by hand is prepared",
            begin: |home, _| home.rollback(LOOP, Some(1)),
            is_on: is_pending,
            freeze: Some(|_| true),
            holds: |scene, end| old_or_new(scene, end, &first_order_loop(0, "pid", 50.0)),
        },
    ];
    for phase in &table {
        // Each change has something to change.
        if phase.name.starts_with("a rollback") {
            api.swap(LOOP, "pidplus").unwrap();
        }
        dies_in(&mut cell, &api, phase);
    }
    one_writer(&cell.journal().unwrap());
}

#[test]
fn of_a_fallback_that_comes_in() {
    let (mut cell, api) = running(1);
    api.upload_guest("traps").unwrap();
    let phase = Phase {
        name: "a fallback is prepared",
        begin: |home, _| {
            // Sound for two seconds, and then never again.
            let mut draft = first_order_loop(0, "traps", 50.0);
            draft["parameters"] = json!({ "after": 40.0 });
            draft["policy"] = json!({ "probation_cycles": 0, "faults_tolerated": 3 });
            (draft["fallback"], draft["fallback_parameters"]) = (json!("pid"), json!({ "k": 0.1, "ti": 0.2 }));
            let end = home.apply(&draft)?;
            home.wait_for_loop(LOOP, "the fallback in force", |view| {
                view["revision"].as_u64() > end["revision"].as_u64()
            })
        },
        is_on: |scene| {
            let view = scene.api.loop_view(LOOP).unwrap();
            text(&view["component"]).starts_with("traps@") && view["pending_revision"].is_u64()
        },
        // All of them hold the failing component before one is frozen.
        freeze: Some(|scene| text(&scene.api.loop_view(LOOP).unwrap()["component"]).starts_with("traps@")),
        holds: |scene, end| {
            let view = end.as_ref().unwrap();
            assert!(text(&view["component"]).starts_with("pid@"), "{view}");
            assert_eq!(view["spec"]["parameters"], json!({ "k": 0.1, "ti": 0.2 }), "{view}");
            assert_eq!(view["spec"]["ports"], scene.before["spec"]["ports"], "{view}");
            let good = |r: &Value| r["revision"] == view["revision"] && !has_event(r, "policy-held");
            scene.feed.record_where("good cycles again", good).unwrap();
        },
    };
    dies_in(&mut cell, &api, &phase);
    one_writer(&cell.journal().unwrap());
}

#[test]
fn of_a_canary() {
    let (mut cell, api) = running(2);
    let phase = Phase {
        name: "the canary is watched",
        begin: |home, _| {
            let asked = json!({ "component": "pidplus", "loops": [LOOP, "loop-1"], "cycles": 40, "factor": 5 });
            let id = text(&home.post("/v1/rollouts", &asked)?["id"]);
            wait_until("the rollout's end", PATIENCE, || {
                let now = home
                    .get(&format!("/v1/rollouts/{id}"))
                    .map_err(|error| error.to_string())?;
                if now["ended_at_unix_ms"].is_number() {
                    Ok(now)
                } else {
                    Err(now.to_string())
                }
            })
        },
        is_on: |scene| {
            let rollouts = scene.api.get("/v1/rollouts").unwrap();
            let Some(id) = rollouts["rollouts"][0]["id"].as_str() else {
                return false;
            };
            let rollout = scene.api.get(&format!("/v1/rollouts/{id}")).unwrap();
            rollout["loops"][0]["loop"] == LOOP && rollout["loops"][0]["stage"] == "watched"
        },
        freeze: None,
        holds: |scene, end| {
            let end = end.as_ref().unwrap();
            for one in end["loops"].as_array().unwrap() {
                let view = scene
                    .api
                    .wait_for_loop(&text(&one["loop"]), "nothing pending", |v| {
                        v["pending_revision"].is_null()
                    })
                    .unwrap();
                let runs = if one["stage"] == "done" { "pidplus@" } else { "pid@" };
                assert!(text(&view["component"]).starts_with(runs), "{one}: {view}");
            }
            let all = end["loops"].as_array().unwrap();
            let done = all.iter().filter(|one| one["stage"] == "done").count();
            // Whole, or stopped at the first: never one of them by chance.
            assert_eq!(done == all.len(), end["state"] == "done", "{end}");
            assert!(done == 2 || done == 0, "{end}");
        },
    };
    dies_in(&mut cell, &api, &phase);
    one_writer(&cell.journal().unwrap());
}
