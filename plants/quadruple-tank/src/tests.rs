//! The model against the constants that Johansson's paper gives for its two settings: levels, time constants, zeros, gains.
//!
//! All of them come from the model's own equations, linearised by differences.

#![allow(clippy::unwrap_used, reason = "tests")]

use super::*;

/// γ, k, start voltages; published levels, time constants, zeros and relative gain.
struct Setting {
    gamma: [f64; 2],
    k: [f64; 2],
    v: f64,
    levels: [f64; 4],
    times_s: [f64; 4],
    zeros: [f64; 2],
    relative_gain: f64,
}

const MINIMUM_PHASE: Setting = Setting {
    gamma: [0.70, 0.60],
    k: [3.33, 3.35],
    v: 3.0,
    levels: [12.4, 12.7, 1.8, 1.4],
    times_s: [62.7, 90.3, 23.9, 30.0],
    zeros: [-0.058, -0.0172],
    relative_gain: 1.40,
};

#[allow(
    clippy::approx_constant,
    reason = "a pump's constant of the paper, which happens to look like π"
)]
const NON_MINIMUM_PHASE: Setting = Setting {
    gamma: [0.43, 0.34],
    k: [3.14, 3.29],
    v: 3.15,
    levels: [12.6, 13.0, 4.8, 4.9],
    times_s: [63.2, 91.4, 39.0, 56.1],
    zeros: [-0.0562, 0.0128],
    relative_gain: -0.64,
};

fn tanks(s: &Setting) -> Running<QuadrupleTank> {
    let constants = [
        28.0, 32.0, 0.071, 0.057, s.k[0], s.k[1], s.gamma[0], s.gamma[1], s.v, s.v, 0.0,
    ];
    Running::begin(&constants, 0).unwrap()
}

/// ∂rate/∂h and ∂rate/∂v at `h`.
fn linearised(plant: &QuadrupleTank, h: [f64; 4], v: [f64; 2]) -> ([[f64; 4]; 4], [[f64; 2]; 4]) {
    let d = 1e-5;
    let (mut a, mut b) = ([[0.0; 4]; 4], [[0.0; 2]; 4]);
    for j in 0..4 {
        let (mut up, mut down) = (h, h);
        up[j] += d;
        down[j] -= d;
        let (up, down) = (plant.rate(&up, v, [0.0; 2]), plant.rate(&down, v, [0.0; 2]));
        for i in 0..4 {
            a[i][j] = (up[i] - down[i]) / (2.0 * d);
        }
    }
    for j in 0..2 {
        let (mut up, mut down) = (v, v);
        up[j] += d;
        down[j] -= d;
        let (up, down) = (plant.rate(&h, up, [0.0; 2]), plant.rate(&h, down, [0.0; 2]));
        for i in 0..4 {
            b[i][j] = (up[i] - down[i]) / (2.0 * d);
        }
    }
    (a, b)
}

/// C·(sI − A)⁻¹·B for the two lower tanks. A is upper triangular but for its diagonal: tank 3 feeds 1 and tank 4 feeds 2.
fn transfer(a: &[[f64; 4]; 4], b: &[[f64; 2]; 4], s: f64) -> [[f64; 2]; 2] {
    let mut g = [[0.0; 2]; 2];
    for (row, above) in [(0, 2), (1, 3)] {
        for j in 0..2 {
            let upper = b[above][j] / (s - a[above][above]);
            g[row][j] = (b[row][j] + a[row][above] * upper) / (s - a[row][row]);
        }
    }
    g
}

#[test]
fn levels_and_time_constants_are_the_published_ones() {
    for setting in [&MINIMUM_PHASE, &NON_MINIMUM_PHASE] {
        let plant = tanks(setting);
        let v = [setting.v; 2];
        for (got, published) in plant.truth().iter().zip(setting.levels) {
            // The paper's voltages and levels are rounded to one or two digits each.
            assert!((got - published).abs() < 0.3, "{got} cm is not {published} cm");
        }
        let (a, _) = linearised(plant.plant(), setting.levels, v);
        for (i, published) in setting.times_s.iter().enumerate() {
            let got = -1.0 / a[i][i];
            assert!(
                (got / published - 1.0).abs() < 0.01,
                "T{} = {got} s is not {published} s",
                i + 1
            );
        }
    }
}

#[test]
fn zeros_and_relative_gains_are_the_published_ones() {
    for setting in [&MINIMUM_PHASE, &NON_MINIMUM_PHASE] {
        let plant = tanks(setting);
        // At the published levels, so that what is compared has no rounding of the voltages in it.
        let (a, b) = linearised(plant.plant(), setting.levels, [setting.v; 2]);
        let det = |s: f64| {
            let g = transfer(&a, &b, s);
            // Times the poles of the lower and upper tanks, so that only the zeros are left.
            let poles: f64 = (0..4).map(|i| s - a[i][i]).product();
            (g[0][0] * g[1][1] - g[0][1] * g[1][0]) * poles
        };
        for zero in setting.zeros {
            let (mut low, mut high) = (zero - 0.004, zero + 0.004);
            assert!(det(low) * det(high) < 0.0, "no zero near {zero}");
            for _ in 0..60 {
                let middle = 0.5 * (low + high);
                if det(low) * det(middle) <= 0.0 {
                    high = middle;
                } else {
                    low = middle;
                }
            }
            assert!((low - zero).abs() < 4e-4, "zero {low} is not {zero}");
        }
        let g = transfer(&a, &b, 0.0);
        let gain = g[0][0] * g[1][1] / (g[0][0] * g[1][1] - g[0][1] * g[1][0]);
        assert!((gain - setting.relative_gain).abs() < 0.01, "{gain}");
    }
}

#[test]
fn it_stays_where_it_starts_and_empties_when_nothing_pumps() {
    let mut plant = tanks(&MINIMUM_PHASE);
    let before = plant.truth().to_vec();
    let mut inputs = before.clone();
    (inputs[4], inputs[5]) = (3.0, 3.0);
    plant.advance(600_000_000_000, &inputs).unwrap();
    for (now, then) in plant.truth().iter().zip(&before) {
        assert!((now - then).abs() < 1e-6, "{now} after {then}");
    }
    (inputs[4], inputs[5]) = (0.0, 0.0);
    plant.advance(3_600_000_000_000, &inputs).unwrap();
    assert!(
        plant.truth()[..4].iter().all(|h| (0.0..1e-3).contains(h)),
        "{:?}",
        plant.truth()
    );
}
