//! The pictures of a report, as SVG: trends, who stepped, box plots, sweeps.
//!
//! Drawn with `plotters`; colours are the inks of `style`. Never: more points than a page can show; each column of pixels
//! keeps its least and greatest value.

use plotters::{
    coord::Shift,
    prelude::*,
    style::text_anchor::{HPos, Pos, VPos},
};

use super::style::{self, EVENT, Ink, LINE, PAPER, TEXT, WANTED};
use crate::{error::Error, result::Summary};

/// Size of pictures, in px.
const WIDTH: u32 = 1000;
/// Points of a line that are drawn: two per pixel.
const POINTS_MAX: usize = 1_600;

/// One line.
pub(crate) struct Curve<'a> {
    pub(crate) ink: &'a Ink,
    pub(crate) points: Vec<(f64, f64)>,
    /// Drawn as steps: the value holds until the next.
    pub(crate) held: bool,
    pub(crate) thick: u32,
}

/// Boxes of one figure: a name and its values.
pub(crate) struct Boxed<'a> {
    pub(crate) ink: &'a Ink,
    pub(crate) name: String,
    pub(crate) values: Vec<f64>,
}

fn color(ink: &Ink) -> RGBColor {
    RGBColor(ink.rgb.0, ink.rgb.1, ink.rgb.2)
}

fn words(size: u32) -> TextStyle<'static> {
    ("sans-serif", size).into_font().color(&color(&TEXT))
}

fn drawn<'a, E: std::error::Error + Send + Sync>(what: &'a str) -> impl Fn(DrawingAreaErrorKind<E>) -> Error + 'a {
    move |error| Error::Picture {
        what: what.to_owned(),
        problem: error.to_string(),
    }
}

/// Bounds with a little air, never empty.
pub(crate) fn bounds(values: impl Iterator<Item = f64>) -> (f64, f64) {
    let (low, high) = values
        .filter(|v| v.is_finite())
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
    if !low.is_finite() {
        return (0.0, 1.0);
    }
    let air = ((high - low) * 0.06).max(high.abs() * 0.01).max(1e-9);
    (low - air, high + air)
}

/// Fewer points: of each stretch the least and the greatest, in their order.
fn thinned(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let good: Vec<(f64, f64)> = points
        .iter()
        .copied()
        .filter(|(t, v)| t.is_finite() && v.is_finite())
        .collect();
    if good.len() <= POINTS_MAX {
        return good;
    }
    let size = good.len().div_ceil(POINTS_MAX / 2);
    let mut out = Vec::with_capacity(POINTS_MAX + 2);
    for piece in good.chunks(size) {
        let least = piece.iter().min_by(|a, b| a.1.total_cmp(&b.1));
        let most = piece.iter().max_by(|a, b| a.1.total_cmp(&b.1));
        if let (Some(a), Some(b)) = (least, most) {
            if a.0 <= b.0 {
                out.extend([*a, *b]);
            } else {
                out.extend([*b, *a]);
            }
        }
    }
    out
}

fn stairs(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let mut out: Vec<(f64, f64)> = Vec::with_capacity(points.len() * 2);
    for &(t, v) in points {
        if let Some(&(_, before)) = out.last()
            && before != v
        {
            out.push((t, before));
        }
        out.push((t, v));
    }
    out
}

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;

fn on_paper(height: u32, what: &str, draw: impl FnOnce(&Area<'_>) -> Result<(), Error>) -> Result<String, Error> {
    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, (WIDTH, height)).into_drawing_area();
        area.fill(&color(&PAPER)).map_err(drawn(what))?;
        draw(&area)?;
        area.present().map_err(drawn(what))?;
    }
    // A picture that fits its page, whatever that is wide.
    Ok(svg.replacen(&format!("width=\"{WIDTH}\" height=\"{height}\" "), "", 1))
}

