//! A trial as curves: in the terminal, and as an SVG file.
//!
//! Above, the setpoint and the measurement; below, each output as it was recorded and as the candidate would have had it.
//! Never: asks the API, or reads a font; whoever shows the file lays out its text.

use std::{fs, path::Path};

use bumpless_api::types::{CurvePoint, Trial};
use plotters::{prelude::*, style::Color as _};
use ratatui::{
    buffer::Buffer,
    layout::{Constraint, Rect},
    style::{Color, Style},
    symbols::Marker,
    widgets::{Axis, Block, Chart, Dataset, GraphType, Widget as _},
};

use crate::{error::Error, show};

/// Size of the picture, in px.
const WIDTH: u32 = 1000;
const TREND_HEIGHT: u32 = 340;
const OUTPUT_HEIGHT: u32 = 240;

/// Lines of a chart in the terminal, and its columns where the terminal does not say.
const LINES: u16 = 12;
const COLUMNS: u16 = 100;

/// One line of a chart.
struct Line {
    name: &'static str,
    ink: (u8, u8, u8),
    color: Color,
    points: Vec<(f64, f64)>,
}

/// One chart.
struct Panel {
    title: String,
    lines: [Line; 2],
}

fn series(trial: &Trial, value: impl Fn(&CurvePoint) -> Option<f64>) -> Vec<(f64, f64)> {
    let start = trial.points.first().map_or(0, |point| point.at_unix_us);
    let seconds = |point: &CurvePoint| point.at_unix_us.saturating_sub(start) as f64 * 1e-6;
    trial
        .points
        .iter()
        .filter_map(|point| Some((seconds(point), value(point)?)))
        .collect()
}

fn titled(name: &str, unit: &str) -> String {
    if unit.is_empty() {
        name.to_owned()
    } else {
        format!("{name}, {unit}")
    }
}

/// The charts of a trial, at least two.
fn panels(trial: &Trial) -> Vec<Panel> {
    let measured = trial.measured_port.as_deref().unwrap_or("measured");
    let mut panels = vec![Panel {
        title: titled(measured, &trial.measured_unit),
        lines: [
            Line {
                name: "setpoint",
                ink: (140, 140, 140),
                color: Color::DarkGray,
                points: series(trial, |point| point.setpoint),
            },
            Line {
                name: "measured",
                ink: (20, 130, 60),
                color: Color::Green,
                points: series(trial, |point| point.measurement),
            },
        ],
    }];
    panels.extend(trial.outputs.iter().enumerate().map(|(i, output)| Panel {
        title: titled(&output.port, &output.unit),
        lines: [
            Line {
                name: "recorded",
                ink: (30, 80, 190),
                color: Color::Cyan,
                points: series(trial, |point| point.recorded.get(i).copied().flatten()),
            },
            Line {
                name: "candidate",
                ink: (215, 110, 0),
                color: Color::Yellow,
                points: series(trial, |point| point.candidate.get(i).copied().flatten()),
            },
        ],
    }));
    panels
}

/// Bounds with a little air, never empty.
fn bounds(values: impl Iterator<Item = f64>) -> [f64; 2] {
    let (low, high) = values
        .filter(|value| value.is_finite())
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| {
            (low.min(value), high.max(value))
        });
    if !low.is_finite() {
        return [0.0, 1.0];
    }
    let air = ((high - low) * 0.05).max(high.abs() * 0.01).max(1e-6);
    [low - air, high + air]
}

impl Panel {
    fn times(&self) -> [f64; 2] {
        let last = self
            .lines
            .iter()
            .filter_map(|line| line.points.last())
            .map(|point| point.0);
        [0.0, last.fold(0.001, f64::max)]
    }

    fn values(&self) -> [f64; 2] {
        bounds(self.lines.iter().flat_map(|line| &line.points).map(|point| point.1))
    }
}

