//! States from one version, program or language to another.

use bumpless_core::Fault;
use bumpless_engine::Origin;

use crate::cell::Cell;

/// A PI law in positional form, as it stands in the guide.
const PI: &str = "PROGRAM pi
VAR_INPUT pv : LREAL; END_VAR
VAR_OUTPUT out : LREAL; {low := 0, high := 100} END_VAR
VAR CONSTANT k : LREAL := 2.0; {low := 0, high := 100} ti : LREAL := 5.0; {low := 0.1, high := 1000} END_VAR
VAR_EXTERNAL setpoint : LREAL; track : BOOL; dt : TIME; END_VAR
VAR RETAIN integral : LREAL; END_VAR
VAR e : LREAL; END_VAR
e := setpoint - pv;
IF track THEN integral := out - k * e;
ELSE integral := LIMIT(0.0, integral + k * e * TIME_TO_LREAL(dt) / 1000.0 / ti, 100.0); END_IF;
out := integral + k * e;
END_PROGRAM";

fn run(source: &str) -> Cell {
    let mut cell = Cell::new(source);
    cell.setpoint = 10.0;
    for n in 0..20 {
        cell.step(&[f64::from(n) * 0.1]);
    }
    cell
}

#[test]
fn a_start_and_a_retune_go_on_from_the_actuator() {
    let mut cell = Cell::tracking(PI, &[37.5]);
    cell.held[1] = 37.5;
    cell.setpoint = 10.0;
    assert_eq!(cell.step(&[8.0]), [37.5]);
    assert!(cell.step(&[8.0])[0] > 37.5);
    let before = cell.held[1];
    cell.retune(&[9.0, 5.0], &[before]);
    assert_eq!(
        cell.step(&[8.0]),
        [before],
        "the gain is another, the output is the same"
    );
    assert!(cell.step(&[8.0])[0] > before);
}

#[test]
fn a_new_version_takes_over_what_it_still_has() {
    let old = run("PROGRAM a VAR_OUTPUT r : LREAL; END_VAR VAR n : INT; gone : LREAL := 3.0; kind : INT := 4; t : TON; v : ARRAY[1..2] OF INT;
        s : STRUCT x : INT; y : INT; END_STRUCT; END_VAR VAR NON_RETAIN fresh : INT; END_VAR
        n := n + 1; kind := 5; t(IN := TRUE, PT := T#1h); v[2] := 8; fresh := 9; s.y := 7; END_PROGRAM");
    let mut new = Cell::new("PROGRAM a VAR_OUTPUT r, n2, kind2, et, v2, fresh2, s2 : LREAL; END_VAR
        VAR first : LREAL := 1.0; t : TON; s : STRUCT y : INT; z : INT := 2; END_STRUCT; n : INT; kind : DINT := 6; v : ARRAY[1..2] OF INT; END_VAR
        VAR NON_RETAIN fresh : INT; END_VAR
        t(IN := TRUE, PT := T#1h); n2 := n; kind2 := kind; et := TIME_TO_LREAL(t.ET); v2 := v[2]; fresh2 := fresh; s2 := s.y * 10 + s.z;
        r := first; END_PROGRAM");
    assert_ne!(old.compiled.state_layout, new.compiled.state_layout);
    new.take(&old.origin(), &old.state, &[0.0; 7]).unwrap();
    // Of the timer every part has its place; KIND is of another type now.
    assert_eq!(new.step(&[]), [1.0, 20.0, 6.0, 2000.0, 8.0, 0.0, 72.0]);
}

#[test]
fn another_program_takes_over_what_is_retained() {
    let old = run(PI);
    let other = PI
        .replace("PROGRAM pi", "PROGRAM pi_two")
        .replace("VAR e : LREAL", "VAR other, e : LREAL");
    let mut new = Cell::new(&other);
    new.setpoint = 10.0;
    new.take(&old.origin(), &old.state, &[old.held[1]]).unwrap();
    new.held[1] = old.held[1];
    let given = new.step(&[2.0]);
    assert!((given[0] - old.held[1]).abs() < 1e-12, "{given:?}, {}", old.held[1]);

    let plain = PI
        .replace("PROGRAM pi", "PROGRAM pi_three")
        .replace("VAR RETAIN", "VAR");
    let fault = Cell::new(&plain).take(&old.origin(), &old.state, &[0.0]).unwrap_err();
    assert_eq!(
        fault,
        Fault::BadState("this program has none of the retained variables of the state".to_owned())
    );
}

#[test]
fn what_is_no_state_is_declined_and_no_length_is_believed() {
    let old = run(PI);
    let mut new = Cell::new(PI);
    let foreign = Origin {
        name: "pid".to_owned(),
        version: "1.0.0".to_owned(),
        state_layout: 1,
    };
    let declined = Fault::BadState("the state is not one of a Structured Text program".to_owned());
    for state in [
        vec![],
        vec![0xB1],
        vec![0; 100],
        b"\xB1\x03pid\x01\0\0\0\0abcdefghijkl".to_vec(),
    ] {
        assert_eq!(new.take(&foreign, &state, &[0.0]), Err(declined.clone()), "{state:?}");
    }
    // Cut anywhere, and with any byte another one: an answer in words, never a trap.
    for cut in 0..old.state.len() {
        let end = new.take(&old.origin(), &old.state[..cut], &[0.0]);
        assert!(matches!(end, Ok(()) | Err(Fault::BadState(_))), "{cut}: {end:?}");
    }
    for at in 0..old.state.len() {
        for value in [0, 0xff, 0x7f] {
            let mut state = old.state.clone();
            state[at] = value;
            let end = new.take(&old.origin(), &state, &[0.0]);
            assert!(matches!(end, Ok(()) | Err(Fault::BadState(_))), "{at}: {end:?}");
        }
    }
    let mut cell = Cell::new(PI);
    cell.state = vec![0xB1; cell.state.len()];
    let fault = cell.try_step(100, &[Some(1.0)]).unwrap_err();
    assert_eq!(
        fault,
        Fault::BadState("the state belongs to another component or layout".to_owned())
    );
}

#[test]
fn the_same_text_gives_the_same_bytes() {
    let (a, b) = (crate::cell::compiled(PI), crate::cell::compiled(PI));
    assert_eq!(a, b);
    let comment = PI.replace("e := setpoint", "(* the error *) e := setpoint");
    assert_eq!(crate::cell::compiled(&comment).state_layout, a.state_layout);
}
