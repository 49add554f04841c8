//! What people read: one page (HTML), tables for other programs (CSV, JSON), and a summary in the terminal.
//!
//! Owns the files of a report and their names. The page needs nothing but itself: pictures are SVG within it, light and dark
//! are the reader's choice, and it prints. Never: a time of day or a path of this machine; the same outcome gives the same
//! bytes.

mod chart;
mod page;
mod style;

use std::{
    collections::BTreeMap,
    fmt::Write as _,
    fs,
    path::{Path, PathBuf},
};

use serde::Serialize;

use crate::{
    error::Error,
    meter::FIGURES,
    result::{Outcome, Summary, VariantResult},
};

pub use page::html;

/// The files of a report.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Files {
    /// The page.
    pub html: PathBuf,
    /// Figures: one row per case, sweep point, seed and loop.
    pub csv: PathBuf,
    /// Curves of the first seed.
    pub curves: PathBuf,
    /// Figures with mean and confidence interval.
    pub json: PathBuf,
}

/// Writes a report into a folder, which is made where it is missing.
///
/// # Errors
/// [`Error::File`], or [`Error::Picture`].
pub fn write(outcome: &Outcome, folder: &Path) -> Result<Files, Error> {
    fs::create_dir_all(folder).map_err(Error::file("making", folder))?;
    let file = |end: &str| folder.join(format!("{}{end}", outcome.name));
    let files = Files {
        html: file(".html"),
        csv: file(".csv"),
        curves: file("-curves.csv"),
        json: file(".json"),
    };
    let json = serde_json::to_string_pretty(&summary(outcome)).map_err(|e| Error::Kept {
        path: files.json.clone(),
        problem: e.to_string(),
    })?;
    for (path, text) in [
        (&files.html, html(outcome)?),
        (&files.csv, csv(outcome)),
        (&files.curves, curves(outcome)),
        (&files.json, json + "\n"),
    ] {
        fs::write(path, text).map_err(Error::file("writing", path))?;
    }
    Ok(files)
}

/// What the JSON file holds.
#[derive(Debug, Serialize)]
struct Json<'a> {
    name: &'a str,
    text: &'a str,
    duration_s: f64,
    figures: Vec<JsonFigure>,
    variants: Vec<JsonVariant<'a>>,
}

#[derive(Debug, Serialize)]
struct JsonFigure {
    key: &'static str,
    name: &'static str,
    unit: &'static str,
    text: &'static str,
}

#[derive(Debug, Serialize)]
struct JsonVariant<'a> {
    case: &'a str,
    component: &'a str,
    at: BTreeMap<&'a str, &'a str>,
    loops: BTreeMap<&'a str, BTreeMap<&'static str, Summary>>,
    failed: Vec<&'a str>,
}

fn summary(outcome: &Outcome) -> Json<'_> {
    let variant = |v: &'_ VariantResult| -> BTreeMap<&str, BTreeMap<&'static str, Summary>> {
        let loops = outcome.loops.iter().enumerate();
        loops.map(|(n, name)| (name.as_str(), v.summaries(n))).collect()
    };
    Json {
        name: &outcome.name,
        text: &outcome.text,
        duration_s: outcome.duration_s,
        figures: FIGURES
            .iter()
            .map(|f| JsonFigure {
                key: f.key,
                name: f.name,
                unit: f.unit,
                text: f.text,
            })
            .collect(),
        variants: outcome
            .variants
            .iter()
            .map(|v| JsonVariant {
                case: &v.case,
                component: &v.component,
                at: v.at.iter().map(|s| (s.title.as_str(), s.label.as_str())).collect(),
                loops: variant(v),
                failed: v.runs.iter().filter_map(|r| r.failed.as_deref()).collect(),
            })
            .collect(),
    }
}

/// A field of a CSV file (RFC 4180).
fn field(text: &str) -> String {
    if text.contains([',', '"', '\n']) {
        format!("\"{}\"", text.replace('"', "\"\""))
    } else {
        text.to_owned()
    }
}

