//! The library as its users see it: uploads with a report, labels, bundles from cell to cell, bombs, crowds.

use std::{
    path::Path,
    process::{Output, Stdio},
    time::Duration,
};

use bumpless_tests::{Api, Binary, Cell, CellOptions, components};
use serde_json::Value;

use crate::{names, number, text, whole};

/// The command line against a host.
fn bumpless(api: &Api, folder: &Path, arguments: &[&str]) -> Output {
    Binary::find()
        .unwrap()
        .command()
        .args(["--api", api.base()])
        .args(arguments)
        .current_dir(folder)
        .env("USER", "ann")
        .stdin(Stdio::null())
        .output()
        .unwrap()
}

/// What a command said that must have succeeded.
#[track_caller]
fn says(api: &Api, folder: &Path, arguments: &[&str], parts: &[&str]) -> String {
    let output = bumpless(api, folder, arguments);
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{arguments:?}: {said}{errors}");
    for part in parts {
        assert!(said.contains(part), "{arguments:?}: {part:?} is missing in: {said}");
    }
    said
}

fn cell() -> Cell {
    let mut options = CellOptions::first_order("{ count = 1 }").controllers(1);
    // Short, so that a bomb is soon over.
    options.plant_tables = "[engine]\ncompile_s_max = 15\n".to_owned();
    Cell::start(options).unwrap()
}

#[test]
fn components_are_tried_labelled_and_carried_from_cell_to_cell() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path();
    let stock = components().unwrap();
    let path = |name: &str| stock.join(format!("{name}.wasm")).to_string_lossy().into_owned();
    {
        let mut cell = cell();
        let (api, other) = (cell.api().unwrap(), cell.api_of("a").unwrap());
        // A dry run shows the report of a bad one, and nothing stays.
        let output = bumpless(&api, dir, &["upload", &path("guests/remembers"), "--dry-run"]);
        let said = String::from_utf8_lossy(&output.stdout).into_owned();
        assert_eq!(output.status.code(), Some(3), "{output:?}");
        assert!(
            said.contains("trial     refused") && said.contains("it gave two answers"),
            "{said}"
        );
        let output = bumpless(&api, dir, &["upload", &path("guests/traps")]);
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(
            said.contains("traps@0.1.0 failed its trial") && said.contains("force"),
            "{said}"
        );
        assert!(api.components().unwrap().is_empty());
        // A good one comes in with its report and labels, and is waited for until both hosts have it.
        let upload = [
            "upload",
            &path("pid"),
            "--label",
            "stage=test",
            "--note",
            "first",
            "--wait",
        ];
        says(
            &api,
            dir,
            &upload,
            &[
                "pid@0.1.0",
                "trial     ",
                "step      half within",
                "its own state is taken over",
            ],
        );
        let shown = other.get("/v1/components/pid").unwrap();
        let hosts = shown["hosts"].as_array().unwrap();
        assert!(
            hosts.len() == 2 && hosts.iter().all(|host| host["stage"] == "ready"),
            "{shown}"
        );
        let report = &shown["admission"];
        assert_eq!(
            (&report["host"], &shown["uploaded_by"]),
            (&"plant".into(), &"ann".into())
        );
        assert!(
            number(&report["step_worst_us"]) >= number(&report["step_p99_us"]),
            "{report}"
        );
        assert!(
            whole(&report["cycles"]) > 400 && whole(&report["memory_bytes"]) > 0,
            "{report}"
        );
        // Labels are changed at one host and heard of at the other.
        says(
            &other,
            dir,
            &["components", "label", "pid", "stage=pilot", "line=3"],
            &["line=3, stage=pilot"],
        );
        api.wait_until("the labels", |api| {
            let listed = api.get("/v1/components?label=stage=pilot,line").unwrap();
            let rows = listed["components"].as_array().map_or(0, Vec::len);
            if rows == 1 { Ok(()) } else { Err(listed) }
        })
        .unwrap();
        says(&api, dir, &["components", "label", "pid", "line-"], &["stage=pilot"]);
        says(
            &api,
            dir,
            &["components", "note", "pid", "for the pilot"],
            &["for the pilot"],
        );
        says(
            &api,
            dir,
            &["components", "show", "pid"],
            &[
                "stage=pilot",
                "for the pilot",
                "ann: label line removed",
                "on plant  ready",
                "trial     ",
            ],
        );
        let listed = says(&api, dir, &["components", "--label", "stage=test"], &[]);
        assert!(!listed.contains("pid@"), "{listed}");
        api.upload_stock(&["on-off"]).unwrap();
        says(
            &api,
            dir,
            &["components", "export", "pid", "on-off", "-o", "laws.tar"],
            &["laws.tar"],
        );
    }
    // The other cell, which has one of them already. The file was changed on its way in the second try.
    let mut cell = cell();
    let api = cell.api().unwrap();
    api.upload_stock(&["on-off"]).unwrap();
    let said = says(
        &api,
        dir,
        &["components", "import", "laws.tar"],
        &["pid@0.1.0", "taken", "known"],
    );
    assert!(!said.contains("refused"), "{said}");
    let pid = api.get("/v1/components/pid").unwrap();
    assert_eq!(
        (&pid["labels"]["stage"], &pid["note"]),
        (&"pilot".into(), &"for the pilot".into())
    );
    assert_eq!(pid["admission"]["host"], "plant", "tried here too");
    let mut bytes = std::fs::read(dir.join("laws.tar")).unwrap();
    let place = bytes.windows(4).position(|part| part == b"\0asm").unwrap();
    bytes[place + 200] ^= 1;
    std::fs::write(dir.join("changed.tar"), bytes).unwrap();
    let output = bumpless(&api, dir, &["components", "import", "changed.tar"]);
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    assert_eq!(output.status.code(), Some(3), "{output:?}");
    assert!(
        said.contains("is not what its digest") && said.contains("known"),
        "{said}"
    );
    assert_eq!(api.components().unwrap().len(), 2);
}

