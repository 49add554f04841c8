//! The page: what was asked, the table, the curves of the first seed, the spread over seeds, the sweeps.
//!
//! Never: a figure without its unit.

use std::fmt::Write as _;

use super::{
    chart::{self, Boxed, Curve},
    interval, number, style, sweep_titles, told,
};
use crate::{
    error::Error,
    meter::Figure,
    result::{Outcome, VariantResult},
};

/// Figures that are drawn as boxes and sweeps, where a loop has them.
const DRAWN: [&str; 5] = ["iae", "itae", "overshoot", "tv", "delay"];
/// Sweep points whose curves are shown; the others are in the file of curves.
const CURVES_MAX: usize = 6;

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
}

/// A figure's unit with the loop's own units in it.
pub(crate) fn unit(figure: &Figure, units: &(String, String)) -> String {
    let one = |name: &str, own: &str, power: &str| -> String {
        if own.is_empty() {
            name.to_owned()
        } else if own.contains('/') && !power.is_empty() {
            format!("({own}){power}")
        } else {
            format!("{own}{power}")
        }
    };
    match figure.unit {
        "u" => one("", &units.0, ""),
        "u s" => format!("{} s", one("", &units.0, "")).trim().to_owned(),
        "u s²" => format!("{} s²", one("", &units.0, "")).trim().to_owned(),
        "u² s" => format!("{} s", one("", &units.0, "²")).trim().to_owned(),
        "u² s²" => format!("{} s²", one("", &units.0, "²")).trim().to_owned(),
        "o" => one("", &units.1, ""),
        "o² s" => format!("{} s", one("", &units.1, "²")).trim().to_owned(),
        other => other.to_owned(),
    }
}

/// Cases by first appearance, for their inks.
fn cases(outcome: &Outcome) -> Vec<&str> {
    let mut cases: Vec<&str> = Vec::new();
    for v in &outcome.variants {
        if !cases.contains(&v.case.as_str()) {
            cases.push(&v.case);
        }
    }
    cases
}

/// The points of the sweeps, each with its variants in the order of cases.
fn points(outcome: &Outcome) -> Vec<(String, Vec<&VariantResult>)> {
    let mut points: Vec<(String, Vec<&VariantResult>)> = Vec::new();
    for v in &outcome.variants {
        let label: Vec<String> = v.at.iter().map(|s| format!("{} = {}", s.title, s.label)).collect();
        let label = label.join(", ");
        match points.iter_mut().find(|(l, _)| *l == label) {
            Some((_, list)) => list.push(v),
            None => points.push((label, vec![v])),
        }
    }
    points
}

/// The page.
///
/// # Errors
/// [`Error::Picture`].
pub fn html(outcome: &Outcome) -> Result<String, Error> {
    let cases = cases(outcome);
    let seeds = outcome.variants.first().map_or(0, |v| v.runs.len());
    let mut page = format!(
        "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n<meta name=\"viewport\" \
         content=\"width=device-width, initial-scale=1\">\n<title>{name}</title>\n<style>\n{sheet}\n</style>\n</head>\n<body>\n\
         <h1>{name}</h1>\n<p>{text}</p>\n<p class=\"soft\">{count} runs of {duration} s: {case_count} {case_word}{points}, {seeds} \
         {seed_word} each.</p>\n",
        name = escaped(&outcome.name),
        sheet = style::sheet(),
        text = escaped(&outcome.text),
        count = outcome.variants.iter().map(|v| v.runs.len()).sum::<usize>(),
        duration = number(outcome.duration_s),
        case_count = cases.len(),
        case_word = if cases.len() == 1 { "case" } else { "cases" },
        points = match points(outcome).len() {
            1 => String::new(),
            n => format!(" at {n} points of the sweep"),
        },
        seed_word = if seeds == 1 { "seed" } else { "seeds" },
    );
    for (n, name) in outcome.loops.iter().enumerate() {
        let heading = if outcome.loops.len() == 1 {
            "Figures".to_owned()
        } else {
            format!("Figures of {name}")
        };
        let _infallible = writeln!(page, "<section><h2>{}</h2>", escaped(&heading));
        table(&mut page, outcome, n);
        page.push_str("</section>\n");
    }
    sweeps(&mut page, outcome, &cases)?;
    for (label, variants) in points(outcome).iter().take(CURVES_MAX) {
        curves(&mut page, outcome, label, variants, &cases)?;
    }
    spread(&mut page, outcome, &cases)?;
    page.push_str(
        "<footer>Made by the lab of Bumpless: the components and the cycle of a live host in virtual time. Intervals are 95 % \
         confidence of the mean over seeds; curves are those of the first seed. The tables beside this page (CSV, JSON) hold \
         every run.</footer>\n</body>\n</html>\n",
    );
    Ok(page)
}

