//! Guests that trap, spin, flood, grow or lie: each ends in a fault with its reason, and the next call works.

use bumpless_core::Fault;

use crate::guest::{Guest, PATIENCE_NS, engine_for, frame, instance, state};

/// Misbehaves where the setpoint is not 0, and is the good law otherwise.
fn sometimes(misdeed: &str) -> Guest {
    let good = Guest::good().step;
    Guest::step(&format!(
        "(if (result i32) (f64.ne (local.get $setpoint) (f64.const 0)) (then {misdeed}) (else {good}))"
    ))
}

#[test]
fn each_misdeed_is_a_fault_and_the_next_step_works() {
    let limit = |text: &str| Fault::Limit(text.to_owned());
    let trap = |text: &str| Fault::Trap(text.to_owned());
    let bad_write = |port: &str, value: &str| Fault::BadWrite {
        port: port.into(),
        value: value.into(),
    };
    let name = "(i32.load (i32.const 1024)) (i32.load (i32.const 1028))";
    let repeat = |times: u32, body: &str| {
        format!(
            "(global.set $i (i32.const {times}))
             (loop $again {body} (global.set $i (i32.sub (global.get $i) (i32.const 1))) (br_if $again (global.get $i)))
             (call $ok (i32.const 0) (i32.const 0))"
        )
    };
    let cases: Vec<(&str, String, Fault)> = vec![
        (
            "unreachable",
            "(unreachable)".into(),
            trap("wasm `unreachable` instruction executed"),
        ),
        (
            "out of bounds",
            "(i32.load (i32.const -8))".into(),
            trap("out of bounds memory access"),
        ),
        (
            "division",
            "(i32.div_s (i32.const 1) (i32.const 0))".into(),
            trap("integer divide by zero"),
        ),
        (
            "names its function",
            "(call $named)".into(),
            trap("wasm `unreachable` instruction executed in named"),
        ),
        (
            "not a number",
            "(call $write (i32.const 1) (f64.const nan)) (unreachable)".into(),
            bad_write("out", "NaN"),
        ),
        (
            "infinite",
            "(call $write (i32.const 1) (f64.const inf)) (unreachable)".into(),
            bad_write("out", "inf"),
        ),
        (
            "writes an input",
            "(call $write (i32.const 0) (f64.const 1)) (unreachable)".into(),
            bad_write("in", "1"),
        ),
        (
            "writes nowhere",
            "(call $write (i32.const 64) (f64.const 1)) (unreachable)".into(),
            bad_write("64", "1"),
        ),
        (
            "reads nowhere",
            "(call $read (i32.const 2) (i32.const 512)) (unreachable)".into(),
            trap("it read port 2, but it has 2 ports"),
        ),
        (
            "huge state",
            "(call $ok (i32.const 0) (i32.const 65537))".into(),
            limit("a state of 65537 bytes; at most 65536 are kept"),
        ),
        (
            "giant state",
            "(drop (memory.grow (i32.const 20))) (call $ok (i32.const 0) (i32.const 1000000))".into(),
            limit("one call moved more than 262144 bytes to the host"),
        ),
        (
            "grows",
            "(if (i32.eq (memory.grow (i32.const 1000)) (i32.const -1)) (then unreachable)) (i32.const 0)".into(),
            limit("it asked for 65667072 bytes of memory; at most 16777216 are given"),
        ),
        (
            "big message",
            format!("(call $publish {name} (i32.const 0) (i32.const 4097)) (unreachable)"),
            limit("a message of 4097 bytes; at most 4096 are carried"),
        ),
        (
            "no topic",
            "(call $publish (i32.const 0) (i32.const 0) (i32.const 0) (i32.const 0)) (unreachable)".into(),
            limit("a topic has 1 to 64 characters"),
        ),
        (
            "many messages",
            repeat(17, &format!("(call $publish {name} (i32.const 0) (i32.const 1))")),
            limit("more than 16 messages in one step"),
        ),
        (
            "many alarms",
            repeat(33, &format!("(call $clear {name})")),
            limit("more than 32 alarm changes in one step"),
        ),
        (
            "long alarm",
            format!("(call $raise {name} (i32.const 0) (i32.const 4096) (i32.const 513)) (unreachable)"),
            limit("an alarm text of more than 512 characters"),
        ),
        (
            "returns nonsense",
            "(i32.store (i32.const 0) (i32.const 9)) (i32.const 0)".into(),
            trap("invalid expected discriminant"),
        ),
    ];
    for (what, misdeed, expected) in cases {
        let guest = Guest {
            extra: "(global $i (mut i32) (i32.const 0)) (func $named (result i32) (unreachable))".into(),
            ..sometimes(&misdeed)
        };
        let mut law = instance(&guest);
        assert_eq!(
            law.step(&frame(1.0), &state(1.0), PATIENCE_NS).unwrap_err(),
            strip_step(expected),
            "{what}"
        );
        let mut good = frame(1.0);
        good.cycle.setpoint = 0.0;
        assert_eq!(
            law.step(&good, &state(1.0), PATIENCE_NS).unwrap().writes,
            [(1, 2.0)],
            "after: {what}"
        );
    }
}

