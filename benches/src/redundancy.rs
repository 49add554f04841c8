//! `redundancy`: replicas go and come while a loop steps, as a picture; and the error against an undisturbed run.
//!
//! ```text
//! four replicas ─30 s─► 3 ─► 2 ─► 1 ─► 2 ─► 3 ─► 4 ─► 3 ─► 4      off: kill -9; on: a new start
//! ```
//! The same course of the setpoint runs twice in one cell, first undisturbed. Never: draws what was not measured; the number
//! of replicas is that of the hosts that stepped within a second.

use std::{path::Path, time::Duration};

use bumpless_tests::{Cell, CellOptions};
use plotters::prelude::*;
use serde_json::json;

use crate::{
    Options, actuator,
    error::Error,
    history::{History, Seen, iae},
    report::{Bound, Report},
    stall::Watch,
};

const LOOP: &str = "level";
const CONTROLLERS: usize = 4;
/// Which hosts go (−) and come (+), one change after the other.
const CHANGES: [(&str, bool); 8] = [
    ("d", false),
    ("c", false),
    ("b", false),
    ("b", true),
    ("c", true),
    ("d", true),
    ("a", false),
    ("a", true),
];
/// Setpoint of each part, in % of span: the first before any change, then one after each.
const SETPOINTS: [f64; 9] = [60.0, 60.0, 45.0, 45.0, 65.0, 65.0, 50.0, 50.0, 60.0];
/// Setpoint before and after, to which the loop settles.
const REST: f64 = 40.0;
/// Within how much of the setpoint the loop is at rest, in % of span.
const AT_REST: f64 = 0.02;
/// Records at rest before a run begins.
const REST_RECORDS: usize = 50;
/// Period of the loop, in ms.
const PERIOD_MS: u64 = 100;
/// From a setpoint to the change of replicas.
const INTO_THE_STEP: Duration = Duration::from_secs(1);

/// Runs the bench.
pub(crate) fn run(options: Options, svg: &Path, report: &mut Report) -> Result<(), Error> {
    let part = Duration::from_secs(options.count(30, 5));
    report.progress(&format!(
        "a loop on four replicas; eight changes, one every {} s",
        part.as_secs()
    ));
    let fopdt = "{ count = 1, gain = 1.0, tau_s = 1.0, dead_time_s = 0.2, noise = 0.0 }";
    let mut cell = Cell::start(CellOptions::first_order(fopdt).controllers(CONTROLLERS))?;
    let api = cell.plant.api();
    api.upload_stock(&["pidplus"])?;
    api.apply(&json!({
        "name": LOOP,
        "component": "pidplus",
        "period_ms": PERIOD_MS,
        "ports": { "pv": "plant.0.pv", "out": "plant.0.out" },
        "parameters": { "k": 1.2, "ti": 1.0 },
        "setpoint": REST,
        "strategy": "round-robin",
        "replicas": CONTROLLERS,
    }))?;
    let history = History::follow(&api, &[LOOP])?;
    for host in ["a", "b", "c", "d"] {
        history.wait_steps(&[LOOP], host, 0)?;
    }
    let watch = Watch::start();
    report.progress("undisturbed");
    let without = course(&mut cell, &history, part, false)?;
    report.progress("with changes");
    let with = course(&mut cell, &history, part, true)?;
    std::thread::sleep(Duration::from_millis(500));
    let stalls = watch.finish();
    let journal = cell.journal()?;

    let (iae_without, iae_with) = (iae(&without), iae(&with));
    report.told("redundancy.changes", CHANGES.len() as f64, "changes");
    report.told("redundancy.iae_undisturbed", iae_without, "%·s");
    report.told("redundancy.iae", iae_with, "%·s");
    let change = 100.0 * (iae_with - iae_without).abs() / iae_without;
    report.figure("redundancy.iae_change", change, "%", Bound::AtMost(0.5));
    // The experiment that this follows found so much between one controller and its replicas.
    report.told("redundancy.iae_change_there", 8.7, "%");
    let missing = |records: &[Seen]| -> u64 {
        let pairs = records.iter().zip(records.iter().skip(1));
        pairs.map(|(a, b)| b.seq.saturating_sub(a.seq).saturating_sub(1)).sum()
    };
    report.told("redundancy.cycles", with.len() as f64, "cycles");
    report.told("redundancy.cycles_missing_raw", missing(&with) as f64, "cycles");
    let hosts = replicas(&with);
    let least = hosts.iter().map(|(_, n)| *n).fold(f64::NAN, f64::min);
    let most = hosts.iter().map(|(_, n)| *n).fold(f64::NAN, f64::max);
    report.figure("redundancy.replicas_least", least, "replicas", Bound::AtMost(1.0));
    report.figure("redundancy.replicas_most", most, "replicas", Bound::AtLeast(4.0));
    actuator::tell_writers(report, "redundancy", &journal);
    stalls.tell(report, "redundancy");
    if let Some(folder) = svg.parent() {
        std::fs::create_dir_all(folder).map_err(Error::io(format!("{} cannot be made", folder.display())))?;
    }
    let text = picture(&with, &hosts).map_err(|error| Error::Picture(error.to_string()))?;
    std::fs::write(svg, text).map_err(Error::io(format!("{} cannot be written", svg.display())))?;
    report.progress(&format!("the picture is {}", svg.display()));
    Ok(())
}

