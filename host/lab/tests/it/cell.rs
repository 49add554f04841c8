//! What the cell does in a run: takeovers, replicas, swaps, losses; and that the same seed gives the same bytes.

use std::fs;

use bumpless_lab::Options;

use crate::setup::{figure, run, run_with};

/// A loop on three hosts.
const BASE: &str = r#"
name = "cell"
duration_s = 20
seeds = 2
plant = { model = "fopdt", fopdt = { gain = 1.0, tau_s = 2.0, dead_time_s = 0.2, noise = 0.05 } }
controller = { component = "pid", parameters = { k = 2, ti = 2 } }
[[loop]]
name = "l"
ports = { pv = "pv", out = "out" }
period_ms = 100
strategy = "round-robin"
setpoint = [{ at_s = 0, to = 0 }, { at_s = 2, to = 20 }, { at_s = 12, to = 30 }]
[cell]
link = { delay = { kind = "uniform", least_ms = 0.1, most_ms = 0.4 } }
[[cell.host]]
name = "a"
step = { kind = "uniform", least_ms = 0.05, most_ms = 0.2 }
[[cell.host]]
name = "b"
step = { kind = "uniform", least_ms = 0.05, most_ms = 0.2 }
[[cell.host]]
name = "c"
step = { kind = "uniform", least_ms = 0.05, most_ms = 0.2 }
"#;

fn with(more: &str) -> String {
    format!("{BASE}\n{more}")
}

#[test]
fn the_owner_dies_and_no_cycle_is_lost() {
    let outcome = run(&with(
        "[[event]]\ndo = \"kill\"\nhost = \"owner\"\nat_s = 5.05\nback_after_s = 5",
    ));
    assert_eq!(figure(&outcome, "cell", &[], "takeovers"), 1.0);
    assert_eq!(figure(&outcome, "cell", &[], "cycles-lost"), 0.0);
    let run = &outcome.variants[0].runs[0];
    assert!(
        run.notes.iter().any(|n| n.text.contains("takes over from")),
        "{:?}",
        run.notes
    );
    let quiet = crate::setup::run(BASE);
    let (with, without) = (figure(&outcome, "cell", &[], "iae"), figure(&quiet, "cell", &[], "iae"));
    assert!((with / without - 1.0).abs() < 0.01, "{with} against {without}");
}

#[test]
fn an_owner_that_stands_still_is_passed_over_within_the_cycle() {
    let outcome = run(&with(
        "[[event]]\ndo = \"pause\"\nhost = \"owner\"\nat_s = 5.05\nfor_s = 3",
    ));
    assert!(figure(&outcome, "cell", &[], "takeovers") >= 1.0);
    assert_eq!(figure(&outcome, "cell", &[], "cycles-lost"), 0.0);
    // The desk gives the owner 35 % of the period.
    assert!(figure(&outcome, "cell", &[], "gap") < 150.0);
}

#[test]
fn replicas_take_turns_and_a_silent_one_is_hedged() {
    let outcome = run(BASE);
    let mut seen: Vec<u8> = outcome.variants[0].runs[0].loops[0]
        .trace
        .iter()
        .map(|r| r.by)
        .collect();
    seen.sort_unstable();
    seen.dedup();
    assert_eq!(seen, [0, 1, 2, 3], "0 is before the first cycle");
    // Two of the three stand still; whoever owns the loop asks one of them two times of three, until its breaker opens.
    let still = "[[event]]\ndo = \"pause\"\nhost = \"a\"\nat_s = 5.05\nfor_s = 3\n\
                 [[event]]\ndo = \"pause\"\nhost = \"b\"\nat_s = 5.05\nfor_s = 3";
    let outcome = run(&with(still));
    assert!(figure(&outcome, "cell", &[], "hedged") >= 1.0);
    assert_eq!(figure(&outcome, "cell", &[], "cycles-lost"), 0.0);
}

#[test]
fn with_nobody_left_the_outputs_hold_and_cycles_are_counted_as_lost() {
    let off: String = ["a", "b", "c"]
        .map(|h| format!("[[event]]\ndo = \"off\"\nhost = \"{h}\"\nat_s = 5.05\n[[event]]\ndo = \"on\"\nhost = \"{h}\"\nat_s = 7.05\n"))
        .concat();
    let outcome = run(&with(&off));
    let lost = figure(&outcome, "cell", &[], "cycles-lost");
    assert!((19.0..=21.0).contains(&lost), "{lost}");
}

#[test]
fn a_swap_to_a_relative_has_no_bump() {
    let outcome = run(&with(
        "[[event]]\ndo = \"swap\"\nat_s = 8\ncomponent = \"pidplus\"\nparameters = { k = 2, ti = 2 }",
    ));
    assert_eq!(figure(&outcome, "cell", &[], "bump"), 0.0);
    let run = &outcome.variants[0].runs[0];
    assert!(
        run.notes.iter().any(|n| n.text.contains("swapped by migrate")),
        "{:?}",
        run.notes
    );
}

#[test]
fn the_same_seed_gives_the_same_bytes_and_what_is_kept_is_not_made_again() {
    let folder = tempfile::tempdir().unwrap();
    let options = Options {
        jobs: 2,
        kept_in: Some(folder.path().to_owned()),
        ..Options::default()
    };
    let text = with(
        "[[sweep]]\nfield = \"network.reads.loss\"\nvalues = [\"none\", { kind = \"random\", probability = 0.2 }]",
    );
    let (first, fresh) = (run_with(&text, &options), run(&text));
    assert_eq!(first, fresh);
    let files = || fs::read_dir(folder.path()).unwrap().count();
    assert_eq!(files(), 4);
    assert_eq!(run_with(&text, &options), first);
    // Another parameter is another result, and only that is made.
    let changed = run_with(&text.replace("ti = 2 }", "ti = 3 }"), &options);
    assert_eq!(files(), 8);
    assert_ne!(changed, first);
    assert_ne!(first.variants[0].runs[0], first.variants[0].runs[1], "seeds differ");
}

#[test]
fn what_a_component_does_not_have_is_named() {
    let (experiment, table) =
        bumpless_lab::Experiment::parse(&BASE.replace("pv = \"pv\"", "pv = \"level\""), "t.toml").unwrap();
    let stop = std::sync::atomic::AtomicBool::new(false);
    let refused = |text: &str| {
        let (experiment, table) = bumpless_lab::Experiment::parse(text, "t.toml").unwrap();
        crate::setup::lab()
            .run(&experiment, &table, "t.toml", &Options::default(), &stop, &|_| {})
            .unwrap_err()
            .to_string()
    };
    drop((experiment, table));
    for (from, to, part) in [
        (
            "pv = \"pv\"",
            "pv = \"level\"",
            "the plant has no signal \"level\"; it has pv, out, load",
        ),
        (
            "pv = \"pv\"",
            "pw = \"pv\"",
            "pid has no port \"pw\"; it has pv, ff, track",
        ),
        (
            "component = \"pid\"",
            "component = \"nothing\"",
            "controller \"nothing\" is not there",
        ),
        ("k = 2,", "kk = 2,", "has no parameter \"kk\""),
        (
            "k = 2,",
            "action = \"up\",",
            "pid has no such choice; it has [\"reverse\", \"direct\"]",
        ),
    ] {
        let error = refused(&BASE.replace(from, to));
        assert!(error.contains(part), "{to}: {error}");
    }
}