/// Names of what is swept; the same in every variant.
fn sweep_titles(outcome: &Outcome) -> Vec<&str> {
    outcome
        .variants
        .first()
        .map_or_else(Vec::new, |v| v.at.iter().map(|s| s.title.as_str()).collect())
}

/// One row per run and loop.
#[must_use]
pub fn csv(outcome: &Outcome) -> String {
    let mut text = String::from("case");
    for title in sweep_titles(outcome) {
        let _infallible = write!(text, ",{}", field(title));
    }
    text.push_str(",seed,loop");
    for figure in FIGURES {
        let _infallible = write!(text, ",{}", figure.key);
    }
    text.push_str(",failed\n");
    for variant in &outcome.variants {
        for run in &variant.runs {
            for (n, name) in outcome.loops.iter().enumerate() {
                text.push_str(&field(&variant.case));
                for setting in &variant.at {
                    let _infallible = write!(text, ",{}", field(&setting.label));
                }
                let _infallible = write!(text, ",{},{name}", run.seed);
                let figures = run.loops.get(n).map(|l| &l.figures);
                for figure in FIGURES {
                    text.push(',');
                    if let Some(value) = figures.and_then(|f| f.get(figure.key)) {
                        let _infallible = write!(text, "{value}");
                    }
                }
                let _infallible = writeln!(text, ",{}", field(run.failed.as_deref().unwrap_or_default()));
            }
        }
    }
    text
}

/// The curves of each variant's first run.
#[must_use]
pub fn curves(outcome: &Outcome) -> String {
    let mut text = String::from("case");
    for title in sweep_titles(outcome) {
        let _infallible = write!(text, ",{}", field(title));
    }
    text.push_str(",loop,t_s,setpoint,truth,measured,output,stepped_by\n");
    for variant in &outcome.variants {
        let Some(run) = variant.runs.first() else { continue };
        for l in &run.loops {
            for row in &l.trace {
                text.push_str(&field(&variant.case));
                for setting in &variant.at {
                    let _infallible = write!(text, ",{}", field(&setting.label));
                }
                let by = run.hosts.get(usize::from(row.by)).map_or("", String::as_str);
                let _infallible = writeln!(
                    text,
                    ",{},{},{},{},{},{},{by}",
                    l.name, row.t_s, row.setpoint, row.truth, row.measured, row.output
                );
            }
        }
    }
    text
}

/// A number for people: four digits that count, no more.
#[must_use]
pub fn number(value: f64) -> String {
    let size = value.abs();
    if value == 0.0 {
        "0".to_owned()
    } else if !(1e-4..1e6).contains(&size) {
        format!("{value:.3e}")
    } else {
        let digits = (3 - size.log10().floor() as i32).clamp(0, 7) as usize;
        let text = format!("{value:.digits$}");
        if text.contains('.') {
            text.trim_end_matches('0').trim_end_matches('.').to_owned()
        } else {
            text
        }
    }
}

/// A figure over seeds for people: mean, and half of its confidence interval.
#[must_use]
pub fn interval(summary: &Summary) -> String {
    match summary.half_95 {
        // Below a billionth of the mean it is the rounding of the sums.
        Some(half) if half > 1e-9 * summary.mean.abs() => format!("{} ± {}", number(summary.mean), number(half)),
        _ => number(summary.mean),
    }
}

