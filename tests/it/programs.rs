//! Free-running programs on real hosts: paused while they spin, kill -9 of their owner and of their home, and the published 3C
//! scripts on a simulated process, central and distributed.

use std::{
    fs,
    time::{Duration, Instant},
};

use bumpless_tests::{
    Api, Binary, Cell, CellOptions, components,
    masters::{LOOP, TwoMasters},
    wait_until,
};
use serde_json::{Value, json};

use crate::{number, one_writer, text, whole};

fn upload(api: &Api, file: &str, query: &str) -> Value {
    let bytes = fs::read(components().unwrap().join(file)).unwrap();
    let headers = [("content-type", "application/wasm")];
    let answer = api
        .send("POST", &format!("/v1/components?by=test{query}"), &headers, &bytes)
        .unwrap();
    assert_eq!(answer.status, 201, "{}", answer.text());
    answer.json()
}

fn script(api: &Api, name: &str, text: &[u8]) -> Value {
    let headers = [("content-type", "text/x-lua")];
    let answer = api
        .send("POST", &format!("/v1/components?by=test&script={name}"), &headers, text)
        .unwrap();
    assert_eq!(answer.status, 201, "{}", answer.text());
    answer.json()
}

fn order(api: &Api, name: &str, order: &str) -> Value {
    api.post(&format!("/v1/programs/{name}/order"), &json!({ "order": order }))
        .unwrap()
}

fn show(api: &Api, name: &str) -> Value {
    api.get(&format!("/v1/programs/{name}")).unwrap()
}

#[track_caller]
fn until(api: &Api, name: &str, what: &str, is: impl Fn(&Value) -> bool) -> Value {
    wait_until(what, Duration::from_secs(60), || {
        match api.get(&format!("/v1/programs/{name}")) {
            Ok(now) if is(&now) => Ok(now),
            Ok(now) => Err(now.to_string()),
            Err(error) => Err(error.to_string()),
        }
    })
    .unwrap()
}

fn options() -> CellOptions {
    CellOptions::first_order("{ count = 2 }")
}

#[test]
fn a_program_is_paused_stopped_and_goes_on_from_its_checkpoint_where_its_owner_is_killed() {
    let mut cell = Cell::start(options().controllers(2)).unwrap();
    let api = cell.api().unwrap();
    upload(&api, "guests/free-runs.wasm", "");
    // The guest does what its script says; the interpreter of scripts is another one, so it is wrapped by hand.
    upload(&api, "programs/lua3c.wasm", "");
    let spins = script(&api, "spins", b"while true do end");
    assert_eq!(text(&spins["world"]), "bumpless:control/program@0.1.0");
    let out = "plant.0.out";
    let counts = b"local n = tonumber(bl.restore() or '0')
        while true do n = n + 1 h3c.aOut(0, n % 100) bl.save(tostring(n)) o3c.dms(20) end";
    script(&api, "counts", counts);
    let created = api
        .post(
            "/v1/programs",
            &json!({"name": "spins", "component": "spins", "prefer": ["a"], "share_percent": 20}),
        )
        .unwrap();
    assert_eq!(text(&created["status"]), "running", "{created}");
    until(&api, "spins", "processor time", |now| {
        now["used_ms"].as_f64().is_some_and(|ms| ms > 50.0)
    });
    assert_eq!(text(&order(&api, "spins", "pause")["status"]), "paused");
    assert_eq!(text(&order(&api, "spins", "resume")["status"]), "running");
    assert_eq!(text(&order(&api, "spins", "stop")["status"]), "stopped");
    let refused = api.ask("POST", "/v1/programs/spins/order", Some(&json!({"order": "pause"})));
    assert!(refused.unwrap_err().to_string().contains("does not run"));

    let draft = json!({"name": "counts", "component": "counts", "prefer": ["a"],
        "grants": {"aout-0": {"point": out, "write": true}}});
    let created = api.post("/v1/programs", &draft).unwrap();
    assert_eq!(text(&created["owner"]), "a", "{created}");
    // A point has one writer.
    let other = json!({"name": "other", "component": "counts", "grants": {"aout-0": {"point": out, "write": true}}});
    assert!(
        api.post("/v1/programs", &other)
            .unwrap_err()
            .to_string()
            .contains("has a writer already")
    );
    let before = until(&api, "counts", "a checkpoint", |now| {
        now["checkpoint_bytes"].as_u64().is_some_and(|n| n >= 2)
    });
    let counted = saved(&api);
    cell.host("a").unwrap().kill9();
    let moved = until(&api, "counts", "another owner", |now| {
        text(&now["owner"]) != "a" && text(&now["status"]) == "running"
    });
    assert!(whole(&moved["term"]) > whole(&before["term"]), "{moved}");
    wait_until("it counts on", Duration::from_secs(60), || {
        let now = saved(&api);
        if now > counted + 10 { Ok(()) } else { Err(now) }
    })
    .unwrap();
    api.delete("/v1/programs/counts").unwrap();
    one_writer(&cell.journal().unwrap());
}