/// Figures of which the least is the best; the others only tell.
const JUDGED: [&str; 11] = [
    "iae",
    "ise",
    "itae",
    "itse",
    "mae",
    "id",
    "overshoot",
    "settling",
    "tv",
    "cycles-lost",
    "gap",
];
/// With more variants than this they are the rows of the table, and only these figures its columns.
const COLUMNS_MAX: usize = 4;
const COLUMNS: [&str; 13] = [
    "iae",
    "ise",
    "itae",
    "itse",
    "id",
    "mae",
    "overshoot",
    "settling",
    "tv",
    "delay",
    "messages-lost",
    "cycles-lost",
    "bump",
];

/// One figure's cell; the best of those at the same point of the sweeps is marked.
fn cell(page: &mut String, outcome: &Outcome, v: &VariantResult, loop_number: usize, figure: &Figure) {
    let Some(summary) = v.summary(loop_number, figure.key) else {
        page.push_str("<td class=\"soft\">–</td>");
        return;
    };
    let beside: Vec<f64> = outcome
        .variants
        .iter()
        .filter(|other| other.at == v.at)
        .filter_map(|other| other.summary(loop_number, figure.key).map(|s| s.mean))
        .collect();
    let least = beside.iter().copied().fold(f64::INFINITY, f64::min);
    let most = beside.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    // A tenth of a percent is no victory.
    let best = JUDGED.contains(&figure.key) && most - least > 1e-3 * most.abs() && summary.mean <= least;
    let class = if best { " class=\"best\"" } else { "" };
    let _infallible = write!(page, "<td{class}>{}</td>", interval(&summary));
}

fn table(page: &mut String, outcome: &Outcome, loop_number: usize) {
    let empty = (String::new(), String::new());
    let units = outcome.units.get(loop_number).unwrap_or(&empty);
    let head = |figure: &Figure| {
        let unit = unit(figure, units);
        let unit = if unit.is_empty() {
            String::new()
        } else {
            format!(" <span class=\"soft\">{}</span>", escaped(&unit))
        };
        format!(
            "<span title=\"{}\">{}{unit}</span>",
            escaped(figure.text),
            escaped(figure.name)
        )
    };
    let figures = told(outcome, loop_number);
    if outcome.variants.len() > COLUMNS_MAX {
        let figures: Vec<_> = figures.into_iter().filter(|f| COLUMNS.contains(&f.key)).collect();
        page.push_str("<table><thead><tr><th>case</th>");
        for figure in &figures {
            let _infallible = write!(page, "<th>{}</th>", head(figure));
        }
        page.push_str("</tr></thead><tbody>\n");
        for v in &outcome.variants {
            let _infallible = write!(page, "<tr><td>{}</td>", escaped(&v.title()));
            for figure in &figures {
                cell(page, outcome, v, loop_number, figure);
            }
            page.push_str("</tr>\n");
        }
    } else {
        page.push_str("<table><thead><tr><th>figure</th>");
        for v in &outcome.variants {
            let _infallible = write!(page, "<th>{}</th>", escaped(&v.title()));
        }
        page.push_str("</tr></thead><tbody>\n");
        for figure in figures {
            let _infallible = write!(page, "<tr><td>{}</td>", head(figure));
            for v in &outcome.variants {
                cell(page, outcome, v, loop_number, figure);
            }
            page.push_str("</tr>\n");
        }
    }
    page.push_str("</tbody></table>\n");
    for v in &outcome.variants {
        for run in v.runs.iter().filter(|r| r.failed.is_some()) {
            let why = run.failed.as_deref().unwrap_or_default();
            let _infallible = writeln!(
                page,
                "<p>Seed {} of {} failed: {}</p>",
                run.seed,
                escaped(&v.title()),
                escaped(why)
            );
        }
    }
}

