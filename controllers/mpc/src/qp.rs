//! A small convex quadratic program: least `½·xᵀHx + gᵀx` with `A·x ≤ b`.
//!
//! A primal-dual interior point method with Mehrotra's predictor and corrector, and a careful step where these make no progress:
//! some ten to twenty steps whatever the constraints, no more than [`STEPS_MAX`]; no clock, no randomness, no branch on anything
//! but its own numbers. Each step solves
//! `(H + Aᵀ·diag(z/s)·A)·dx = r` by Cholesky. Source: Nocedal and Wright, *Numerical Optimization*, 2nd ed., ch. 16.6.
//! Never: sparse, large, or without H positive definite; an interior of `A·x ≤ b` must exist.

use bumpless_sdk::blocks::limit;

/// Steps at most.
pub const STEPS_MAX: usize = 60;
/// Complementarity and residuals below which the solution counts, relative to the largest gradient or dual.
const TOLERANCE: f64 = 1e-9;
/// By which part a step must lower complementarity; the predictor alone may go in circles.
const PROGRESS: f64 = 0.9;
/// What the careful step keeps of it instead.
const CENTRE: f64 = 0.3;
/// Room to a constraint that a first point is taken to have at least.
const ROOM_MIN: f64 = 1e-6;
/// Part of the way to the boundary that a step goes.
const BOUNDARY: f64 = 0.995;

/// A program; matrices by rows.
#[derive(Debug, Clone, PartialEq)]
pub struct Program {
    /// Length of x.
    pub size: usize,
    /// `size` × `size`, symmetric, positive definite.
    pub h: Vec<f64>,
    /// `size`.
    pub g: Vec<f64>,
    /// Rows × `size`.
    pub a: Vec<f64>,
    /// One per row.
    pub b: Vec<f64>,
    /// Where to begin, of length `size`: within all constraints, and not near to any of them. Every later point is within them.
    pub start: Vec<f64>,
}

/// Lower triangle of the Cholesky factor; none where the matrix is not positive definite.
fn factor(matrix: &[f64], n: usize) -> Option<Vec<f64>> {
    let mut l = vec![0.0; n * n];
    for i in 0..n {
        for j in 0..=i {
            let (row_i, row_j) = (l.get(i * n..i * n + j)?, l.get(j * n..j * n + j)?);
            let sum = matrix.get(i * n + j)? - dot(row_i, row_j);
            let value = if i == j {
                if sum > 0.0 {
                    sum.sqrt()
                } else {
                    return None;
                }
            } else {
                sum / l.get(j * n + j)?
            };
            *l.get_mut(i * n + j)? = value;
        }
    }
    Some(l)
}