/// The step function itself has a name in the guest's text, which a trap in it reports.
fn strip_step(fault: Fault) -> Fault {
    match fault {
        Fault::Trap(text)
            if ["unreachable", "memory access", "divide"]
                .iter()
                .any(|t| text.contains(t))
                && !text.contains(" in ") =>
        {
            Fault::Trap(format!("{text} in step"))
        }
        other => other,
    }
}

#[test]
fn a_spinning_step_is_stopped_and_the_next_works() {
    let mut law = instance(&sometimes("(loop $l (br $l)) (unreachable)"));
    let mut good = frame(1.0);
    good.cycle.setpoint = 0.0;
    for _ in 0..3 {
        assert_eq!(
            law.step(&frame(1.0), &state(1.0), 3_000_000).unwrap_err(),
            Fault::Overrun { limit_us: 3000 }
        );
        assert!(law.last_step_ns() >= 3_000_000, "not before its limit");
        assert!(law.step(&good, &state(1.0), PATIENCE_NS).is_ok());
    }
}

#[test]
fn a_spinning_step_is_stopped_inside_host_calls_too() {
    let name = "(i32.load (i32.const 1024)) (i32.load (i32.const 1028))";
    let mut law = instance(&Guest::step(&format!(
        "(loop $l (call $log (i32.const 0) {name}) (br $l)) (unreachable)"
    )));
    assert_eq!(
        law.step(&frame(1.0), &[], 3_000_000).unwrap_err(),
        Fault::Overrun { limit_us: 3000 }
    );
}

#[test]
fn endless_recursion_is_a_trap() {
    let deep = Guest {
        extra: "(func $deep (param i32) (result i32) (i32.add (call $deep (local.get 0)) (i32.const 1)))".into(),
        ..Guest::step("(call $deep (i32.const 0))")
    };
    let fault = instance(&deep).step(&frame(1.0), &[], PATIENCE_NS).unwrap_err();
    assert_eq!(fault, Fault::Trap("call stack exhausted in deep".to_owned()));
}

#[test]
fn a_flood_of_lines_costs_lines_and_no_cycle() {
    let flood = Guest {
        extra: "(global $i (mut i32) (i32.const 0))".into(),
        ..Guest::step(
            "(global.set $i (i32.const 1000))
             (loop $again
               (call $log (i32.const 2) (i32.const 4096) (i32.const 600))
               (global.set $i (i32.sub (global.get $i) (i32.const 1)))
               (br_if $again (global.get $i)))
             (call $ok (local.get $state) (local.get $state_len))",
        )
    };
    let effects = instance(&flood).step(&frame(1.0), &state(1.0), PATIENCE_NS).unwrap();
    assert_eq!(effects.state, state(1.0));
    assert_eq!(effects.log.len(), 16);
    assert_eq!(effects.log[0].text.chars().count(), 512);
    assert_eq!(
        effects.log[15].text,
        "985 more lines were dropped: at most 16 per step are kept"
    );
}

#[test]
fn effects_outside_a_step_are_refused() {
    let name = "(i32.load (i32.const 1024)) (i32.load (i32.const 1028))";
    for (what, body, expected) in [
        (
            "publish",
            format!("(call $publish {name} (i32.const 0) (i32.const 1))"),
            "publish",
        ),
        ("clear", format!("(call $clear {name})"), "change an alarm"),
    ] {
        let guest = Guest {
            start: format!("{body} (call $ok (i32.const 0) (i32.const 0))"),
            ..Guest::good()
        };
        let fault = instance(&guest).start(&[], &[], PATIENCE_NS).unwrap_err();
        assert_eq!(
            fault,
            Fault::Failed(format!("it tried to {expected} outside a step")),
            "{what}"
        );
    }
}

#[test]
fn one_guests_overrun_does_not_touch_its_neighbours() {
    let engine = engine_for(2);
    let bad = engine
        .prepare(&sometimes("(loop $l (br $l)) (unreachable)").build())
        .unwrap();
    let good = engine.prepare(&Guest::good().build()).unwrap();
    let (mut bad, mut good) = (bad.instantiate().unwrap(), good.instantiate().unwrap());
    std::thread::scope(|scope| {
        let spinning = scope.spawn(move || bad.step(&frame(1.0), &state(0.0), 20_000_000).unwrap_err());
        let mut sum = state(0.0);
        while !spinning.is_finished() {
            sum = good.step(&frame(1.0), &sum, PATIENCE_NS).unwrap().state;
        }
        assert_eq!(spinning.join().unwrap(), Fault::Overrun { limit_us: 20_000 });
    });
}
