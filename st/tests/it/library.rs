//! The standard's function blocks by their timing diagrams, and the functions of numbers by their values.

use crate::cell::Cell;

/// Steps a block through `(dt in ms, inputs, outputs)`.
fn diagram(source: &str, rows: &[(u64, &[f64], &[f64])]) {
    let mut cell = Cell::new(source);
    for (n, (dt_ms, inputs, outputs)) in rows.iter().enumerate() {
        assert_eq!(cell.step_of(*dt_ms, inputs), *outputs, "row {n}: {inputs:?}");
    }
}

fn timer(name: &str) -> String {
    format!(
        "PROGRAM p VAR_INPUT i : BOOL; END_VAR VAR_OUTPUT q : BOOL; et : LREAL; END_VAR
         VAR t : {name}; END_VAR t(IN := i, PT := T#300ms, Q => q); et := TIME_TO_LREAL(t.ET); END_PROGRAM"
    )
}

#[test]
fn ton_switches_on_late() {
    diagram(
        &timer("TON"),
        &[
            (100, &[0.0], &[0.0, 0.0]),
            (100, &[1.0], &[0.0, 0.0]),
            (100, &[1.0], &[0.0, 100.0]),
            (150, &[1.0], &[0.0, 250.0]),
            (50, &[1.0], &[1.0, 300.0]),
            (900, &[1.0], &[1.0, 300.0]),
            (100, &[0.0], &[0.0, 0.0]),
            // Too short.
            (100, &[1.0], &[0.0, 0.0]),
            (200, &[1.0], &[0.0, 200.0]),
            (50, &[0.0], &[0.0, 0.0]),
            (500, &[0.0], &[0.0, 0.0]),
        ],
    );
}

#[test]
fn tof_switches_off_late() {
    diagram(
        &timer("TOF"),
        &[
            (100, &[0.0], &[0.0, 0.0]),
            (100, &[1.0], &[1.0, 0.0]),
            (100, &[1.0], &[1.0, 0.0]),
            (100, &[0.0], &[1.0, 0.0]),
            (200, &[0.0], &[1.0, 200.0]),
            // Again, before it is over.
            (50, &[1.0], &[1.0, 0.0]),
            (100, &[0.0], &[1.0, 0.0]),
            (300, &[0.0], &[0.0, 300.0]),
            (100, &[0.0], &[0.0, 300.0]),
            (100, &[1.0], &[1.0, 0.0]),
        ],
    );
}

#[test]
fn tp_gives_a_pulse_that_nothing_shortens() {
    diagram(
        &timer("TP"),
        &[
            (100, &[0.0], &[0.0, 0.0]),
            (100, &[1.0], &[1.0, 0.0]),
            (100, &[0.0], &[1.0, 100.0]),
            (100, &[1.0], &[1.0, 200.0]),
            (100, &[1.0], &[0.0, 300.0]),
            (100, &[1.0], &[0.0, 300.0]),
            (100, &[0.0], &[0.0, 0.0]),
            (100, &[1.0], &[1.0, 0.0]),
            (1000, &[0.0], &[0.0, 0.0]),
        ],
    );
}

#[test]
fn timers_count_time_once_however_often_they_are_called() {
    let source = "PROGRAM p VAR_OUTPUT et : LREAL; END_VAR VAR t : TON; END_VAR
        t(IN := TRUE, PT := T#1s); t(); t(); et := TIME_TO_LREAL(t.ET); END_PROGRAM";
    diagram(
        source,
        &[(100, &[], &[0.0]), (100, &[], &[100.0]), (250, &[], &[350.0])],
    );
}

#[test]
fn edges_are_seen_once() {
    let source =
        "PROGRAM p VAR_INPUT c : BOOL; END_VAR VAR_OUTPUT r, f : BOOL; END_VAR VAR rt : R_TRIG; ft : F_TRIG; END_VAR
        rt(CLK := c); ft(CLK := c); r := rt.Q; f := ft.Q; END_PROGRAM";
    diagram(
        source,
        &[
            (100, &[0.0], &[0.0, 0.0]),
            (100, &[1.0], &[1.0, 0.0]),
            (100, &[1.0], &[0.0, 0.0]),
            (100, &[0.0], &[0.0, 1.0]),
            (100, &[0.0], &[0.0, 0.0]),
        ],
    );
}

#[test]
fn latches_prefer_what_their_name_says() {
    let source =
        "PROGRAM p VAR_INPUT s, r : BOOL; END_VAR VAR_OUTPUT sq, rq : BOOL; END_VAR VAR a : SR; b : RS; END_VAR
        a(S1 := s, R := r, Q1 => sq); b(S := s, R1 := r, Q1 => rq); END_PROGRAM";
    diagram(
        source,
        &[
            (100, &[0.0, 0.0], &[0.0, 0.0]),
            (100, &[1.0, 0.0], &[1.0, 1.0]),
            (100, &[0.0, 0.0], &[1.0, 1.0]),
            (100, &[1.0, 1.0], &[1.0, 0.0]),
            (100, &[0.0, 1.0], &[0.0, 0.0]),
        ],
    );
}

#[test]
fn counters_count_edges() {
    let source = "PROGRAM p VAR_INPUT u, d, r, l : BOOL; END_VAR VAR_OUTPUT cu, cd, ud, qu, qd : LREAL; END_VAR
        VAR a : CTU; b : CTD; c : CTUD; END_VAR
        a(CU := u, R := r, PV := 2); b(CD := d, LD := l, PV := 2); c(CU := u, CD := d, R := r, LD := l, PV := 2);
        cu := a.CV + 100 * BOOL_TO_INT(a.Q); cd := b.CV + 100 * BOOL_TO_INT(b.Q); ud := c.CV;
        qu := BOOL_TO_INT(c.QU); qd := BOOL_TO_INT(c.QD); END_PROGRAM";
    diagram(
        source,
        &[
            (100, &[0.0, 0.0, 0.0, 0.0], &[0.0, 100.0, 0.0, 0.0, 1.0]),
            (100, &[1.0, 0.0, 0.0, 0.0], &[1.0, 100.0, 1.0, 0.0, 0.0]),
            (100, &[1.0, 0.0, 0.0, 0.0], &[1.0, 100.0, 1.0, 0.0, 0.0]),
            (100, &[0.0, 0.0, 0.0, 0.0], &[1.0, 100.0, 1.0, 0.0, 0.0]),
            (100, &[1.0, 0.0, 0.0, 1.0], &[102.0, 2.0, 2.0, 1.0, 0.0]),
            (100, &[0.0, 1.0, 0.0, 0.0], &[102.0, 1.0, 1.0, 0.0, 0.0]),
            (100, &[1.0, 1.0, 0.0, 0.0], &[103.0, 1.0, 2.0, 1.0, 0.0]),
            (100, &[0.0, 0.0, 0.0, 0.0], &[103.0, 1.0, 2.0, 1.0, 0.0]),
            // Both at once leave it.
            (100, &[1.0, 1.0, 0.0, 0.0], &[104.0, 100.0, 2.0, 1.0, 0.0]),
            (100, &[1.0, 1.0, 1.0, 0.0], &[0.0, 100.0, 0.0, 0.0, 1.0]),
        ],
    );
}

/// Units in the last place between two numbers.
fn ulps(a: f64, b: f64) -> f64 {
    if a == b || (a.is_nan() && b.is_nan()) {
        return 0.0;
    }
    (a - b).abs() / (b.abs() * f64::EPSILON).max(f64::MIN_POSITIVE)
}

#[test]
fn functions_of_numbers_are_exact_to_some_last_places() {
    let source = "PROGRAM p VAR_INPUT x : LREAL; END_VAR VAR_OUTPUT a, b, c, d, e, f, g, h, i : LREAL; END_VAR
        a := EXP(LIMIT(-700.0, x, 700.0)); b := LN(ABS(x) + 1.0E-300); c := SIN(x); d := COS(x); e := ATAN(x); f := LOG(ABS(x) + 1.0E-300);
        g := ASIN(x / (1.0 + ABS(x))); h := ACOS(x / (1.0 + ABS(x))); i := EXPT(ABS(x) + 0.1, 1.37); END_PROGRAM";
    let mut cell = Cell::new(source);
    let mut worst = [0.0_f64; 9];
    let steps =
        (-400..400)
            .map(|n| f64::from(n) * 0.1731)
            .chain([0.0, 1.0, 10.0, 1e-9, 1e-300, 1e5, -1e5, 700.0, 123_456.789]);
    for x in steps {
        let given = cell.step(&[x]);
        let unit = x / (1.0 + x.abs());
        let wanted = [
            x.clamp(-700.0, 700.0).exp(),
            (x.abs() + 1e-300).ln(),
            x.sin(),
            x.cos(),
            x.atan(),
            (x.abs() + 1e-300).log10(),
            unit.asin(),
            unit.acos(),
            (x.abs() + 0.1).powf(1.37),
        ];
        for ((given, wanted), worst) in given.iter().zip(wanted).zip(&mut worst) {
            // An infinite answer is no write that a host takes.
            if wanted.is_finite() && wanted.abs() > 1e-12 {
                *worst = worst.max(ulps(*given, wanted));
            }
        }
    }
    let bounds = [4.0, 4.0, 600.0, 600.0, 8.0, 4.0, 16.0, 16.0, 40.0];
    for (n, (worst, bound)) in worst.iter().zip(bounds).enumerate() {
        assert!(
            *worst <= bound,
            "function {n}: {worst} units in the last place; all: {:?}",
            (worst, bounds)
        );
    }
}

#[test]
fn powers_of_ten_and_whole_powers_are_exact() {
    crate::cell::values(
        "",
        "x : LREAL := 1000.0; y : LREAL := -2.0; r : REAL := 2.0;",
        "",
        &[
            ("LOG(x)", 3.0),
            ("LOG(1.0E-5)", -5.0),
            ("y ** 3", -8.0),
            ("y ** -1", -0.5),
            ("r ** 0.5", f64::from(2.0_f64.sqrt() as f32)),
            ("SIN(0.0)", 0.0),
            ("COS(0.0)", 1.0),
            ("ATAN2(Y := 1.0, X := 0.0)", std::f64::consts::FRAC_PI_2),
            ("ATAN2(0.0, y)", std::f64::consts::PI),
            ("EXP(0.0)", 1.0),
            ("LN(1.0)", 0.0),
        ],
    );
}
