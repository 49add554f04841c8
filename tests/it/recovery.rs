//! A loop whose measurement's device goes away and comes back, under each policy on bad input: the output does not step.
//!
//! Two Modbus devices, so that the loop can go on writing while it cannot read.

use std::cell::Cell as Last;

use bumpless_tests::{Cell, CellOptions, FieldDevice};
use serde_json::{Value, json};

use crate::{number, text};

/// The measurement's register.
const PV: u16 = 20;
/// Where the policy `safe-value` puts the output, in %.
const SAFE: f64 = 12.0;
/// What the output may change in one cycle by itself: its integral's share, far below; a kick would be some per cent.
const STEP_MAX: f64 = 0.5;

fn buses(sense: &FieldDevice, act: &FieldDevice) -> String {
    let bus = |id: &str, device: &FieldDevice, point: &str| {
        format!(
            "[[bus]]\nid = \"{id}\"\ndriver = \"modbus-tcp\"\naddress = \"{}\"\nperiod_ms = 50\ntimeout_ms = 300\n\
             backoff_ms_min = 10\nbackoff_ms_max = 100\n\n[[bus.point]]\n{point}\n",
            device.address(0)
        )
    };
    let pv = format!("id = \"sense.pv\"\ntable = \"input\"\naddress = {PV}\nlow = 0.0\nhigh = 10000.0");
    let out = "id = \"act.out\"\ntable = \"holding\"\naddress = 10\nraw = [0.0, 10000.0]\nlow = 0.0\nhigh = 100.0\nwritable = true";
    bus("sense", sense, &pv) + &bus("act", act, out)
}

fn pv_is_good(record: &Value) -> bool {
    let readings = record["readings"].as_array().unwrap();
    let pv = readings.iter().find(|reading| reading["port"] == "pv").unwrap();
    pv["quality"] == "good"
}

fn out(record: &Value) -> f64 {
    number(&record["outputs"]["out"])
}

#[test]
fn what_comes_back_comes_back_without_a_bump() {
    let (sense, act) = (FieldDevice::start(1, 900).unwrap(), FieldDevice::start(1, 900).unwrap());
    sense.set_words(PV, &[4_000]);
    let mut cell = Cell::start(CellOptions {
        controllers: 1,
        bus: buses(&sense, &act),
        ..CellOptions::default()
    })
    .unwrap();
    let api = cell.api().unwrap();
    api.upload_stock(&["pid"]).unwrap();
    api.wait_until("both devices answer", |api| {
        let points = ["sense.pv", "act.out"].map(|point| api.get(&format!("/v1/points/{point}")).unwrap());
        if points.iter().all(|point| point["quality"] == "good") {
            Ok(())
        } else {
            Err(points)
        }
    })
    .unwrap();

    for (n, policy) in ["hold", "manual", "safe-value"].into_iter().enumerate() {
        let name = format!("oven-{n}");
        sense.set_words(PV, &[4_000]);
        api.apply(&json!({
            "name": name, "component": "pid", "period_ms": 100.0, "setpoint": 5_000.0, "setpoint_range": [0.0, 10_000.0],
            "ports": {"pv": "sense.pv", "out": "act.out"}, "parameters": {"k": 0.01, "ti": 50.0}, "mode": "manual",
            "limits": {"out": {"low": 0.0, "high": 100.0, "safe": SAFE}},
            "policy": {"on_bad_input": policy},
        }))
        .unwrap();
        // A warm oven: the output is far from both its ends, and the law is at work.
        api.command(&name, "output", &json!({"outputs": {"out": 40.0}}))
            .unwrap();
        api.mode(&name, "automatic").unwrap();
        let feed = api.live(&format!("?loops={name}")).unwrap();
        feed.record_where("the law at work", |record| {
            record["mode"] == "automatic" && out(record) > 40.1
        })
        .unwrap();

        sense.cut(Some(0));
        let held = feed
            .record_where("the bad input's policy at work", |record| {
                !pv_is_good(record)
                    && match policy {
                        "manual" => record["mode"] == "manual",
                        "safe-value" => out(record) == SAFE,
                        _ => true,
                    }
            })
            .unwrap();
        let before = out(&held);
        if policy != "safe-value" {
            assert!(before > 40.0, "{policy}: it stays where it was: {before}");
        }
        // It has cooled down meanwhile: an output that follows the error at once would step by 10 %.
        sense.set_words(PV, &[3_000]);
        for _ in 0..5 {
            let record = feed.record().unwrap();
            assert!(!pv_is_good(&record) && out(&record) == before, "{policy}: {record}");
        }
        sense.cut(None);
        if policy == "manual" {
            let back = feed.record_where("a good measurement", pv_is_good).unwrap();
            assert_eq!(
                (text(&back["mode"]).as_str(), out(&back)),
                ("manual", before),
                "a person says when"
            );
            api.mode(&name, "automatic").unwrap();
        }
        let last = Last::new(before);
        let first = feed
            .record_where("the law at work again", |record| {
                let at_work = pv_is_good(record) && record["mode"] == "automatic";
                if !at_work {
                    last.set(out(record));
                }
                at_work
            })
            .unwrap();
        let step = (out(&first) - last.get()).abs();
        assert!(
            step <= STEP_MAX,
            "{policy}: the output steps by {step} % as the measurement comes back: {first}"
        );
        // And it is at work: an error of 2,000 moves it by 0.4 % a second.
        feed.record_where("the law's own movement", |record| out(record) > last.get() + 0.2)
            .unwrap();
        assert!(
            f64::from(act.word(10)) / 100.0 > last.get(),
            "{policy}: the device has it too"
        );
        api.delete(&format!("/v1/loops/{name}")).unwrap();
    }
}
