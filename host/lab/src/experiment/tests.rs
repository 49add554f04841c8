//! Bad experiments and what is said about them.

#![allow(clippy::unwrap_used, reason = "tests")]

use super::*;

const GOOD: &str = r#"
name = "t"
duration_s = 60
seeds = [3, 4]
controller = { component = "pid", parameters = { k = 2, action = "direct" } }
plant = { model = "fopdt", fopdt = { gain = 2.0 } }

[[loop]]
name = "flow"
ports = { pv = "pv", out = "out" }
period_ms = 100
setpoint = [{ at_s = 0, to = 1 }, { at_s = 10, to = 2, over_s = 5 }]

[network]
both = { loss = { kind = "periodic", every_s = 60, for_s = 6 } }

[[cell.host]]
name = "a"

[[event]]
do = "kill"
at_s = 5
host = "owner"
"#;

#[test]
fn a_good_one_is_read() {
    let (experiment, _) = Experiment::parse(GOOD, "t.toml").unwrap();
    assert_eq!(experiment.seeds.list(), [3, 4]);
    assert_eq!(experiment.loops[0].strategy, Strategy::Local);
    let parameters = &experiment.controller.as_ref().unwrap().parameters;
    assert_eq!(parameters["action"], Value::Word("direct".to_owned()));
    assert_eq!(parameters["k"], Value::Number(2.0));
}

#[test]
fn what_is_wrong_is_named_with_its_place() {
    for (from, to, part) in [
        ("duration_s = 60", "duration = 60", "unknown field `duration`"),
        (
            "duration_s = 60",
            "duration_s = -1",
            "t.toml: duration_s: it must be greater than 0",
        ),
        ("name = \"t\"", "name = \"a b\"", "t.toml: name: use 1 to 64"),
        ("seeds = [3, 4]", "seeds = []", "t.toml: seeds: at least one"),
        (
            "model = \"fopdt\"",
            "model = \"pot\"",
            "model = \"pot\" is unknown: use pilot, fopdt",
        ),
        (
            "model = \"fopdt\"",
            "model = \"pilot\"",
            "fopdt belongs to another model than \"pilot\"",
        ),
        ("gain = 2.0", "gian = 2.0", "unknown field `gian`"),
        (
            "period_ms = 100",
            "period_ms = 0.5",
            "loop \"flow\": period_ms must be 1 to 3,600,000",
        ),
        (
            "period_ms = 100",
            "period_ms = 100\nphase_ms = 100",
            "phase_ms must be 0 or more",
        ),
        ("name = \"flow\"", "name = \"Flow\"", "its name is no loop's name"),
        ("at_s = 0, to = 1", "at_s = 1, to = 1", "setpoint must begin at 0 s"),
        (
            "at_s = 10, to = 2",
            "at_s = -1, to = 2",
            "must come one after the other",
        ),
        (
            "every_s = 60, for_s = 6",
            "every_s = 6, for_s = 60",
            "network.both: loss: times must be",
        ),
        ("kind = \"periodic\"", "kind = \"weekly\"", "unknown variant `weekly`"),
        (
            "host = \"owner\"",
            "host = \"b\"",
            "event at 5 s: there is no such host",
        ),
        ("do = \"kill\"", "do = \"kil\"", "unknown variant `kil`"),
        ("name = \"a\"", "name = \"owner\"", "one that means something else here"),
        ("duration_s = 60", "duration_s = 864000\n", "cycles are asked for"),
    ] {
        let text = GOOD.replace(from, to);
        let text = if part.contains("cycles are asked") {
            text.replace("period_ms = 100", "period_ms = 1")
        } else {
            text
        };
        let error = Experiment::parse(&text, "t.toml").unwrap_err().to_string();
        assert!(error.contains(part) && error.contains("t.toml"), "{to}: {error}");
    }
}
