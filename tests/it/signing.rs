//! Whose components a cell takes: uploads, starts and loads under each policy, revocation while loops run, a stranger's document.

use std::{
    path::Path,
    process::{Command, Output},
};

use bumpless_tests::{Api, Binary, Cell, CellOptions, components, first_order_loop};
use serde_json::{Value, json};

use crate::{one_writer, text, whole};

/// Long enough for a key file.
const PASSPHRASE: &str = "correct horse battery";

fn bumpless(api: &Api, folder: &Path, args: &[&str]) -> Output {
    Command::new(Binary::find().unwrap().path())
        .args(args)
        .current_dir(folder)
        .env("BUMPLESS_API", api.base())
        .env("BUMPLESS_PASSPHRASE", PASSPHRASE)
        .output()
        .unwrap()
}

#[track_caller]
fn done(api: &Api, folder: &Path, args: &[&str]) -> String {
    let output = bumpless(api, folder, args);
    let error = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{args:?}: {error}");
    assert!(!error.contains(PASSPHRASE));
    String::from_utf8_lossy(&output.stdout).into_owned()
}

#[track_caller]
fn refused(api: &Api, folder: &Path, args: &[&str], words: &str) {
    let output = bumpless(api, folder, args);
    let error = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(3), "{args:?}: {error}");
    assert!(error.contains(words), "{args:?}: {error}");
}

/// Every host has this document.
fn on_every_host(cell: &Cell, number: u64) {
    for host in cell.hosts() {
        host.api()
            .wait_until("the document of trust", |api| {
                let trust = api.get("/v1/trust").unwrap();
                if trust["number"].as_u64() == Some(number) {
                    Ok(())
                } else {
                    Err(trust["number"].clone())
                }
            })
            .unwrap();
    }
}

