//! `/v1/loops/{name}/trend` and `/v1/notices`: the past as curves and in words, for people.
//!
//! Never: averages. A curve is made of recorded cycles, chosen so that no excursion is lost.

use std::{collections::HashMap, time::Instant};

use axum::{Json as JsonAnswer, extract::State};
use bumpless_core::{LoopId, Record};
use bumpless_deploy::Window;
use serde::Deserialize;
use utoipa::IntoParams;

use crate::{
    error::{Kind, Problem},
    extract::{InPath, InQuery},
    limits::{NOTICES_AT_ONCE, NOTICES_MAX, TREND_CYCLES_MAX, TREND_NOTICES_MAX, TREND_POINTS_MAX, TREND_TIME_MAX},
    notices,
    server::App,
    types::{LiveRow, Mode, Notices, Quality, Trend},
};

/// Records of one question to the home.
const PAGE: u32 = 1_000;

/// Which part of the past.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(crate) struct TrendQuery {
    /// From this time on, in µs since 1970-01-01 UTC by the clock of the loop's home.
    from_unix_us: u64,
    /// Up to this time.
    to_unix_us: u64,
    /// In so many pieces, 10 to 4,000; 800 where not given.
    points: Option<usize>,
}

/// Curves of a loop over a window, from its recorded cycles.
#[utoipa::path(get, operation_id = "loop_trend", path = "/v1/loops/{name}/trend", tag = "history", params(("name" = String, Path), TrendQuery),
    responses(
        (status = 200, description = "The curves", body = Trend),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn trend(
    State(app): State<App>,
    InPath(name): InPath<String>,
    InQuery(query): InQuery<TrendQuery>,
) -> Result<JsonAnswer<Trend>, Problem> {
    let (from, to) = (query.from_unix_us, query.to_unix_us);
    let points = query.points.unwrap_or(800);
    if !(10..=TREND_POINTS_MAX).contains(&points) {
        let detail = format!("points = {points}");
        return Err(Problem::new(
            Kind::Invalid,
            detail,
            format!("use 10 to {TREND_POINTS_MAX}"),
        ));
    }
    if to <= from {
        return Err(Problem::new(
            Kind::Invalid,
            format!("the window ends ({to}) before it begins ({from})"),
            "give from_unix_us < to_unix_us",
        ));
    }
    let id = LoopId::new(&name)?;
    let started = Instant::now();
    let mut curves = Curves::new(name, from, to, points);
    let mut next_ns = from.saturating_mul(1_000);
    let end_ns = to.saturating_mul(1_000).saturating_add(999);
    loop {
        let window = Window::Between(next_ns, end_ns);
        let view = app.cell.cycles(id.clone(), window, PAGE).await?;
        curves.trend.unread += view.unread;
        for record in &view.records {
            curves.take(&app, record);
        }
        let Some(last) = view.records.last().filter(|_| view.more) else {
            curves.trend.read_to_unix_us = to;
            break;
        };
        next_ns = last.at_ns.saturating_add(1);
        if curves.trend.cycles >= TREND_CYCLES_MAX || started.elapsed() >= TREND_TIME_MAX {
            curves.trend.read_to_unix_us = last.at_ns / 1_000;
            break;
        }
    }
    Ok(JsonAnswer(curves.end()))
}

/// Curves while they are read.
struct Curves {
    trend: Trend,
    from: u64,
    piece_us: u64,
    piece: u64,
    chosen: Chosen,
    hosts: HashMap<String, u32>,
}

/// What stands for one piece of the window.
#[derive(Default)]
struct Chosen {
    first: Option<LiveRow>,
    least: Option<LiveRow>,
    greatest: Option<LiveRow>,
    output_least: Option<LiveRow>,
    output_greatest: Option<LiveRow>,
    latest_write: Option<LiveRow>,
}

impl Chosen {
    fn take(&mut self, row: &LiveRow) {
        fn keep(place: &mut Option<LiveRow>, row: &LiveRow, value: impl Fn(&LiveRow) -> f64) {
            if place.as_ref().is_none_or(|held| value(row) > value(held)) {
                *place = Some(row.clone());
            }
        }
        // Nothing is greater than a value that is not there, and it gives way to any.
        let measured = |row: &LiveRow| row.measurement.unwrap_or(f64::NEG_INFINITY);
        let output = |row: &LiveRow| {
            row.outputs
                .values()
                .next()
                .copied()
                .flatten()
                .unwrap_or(f64::NEG_INFINITY)
        };
        let negative = |value: f64| if value == f64::NEG_INFINITY { value } else { -value };
        if self.first.is_none() {
            self.first = Some(row.clone());
        }
        keep(&mut self.greatest, row, measured);
        keep(&mut self.least, row, |row| negative(measured(row)));
        keep(&mut self.output_greatest, row, output);
        keep(&mut self.output_least, row, |row| negative(output(row)));
        keep(&mut self.latest_write, row, |row| row.committed_after_us);
    }

    /// The chosen rows in order, none twice.
    fn rows(self) -> Vec<LiveRow> {
        let all = [
            self.first,
            self.least,
            self.greatest,
            self.output_least,
            self.output_greatest,
            self.latest_write,
        ];
        let mut rows: Vec<LiveRow> = all.into_iter().flatten().collect();
        rows.sort_by_key(|row| (row.term, row.seq));
        rows.dedup_by_key(|row| (row.term, row.seq));
        rows
    }
}

impl Curves {
    fn new(loop_name: String, from: u64, to: u64, points: usize) -> Self {
        Self {
            trend: Trend {
                loop_name,
                ..Trend::default()
            },
            from,
            piece_us: ((to - from) / points as u64).max(1),
            piece: 0,
            chosen: Chosen::default(),
            hosts: HashMap::new(),
        }
    }

    fn take(&mut self, app: &App, record: &Record) {
        let ports = app.ports(&record.digest);
        let row = LiveRow::new(record, &ports);
        let piece = row.at_unix_us.saturating_sub(self.from) / self.piece_us;
        if piece != self.piece {
            self.put_piece();
            self.piece = piece;
        }
        self.trend.cycles += 1;
        self.chosen.take(&row);
        if !record.events.is_empty() || !record.alarms.is_empty() {
            let told = notices::in_words(record, &ports);
            let room = TREND_NOTICES_MAX.saturating_sub(self.trend.notices.len());
            self.trend.notices.extend(told.into_iter().take(room));
        }
    }

    fn put_piece(&mut self) {
        for row in std::mem::take(&mut self.chosen).rows() {
            let owner = self.host(&row.owner);
            let stepped_by = self.host(&row.stepped_by);
            let trend = &mut self.trend;
            let before = trend.at_unix_us.len();
            trend.at_unix_us.push(row.at_unix_us);
            trend.seq.push(row.seq);
            trend.setpoint.push(row.setpoint);
            trend.measurement.push(row.measurement);
            trend.good.push(row.quality == Quality::Good);
            trend.automatic.push(row.mode == Mode::Automatic);
            trend.owner.push(owner);
            trend.stepped_by.push(stepped_by);
            trend.step_us.push(row.step_us);
            trend.committed_after_us.push(row.committed_after_us);
            // A component with other ports may have run before: each column is as long as all.
            for (port, value) in row.outputs {
                let column = trend.outputs.entry(port).or_default();
                column.resize(before, None);
                column.push(value);
            }
            for column in trend.outputs.values_mut() {
                column.resize(before + 1, None);
            }
        }
    }

    fn host(&mut self, name: &str) -> u32 {
        if let Some(number) = self.hosts.get(name) {
            return *number;
        }
        let number = u32::try_from(self.trend.hosts.len()).unwrap_or(u32::MAX);
        self.trend.hosts.push(name.to_owned());
        self.hosts.insert(name.to_owned(), number);
        number
    }

    fn end(mut self) -> Trend {
        self.put_piece();
        self.trend
    }
}

/// Which notices.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(crate) struct NoticesQuery {
    /// Only those with a greater number.
    #[serde(default)]
    after: u64,
    /// At most so many, the newest of them, 1 to 2,000; 200 where not given.
    limit: Option<usize>,
}

/// What people should hear of, as far as the answering host remembers: events, alarms and warnings of all loops.
#[utoipa::path(get, operation_id = "list_notices", path = "/v1/notices", tag = "cell", params(NoticesQuery),
    responses(
        (status = 200, description = "The notices, oldest first", body = Notices),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn list_notices(
    State(app): State<App>,
    InQuery(query): InQuery<NoticesQuery>,
) -> Result<JsonAnswer<Notices>, Problem> {
    let limit = query.limit.unwrap_or(NOTICES_AT_ONCE);
    if !(1..=NOTICES_MAX).contains(&limit) {
        let detail = format!("limit = {limit}");
        return Err(Problem::new(Kind::Invalid, detail, format!("use 1 to {NOTICES_MAX}")));
    }
    Ok(JsonAnswer(app.notices.told(query.after, limit)))
}