#[test]
fn a_program_without_points_goes_on_where_its_home_is_killed_and_its_old_home_lets_it_be() {
    let mut cell = Cell::start(options().controllers(2)).unwrap();
    let api = cell.api().unwrap();
    upload(&api, "programs/lua3c.wasm", "");
    let counts = b"local n = tonumber(bl.restore() or '0')
        while true do n = n + 1 bl.save(tostring(n)) o3c.dms(20) end";
    script(&api, "counts", counts);
    script(&api, "ends", b"print('done')");
    // It is at home where it is asked for, and runs there too.
    let at_a = cell.api_of("a").unwrap();
    for name in ["counts", "ends"] {
        // Its library may be a moment behind.
        let created = wait_until("host a has the script", Duration::from_secs(60), || {
            let draft = json!({"name": name, "component": name, "prefer": ["a"]});
            at_a.post("/v1/programs", &draft).map_err(|error| error.to_string())
        })
        .unwrap();
        assert_eq!(
            (text(&created["home"]), text(&created["owner"])),
            ("a".to_owned(), "a".to_owned())
        );
    }
    let before = until(&api, "counts", "a standby and a checkpoint", |now| {
        now["standbys"].as_array().is_some_and(|hosts| !hosts.is_empty()) && now["checkpoint_bytes"].as_u64() >= Some(2)
    });
    until(&api, "ends", "its end", |now| {
        text(&now["status"]) == "stopped" && !now["standbys"].as_array().unwrap().is_empty()
    });
    // A name is one program's, wherever it is asked for.
    let refused = api
        .ask("DELETE", "/v1/components/counts", None)
        .unwrap_err()
        .to_string();
    assert!(refused.contains("is used by program counts"), "{refused}");
    let mut counted = 0;
    wait_until("the standby has counted too", Duration::from_secs(60), || {
        counted = saved(&api);
        if counted > 50 { Ok(()) } else { Err(counted) }
    })
    .unwrap();
    cell.host("a").unwrap().kill9();
    let moved = until(&api, "counts", "another home", |now| {
        text(&now["home"]) != "a" && text(&now["owner"]) != "a" && text(&now["status"]) == "running"
    });
    assert!(whole(&moved["term"]) > whole(&before["term"]), "{moved}");
    // At most what was counted within the pause between two copies, and within a look, is done again.
    wait_until("it counts on", Duration::from_secs(60), || {
        let now = saved(&api);
        if now > counted { Ok(()) } else { Err(now) }
    })
    .unwrap();
    // What had ended has ended.
    let ended = until(&api, "ends", "another home", |now| text(&now["home"]) != "a");
    assert_eq!(text(&ended["status"]), "stopped", "{ended}");

    cell.restart("a").unwrap();
    let term = whole(&moved["term"]);
    wait_until("the old home has only a copy, or none", Duration::from_secs(60), || {
        let list = at_a.get("/v1/programs").map_err(|error| error.to_string())?;
        let homes: Vec<(String, u64)> = list["programs"]
            .as_array()
            .unwrap()
            .iter()
            .filter(|program| text(&program["name"]) == "counts")
            .map(|program| (text(&program["home"]), whole(&program["term"])))
            .collect();
        let settled = homes.len() == 1 && homes.iter().all(|(home, now)| home != "a" && *now >= term);
        if settled { Ok(()) } else { Err(format!("{homes:?}")) }
    })
    .unwrap();
    at_a.delete("/v1/programs/counts").unwrap();
    at_a.delete("/v1/programs/ends").unwrap();
    wait_until("all hosts have let go of them", Duration::from_secs(60), || {
        let left = api.get("/v1/programs").unwrap();
        if !left["programs"].as_array().unwrap().is_empty() {
            return Err(left.to_string());
        }
        let used = api.ask("DELETE", "/v1/components/counts", None);
        used.map(drop).map_err(|error| error.to_string())
    })
    .unwrap();
}