/// Prints the charts. Colours are the terminal's own.
pub(crate) fn draw(trial: &Trial) -> Result<(), Error> {
    let columns = ratatui::crossterm::terminal::size().map_or(COLUMNS, |(columns, _)| columns.clamp(40, 200));
    panels(trial).iter().try_for_each(|panel| {
        let picture = picture(panel, columns);
        for y in 0..picture.area.height {
            show::line(&row(&picture, y))?;
        }
        Ok(())
    })
}

fn picture(panel: &Panel, columns: u16) -> Buffer {
    let dataset = |line| {
        let Line {
            name, color, points, ..
        }: &Line = line;
        Dataset::default()
            .name(*name)
            .marker(Marker::Braille)
            .graph_type(GraphType::Line)
            .style(Style::new().fg(*color))
            .data(points)
    };
    let (times, values) = (panel.times(), panel.values());
    let [low, high] = values;
    let chart = Chart::new(panel.lines.iter().map(dataset).collect())
        // Half of the chart may be legend: it is small, and without it the colours say nothing.
        .hidden_legend_constraints((Constraint::Ratio(1, 2), Constraint::Ratio(1, 2)))
        .block(Block::bordered().title(format!(" {} ", panel.title)))
        .x_axis(
            Axis::default()
                .bounds(times)
                .labels(["0 s".to_owned(), format!("{} s", show::number(times[1]))]),
        )
        .y_axis(
            Axis::default()
                .bounds(values)
                .labels([show::number(low), show::number(high)]),
        );
    let mut buffer = Buffer::empty(Rect::new(0, 0, columns, LINES));
    chart.render(buffer.area, &mut buffer);
    buffer
}

/// A line of a picture with its colours.
fn row(picture: &Buffer, y: u16) -> String {
    let (mut text, mut now) = (String::new(), 39);
    for x in 0..picture.area.width {
        let Some(cell) = picture.cell((x, y)) else { continue };
        let code = match cell.fg {
            Color::Green => 32,
            Color::Yellow => 33,
            Color::Cyan => 36,
            Color::DarkGray => 90,
            _ => 39,
        };
        if code != now {
            text.push_str(&format!("\u{1b}[{code}m"));
            now = code;
        }
        text.push_str(cell.symbol());
    }
    if now != 39 {
        text.push_str("\u{1b}[39m");
    }
    text
}

/// Writes the charts to a file.
pub(crate) fn write_svg(trial: &Trial, file: &Path) -> Result<(), Error> {
    let text = svg(trial).map_err(|source| Error::Failed {
        what: "drawing the curves",
        source,
    })?;
    fs::write(file, text).map_err(|source| Error::File {
        path: file.to_owned(),
        action: "written",
        source,
    })
}