/// Lines over time, with a mark at each event.
pub(crate) fn trend(
    title: &str,
    unit: &str,
    height: u32,
    curves: &[Curve<'_>],
    events: &[f64],
    end_s: f64,
) -> Result<String, Error> {
    on_paper(height, title, |area| {
        let (low, high) = bounds(curves.iter().flat_map(|c| c.points.iter().map(|p| p.1)));
        let mut chart = ChartBuilder::on(area)
            .margin_right(14)
            .margin_top(22)
            .x_label_area_size(34)
            .y_label_area_size(66)
            .build_cartesian_2d(0.0..end_s.max(1e-9), low..high)
            .map_err(drawn(title))?;
        chart
            .configure_mesh()
            .light_line_style(TRANSPARENT)
            .bold_line_style(color(&LINE))
            .axis_style(color(&LINE))
            .label_style(words(15))
            .x_labels(11)
            .x_label_formatter(&|t| super::number(*t))
            .y_labels(6)
            .y_label_formatter(&|v| super::number(*v))
            .draw()
            .map_err(drawn(title))?;
        for &at_s in events {
            let mark = vec![(at_s, low), (at_s, high)];
            chart
                .draw_series(std::iter::once(PathElement::new(mark, color(&EVENT).stroke_width(1))))
                .map_err(drawn(title))?;
        }
        for curve in curves {
            let points = if curve.held {
                thinned(&stairs(&curve.points))
            } else {
                thinned(&curve.points)
            };
            chart
                .draw_series(LineSeries::new(points, color(curve.ink).stroke_width(curve.thick)))
                .map_err(drawn(title))?;
        }
        heading(area, title, unit)
    })
}

fn heading(area: &Area<'_>, title: &str, unit: &str) -> Result<(), Error> {
    let text = if unit.is_empty() {
        title.to_owned()
    } else {
        format!("{title}, {unit}")
    };
    area.draw_text(&text, &words(16), (8, 2)).map_err(drawn(title))
}

/// Who stepped: one row per host, a mark where it did.
pub(crate) fn steppers(hosts: &[String], rows: &[(f64, u8)], ink: &Ink, end_s: f64) -> Result<String, Error> {
    let title = "who stepped";
    let seen: Vec<u8> = (0..hosts.len().min(255) as u8)
        .filter(|h| rows.iter().any(|r| r.1 == *h))
        .collect();
    let height = 56 + 20 * seen.len() as u32;
    on_paper(height, title, |area| {
        let mut chart = ChartBuilder::on(area)
            .margin_right(14)
            .margin_top(22)
            .x_label_area_size(34)
            .y_label_area_size(66)
            .build_cartesian_2d(0.0..end_s.max(1e-9), 0.0..seen.len().max(1) as f64)
            .map_err(drawn(title))?;
        chart
            .configure_mesh()
            .disable_y_mesh()
            .light_line_style(TRANSPARENT)
            .bold_line_style(color(&LINE))
            .axis_style(color(&LINE))
            .label_style(words(15))
            .y_labels(0)
            .x_labels(11)
            .x_label_formatter(&|t| super::number(*t))
            .draw()
            .map_err(drawn(title))?;
        // A pixel wide at least; what lies in one pixel is drawn once.
        let pixel_s = end_s / f64::from(WIDTH);
        for (place, host) in seen.iter().enumerate() {
            let low = place as f64 + 0.18;
            let mut last = f64::NEG_INFINITY;
            let mut boxes = Vec::new();
            for (k, (t, by)) in rows.iter().enumerate() {
                if by != host || *t - last < pixel_s * 0.8 {
                    continue;
                }
                last = *t;
                let next = rows.get(k + 1).map_or(end_s, |r| r.0);
                boxes.push(Rectangle::new(
                    [(*t, low), (next.max(t + pixel_s).min(end_s), low + 0.64)],
                    color(ink).filled(),
                ));
            }
            chart.draw_series(boxes).map_err(drawn(title))?;
            if let Some(name) = hosts.get(usize::from(*host)) {
                let (x, y) = chart.backend_coord(&(0.0, place as f64 + 0.5));
                let style = words(14).pos(Pos::new(HPos::Right, VPos::Center));
                area.draw_text(name, &style, (x - 8, y)).map_err(drawn(title))?;
            }
        }
        heading(area, title, "")
    })
}

/// One box per case: quartiles, least and greatest, mean as a dot.
pub(crate) fn boxes(title: &str, unit: &str, all: &[Boxed<'_>]) -> Result<String, Error> {
    let height = 70 + 34 * all.len() as u32;
    on_paper(height, title, |area| {
        let (low, high) = bounds(all.iter().flat_map(|b| b.values.iter().copied()));
        let mut chart = ChartBuilder::on(area)
            .margin_right(14)
            .margin_top(24)
            .x_label_area_size(34)
            .y_label_area_size(190)
            .build_cartesian_2d(low..high, 0.0..all.len().max(1) as f64)
            .map_err(drawn(title))?;
        chart
            .configure_mesh()
            .disable_y_mesh()
            .light_line_style(TRANSPARENT)
            .bold_line_style(color(&LINE))
            .axis_style(color(&LINE))
            .label_style(words(15))
            .y_labels(0)
            .x_labels(9)
            .x_label_formatter(&|v| super::number(*v))
            .draw()
            .map_err(drawn(title))?;
        for (n, one) in all.iter().enumerate() {
            // The first case is on top.
            let y = (all.len() - n) as f64 - 0.5;
            let Some(s) = Summary::of(&one.values) else { continue };
            let pen = color(one.ink).stroke_width(2);
            let [q1, q2, q3] = s.quartiles;
            let lines = [
                vec![(s.least, y), (q1, y)],
                vec![(q3, y), (s.most, y)],
                vec![(s.least, y - 0.12), (s.least, y + 0.12)],
                vec![(s.most, y - 0.12), (s.most, y + 0.12)],
                vec![(q2, y - 0.28), (q2, y + 0.28)],
            ];
            chart
                .draw_series(lines.into_iter().map(|line| PathElement::new(line, pen)))
                .map_err(drawn(title))?;
            chart
                .draw_series([
                    Rectangle::new([(q1, y - 0.28), (q3, y + 0.28)], color(one.ink).mix(0.18).filled()),
                    Rectangle::new([(q1, y - 0.28), (q3, y + 0.28)], pen),
                ])
                .map_err(drawn(title))?;
            chart
                .draw_series(std::iter::once(Circle::new((s.mean, y), 3, color(one.ink).filled())))
                .map_err(drawn(title))?;
            let (x, y) = chart.backend_coord(&(low, y));
            let style = words(15).pos(Pos::new(HPos::Right, VPos::Center));
            area.draw_text(&one.name, &style, (x - 8, y)).map_err(drawn(title))?;
        }
        heading(area, title, unit)
    })
}

/// One line per case over what is swept, with confidence intervals. `labels` stand under the places 0, 1, 2 …; where `numbers`
/// are given they are the places.
pub(crate) fn sweep(
    title: &str,
    unit: &str,
    along: &str,
    labels: &[String],
    numbers: Option<&[f64]>,
    lines: &[(&Ink, Vec<Option<Summary>>)],
) -> Result<String, Error> {
    on_paper(300, title, |area| {
        let ends = |s: &Summary| [s.mean - s.half_95.unwrap_or(0.0), s.mean + s.half_95.unwrap_or(0.0)];
        let (_, high) = bounds(lines.iter().flat_map(|(_, l)| l.iter().flatten().flat_map(ends)));
        let (least, _) = bounds(lines.iter().flat_map(|(_, l)| l.iter().flatten().flat_map(ends)));
        let low = if least > 0.0 && least < 0.5 * high { 0.0 } else { least };
        let place = |n: usize| numbers.and_then(|p| p.get(n).copied()).unwrap_or(n as f64);
        let (from, to) = match numbers {
            Some(numbers) => bounds(numbers.iter().copied()),
            None => (-0.4, labels.len() as f64 - 0.6),
        };
        let mut chart = ChartBuilder::on(area)
            .margin_right(14)
            .margin_top(22)
            .x_label_area_size(46)
            .y_label_area_size(66)
            .build_cartesian_2d(from..to, low..high)
            .map_err(drawn(title))?;
        let mut mesh = chart.configure_mesh();
        mesh.light_line_style(TRANSPARENT)
            .bold_line_style(color(&LINE))
            .axis_style(color(&LINE))
            .label_style(words(15))
            .y_labels(6)
            .y_label_formatter(&|v| super::number(*v));
        if numbers.is_some() {
            mesh.x_labels(10).x_label_formatter(&|v| super::number(*v));
        } else {
            mesh.x_labels(0).disable_x_mesh();
        }
        mesh.draw().map_err(drawn(title))?;
        let (left, bottom) = chart.backend_coord(&(from, low));
        let (right, _) = chart.backend_coord(&(to, low));
        if numbers.is_none() {
            for (n, label) in labels.iter().enumerate() {
                let (x, _) = chart.backend_coord(&(n as f64, low));
                let style = words(14).pos(Pos::new(HPos::Center, VPos::Top));
                let short: String = label.chars().take(34).collect();
                area.draw_text(&short, &style, (x, bottom + 8)).map_err(drawn(title))?;
            }
        }
        let style = words(15).pos(Pos::new(HPos::Center, VPos::Top));
        area.draw_text(along, &style, ((left + right) / 2, bottom + 27))
            .map_err(drawn(title))?;
        for (ink, line) in lines {
            let points: Vec<(f64, &Summary)> = line
                .iter()
                .enumerate()
                .filter_map(|(n, s)| Some((place(n), s.as_ref()?)))
                .collect();
            chart
                .draw_series(LineSeries::new(
                    points.iter().map(|(x, s)| (*x, s.mean)),
                    color(ink).stroke_width(2),
                ))
                .map_err(drawn(title))?;
            let bars = points.iter().filter(|(_, s)| s.half_95.is_some()).map(|(x, s)| {
                let [low, high] = ends(s);
                PathElement::new(vec![(*x, low), (*x, high)], color(ink).stroke_width(1))
            });
            chart.draw_series(bars).map_err(drawn(title))?;
            let dots = points
                .iter()
                .map(|(x, s)| Circle::new((*x, s.mean), 4, color(ink).filled()));
            chart.draw_series(dots).map_err(drawn(title))?;
        }
        heading(area, title, unit)
    })
}

/// The ink of what is wanted.
pub(crate) const fn wanted() -> &'static Ink {
    &WANTED
}

/// The ink of a case.
pub(crate) fn ink(n: usize) -> &'static Ink {
    style::of(n)
}
