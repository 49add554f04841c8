//! Dead time: what went in comes out a given time later, for any time between two steps.
//!
//! ```text
//!   shift(dt, value) ─► [newest piece] … [oldest piece] ─► pieces that are over, oldest first
//!                        └──────── together the dead time ────────┘
//! ```
//! A piece is a time and the value that held in it. Neighbours that together are shorter than a [`CELLS`]th of the dead time are
//! joined to their mean, so that memory is bounded ([`PIECES_MAX`]) and the integral of what goes in is what comes out.
//! While the time between steps is longer than such a cell, the delay is exact.
//! Never: a clock; a model of the process behind it.

use serde::{Deserialize, Serialize};

/// Parts of the dead time below which pieces are joined.
pub const CELLS: usize = 64;

/// Pieces that are kept at most: any two neighbours are longer than one cell, and a piece may be cut at the old end.
pub const PIECES_MAX: usize = 2 * CELLS + 2;

/// Some time in which a value held.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Piece {
    /// How long, s.
    pub for_s: f64,
    /// The value.
    pub value: f64,
}

/// A line of pieces, oldest first; together as long as the dead time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Delay {
    time_s: f64,
    line: Vec<Piece>,
    /// What went in last; stands in where the line is empty.
    last: f64,
}

impl Delay {
    /// A line in which one value has held for as long as it reaches back. `time_s` ≥ 0; 0 is no delay.
    ///
    /// It is made of [`CELLS`] equal pieces, so that the state's size hardly changes while it fills.
    #[must_use]
    pub fn holding(value: f64, time_s: f64) -> Self {
        let piece = Piece {
            for_s: time_s / CELLS as f64,
            value,
        };
        let cells = if time_s > 0.0 { CELLS } else { 0 };
        Self {
            time_s,
            line: vec![piece; cells],
            last: value,
        }
    }

    /// The dead time, s.
    #[must_use]
    pub const fn time_s(&self) -> f64 {
        self.time_s
    }

    /// What is under way, oldest first.
    #[must_use]
    pub fn pieces(&self) -> &[Piece] {
        &self.line
    }

    /// What comes out next: the oldest value, or, without a dead time, the last one.
    #[must_use]
    pub fn oldest(&self) -> f64 {
        self.line.first().map_or(self.last, |piece| piece.value)
    }

    /// `value` held for the last `dt_s`, and as much time comes out, oldest first. `dt_s` > 0.
    pub fn shift(&mut self, dt_s: f64, value: f64, mut out: impl FnMut(Piece)) {
        self.last = value;
        self.push(dt_s, value);
        self.pull(dt_s, &mut out);
    }

    /// Another dead time: a longer line held its oldest value before, a shorter one forgets its oldest pieces.
    pub fn stretch(&mut self, time_s: f64) {
        if time_s > self.time_s {
            let before = Piece {
                for_s: time_s - self.time_s,
                value: self.oldest(),
            };
            self.line.insert(0, before);
        } else {
            self.pull(self.time_s - time_s, &mut |_| {});
        }
        self.time_s = time_s;
    }

    fn push(&mut self, for_s: f64, value: f64) {
        let cell_s = self.time_s / CELLS as f64;
        match self.line.last_mut() {
            Some(last) if last.for_s + for_s <= cell_s => {
                let both_s = last.for_s + for_s;
                last.value += (value - last.value) * (for_s / both_s);
                last.for_s = both_s;
            }
            _ => self.line.push(Piece { for_s, value }),
        }
    }

    fn pull(&mut self, dt_s: f64, out: &mut impl FnMut(Piece)) {
        let (mut left_s, mut over) = (dt_s, 0);
        for piece in &mut self.line {
            // A rest of a billionth is rounding, not time.
            if piece.for_s > left_s * (1.0 + 1e-9) {
                if left_s > 0.0 {
                    out(Piece {
                        for_s: left_s,
                        value: piece.value,
                    });
                    piece.for_s -= left_s;
                }
                break;
            }
            out(*piece);
            left_s -= piece.for_s;
            over += 1;
        }
        self.line.drain(..over);
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn shifted(delay: &mut Delay, dt_s: f64, value: f64) -> Vec<(f64, f64)> {
        let mut out = Vec::new();
        delay.shift(dt_s, value, |p| out.push((p.for_s, p.value)));
        out
    }

    #[test]
    fn values_come_out_after_the_dead_time() {
        let mut delay = Delay::holding(7.0, 3.0);
        let mut seen = Vec::new();
        for i in 0..6 {
            let out = shifted(&mut delay, 1.0, f64::from(i));
            let mean: f64 = out.iter().map(|(t, v)| t * v).sum();
            seen.push((mean * 1e9).round() / 1e9);
        }
        assert_eq!(seen, [7.0, 7.0, 7.0, 0.0, 1.0, 2.0]);
    }

    #[test]
    fn a_dead_time_between_two_steps_cuts_a_piece() {
        let mut delay = Delay::holding(0.0, 0.25);
        shifted(&mut delay, 1.0, 0.0);
        assert_eq!(shifted(&mut delay, 1.0, 4.0), [(0.25, 0.0), (0.75, 4.0)]);
        assert_eq!(shifted(&mut delay, 1.0, 5.0), [(0.25, 4.0), (0.75, 5.0)]);
    }

    #[test]
    fn no_dead_time_is_no_delay_and_a_day_is_no_matter() {
        let mut none = Delay::holding(1.0, 0.0);
        assert_eq!(shifted(&mut none, 0.1, 3.0), [(0.1, 3.0)]);
        let mut long = Delay::holding(1.0, 10.0);
        let out = shifted(&mut long, 86_400.0, 2.0);
        let all: f64 = out.iter().map(|(t, _)| t).sum();
        assert!((all - 86_400.0).abs() < 1e-6);
        assert_eq!(long.pieces().len(), 1);
    }

    proptest! {
        #[test]
        fn time_and_area_are_kept_and_memory_is_bounded(
            time_s in 0.0..50.0f64,
            steps in prop::collection::vec((1e-4..5.0f64, -10.0..10.0f64), 1..400),
            other_s in 0.0..80.0f64,
        ) {
            let mut delay = Delay::holding(0.0, time_s);
            let (mut into, mut out) = (0.0, 0.0);
            for (i, (dt_s, value)) in steps.iter().enumerate() {
                into += dt_s * value;
                let mut time = 0.0;
                delay.shift(*dt_s, *value, |p| {
                    out += p.for_s * p.value;
                    time += p.for_s;
                });
                prop_assert!((time - dt_s).abs() < 1e-6 * dt_s.max(1.0));
                prop_assert!(delay.pieces().len() <= PIECES_MAX, "{}", delay.pieces().len());
                if i == 200 {
                    into -= delay.pieces().iter().map(|p| p.for_s * p.value).sum::<f64>();
                    delay.stretch(other_s);
                    into += delay.pieces().iter().map(|p| p.for_s * p.value).sum::<f64>();
                }
            }
            let inside: f64 = delay.pieces().iter().map(|p| p.for_s * p.value).sum();
            prop_assert!((into - out - inside).abs() < 1e-5, "{into} in, {out} out, {inside} under way");
            let long: f64 = delay.pieces().iter().map(|p| p.for_s).sum();
            prop_assert!((long - delay.time_s()).abs() < 1e-6);
        }
    }
}