/// A compiling child that has taken its own rights away.
#[derive(Debug)]
struct Confined {
    threads: u64,
    /// Greatest address space in bytes, as the kernel says it.
    address_space: String,
}

/// The child of a host that has the lowest priority, if there is one.
fn confined(host: u32) -> Option<Confined> {
    let processes = std::fs::read_dir("/proc").unwrap().flatten();
    processes
        .filter_map(|entry| entry.file_name().to_str()?.parse::<u32>().ok())
        .find_map(|pid| {
            let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
            // Behind the name in brackets: state, parent; nice is the 17th and the number of threads the 18th.
            let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
            let (parent, nice, threads) = (fields.get(1)?, fields.get(16)?, fields.get(17)?);
            if **parent != *host.to_string() || **nice != *"19" {
                return None;
            }
            let limits = std::fs::read_to_string(format!("/proc/{pid}/limits")).ok()?;
            let line = limits.lines().find(|line| line.starts_with("Max address space"))?;
            let address_space = line.split_whitespace().nth(3)?.to_owned();
            // It sets the limits right after its priority.
            (address_space != "unlimited").then(|| Confined {
                threads: threads.parse().unwrap_or(u64::MAX),
                address_space,
            })
        })
}

/// A number in LEB128.
fn leb(mut number: usize) -> Vec<u8> {
    let mut bytes = Vec::new();
    loop {
        let low = (number & 0x7f) as u8;
        number >>= 7;
        if number == 0 {
            bytes.push(low);
            return bytes;
        }
        bytes.push(low | 0x80);
    }
}

fn section(id: u8, content: &[u8]) -> Vec<u8> {
    [&[id], &*leb(content.len()), content].concat()
}