fn key(page: &mut String, names: &[(usize, &str)], setpoint: bool, events: bool) {
    page.push_str("<p>");
    for (n, name) in names {
        let _infallible = write!(
            page,
            "<span class=\"key\"><i class=\"c{}\"></i>{}</span>",
            n % style::INKS.len(),
            escaped(name)
        );
    }
    if setpoint {
        page.push_str("<span class=\"key\"><i class=\"wanted\"></i>setpoint</span>");
    }
    if events {
        page.push_str("<span class=\"key\"><i class=\"event\"></i>event</span>");
    }
    page.push_str("</p>\n");
}

fn curves(
    page: &mut String,
    outcome: &Outcome,
    label: &str,
    variants: &[&VariantResult],
    cases: &[&str],
) -> Result<(), Error> {
    let place = |v: &VariantResult| cases.iter().position(|c| *c == v.case).unwrap_or(0);
    for (n, name) in outcome.loops.iter().enumerate() {
        let traced: Vec<(usize, &VariantResult)> = variants
            .iter()
            .filter(|v| {
                v.runs
                    .first()
                    .and_then(|r| r.loops.get(n))
                    .is_some_and(|l| !l.trace.is_empty())
            })
            .map(|v| (place(v), *v))
            .collect();
        let Some((_, first)) = traced.first() else { continue };
        let trace = |v: &'_ VariantResult| {
            v.runs
                .first()
                .and_then(|r| r.loops.get(n))
                .map(|l| l.trace.clone())
                .unwrap_or_default()
        };
        let empty = (String::new(), String::new());
        let (pv_unit, out_unit) = outcome.units.get(n).unwrap_or(&empty);
        let title = match (outcome.loops.len(), label.is_empty()) {
            (1, true) => "Curves".to_owned(),
            (1, false) => label.to_owned(),
            (_, true) => name.clone(),
            (_, false) => format!("{name}, {label}"),
        };
        let _infallible = writeln!(page, "<section><h2>{}</h2>", escaped(&title));
        let names: Vec<(usize, &str)> = traced.iter().map(|(p, v)| (*p, v.case.as_str())).collect();
        let notes = first.runs.first().map_or(&[][..], |r| &r.notes);
        key(page, &names, true, !notes.is_empty());
        let events: Vec<f64> = notes.iter().map(|note| note.at_s).collect();
        let mut above = vec![Curve {
            ink: chart::wanted(),
            points: trace(first).iter().map(|r| (r.t_s, r.setpoint)).collect(),
            held: true,
            thick: 2,
        }];
        let mut below = Vec::new();
        for (place, v) in &traced {
            let rows = trace(v);
            above.push(Curve {
                ink: chart::ink(*place),
                points: rows.iter().map(|r| (r.t_s, r.truth)).collect(),
                held: false,
                thick: 2,
            });
            below.push(Curve {
                ink: chart::ink(*place),
                points: rows.iter().map(|r| (r.t_s, r.output)).collect(),
                held: true,
                thick: 1,
            });
        }
        let end_s = outcome.duration_s;
        page.push_str(&chart::trend("measurement", pv_unit, 300, &above, &events, end_s)?);
        page.push_str(&chart::trend("output", out_unit, 210, &below, &events, end_s)?);
        for (place, v) in &traced {
            let Some(run) = v.runs.first() else { continue };
            let rows: Vec<(f64, u8)> = trace(v).iter().filter(|r| r.by > 0).map(|r| (r.t_s, r.by)).collect();
            if run.hosts.len() > 2 && !rows.is_empty() {
                let _infallible = writeln!(page, "<h3>{}</h3>", escaped(&v.case));
                page.push_str(&chart::steppers(&run.hosts, &rows, chart::ink(*place), end_s)?);
            }
        }
        if !notes.is_empty() {
            page.push_str("<h3>What happened</h3><ul>\n");
            for note in notes.iter().take(40) {
                let _infallible = writeln!(page, "<li>{} s: {}</li>", number(note.at_s), escaped(&note.text));
            }
            page.push_str("</ul>\n");
        }
        page.push_str("</section>\n");
    }
    Ok(())
}