#[test]
fn a_program_goes_over_with_the_mastership_of_its_device() {
    let mut rig = TwoMasters::start(150).unwrap();
    let first = rig.writes().last().unwrap().master;
    let other = 1 - first;
    let (api, there) = (rig.api(first).unwrap(), rig.api(other).unwrap());
    api.delete(&format!("/v1/loops/{LOOP}")).unwrap();
    upload(&api, "programs/lua3c.wasm", "");
    let counts = b"local n = tonumber(bl.restore() or '0')
        while true do n = n + 1 h3c.aOut(0, n % 9000) bl.save(tostring(n)) o3c.dms(20) end";
    script(&api, "counts", counts);
    let draft = json!({"name": "counts", "component": "counts",
        "grants": {"aout-0": {"point": "line.valve", "write": true}}});
    wait_until("the point is free", Duration::from_secs(60), || {
        api.post("/v1/programs", &draft).map_err(|error| error.to_string())
    })
    .unwrap();
    wait_until("the other master has code and copy", Duration::from_secs(60), || {
        let now = show(&api, "counts");
        let copied = now["standbys"].as_array().is_some_and(|hosts| hosts.len() == 1);
        match there.get("/v1/components/counts") {
            Ok(_) if copied && now["checkpoint_bytes"].as_u64() >= Some(2) => Ok(()),
            _ => Err(now.to_string()),
        }
    })
    .unwrap();
    let counted = saved(&api);
    let at = Instant::now();
    rig.hosts[first].kill9();
    rig.wait_written_by(other, at).unwrap();
    let home = format!("io-{}", other + 1);
    until(&there, "counts", "the other home", |now| {
        text(&now["home"]) == home && text(&now["status"]) == "running"
    });
    wait_until("it counts on", Duration::from_secs(60), || {
        let now = saved(&there);
        if now > counted { Ok(()) } else { Err(now) }
    })
    .unwrap();
    let overlaps = rig.overlaps();
    assert!(overlaps.is_empty(), "{overlaps:?}");
}

fn saved(api: &Api) -> u64 {
    let answer = api.send("GET", "/v1/programs/counts/checkpoint", &[], &[]).unwrap();
    answer.text().parse().unwrap_or(0)
}

/// Uploads the published script as it is, by the command line, and reads it back.
fn by_command(api: &Api, folder: &std::path::Path, name: &str, script: &[u8]) {
    let (file, back) = (folder.join(format!("{name}.lua")), folder.join("back.lua"));
    fs::write(&file, script).unwrap();
    let run = |words: &[&std::ffi::OsStr]| {
        let output = Binary::find()
            .unwrap()
            .command()
            .args(words)
            .args(["--api", api.base()])
            .output()
            .unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    };
    run(&["upload".as_ref(), file.as_os_str()]);
    run(&[
        "components".as_ref(),
        "script".as_ref(),
        name.as_ref(),
        "-o".as_ref(),
        back.as_os_str(),
    ]);
    assert_eq!(fs::read(&back).unwrap(), script, "{name} comes back byte by byte");
}

