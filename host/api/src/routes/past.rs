//! `/v1/loops/{name}/history` and `/v1/points/{name}/history`: what was, for years, as columns or as a file.
//!
//! Never: holds a whole export in memory, or lets one go on without end.

use std::time::{Duration, Instant};

use axum::{
    Json as JsonAnswer,
    body::Body,
    extract::State,
    http::{HeaderMap, HeaderValue, header},
    response::{IntoResponse as _, Response},
};
use bumpless_core::{LoopId, PointId, history::Series};
use bumpless_deploy::history::{Fineness, HistoryQuestion};
use chrono::DateTime;
use futures_util::stream;
use serde::Deserialize;
use tokio::sync::OwnedSemaphorePermit;
use utoipa::IntoParams;

use crate::{
    error::{Kind, Problem},
    export::{Export, FileKind},
    extract::{InPath, InQuery},
    limits::{EXPORT_TIME_MAX, HISTORY_PIECES_DEFAULT},
    server::App,
    types::{History, output_names},
};

/// Which part of the past, and how.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(crate) struct HistoryQuery {
    /// From this time on: RFC 3339 (`2026-11-22T08:00:00Z`), or back from now (`-90s`, `-15m`, `-8h`, `-7d`); `-1h` where not given.
    from: Option<String>,
    /// Up to this time, said in the same ways; now where not given.
    to: Option<String>,
    /// In about so many pieces, 1 to 4,000, from the best that is kept; 500 where not given.
    buckets: Option<u32>,
    /// Instead of buckets: in pieces as they are kept, `cycles`, `1s`, `10s`, `1m` or `15m`. A JSON answer then has some 20,000 of
    /// each at most and says how far it goes; a file has all.
    step: Option<String>,
    /// `json`, `csv` or `parquet`; as the header Accept says where not given, else `json`.
    format: Option<String>,
}

