//! End-to-end tests: cells of real processes, asked as users ask them.
//!
//! | file | what it tells |
//! |---|---|
//! | story | a loop's whole life: swaps, commands, the death of its owner |
//! | restarts | the whole cell, or the I/O host alone, dies and comes back |
//! | changes | what may change while a loop runs, what brings it back, and owners that die meanwhile |
//! | phases | the owner dies in each phase of an upload, a backtest, a change, a rollout |
//! | commissioning | points by hand, forces, jobs, point lists |
//! | door | jobs over the bus, by a program that is no host |
//! | masters | two hosts for one device |
//! | members | frozen owners, late hosts, hosts that leave |
//! | clocks | dates that are apart, that step, that went back |
//! | drain | hosts that are emptied, restarted one by one, preferred, cut off |
//! | chaos | faults by a seed, under the checker |
//! | history | replays, backtests, shadows |
//! | past | the long history: gaps filled by other hosts, kills, points, files |
//! | rollouts | one component for many loops, one loop first |
//! | calls | the cell as a control service |
//! | recovery | a measurement that comes back, under each policy on bad input |
//! | refusals | bad components, loops, requests, configurations, command lines |
//! | audit | every change leaves its entry; kill -9, tampering |
//! | webhooks | alarms told to a receiver that is slow, away, back; and to readers at any host |
//! | programs | free-running programs: paused while they spin, kill -9 of their owner; the published 3C scripts |
//! | signing | whose components the cell takes |
//! | hostile | the worst components beside a loop that must not notice |
//! | access | accounts, tokens, TLS, a closed bus, and attacks on them |
//! | votes | a host whose steps come out wrong, and who notices |
//! | modbus | a real Modbus device that dies and comes back |
//! | scada | the cell as a Modbus device: points of another host, commands to a loop |
//! | neighbours | two cells on one machine |
//! | api | strangers who read the document, the metrics and the traces |
//! | watching | metrics, the document of the API, the live feed |
//! | library | trials, labels, bundles, bombs and crowds of components |
//! | stock | every stock law passes its trial |
//! | authors | a law in Structured Text from its project to a running loop, and back to `pid` |
//! | languages | the example law in every language: the same numbers, swaps without a bump |
//! | lab | virtual time against a live cell, and the ways between the two; plants as components |
//! | guides | the commands in the documentation |
//! | stranger | from the binary to a swap in a root without anything else of ours |
//! | operations | dry runs, systemd, safe outputs at a stop, backup and restore |
//! | house | the rules of the source itself |

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test fails loudly"
)]

mod access;
mod alarms;
mod api;
mod audit;
mod authors;
mod calls;
mod changes;
mod chaos;
mod clocks;
mod commissioning;
mod door;
mod drain;
mod guides;
mod history;
mod hostile;
mod house;
mod lab;
mod languages;
mod library;
mod masters;
mod members;
mod modbus;
mod neighbours;
mod operations;
mod past;
mod phases;
mod programs;
mod recovery;
mod refusals;
mod restarts;
mod rollouts;
mod scada;
mod signing;
mod stock;
mod story;
mod stranger;
mod votes;
mod watching;
mod webhooks;

use std::time::Duration;

use bumpless_tests::{Api, Journal};
use serde_json::Value;

/// No write of a second writer, and nothing lost from the log itself.
#[track_caller]
fn one_writer(journal: &Journal) {
    let violations: Vec<String> = journal.check_one_writer().iter().map(ToString::to_string).collect();
    assert!(
        violations.is_empty(),
        "{} violations: {violations:#?}",
        violations.len()
    );
    assert_eq!(journal.dropped, 0, "lines of the journal were dropped");
}

/// A number that must be there.
#[track_caller]
fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is no number"))
}

/// A whole number that must be there.
#[track_caller]
fn whole(value: &Value) -> u64 {
    value.as_u64().unwrap_or_else(|| panic!("{value} is no whole number"))
}

/// A text that must be there.
#[track_caller]
fn text(value: &Value) -> String {
    value
        .as_str()
        .unwrap_or_else(|| panic!("{value} is no text"))
        .to_owned()
}

/// Names in a list.
fn names(list: &Value) -> Vec<String> {
    list.as_array()
        .map(|rows| rows.iter().filter_map(Value::as_str).map(str::to_owned).collect())
        .unwrap_or_default()
}

/// Waits until the loop's measurement has stayed within `band` of the setpoint for some cycles.
#[track_caller]
fn settle(api: &Api, name: &str, band: f64) -> Value {
    let feed = api.live(&format!("?loops={name}")).unwrap();
    let good = std::cell::Cell::new(0);
    // The simulated vessel needs half a minute by itself.
    let longest = Duration::from_secs(120);
    feed.record_within(longest, &format!("{name} within {band} of its setpoint"), |record| {
        let near = matches!(
            (record["measurement"].as_f64(), record["setpoint"].as_f64()),
            (Some(pv), Some(sp)) if (pv - sp).abs() <= band
        );
        good.set(if near { good.get() + 1 } else { 0 });
        good.get() >= 10
    })
    .unwrap()
}