fn svg(trial: &Trial) -> Result<String, Box<dyn std::error::Error + Send + Sync>> {
    let panels = panels(trial);
    let outputs = u32::try_from(panels.len().saturating_sub(1)).unwrap_or(u32::MAX);
    let height = TREND_HEIGHT.saturating_add(OUTPUT_HEIGHT.saturating_mul(outputs));
    let mut text = String::new();
    {
        let root = SVGBackend::with_string(&mut text, (WIDTH, height)).into_drawing_area();
        root.fill(&WHITE)?;
        let verdict = trial.verdict.map_or("", |verdict| verdict.name());
        let mut rest = root.titled(
            &format!("{} on {}: {verdict}", trial.component, trial.loop_name),
            ("sans-serif", 18),
        )?;
        for panel in &panels {
            let (area, below) = if panel.lines.iter().any(|line| line.name == "setpoint") {
                rest.split_vertically(TREND_HEIGHT - 40)
            } else {
                rest.split_vertically(OUTPUT_HEIGHT)
            };
            rest = below;
            let ([from, to], [low, high]) = (panel.times(), panel.values());
            let mut chart = ChartBuilder::on(&area)
                .margin(10)
                .x_label_area_size(34)
                .y_label_area_size(64)
                .build_cartesian_2d(from..to, low..high)?;
            chart
                .configure_mesh()
                .x_desc("s")
                .y_desc(panel.title.as_str())
                .light_line_style(RGBColor(240, 240, 240))
                .draw()?;
            for line in &panel.lines {
                let (r, g, b) = line.ink;
                let ink = RGBColor(r, g, b);
                chart
                    .draw_series(LineSeries::new(line.points.iter().copied(), &ink))?
                    .label(line.name)
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

    use serde_json::json;

    use super::*;

    fn trial(points: usize) -> Trial {
        let point = |i: usize| {
            json!({
                "at_unix_us": 1_000_000 + i * 100_000, "setpoint": 1.0, "measurement": if i == 3 { None } else { Some(0.5) },
                "recorded": [i as f64], "candidate": [i as f64 * 2.0],
            })
        };
        serde_json::from_value(json!({
            "loop": "pressure", "component": "pid@1.0.0", "digest": "", "parameters": {}, "dropped_parameters": [],
            "dropped_ports": [], "verdict": "differs", "reason": "", "taken_over_by": "migrate", "anchored_anew": 0,
            "from_unix_us": 0, "to_unix_us": 0, "cycles": points, "compared": points, "equal": 0, "held": 0, "faults": 0,
            "first_fault": null, "skipped": [], "bump_percent": 0.0, "bump_limit_percent": 5.0,
            "outputs": [{"port": "out", "unit": "V", "span": 10.0, "max_percent": 1.0, "max_term": 1, "max_seq": 2,
                "mean_percent": 1.0, "rms_percent": 1.0, "recorded_travel": 1.0, "candidate_travel": 2.0}],
            "steps": {"p50_us": 1.0, "p99_us": 2.0, "worst_us": 3.0},
            "indices": {"duration_s": 1.0, "ie": 0.0, "iae": 0.0, "ise": 0.0, "itae": 0.0, "id_percent": null},
            "measured_port": "pv", "measured_unit": "bar", "cycles_per_point": 1,
            "points": (0..points).map(point).collect::<Vec<_>>(), "unread": 0, "stopped_early": null,
        }))
        .unwrap()
    }

    #[test]
    fn a_file_has_all_four_curves() {
        let text = svg(&trial(50)).unwrap();
        assert!(text.starts_with("<svg") && text.trim_end().ends_with("</svg>"));
        for part in [
            "setpoint",
            "measured",
            "recorded",
            "candidate",
            "pv, bar",
            "out, V",
            "pid@1.0.0 on pressure: differs",
        ] {
            assert!(text.contains(part), "{part} is missing");
        }
        // A value that is missing is no point of its curve.
        let lines: Vec<usize> = text
            .split("<polyline")
            .skip(1)
            .map(|line| line.matches(',').count())
            .collect();
        assert!(lines.contains(&50) && lines.contains(&49), "{lines:?}");
    }

    #[test]
    fn a_terminal_shows_them_in_colours() {
        let all = panels(&trial(50));
        let text: String = all
            .iter()
            .flat_map(|panel| {
                let picture = picture(panel, 80);
                (0..LINES).map(|y| row(&picture, y) + "\n").collect::<Vec<_>>()
            })
            .collect();
        for part in [
            "pv, bar",
            "out, V",
            "setpoint",
            "candidate",
            "\u{1b}[32m",
            "\u{1b}[33m",
            "\u{1b}[36m",
            "4.9 s",
        ] {
            assert!(text.contains(part), "{part:?} is not in\n{text}");
        }
    }

    #[test]
    fn nothing_to_draw_is_no_failure() {
        for points in [0, 1] {
            assert!(svg(&trial(points)).is_ok());
            panels(&trial(points)).iter().for_each(|panel| drop(picture(panel, 40)));
        }
        assert_eq!(bounds([f64::NAN].into_iter()), [0.0, 1.0]);
    }
}