/// History of a loop: setpoint, measurement and outputs with least, greatest and mean, and what went wrong. Any host answers, with
/// what all of them have.
#[utoipa::path(get, operation_id = "loop_history", path = "/v1/loops/{name}/history", tag = "history", params(("name" = String, Path), HistoryQuery),
    responses(
        (status = 200, description = "The history; as a file where one was asked for", body = History),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn of_loop(
    State(app): State<App>,
    InPath(name): InPath<String>,
    InQuery(query): InQuery<HistoryQuery>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    answer(app, Series::Loop(LoopId::new(&name)?), &query, &headers).await
}

/// History of a point, where the configuration of its host lists it.
#[utoipa::path(get, operation_id = "point_history", path = "/v1/points/{name}/history", tag = "history", params(("name" = String, Path), HistoryQuery),
    responses(
        (status = 200, description = "The history; as a file where one was asked for", body = History),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn of_point(
    State(app): State<App>,
    InPath(name): InPath<String>,
    InQuery(query): InQuery<HistoryQuery>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    answer(app, Series::Point(PointId::new(&name)?), &query, &headers).await
}

async fn answer(app: App, series: Series, query: &HistoryQuery, headers: &HeaderMap) -> Result<Response, Problem> {
    let now_ns = app.cell.history_now_ns(&series);
    let question = question(query, now_ns).map_err(|reason| Problem::new(Kind::Invalid, reason, ""))?;
    match file_kind(query.format.as_deref(), headers)? {
        None => {
            let view = app.cell.history(series.clone(), question).await?;
            Ok(JsonAnswer(History::new(&series, &view)).into_response())
        }
        Some(kind) => export(app, series, question, kind).await,
    }
}

fn question(query: &HistoryQuery, now_ns: u64) -> Result<HistoryQuestion, String> {
    let time = |key: &str, text: Option<&str>, default: &str| time(key, text.unwrap_or(default), now_ns);
    let fineness = match (&query.step, query.buckets) {
        (Some(_), Some(_)) => return Err("buckets and step are two ways to say it: give one".to_owned()),
        (None, buckets) => Fineness::Pieces(buckets.unwrap_or(HISTORY_PIECES_DEFAULT)),
        (Some(step), None) => Fineness::Step(step_of(step)?),
    };
    Ok(HistoryQuestion {
        from_ns: time("from", query.from.as_deref(), "-1h")?,
        to_ns: time("to", query.to.as_deref(), "now")?,
        fineness,
        goes_on: false,
    })
}

fn step_of(text: &str) -> Result<u64, String> {
    match text {
        "cycles" => Ok(0),
        "1s" => Ok(1_000_000_000),
        "10s" => Ok(10_000_000_000),
        "1m" => Ok(60_000_000_000),
        "15m" => Ok(900_000_000_000),
        other => {
            let text: String = other.chars().take(40).collect();
            Err(format!("step = {text:?}: use cycles, 1s, 10s, 1m or 15m"))
        }
    }
}

/// `now`, a time back from now, or RFC 3339; in ns since 1970.
fn time(key: &str, text: &str, now_ns: u64) -> Result<u64, String> {
    let wrong = || {
        let text: String = text.chars().take(40).collect();
        format!(
            "{key} = {text:?}: use RFC 3339 (2026-11-22T08:00:00Z; + as %2B) or a time back from now (-90s, -15m, -8h, -7d)"
        )
    };
    if text == "now" {
        return Ok(now_ns);
    }
    let Some(back) = text.strip_prefix('-') else {
        let time = DateTime::parse_from_rfc3339(text).map_err(|_| wrong())?;
        let ns = time.timestamp_nanos_opt().ok_or_else(wrong)?;
        return u64::try_from(ns).map_err(|_| wrong());
    };
    let digits = back.trim_end_matches(|c: char| c.is_ascii_alphabetic());
    let number: u64 = digits.parse().map_err(|_| wrong())?;
    let unit_s = match back.get(digits.len()..) {
        Some("s") => 1,
        Some("m") => 60,
        Some("h") => 3_600,
        Some("d") => 86_400,
        _ => return Err(wrong()),
    };
    Ok(now_ns.saturating_sub(number.saturating_mul(unit_s * 1_000_000_000)))
}

/// The file that is wanted; none for JSON.
fn file_kind(format: Option<&str>, headers: &HeaderMap) -> Result<Option<FileKind>, Problem> {
    let accepts = |part: &str| {
        let values = headers
            .get_all(header::ACCEPT)
            .iter()
            .filter_map(|value| value.to_str().ok());
        values.flat_map(|value| value.split(',')).any(|value| {
            value
                .split(';')
                .next()
                .unwrap_or_default()
                .trim()
                .eq_ignore_ascii_case(part)
        })
    };
    match format {
        Some("json") => Ok(None),
        Some("csv") => Ok(Some(FileKind::Csv)),
        Some("parquet") => Ok(Some(FileKind::Parquet)),
        Some(other) => {
            let text: String = other.chars().take(40).collect();
            Err(Problem::new(
                Kind::Invalid,
                format!("format = {text:?}"),
                "use json, csv or parquet",
            ))
        }
        None if accepts("application/json") => Ok(None),
        None if accepts("text/csv") => Ok(Some(FileKind::Csv)),
        None if accepts("application/vnd.apache.parquet") => Ok(Some(FileKind::Parquet)),
        None => Ok(None),
    }
}

/// A file on its way to one reader.
struct Sending {
    app: App,
    series: Series,
    question: HistoryQuestion,
    to_ns: u64,
    /// None once the file is ended.
    export: Option<Export>,
    until: Instant,
    _place: OwnedSemaphorePermit,
}

async fn export(app: App, series: Series, question: HistoryQuestion, kind: FileKind) -> Result<Response, Problem> {
    let place = app.exports.clone().try_acquire_owned().map_err(|_| {
        Problem::new(
            Kind::Busy,
            "other exports of history are under way",
            "try again when they are done",
        )
    })?;
    // The columns are those of the whole window: a component with other outputs may have run for a part of it.
    let overview = HistoryQuestion {
        fineness: Fineness::Pieces(200),
        ..question
    };
    let outputs = output_names(&app.cell.history(series.clone(), overview).await?.rows);
    let name = match &series {
        Series::Loop(id) => id.to_string(),
        Series::Point(id) => id.to_string(),
    };
    let sending = Sending {
        series,
        question,
        to_ns: question.to_ns,
        export: Some(Export::begin(kind, outputs).map_err(|error| failed(&error))?),
        until: Instant::now() + EXPORT_TIME_MAX,
        app,
        _place: place,
    };
    let parts = stream::try_unfold(sending, next_part);
    let mut response = Response::new(Body::from_stream(parts));
    let headers = response.headers_mut();
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(kind.media_type()));
    // Names are lower-case letters, digits, dashes, underscores and dots.
    if let Ok(value) = HeaderValue::from_str(&format!("attachment; filename=\"{name}.{}\"", kind.ending())) {
        headers.insert(header::CONTENT_DISPOSITION, value);
    }
    Ok(response)
}

fn failed(error: &crate::export::ExportError) -> Problem {
    Problem::new(Kind::Internal, error.to_string(), "")
}

/// The next bytes. An error ends the connection, so that nobody takes half a file for a whole one.
async fn next_part(mut sending: Sending) -> Result<Option<(Vec<u8>, Sending)>, std::io::Error> {
    let Some(mut export) = sending.export.take() else {
        return Ok(None);
    };
    if Instant::now() >= sending.until {
        return Err(std::io::Error::other("the export took too long"));
    }
    let view = sending.app.cell.history(sending.series.clone(), sending.question);
    let view = tokio::time::timeout(Duration::from_secs(30), view)
        .await
        .map_err(std::io::Error::other)?
        .map_err(|error| {
            tracing::warn!(series = %sending.series, %error, "an export of history broke off");
            std::io::Error::other(error.to_string())
        })?;
    let done = view.to_ns >= sending.to_ns || !matches!(sending.question.fineness, Fineness::Step(_));
    let work = move || {
        let mut bytes = export.put(&view.rows)?;
        if done {
            bytes.extend(export.end());
            return Ok((bytes, None, view.to_ns));
        }
        Ok((bytes, Some(export), view.to_ns))
    };
    let made = tokio::task::spawn_blocking(work).await.map_err(std::io::Error::other)?;
    let (bytes, export, to_ns) = made.map_err(|error: crate::export::ExportError| std::io::Error::other(error))?;
    sending.export = export;
    sending.question.from_ns = to_ns;
    sending.question.goes_on = true;
    Ok(Some((bytes, sending)))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]

    use super::*;

    const NOW: u64 = 1_700_000_000_000_000_000;

    #[test]
    fn times_are_said_in_words_or_by_the_standard() {
        let s = 1_000_000_000;
        for (text, wanted) in [
            ("now", NOW),
            ("-90s", NOW - 90 * s),
            ("-15m", NOW - 900 * s),
            ("-8h", NOW - 28_800 * s),
            ("-7d", NOW - 604_800 * s),
            ("-99999999999d", 0),
            ("2023-11-14T22:13:20Z", NOW),
            ("2023-11-14T23:13:20.5+01:00", NOW + s / 2),
        ] {
            assert_eq!(time("from", text, NOW).unwrap(), wanted, "{text}");
        }
        for bad in [
            "",
            "-",
            "-5",
            "5m",
            "-5w",
            "yesterday",
            "2023-11-14",
            "1969-01-01T00:00:00Z",
            "-ü",
        ] {
            let error = time("to", bad, NOW).expect_err(bad);
            assert!(error.contains("to = ") && error.contains("RFC 3339"), "{error}");
        }
    }

    #[test]
    fn files_are_asked_for_by_name_or_by_what_is_accepted() {
        let accept = |value: &'static str| HeaderMap::from_iter([(header::ACCEPT, HeaderValue::from_static(value))]);
        for (format, header, wanted) in [
            (None, "*/*", None),
            (None, "text/csv", Some(FileKind::Csv)),
            (
                None,
                "text/html, application/vnd.apache.parquet;q=0.9",
                Some(FileKind::Parquet),
            ),
            (None, "application/json, text/csv", None),
            (Some("json"), "text/csv", None),
            (Some("parquet"), "*/*", Some(FileKind::Parquet)),
        ] {
            assert_eq!(
                file_kind(format, &accept(header)).unwrap(),
                wanted,
                "{format:?} {header}"
            );
        }
        assert!(file_kind(Some("xml"), &HeaderMap::new()).is_err());
    }
}