/// A component whose core module has so many functions.
fn bomb(functions: usize) -> Vec<u8> {
    // local.get 0, then adds and multiplications of constants, then end.
    let mut code = vec![0, 0x20, 0];
    for n in 0..10_u8 {
        code.extend([0x41, n, 0x6a, 0x41, n + 1, 0x6c]);
    }
    code.push(0x0b);
    let body = [leb(code.len()), code].concat();
    let count = leb(functions);
    let module = [
        b"\0asm\x01\0\0\0".to_vec(),
        section(1, &[1, 0x60, 1, 0x7f, 1, 0x7f]),
        section(3, &[count.clone(), vec![0; functions]].concat()),
        section(10, &[count, body.repeat(functions)].concat()),
    ]
    .concat();
    [b"\0asm\x0d\0\x01\0".to_vec(), section(1, &module)].concat()
}

#[test]
fn bombs_and_crowds_are_refused_and_the_loops_go_on() {
    let mut cell = cell();
    let api = cell.api().unwrap();
    api.upload_stock(&["pid"]).unwrap();
    api.apply(&bumpless_tests::first_order_loop(0, "pid", 50.0)).unwrap();
    let before = api
        .wait_for_loop("loop-0", "cycles", |view| view["seq"].is_u64())
        .unwrap();
    // Minutes of compilation, of which it gets some seconds, in a process that everything else goes before.
    let host = cell.plant.pid().unwrap();
    let error = std::thread::scope(|scope| {
        let upload = scope.spawn(|| api.upload_bytes(&bomb(400_000)).unwrap_err());
        let child = bumpless_tests::wait_until("the compiling child", Duration::from_secs(60), || {
            confined(host).ok_or("none that has lowered its priority")
        })
        .unwrap();
        assert!(child.threads <= 5, "it leaves cores to the cycles: {child:?}");
        assert_eq!(child.address_space, "2147483648", "{child:?}");
        upload.join().unwrap()
    });
    assert!(confined(host).is_none(), "the child is gone");
    assert_eq!(error.status(), 422, "{error}");
    assert!(error.to_string().contains("longer than 15 s"), "{error}");
    // A hundred at once: the same bytes but for a section that says nothing, so that one alone may come in.
    let other = std::fs::read(components().unwrap().join("on-off.wasm")).unwrap();
    let ends: Vec<(u16, Option<String>, Value)> = std::thread::scope(|scope| {
        let uploads: Vec<_> = (0..100_u8)
            .map(|n| {
                let (api, mut bytes) = (api.clone(), other.clone());
                bytes.extend([0, 3, 1, b'x', n]);
                scope.spawn(move || {
                    let headers = [("content-type", "application/wasm")];
                    let answer = api.send("POST", "/v1/components", &headers, &bytes).unwrap();
                    (answer.status, answer.headers.get("retry-after").cloned(), answer.json())
                })
            })
            .collect();
        uploads.into_iter().map(|upload| upload.join().unwrap()).collect()
    });
    let taken: Vec<&Value> = ends
        .iter()
        .filter(|(status, ..)| *status == 201)
        .map(|(.., body)| body)
        .collect();
    assert_eq!(taken.len(), 1, "{ends:?}");
    for (status, retry, body) in &ends {
        match status {
            201 => {}
            409 => assert!(
                text(&body["detail"]).contains("another component on-off@0.1.0"),
                "{body}"
            ),
            503 => assert!(retry.is_some(), "{body}"),
            other => panic!("{other}: {body}"),
        }
    }
    assert!(
        ends.iter().any(|(status, ..)| *status == 503),
        "four at a time have a place"
    );
    let listed = api.components().unwrap();
    let digests: Vec<String> = listed.iter().map(|row| text(&row["digest"])).collect();
    assert!(
        listed.len() == 2 && digests.contains(&text(&taken[0]["digest"])),
        "{digests:?}"
    );
    // Both hosts have it, the loop never stopped, and its owner never changed.
    api.wait_until("on-off on both hosts", |api| {
        let shown = api.get("/v1/components/on-off").unwrap();
        if names(&shown["ready_on"]).len() == 2 {
            Ok(())
        } else {
            Err(shown)
        }
    })
    .unwrap();
    let after = api.loop_view("loop-0").unwrap();
    assert!(whole(&after["seq"]) > whole(&before["seq"]), "{after}");
    assert_eq!(after["failures"], before["failures"], "{after}");
}
