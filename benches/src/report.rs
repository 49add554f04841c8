//! Figures: a value, its unit, the bound that was promised, and whether it holds.
//!
//! Owns everything that is printed. Never: rounds a value before it is judged; hides one.
//!
//! For people, a figure is a line of a table; for programs (`--json`), one JSON object on standard output:
//!
//! ```text
//! {"figure":"failover.replica_10hz.cycles_lost","value":0,"unit":"cycles","bound":"<= 0","holds":true}
//! ```
#![allow(
    clippy::print_stdout,
    clippy::print_stderr,
    reason = "the one place that speaks to the terminal"
)]

use serde::Serialize;

use crate::conditions::Conditions;

/// What was promised of a figure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Bound {
    /// Nothing: it is told, not judged.
    None,
    /// At most this.
    AtMost(f64),
    /// Less than this.
    Below(f64),
    /// At least this.
    AtLeast(f64),
}

impl Bound {
    /// A value that is no number keeps no promise.
    fn holds(self, value: f64) -> bool {
        match self {
            Self::None => true,
            Self::AtMost(bound) => value <= bound,
            Self::Below(bound) => value < bound,
            Self::AtLeast(bound) => value >= bound,
        }
    }

    fn text(self) -> Option<String> {
        match self {
            Self::None => None,
            Self::AtMost(bound) => Some(format!("<= {bound}")),
            Self::Below(bound) => Some(format!("< {bound}")),
            Self::AtLeast(bound) => Some(format!(">= {bound}")),
        }
    }
}

/// One figure.
#[derive(Debug, Serialize)]
struct Figure<'a> {
    figure: &'a str,
    value: serde_json::Value,
    unit: &'a str,
    bound: Option<String>,
    holds: bool,
}

/// Figures of one bench.
#[derive(Debug)]
pub(crate) struct Report {
    json: bool,
    figures: u32,
    broken: Vec<String>,
}

impl Report {
    /// Prints the conditions.
    pub(crate) fn begin(conditions: &Conditions, json: bool) -> Self {
        if json {
            eprint!("{conditions}");
        } else {
            print!("{conditions}");
        }
        Self {
            json,
            figures: 0,
            broken: Vec::new(),
        }
    }

    /// Prints a figure and judges it.
    pub(crate) fn figure(&mut self, figure: &str, value: f64, unit: &str, bound: Bound) {
        self.figures += 1;
        let holds = bound.holds(value);
        if !holds {
            self.broken.push(figure.to_owned());
        }
        let bound = bound.text();
        if self.json {
            let line = Figure {
                figure,
                value: number(value),
                unit,
                bound,
                holds,
            };
            match serde_json::to_string(&line) {
                Ok(line) => println!("{line}"),
                // A struct of plain fields always has a JSON form.
                Err(error) => eprintln!("{figure}: {error}"),
            }
        } else {
            let verdict = match (&bound, holds) {
                (None, _) => "",
                (Some(_), true) => "holds",
                (Some(_), false) => "DOES NOT HOLD",
            };
            let bound = bound.unwrap_or_default();
            println!("{figure:<56} {:>12} {unit:<10} {bound:<10} {verdict}", short(value));
        }
    }

    /// A figure that is told and not judged.
    pub(crate) fn told(&mut self, figure: &str, value: f64, unit: &str) {
        self.figure(figure, value, unit, Bound::None);
    }

    /// A line for people: what is being done now.
    pub(crate) fn progress(&self, text: &str) {
        eprintln!("… {text}");
    }

    /// Prints the verdict; says whether every bound holds.
    pub(crate) fn end(self) -> bool {
        let verdict = match self.broken.as_slice() {
            [] => format!("{} figures, every bound holds", self.figures),
            broken => format!(
                "{} figures, {} of them beyond their bounds: {}",
                self.figures,
                broken.len(),
                broken.join(", ")
            ),
        };
        if self.json {
            eprintln!("{verdict}");
        } else {
            println!("\n{verdict}");
        }
        self.broken.is_empty()
    }
}

/// An error and its causes.
pub(crate) fn failed(error: &dyn std::error::Error) {
    eprintln!("error: {error}");
    let mut cause = error.source();
    while let Some(next) = cause {
        eprintln!("  because: {next}");
        cause = next.source();
    }
}

/// What another process waits for on our standard output.
pub(crate) fn say(line: &str) {
    println!("{line}");
}

/// Whole numbers without a fraction; null for what is no number.
fn number(value: f64) -> serde_json::Value {
    #[allow(clippy::cast_possible_truncation, reason = "whole and far below 2^63")]
    if value.fract() == 0.0 && value.abs() < 1e15 {
        serde_json::Value::from(value as i64)
    } else {
        serde_json::Value::from(value)
    }
}

/// Five digits are enough for people.
fn short(value: f64) -> String {
    if value.fract() == 0.0 && value.abs() < 1e15 {
        return format!("{value:.0}");
    }
    let digits = match value.abs() {
        v if v >= 1000.0 => 0,
        v if v >= 100.0 => 1,
        v if v >= 10.0 => 2,
        v if v >= 0.1 => 3,
        v if v >= 1e-4 => 6,
        _ => return format!("{value:.1e}"),
    };
    format!("{value:.digits$}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bounds_are_judged_and_written() {
        for (bound, value, holds, text) in [
            (Bound::AtMost(0.0), 0.0, true, Some("<= 0")),
            (Bound::AtMost(0.0), 1.0, false, Some("<= 0")),
            (Bound::Below(1.5), 1.5, false, Some("< 1.5")),
            (Bound::AtLeast(2.0), 2.0, true, Some(">= 2")),
            (Bound::AtMost(1.0), f64::NAN, false, Some("<= 1")),
            (Bound::None, f64::NAN, true, None),
        ] {
            assert_eq!(bound.holds(value), holds, "{bound:?} of {value}");
            assert_eq!(bound.text().as_deref(), text);
        }
    }

    #[test]
    fn numbers_are_short_for_people_and_whole_for_programs() {
        assert_eq!(number(0.0).to_string(), "0");
        assert_eq!(number(1.25).to_string(), "1.25");
        assert_eq!(number(f64::NAN).to_string(), "null");
        for (value, text) in [
            (3.0, "3"),
            (0.00012, "0.000120"),
            (12.345, "12.35"),
            (48_012.6, "48013"),
        ] {
            assert_eq!(short(value), text);
        }
    }
}
