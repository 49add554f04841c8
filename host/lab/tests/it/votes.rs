//! `vote(n)` in virtual time: what one wrong machine does to a loop, with a vote and without.

use bumpless_lab::{Experiment, Outcome};

use crate::setup::{figure, run};

/// Three hosts, of which one errs for a while; the plant is noise-free, so that any difference is the error's.
fn text(strategy: &str, more: &str) -> String {
    format!(
        r#"
name = "votes"
duration_s = 20
plant = {{ model = "fopdt", fopdt = {{ gain = 1.0, tau_s = 2.0, dead_time_s = 0.2 }} }}
controller = {{ component = "pid", parameters = {{ k = 2, ti = 2 }} }}
[[loop]]
name = "l"
ports = {{ pv = "pv", out = "out" }}
period_ms = 100
strategy = "{strategy}"
setpoint = [{{ at_s = 0, to = 0 }}, {{ at_s = 2, to = 20 }}]
[cell]
link = {{ delay = {{ kind = "uniform", least_ms = 0.1, most_ms = 0.4 }} }}
[[cell.host]]
name = "a"
step = {{ kind = "uniform", least_ms = 0.05, most_ms = 0.2 }}
[[cell.host]]
name = "b"
step = {{ kind = "uniform", least_ms = 0.05, most_ms = 0.2 }}
[[cell.host]]
name = "c"
step = {{ kind = "uniform", least_ms = 0.05, most_ms = 0.2 }}
{more}
"#
    )
}

fn wrong(host: &str) -> String {
    format!("[[event]]\ndo = \"wrong\"\nhost = \"{host}\"\nat_s = 5.05\nby = 30\nfor_s = 4\n")
}

fn iae(outcome: &Outcome) -> f64 {
    figure(outcome, "votes", &[], "iae")
}

#[test]
fn a_majority_outvotes_a_wrong_machine_and_turns_do_not() {
    let (sound, erring) = (run(&text("vote(3)", "")), run(&text("vote(3)", &wrong("b"))));
    assert_eq!(figure(&sound, "votes", &[], "cycles-lost"), 0.0);
    let took = figure(&sound, "votes", &[], "delay");
    assert!((0.1..2.0).contains(&took), "the middle answer's time: {took} ms");
    assert!(
        (iae(&erring) / iae(&sound) - 1.0).abs() < 1e-3,
        "{} and {}",
        iae(&erring),
        iae(&sound)
    );
    let turns = run(&text("round-robin", &wrong("b")));
    assert!(iae(&turns) > 1.05 * iae(&sound), "{} and {}", iae(&turns), iae(&sound));
    // 40 cycles of error: it steps along without a vote, and gets it back 20 clean cycles later.
    let dissents = figure(&erring, "votes", &[], "dissents");
    assert!((38.0..=42.0).contains(&dissents), "{dissents}");
    let run = &erring.variants[0].runs[0];
    let at = |text: &str| run.notes.iter().find(|n| n.text.contains(text)).map(|n| n.at_s);
    let (lost, back) = (
        at("b stood against the majority").unwrap(),
        at("b votes again").unwrap(),
    );
    assert!(
        (5.0..5.3).contains(&lost) && (10.9..11.4).contains(&back),
        "{lost} and {back}"
    );
}

#[test]
fn two_wrong_machines_that_agree_are_a_majority_and_two_that_differ_leave_none() {
    let agree = run(&text("vote(3)", &(wrong("a") + &wrong("b"))));
    let sound = run(&text("vote(3)", ""));
    assert!(
        iae(&agree) > 1.5 * iae(&sound),
        "three voters stand one wrong machine, not two"
    );
    let differ = wrong("a") + &wrong("b").replace("by = 30", "by = 20");
    let differ = run(&text("vote(3)", &differ));
    let faults = figure(&differ, "votes", &[], "faults");
    assert!(
        (38.0..=42.0).contains(&faults),
        "each cycle without a majority is the policy's: {faults}"
    );
    assert_eq!(figure(&differ, "votes", &[], "cycles-lost"), 0.0);
}

#[test]
fn a_vote_goes_on_when_a_voter_stands_still_or_dies() {
    let sound = run(&text("vote(3)", ""));
    for event in [
        "[[event]]\ndo = \"pause\"\nhost = \"b\"\nat_s = 5.05\nfor_s = 3\n",
        "[[event]]\ndo = \"kill\"\nhost = \"owner\"\nat_s = 5.05\nback_after_s = 4\n",
    ] {
        let outcome = run(&text("vote(3)", event));
        assert_eq!(figure(&outcome, "votes", &[], "cycles-lost"), 0.0, "{event}");
        assert_eq!(figure(&outcome, "votes", &[], "faults"), 0.0, "{event}");
        assert!((iae(&outcome) / iae(&sound) - 1.0).abs() < 0.01, "{event}");
    }
}

#[test]
fn a_vote_needs_its_hosts() {
    let refused = |text: &str| Experiment::parse(text, "t").unwrap_err().to_string();
    let error = refused(&text("vote(5)", ""));
    assert!(
        error.contains("vote(5) needs 5 hosts that control, and cell.host names 3"),
        "{error}"
    );
    let error = refused(&text("vote(3)", &wrong("b").replace("by = 30", "by = 0")));
    assert!(
        error.contains("event at 5.05 s") && error.contains("by must be"),
        "{error}"
    );
}