/// Waits until the loop is at rest, runs the course of the setpoint, and gives its records.
fn course(cell: &mut Cell, history: &History, part: Duration, changes: bool) -> Result<Vec<Seen>, Error> {
    let api = cell.plant.api();
    api.setpoint(LOOP, REST)?;
    let place = history.place();
    let at_rest = std::cell::Cell::new(0);
    history.wait("the loop at rest", place, |record| {
        let is = (record.measurement - REST).abs() < AT_REST && record.setpoint == REST;
        at_rest.set(if is { at_rest.get() + 1 } else { 0 });
        at_rest.get() >= REST_RECORDS
    })?;
    let part_cycles = u64::try_from(part.as_millis()).unwrap_or(0) / PERIOD_MS;
    let from = history.last(LOOP).map_or(0, |record| record.seq);
    for (number, setpoint) in (0_u64..).zip(SETPOINTS) {
        // A fixed number of cycles from the beginning, whatever the change before took.
        let wanted = from + 1 + number * part_cycles;
        history.wait("the cycle of a setpoint", place, |record| record.seq >= wanted)?;
        api.setpoint(LOOP, setpoint)?;
        let change = usize::try_from(number)
            .ok()
            .and_then(|n| CHANGES.get(n.checked_sub(1)?));
        if let Some((host, on)) = change.filter(|_| changes) {
            // While the measurement is on its way.
            std::thread::sleep(INTO_THE_STEP);
            if *on {
                cell.restart(host)?;
            } else {
                cell.host(host)?.kill9();
            }
        }
    }
    let to = from + 1 + SETPOINTS.len() as u64 * part_cycles;
    history.wait("the last cycle", place, |record| record.seq >= to)?;
    let records = history.since(place);
    Ok(records
        .into_iter()
        .filter(|record| record.seq > from && record.seq <= to)
        .collect())
}

/// How many hosts stepped within the second before each record; time in s.
fn replicas(records: &[Seen]) -> Vec<(f64, f64)> {
    let start_ns = records.first().map_or(0, |record| record.at_ns);
    let count = |(place, record): (usize, &Seen)| {
        let second = records.iter().take(place + 1).rev();
        let mut hosts: Vec<&str> = second
            .take_while(|r| r.at_ns + 1_000_000_000 > record.at_ns)
            .map(|r| r.stepped_by.as_str())
            .collect();
        hosts.sort_unstable();
        hosts.dedup();
        ((record.at_ns - start_ns) as f64 / 1e9, hosts.len() as f64)
    };
    // In the first second not all have had their turn yet.
    records.iter().enumerate().skip(10).map(count).collect()
}