#[test]
fn the_published_scripts_control_a_simulated_process_central_and_distributed() {
    const LEVEL: &[u8] = include_bytes!("../../programs/lua3c/scripts/level.lua");
    const ACTUATOR: &[u8] = include_bytes!("../../programs/lua3c/scripts/level-actuator.lua");
    const TRANSMITTER: &[u8] = include_bytes!("../../programs/lua3c/scripts/level-transmitter.lua");
    let mut cell = Cell::start(options().controllers(2)).unwrap();
    let api = cell.api().unwrap();
    upload(&api, "programs/lua3c.wasm", "");
    let folder = tempfile::tempdir().unwrap();
    for (name, script) in [
        ("level", LEVEL),
        ("level-actuator", ACTUATOR),
        ("level-transmitter", TRANSMITTER),
    ] {
        by_command(&api, folder.path(), name, script);
    }
    // What a script that does not compile leaves behind.
    script(&api, "broken", b"x = 1\nx = = 2\n");
    api.post("/v1/programs", &json!({"name": "broken", "component": "broken"}))
        .unwrap();
    let broken = until(&api, "broken", "a fault", |now| text(&now["status"]) == "fault");
    assert!(text(&broken["reason"]).contains("script:2:"), "{broken}");

    let (pv, out) = ("plant.0.pv", "plant.0.out");
    // The potentiometer of the setpoint: the other process's output, set by hand.
    let knob = "plant.1.out";
    let level = json!({"point": pv, "raw": [70, 500]});
    let turned = json!({"point": knob, "raw": [0, 1023]});
    let pump = json!({"point": out, "write": true, "raw": [0, 100]});
    let set = |part: f64| {
        let facts = api.point(knob).unwrap();
        let (low, high) = (number(&facts["range"][0]), number(&facts["range"][1]));
        let body = json!({"value": low + part * (high - low), "by": "test"});
        api.post(&format!("/v1/points/{knob}/write"), &body).unwrap();
    };
    let settled = |name: &str, part: f64| {
        wait_until("the level at its setpoint", Duration::from_secs(60), || {
            let facts = api.point(pv).unwrap();
            let (low, high) = (number(&facts["range"][0]), number(&facts["range"][1]));
            let now = (number(&facts["value"]) - low) / (high - low);
            if (now - part).abs() < 0.06 {
                Ok(())
            } else {
                Err(format!("{name}: {now} of {part}: {}", show(&api, name)))
            }
        })
        .unwrap();
    };
    set(0.5);
    let central = json!({"name": "central", "component": "level", "prefer": ["a"],
        "grants": {"ain-0": level, "ain-2": turned, "aout-2": pump}});
    api.post("/v1/programs", &central).unwrap();
    settled("central", 0.5);
    let log = api.get("/v1/programs/central/log").unwrap();
    assert!(!log["lines"].as_array().unwrap().is_empty(), "{log}");
    api.delete("/v1/programs/central").unwrap();

    let transmitter = json!({"name": "transmitter", "component": "level-transmitter", "prefer": ["a"],
        "grants": {"ain-0": level}, "publishes": ["n3c.10"]});
    let sent = api.post("/v1/programs", &transmitter).unwrap();
    let actuator = json!({"name": "actuator", "component": "level-actuator", "prefer": ["b"],
        "grants": {"ain-2": turned, "aout-2": pump}, "listens": ["n3c.10"]});
    // Its first line needs two messages: they are kept for whoever begins to listen.
    wait_until("the transmitter's second line", Duration::from_secs(30), || {
        let lines = api.get("/v1/programs/transmitter/log").unwrap()["lines"]
            .as_array()
            .unwrap()
            .len();
        if lines >= 2 { Ok(()) } else { Err(lines) }
    })
    .unwrap();
    let taken = api.post("/v1/programs", &actuator).unwrap();
    assert_eq!(
        (text(&sent["owner"]), text(&taken["owner"])),
        ("a".to_owned(), "b".to_owned())
    );
    set(0.6);
    settled("actuator", 0.6);
    assert_eq!(text(&show(&api, "actuator")["status"]), "running");
    one_writer(&cell.journal().unwrap());
}