/// Box plots over seeds; only where there are some.
fn spread(page: &mut String, outcome: &Outcome, cases: &[&str]) -> Result<(), Error> {
    if outcome.variants.iter().all(|v| v.runs.len() < 3) {
        return Ok(());
    }
    for (n, name) in outcome.loops.iter().enumerate() {
        let empty = (String::new(), String::new());
        let units = outcome.units.get(n).unwrap_or(&empty);
        let title = if outcome.loops.len() == 1 {
            "Spread over seeds".to_owned()
        } else {
            format!("Spread over seeds: {name}")
        };
        let _infallible = writeln!(page, "<section><h2>{}</h2>", escaped(&title));
        for figure in told(outcome, n).into_iter().filter(|f| DRAWN.contains(&f.key)) {
            let all: Vec<Boxed<'_>> = outcome
                .variants
                .iter()
                .take(40)
                .map(|v| Boxed {
                    ink: chart::ink(cases.iter().position(|c| *c == v.case).unwrap_or(0)),
                    name: shortened(&v.title()),
                    values: v.values(n, figure.key),
                })
                .filter(|b| !b.values.is_empty())
                .collect();
            page.push_str(&chart::boxes(figure.name, &unit(figure, units), &all)?);
        }
        page.push_str("</section>\n");
    }
    Ok(())
}

fn shortened(text: &str) -> String {
    if text.chars().count() <= 26 {
        text.to_owned()
    } else {
        text.chars().take(25).chain(['…']).collect()
    }
}

/// A figure over what is swept; only with one sweep, for two make a table.
fn sweeps(page: &mut String, outcome: &Outcome, cases: &[&str]) -> Result<(), Error> {
    let titles = sweep_titles(outcome);
    let [along] = titles[..] else { return Ok(()) };
    let of_case = |case: &str| outcome.variants.iter().filter(|v| v.case == case).collect::<Vec<_>>();
    let Some(first) = cases.first() else { return Ok(()) };
    let settings: Vec<_> = of_case(first).iter().filter_map(|v| v.at.first()).collect();
    if settings.len() < 2 {
        return Ok(());
    }
    let labels: Vec<String> = settings.iter().map(|s| s.label.clone()).collect();
    let numbers: Option<Vec<f64>> = settings.iter().map(|s| s.number).collect();
    for (n, name) in outcome.loops.iter().enumerate() {
        let empty = (String::new(), String::new());
        let units = outcome.units.get(n).unwrap_or(&empty);
        let title = if outcome.loops.len() == 1 {
            format!("Over {along}")
        } else {
            format!("{name} over {along}")
        };
        let _infallible = writeln!(page, "<section><h2>{}</h2>", escaped(&title));
        let names: Vec<(usize, &str)> = cases.iter().copied().enumerate().collect();
        key(page, &names, false, false);
        for figure in told(outcome, n).into_iter().filter(|f| DRAWN.contains(&f.key)) {
            let lines: Vec<_> = cases
                .iter()
                .enumerate()
                .map(|(c, case)| {
                    (
                        chart::ink(c),
                        of_case(case).iter().map(|v| v.summary(n, figure.key)).collect(),
                    )
                })
                .collect();
            page.push_str(&chart::sweep(
                figure.name,
                &unit(figure, units),
                along,
                &labels,
                numbers.as_deref(),
                &lines,
            )?);
        }
        page.push_str("</section>\n");
    }
    Ok(())
}