#[test]
fn only_what_is_signed_comes_in_and_starts_and_what_runs_goes_on() {
    let cell = Cell::start(CellOptions::first_order("{ count = 2 }").controllers(1)).unwrap();
    let (api, other) = (cell.plant.api(), cell.controllers[0].api());
    let folder = tempfile::tempdir().unwrap();
    let here = folder.path();
    for name in ["pid", "pidplus"] {
        std::fs::copy(
            components().unwrap().join(format!("{name}.wasm")),
            here.join(format!("{name}.wasm")),
        )
        .unwrap();
    }
    for key in ["root", "ann", "bob", "eve"] {
        done(&api, here, &["keys", "new", key]);
    }
    assert!(
        !bumpless(&api, here, &["keys", "new", "ann"]).status.success(),
        "no key is written over"
    );

    // Asked for by nobody yet; then for a warning; then for good. At one host, and in force at the other.
    done(&api, here, &["upload", "pidplus.wasm"]);
    done(
        &api,
        here,
        &["keys", "trust", "ann.key", "--role", "author", "--root", "root.key"],
    );
    on_every_host(&cell, 1);
    done(
        &other,
        here,
        &["keys", "trust", "bob.key", "--role", "approver", "--root", "root.key"],
    );
    on_every_host(&cell, 2);
    done(
        &api,
        here,
        &[
            "keys",
            "policy",
            "required",
            "--needs",
            "author,approver",
            "--root",
            "root.key",
        ],
    );
    on_every_host(&cell, 3);

    refused(&other, here, &["upload", "pid.wasm"], "author and approver");
    refused(&other, here, &["upload", "pid.wasm", "--force"], "author and approver");
    let plain = api.apply(&first_order_loop(0, "pidplus", 50.0)).unwrap_err();
    assert!(plain.to_string().contains("not signed as this cell asks"), "{plain}");

    // Signatures of a stranger, of the wrong role, of one key for both roles: none is enough.
    done(&api, here, &["sign", "pid.wasm", "--key", "eve.key"]);
    refused(&api, here, &["upload", "pid.wasm"], "does not know the key");
    done(&api, here, &["sign", "pid.wasm", "--key", "ann.key"]);
    done(
        &api,
        here,
        &["sign", "pid.wasm", "--key", "ann.key", "--role", "approver"],
    );
    refused(&api, here, &["upload", "pid.wasm"], "is no approver");
    done(
        &api,
        here,
        &["sign", "pid.wasm", "--key", "bob.key", "--role", "approver"],
    );
    done(&other, here, &["upload", "pid.wasm", "--wait"]);
    done(&api, here, &["verify", "pid.wasm"]);
    api.apply(&first_order_loop(0, "pid", 50.0)).unwrap();

    // A forged document, however high its number, is taken by nobody.
    let trust = api.get("/v1/trust").unwrap();
    let mut document: Value = serde_json::from_str(&text(&trust["document"]["text"])).unwrap();
    document["number"] = json!(1_000);
    document["policy"] = json!("off");
    let mut forged = trust["document"].clone();
    forged["text"] = json!(document.to_string());
    let refusal = api.put("/v1/trust", &forged).unwrap_err();
    assert!(
        refusal.status() == 409 && refusal.to_string().contains("no root key"),
        "{refusal}"
    );
    refused(
        &api,
        here,
        &["keys", "policy", "off", "--root", "eve.key"],
        "no root key",
    );

    // Revoked: the loop goes on, an alarm stands, nothing starts.
    done(
        &other,
        here,
        &["keys", "revoke", "ann", "--reason", "lost", "--root", "root.key"],
    );
    on_every_host(&cell, 4);
    let before = whole(&api.loop_view("loop-0").unwrap()["seq"]);
    api.wait_for_loop("loop-0", "cycles after the revocation", |view| {
        view["seq"].as_u64() > Some(before + 10)
    })
    .unwrap();
    assert_eq!(api.get("/v1/trust").unwrap()["unsigned"][0]["component"], "pid@0.1.0");
    api.wait_until("the alarm of the host", |api| {
        let alarms = api.get("/v1/alarms").unwrap();
        let stands =
            |alarm: &Value| alarm["loop"] == "host.plant" && alarm["name"] == "signature" && alarm["state"] == "active";
        if alarms["alarms"].as_array().unwrap().iter().any(stands) {
            Ok(())
        } else {
            Err(alarms)
        }
    })
    .unwrap();
    let start = api.apply(&first_order_loop(1, "pid", 50.0)).unwrap_err();
    assert!(start.to_string().contains("was revoked: lost"), "{start}");
    let set = api
        .command("loop-0", "set", &json!({ "parameters": { "k": 0.2 } }))
        .unwrap();
    assert!(set["warnings"].to_string().contains("revoked"), "{set}");
    one_writer(&cell.journal().unwrap());
}

#[test]
fn a_host_that_was_away_takes_the_document_and_keeps_what_its_loops_run() {
    let mut cell = Cell::start(CellOptions::first_order("{ count = 1 }").controllers(1)).unwrap();
    let api = cell.plant.api();
    let folder = tempfile::tempdir().unwrap();
    let here = folder.path();
    for key in ["root", "ann"] {
        done(&api, here, &["keys", "new", key]);
    }
    api.upload_stock(&["pid"]).unwrap();
    api.apply(&first_order_loop(0, "pid", 50.0)).unwrap();
    cell.controllers[0].kill9();
    done(
        &api,
        here,
        &["keys", "trust", "ann.key", "--role", "author", "--root", "root.key"],
    );
    done(&api, here, &["keys", "policy", "required", "--root", "root.key"]);
    cell.restart("a").unwrap();
    cell.wait_joined().unwrap();
    on_every_host(&cell, 2);
    // The whole cell starts again: its loop runs a component that nobody signed, and goes on.
    cell.plant.restart().unwrap();
    cell.wait_joined().unwrap();
    on_every_host(&cell, 2);
    let feed = cell.plant.api().live("?loops=loop-0").unwrap();
    for _ in 0..10 {
        feed.record().unwrap();
    }
    let other = cell.controllers[0].api().upload_stock(&["pidplus"]).unwrap_err();
    assert!(
        other.to_string().contains("lacks a valid signature of author"),
        "{other}"
    );
    one_writer(&cell.journal().unwrap());
}