/// Keys of the figures that some variant of a loop has, and that do not say the same of all in vain.
#[must_use]
pub fn told(outcome: &Outcome, loop_number: usize) -> Vec<&'static crate::meter::Figure> {
    FIGURES
        .iter()
        .filter(|figure| {
            let means: Vec<f64> = outcome
                .variants
                .iter()
                .filter_map(|v| v.summary(loop_number, figure.key).map(|s| s.mean))
                .collect();
            // A row of zeros tells nothing but that nothing happened; the main indices are told anyway.
            let main = ["iae", "itae", "overshoot", "tv"].contains(&figure.key);
            !means.is_empty() && (main || means.iter().any(|m| *m != 0.0))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use super::*;
    use crate::{
        meter::Row,
        result::{LoopResult, Note, RunResult},
        variant::Setting,
    };

    fn outcome() -> Outcome {
        let run = |seed, iae: f64| RunResult {
            seed,
            loops: vec![LoopResult {
                name: "flow".to_owned(),
                figures: [("iae".to_owned(), iae), ("tv".to_owned(), 2.0)].into(),
                trace: (0..50_u8)
                    .map(|n| Row {
                        t_s: f64::from(n),
                        setpoint: 1.0,
                        truth: f64::from(n) / 50.0,
                        measured: f64::NAN,
                        output: 3.0,
                        by: n % 2,
                    })
                    .collect(),
            }],
            notes: vec![Note {
                at_s: 20.0,
                text: "a <b> is killed".to_owned(),
            }],
            notes_dropped: 0,
            hosts: vec!["home".to_owned(), "a".to_owned()],
            failed: None,
        };
        let variant = |case: &str, number: f64, iae: f64| VariantResult {
            case: case.to_owned(),
            at: vec![Setting {
                title: "gain, K".to_owned(),
                label: number.to_string(),
                of_law: false,
                number: Some(number),
            }],
            component: "pid".to_owned(),
            runs: vec![run(1, iae), run(2, iae + 1.0), run(3, iae + 2.0)],
        };
        Outcome {
            name: "t".to_owned(),
            text: "Two & two".to_owned(),
            loops: vec!["flow".to_owned()],
            units: vec![("m³/h".to_owned(), "V".to_owned())],
            variants: vec![
                variant("pid", 1.0, 5.0),
                variant("plus", 1.0, 4.0),
                variant("pid", 2.0, 7.0),
                variant("plus", 2.0, 6.0),
            ],
            duration_s: 50.0,
        }
    }

    #[test]
    fn numbers_have_four_digits_that_count() {
        for (value, text) in [
            (0.0, "0"),
            (1.0, "1"),
            (123_456.0, "123456"),
            (12.3456, "12.35"),
            (0.012_34, "0.01234"),
            (-2.5, "-2.5"),
            (1e-9, "1.000e-9"),
            (1e9, "1.000e9"),
        ] {
            assert_eq!(number(value), text);
        }
    }

    #[test]
    fn tables_hold_every_run_and_quote_what_must_be_quoted() {
        let text = csv(&outcome());
        assert_eq!(text.lines().count(), 1 + 12);
        assert!(text.starts_with("case,\"gain, K\",seed,loop,iae,"), "{text}");
        assert!(text.contains("\nplus,2,3,flow,8,"), "{text}");
        assert_eq!(curves(&outcome()).lines().count(), 1 + 4 * 50);
    }

    #[test]
    fn a_report_is_whole_by_itself_and_the_same_every_time() {
        let folder = tempfile::tempdir().unwrap();
        let files = write(&outcome(), folder.path()).unwrap();
        let page = fs::read_to_string(&files.html).unwrap();
        assert!(page.starts_with("<!doctype html>") && page.trim_end().ends_with("</html>"));
        for part in [
            "Two &amp; two",
            "<svg",
            "a &lt;b&gt; is killed",
            "prefers-color-scheme",
            "@media print",
            "IAE",
            "m³/h s",
        ] {
            assert!(page.contains(part), "{part} is missing");
        }
        for never in ["http://", "https://", "<script src", "NaN"] {
            assert!(
                !page.replace("http://www.w3.org/2000/svg", "").contains(never),
                "{never}"
            );
        }
        assert_eq!(html(&outcome()).unwrap(), page);
        let json: serde_json::Value = serde_json::from_str(&fs::read_to_string(&files.json).unwrap()).unwrap();
        assert_eq!(json["variants"][0]["loops"]["flow"]["iae"]["mean"], 6.0);
        assert_eq!(outcome().winner("iae", None).unwrap().title(), "plus");
    }
}