/// Solves `L·Lᵀ·x = r` in place.
fn solve(l: &[f64], r: &mut [f64]) {
    let n = r.len();
    for i in 0..n {
        let (done, rest) = r.split_at_mut(i);
        if let (Some(row), Some(x)) = (l.get(i * n..i * n + i + 1), rest.first_mut()) {
            let (left, diagonal) = row.split_at(i);
            *x = (*x - dot(left, done)) / diagonal.first().copied().unwrap_or(1.0);
        }
    }
    for i in (0..n).rev() {
        let at = |row: usize, column: usize| l.get(row * n + column).copied().unwrap_or(0.0);
        let below: f64 = (i + 1..n).map(|j| at(j, i) * r.get(j).copied().unwrap_or(0.0)).sum();
        if let Some(x) = r.get_mut(i) {
            *x = (*x - below) / at(i, i);
        }
    }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// The longest step of `x` along `dx` that stays positive, at most 1.
fn longest(x: &[f64], dx: &[f64]) -> f64 {
    x.iter()
        .zip(dx)
        .filter(|(_, dx)| **dx < 0.0)
        .fold(1.0, |step: f64, (x, dx)| step.min(-x / dx))
}

/// Where the method stands.
struct Point {
    x: Vec<f64>,
    slack: Vec<f64>,
    dual: Vec<f64>,
}

/// A direction from there.
struct Direction {
    x: Vec<f64>,
    slack: Vec<f64>,
    dual: Vec<f64>,
}

/// A step that stays off the boundary.
const fn shorter(reach: f64) -> f64 {
    if reach < 1.0 { BOUNDARY * reach } else { 1.0 }
}

impl Point {
    /// The longest step along a direction that stays positive, at most 1.
    fn reach(&self, d: &Direction) -> f64 {
        longest(&self.slack, &d.slack).min(longest(&self.dual, &d.dual))
    }

    /// The sum of the products of slack and dual after a step.
    fn complementarity(&self, d: &Direction, step: f64) -> f64 {
        let slack = self.slack.iter().zip(&d.slack);
        let dual = self.dual.iter().zip(&d.dual);
        slack
            .zip(dual)
            .map(|((s, ds), (z, dz))| (s + step * ds) * (z + step * dz))
            .sum()
    }

    fn go(&mut self, d: &Direction, step: f64) {
        let along = |at: &mut [f64], d: &[f64]| {
            for (at, d) in at.iter_mut().zip(d) {
                *at += step * d;
            }
        };
        along(&mut self.x, &d.x);
        along(&mut self.slack, &d.slack);
        along(&mut self.dual, &d.dual);
        // Positive by the length of the step; rounding must not make it otherwise.
        for value in self.slack.iter_mut().chain(&mut self.dual) {
            *value = value.max(1e-300);
        }
    }
}

impl Program {
    fn rows(&self) -> impl Iterator<Item = &[f64]> {
        self.a.chunks_exact(self.size.max(1))
    }

    /// `Aᵀ·v`, added to `to`.
    fn transposed(&self, v: &[f64], to: &mut [f64]) {
        for (row, v) in self.rows().zip(v) {
            for (to, a) in to.iter_mut().zip(row) {
                *to += a * v;
            }
        }
    }

    /// H·x + g + Aᵀ·z.
    fn gradient(&self, p: &Point) -> Vec<f64> {
        let h = self.h.chunks_exact(self.size.max(1));
        let mut gradient: Vec<f64> = h.zip(&self.g).map(|(row, g)| dot(row, &p.x) + g).collect();
        self.transposed(&p.dual, &mut gradient);
        gradient
    }

    /// H + Aᵀ·diag(z/s)·A, as its factor.
    fn normal(&self, p: &Point) -> Option<Vec<f64>> {
        let mut matrix = self.h.clone();
        for ((row, z), s) in self.rows().zip(&p.dual).zip(&p.slack) {
            let weight = z / s;
            for (i, a) in row.iter().enumerate() {
                let scaled = weight * a;
                if scaled != 0.0 {
                    let line = matrix.get_mut(i * self.size..(i + 1) * self.size)?;
                    for (m, b) in line.iter_mut().zip(row) {
                        *m += scaled * b;
                    }
                }
            }
        }
        factor(&matrix, self.size)
    }

    /// The direction that takes both residuals away and brings each product of slack and dual by `-off`.
    fn direction(&self, l: &[f64], p: &Point, gradient: &[f64], gap: &[f64], off: &[f64]) -> Direction {
        let weighted = |value: &dyn Fn(usize) -> f64| -> Vec<f64> { (0..p.slack.len()).map(value).collect() };
        let of = |v: &[f64], i: usize| v.get(i).copied().unwrap_or(0.0);
        let pull = weighted(&|i| (of(&p.dual, i) * of(gap, i) - of(off, i)) / of(&p.slack, i));
        let mut x = vec![0.0; self.size];
        self.transposed(&pull, &mut x);
        for (x, g) in x.iter_mut().zip(gradient) {
            *x = -g - *x;
        }
        solve(l, &mut x);
        let moved: Vec<f64> = self.rows().map(|row| dot(row, &x)).collect();
        let slack = weighted(&|i| -of(gap, i) - of(&moved, i));
        let dual = weighted(&|i| (-of(off, i) - of(&p.dual, i) * of(&slack, i)) / of(&p.slack, i));
        Direction { x, slack, dual }
    }

    /// The solution, or the best point after [`STEPS_MAX`]; none where H is not positive definite or a number is none.
    #[must_use]
    pub fn solve(&self) -> Option<Vec<f64>> {
        self.run().map(|(x, _)| x)
    }

    /// How many steps the solution takes; [`STEPS_MAX`] where it is not reached.
    #[cfg(test)]
    pub(crate) fn steps(&self) -> Option<usize> {
        self.run().map(|(_, steps)| steps)
    }

    /// The first point: where the caller says, with duals of the size that the gradient needs.
    fn begin(&self) -> Point {
        let x = self.start.clone();
        let pull = self.g.iter().fold(1.0_f64, |pull, g| pull.max(g.abs()));
        let room = self.rows().zip(&self.b).map(|(row, b)| b - dot(row, &x));
        let slack: Vec<f64> = room.map(|room| room.max(ROOM_MIN)).collect();
        let dual = slack.iter().map(|slack| pull / slack).collect();
        Point { x, slack, dual }
    }

    /// The solution and how many steps it took.
    fn run(&self) -> Option<(Vec<f64>, usize)> {
        let mut p = self.begin();
        let mut steps = 0;
        let count = self.b.len().max(1) as f64;
        let largest = |v: &[f64]| v.iter().fold(0.0_f64, |w, v| w.max(v.abs()));
        while steps < STEPS_MAX {
            let gradient = self.gradient(&p);
            let rows = self.rows().zip(&p.slack).zip(&self.b);
            let gap: Vec<f64> = rows.map(|((row, s), b)| dot(row, &p.x) + s - b).collect();
            let mean = dot(&p.slack, &p.dual) / count;
            let small = TOLERANCE * largest(&self.g).max(largest(&p.dual)).max(1.0);
            if largest(&gradient) <= small && largest(&gap) <= small && mean <= small {
                break;
            }
            steps += 1;
            let Some(l) = self.normal(&p) else {
                if steps == 1 {
                    return None;
                }
                // Not positive definite any more: this is as near as numbers come.
                break;
            };
            let products: Vec<f64> = p.slack.iter().zip(&p.dual).map(|(s, z)| s * z).collect();
            let affine = self.direction(&l, &p, &gradient, &gap, &products);
            let ahead = p.complementarity(&affine, p.reach(&affine)) / count;
            let centre = limit((ahead / mean).powi(3), 0.0, 1.0) * mean;
            let corrected: Vec<f64> = products
                .iter()
                .zip(affine.slack.iter().zip(&affine.dual))
                .map(|(product, (ds, dz))| product + ds * dz - centre)
                .collect();
            let mut d = self.direction(&l, &p, &gradient, &gap, &corrected);
            let mut step = shorter(p.reach(&d));
            if p.complementarity(&d, step) > PROGRESS * mean * count {
                let careful: Vec<f64> = products.iter().map(|product| product - CENTRE * mean).collect();
                d = self.direction(&l, &p, &gradient, &gap, &careful);
                step = shorter(p.reach(&d));
            }
            p.go(&d, step);
        }
        p.x.iter().all(|x| x.is_finite()).then_some((p.x, steps))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::indexing_slicing, reason = "tests")]

    use proptest::prelude::*;

    use super::*;

    #[test]
    fn a_textbook_program_has_its_textbook_solution() {
        // Nocedal and Wright, example 16.4: least (x−1)² + (y−2.5)² within five half planes; at (1.4, 1.7).
        let program = Program {
            size: 2,
            h: vec![2.0, 0.0, 0.0, 2.0],
            g: vec![-2.0, -5.0],
            a: vec![-1.0, 2.0, 1.0, 2.0, 1.0, -2.0, -1.0, 0.0, 0.0, -1.0],
            b: vec![2.0, 6.0, 2.0, 0.0, 0.0],
            start: vec![1.0, 1.0],
        };
        let x = program.solve().unwrap();
        assert!((x[0] - 1.4).abs() < 1e-8 && (x[1] - 1.7).abs() < 1e-8, "{x:?}");
    }

    #[test]
    fn without_constraints_it_is_a_linear_system_and_an_indefinite_one_is_refused() {
        let free = Program {
            size: 2,
            h: vec![4.0, 1.0, 1.0, 3.0],
            g: vec![-1.0, -2.0],
            a: vec![],
            b: vec![],
            start: vec![0.0, 0.0],
        };
        let x = free.solve().unwrap();
        assert!(
            (x[0] - 1.0 / 11.0).abs() < 1e-9 && (x[1] - 7.0 / 11.0).abs() < 1e-9,
            "{x:?}"
        );
        let bad = Program {
            h: vec![1.0, 0.0, 0.0, -1.0],
            ..free
        };
        assert_eq!(bad.solve(), None);
    }

    proptest! {
        #[test]
        fn what_comes_out_is_feasible_and_no_neighbour_is_better(
            root in prop::collection::vec(-1.0..1.0f64, 9),
            g in prop::collection::vec(-10.0..10.0f64, 3),
            bounds in prop::collection::vec(0.01..5.0f64, 6),
            way in prop::collection::vec(-1.0..1.0f64, 3),
        ) {
            let at = |i: usize, j: usize| (0..3).map(|k| root[i * 3 + k] * root[j * 3 + k]).sum::<f64>() + f64::from(u8::from(i == j)) * 0.1;
            let h: Vec<f64> = (0..9).map(|n| at(n / 3, n % 3)).collect();
            let mut a = vec![0.0; 18];
            for i in 0..3 {
                a[2 * i * 3 + i] = 1.0;
                a[(2 * i + 1) * 3 + i] = -1.0;
            }
            let program = Program { size: 3, h: h.clone(), g: g.clone(), a, b: bounds.clone(), start: vec![0.0; 3] };
            let x = program.solve().unwrap();
            let cost = |x: &[f64]| dot(&g, x) + 0.5 * h.chunks(3).zip(x).map(|(row, x_i)| dot(row, x) * x_i).sum::<f64>();
            for i in 0..3 {
                prop_assert!(x[i] <= bounds[2 * i] + 1e-6 && -x[i] <= bounds[2 * i + 1] + 1e-6);
            }
            let other: Vec<f64> = (0..3).map(|i| limit(x[i] + 0.05 * way[i], -bounds[2 * i + 1], bounds[2 * i])).collect();
            prop_assert!(cost(&x) <= cost(&other) + 1e-6, "{x:?} {other:?}");
        }
    }
}