type Line = (&'static str, RGBColor, Vec<(f64, f64)>);

/// Setpoint and measurement above, replicas below.
fn picture(records: &[Seen], replicas: &[(f64, f64)]) -> Result<String, Box<dyn std::error::Error + Send + Sync>> {
    let start_ns = records.first().map_or(0, |record| record.at_ns);
    let line = |value: fn(&Seen) -> f64| -> Vec<(f64, f64)> {
        let point = |record: &Seen| ((record.at_ns - start_ns) as f64 / 1e9, value(record));
        records
            .iter()
            .map(point)
            .filter(|(_, value)| value.is_finite())
            .collect()
    };
    let end_s = records
        .last()
        .map_or(1.0, |record| (record.at_ns - start_ns) as f64 / 1e9)
        .max(1.0);
    let above: [Line; 2] = [
        ("setpoint", RGBColor(140, 140, 140), line(|record| record.setpoint)),
        ("measurement", RGBColor(20, 130, 60), line(|record| record.measurement)),
    ];
    let below: [Line; 1] = [("replicas that step", RGBColor(30, 80, 190), replicas.to_vec())];
    let mut text = String::new();
    {
        let root = SVGBackend::with_string(&mut text, (1000, 520)).into_drawing_area();
        root.fill(&WHITE)?;
        let titled = root.titled(
            "Replicas killed and started again while a loop steps",
            ("sans-serif", 18),
        )?;
        let (upper, lower) = titled.split_vertically(320);
        let panels: [(_, &[Line], &str, std::ops::Range<f64>); 2] = [
            (&upper, &above, "% of span", 35.0..70.0),
            (&lower, &below, "replicas", 0.0..5.0),
        ];
        for (area, lines, unit, values) in panels {
            let mut chart = ChartBuilder::on(area)
                .margin(10)
                .x_label_area_size(34)
                .y_label_area_size(54)
                .build_cartesian_2d(0.0..end_s, values)?;
            chart
                .configure_mesh()
                .x_desc("s")
                .y_desc(unit)
                .light_line_style(RGBColor(240, 240, 240))
                .draw()?;
            for (name, ink, points) in lines {
                let ink = *ink;
                chart
                    .draw_series(LineSeries::new(points.iter().copied(), &ink))?
                    .label(*name)
                    .legend(move |(x, y)| PathElement::new(vec![(x, y), (x + 18, y)], ink));
            }
            chart
                .configure_series_labels()
                .background_style(WHITE.mix(0.8))
                .border_style(RGBColor(200, 200, 200))
                .position(SeriesLabelPosition::UpperRight)
                .draw()?;
        }
        root.present()?;
    }
    Ok(text)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    fn record(n: u64, by: &str) -> Seen {
        Seen {
            loop_name: LOOP.to_owned(),
            seq: n,
            owner: "a".to_owned(),
            stepped_by: by.to_owned(),
            setpoint: 50.0,
            measurement: if n == 3 { f64::NAN } else { 49.0 },
            ..Seen::of_cycle(n * 100_000_000)
        }
    }

    #[test]
    fn replicas_are_those_that_stepped_within_a_second() {
        let records: Vec<Seen> = (0..30)
            .map(|n| record(n, if n < 15 { ["a", "b"][n as usize % 2] } else { "a" }))
            .collect();
        let counts: Vec<f64> = replicas(&records).iter().map(|(_, n)| *n).collect();
        assert_eq!(counts.len(), 20);
        assert_eq!((counts[0], counts[12], counts[13], counts[19]), (2.0, 2.0, 1.0, 1.0));
    }

    #[test]
    fn the_picture_has_all_curves_and_the_course_comes_back() {
        let records: Vec<Seen> = (0..30).map(|n| record(n, "a")).collect();
        let text = picture(&records, &replicas(&records)).unwrap();
        for part in ["<svg", "setpoint", "measurement", "replicas that step", "</svg>"] {
            assert!(text.contains(part), "{part}");
        }
        assert!(picture(&[], &[]).is_ok(), "nothing to draw is no failure");
        let on = CHANGES.iter().fold(0_i32, |n, (_, on)| n + if *on { 1 } else { -1 });
        assert_eq!((on, SETPOINTS.len()), (0, CHANGES.len() + 1));
    }
}
