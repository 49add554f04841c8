//! Figures on the terminal: one per line, for people or as JSON, each with its bound where it has one.
//!
//! Never: a figure without its unit.

use serde::Serialize;

#[derive(Serialize)]
struct Figure<'a> {
    figure: &'a str,
    value: f64,
    unit: &'a str,
    bound: Option<String>,
    holds: bool,
}

/// What is printed, and whether every bound held.
#[allow(
    clippy::print_stdout,
    clippy::print_stderr,
    reason = "a command-line tool speaks to its terminal"
)]
pub(crate) mod terminal {
    use super::Figure;

    pub(crate) struct Report {
        pub(crate) json: bool,
        pub(crate) holds: bool,
    }

    impl Report {
        /// A line for people.
        pub(crate) fn say(&self, line: &str) {
            if self.json {
                eprintln!("{line}");
            } else {
                println!("{line}");
            }
        }

        /// A figure that is told.
        pub(crate) fn told(&mut self, figure: &str, value: f64, unit: &str) {
            self.put(figure, value, unit, None, true);
        }

        /// A figure that must not be greater than its bound.
        pub(crate) fn at_most(&mut self, figure: &str, value: f64, unit: &str, bound: f64) {
            self.put(figure, value, unit, Some(format!("<= {bound}")), value <= bound);
        }

        fn put(&mut self, figure: &str, value: f64, unit: &str, bound: Option<String>, holds: bool) {
            self.holds &= holds;
            if self.json {
                let line = Figure {
                    figure,
                    value,
                    unit,
                    bound,
                    holds,
                };
                // A struct of plain fields always has a JSON form.
                println!("{}", serde_json::to_string(&line).unwrap_or_default());
            } else {
                let verdict = match (&bound, holds) {
                    (None, _) => "",
                    (_, true) => "holds",
                    (_, false) => "DOES NOT HOLD",
                };
                let value = if value.fract() == 0.0 {
                    format!("{value:.0}")
                } else {
                    format!("{value:.4}")
                };
                println!(
                    "{figure:<64} {value:>14} {unit:<12} {:<8} {verdict}",
                    bound.unwrap_or_default()
                );
            }
        }

        /// What went wrong with the command itself.
        pub(crate) fn failed(error: &dyn std::error::Error) {
            eprintln!("error: {error}");
            let mut cause = error.source();
            while let Some(next) = cause {
                eprintln!("  because: {next}");
                cause = next.source();
            }
        }
    }
}
