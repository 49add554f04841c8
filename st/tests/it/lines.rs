//! Which line an instruction comes from: a step that never ends is found where it spins.

use bumpless_core::{Cycle, Fault, Frame, Mode};
use bumpless_engine::{Config, Engine};
use bumpless_st::{Compiled, compile, compile_with_lines};

const SOURCE: &str = "FUNCTION spin : DINT
VAR_INPUT n : DINT; END_VAR
spin := n;
WHILE spin >= 0 DO
    spin := 1;
END_WHILE;
END_FUNCTION

PROGRAM endless
VAR_OUTPUT r : LREAL; END_VAR
VAR t : TON; END_VAR
t(IN := TRUE, PT := T#1s);
r := DINT_TO_LREAL(spin(2));
END_PROGRAM
";

/// Where its first step is stopped.
fn place(compiled: &Compiled, lines: bool) -> Option<String> {
    let engine = Engine::new(Config {
        instances_max: 4,
        lines,
        ..Config::default()
    })
    .expect("engine");
    let (_, prepared) = engine.open(&compiled.component).expect("a component");
    let mut instance = prepared.instantiate().expect("instance");
    let state = instance.start(&[], &[0.0], 20_000_000_000).expect("start");
    let frame = Frame {
        cycle: Cycle {
            seq: 1,
            at_ns: 1,
            dt_ns: 1,
            mode: Mode::Automatic,
            setpoint: 0.0,
        },
        readings: Vec::new(),
        messages: Vec::new(),
    };
    let fault = instance.step(&frame, &state, 20_000_000).expect_err("it never ends");
    assert!(matches!(fault, Fault::Overrun { .. }), "{fault}");
    instance.stopped_in().map(str::to_owned)
}

#[test]
fn an_endless_loop_is_found_at_its_line() {
    let with_lines = compile_with_lines(SOURCE, "endless.st").expect("it compiles");
    let without = compile(SOURCE).expect("it compiles");
    assert!(with_lines.component.len() > without.component.len());
    assert_eq!(
        (with_lines.state_layout, &with_lines.name),
        (without.state_layout, &without.name)
    );
    let found = place(&with_lines, true).expect("a place");
    assert!(
        found == "SPIN (endless.st:4)" || found == "SPIN (endless.st:5)",
        "{found}"
    );
    assert_eq!(place(&without, true).as_deref(), Some("SPIN"));
    assert_eq!(place(&with_lines, false).as_deref(), Some("SPIN"));
}
