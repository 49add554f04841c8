//! History as files: CSV and Parquet, made piece by piece, so that a year needs no more memory than a page.
//!
//! Owns: the columns of both, which are the same, and their encodings. Never: asks the cell.
//!
//! | column | type | |
//! |---|---|---|
//! | `time` | UTC, µs | when the piece begins |
//! | `duration_s` | number | its length; 0 for a single cycle |
//! | `cycles`, `lost`, `late`, `bad`, `manual`, `mode_changes` | whole number | counts within it |
//! | `setpoint_min`, `_max`, `_mean`, the same of `measurement`, `step_us`, `out_PORT` | number or nothing | values within it |

use bumpless_core::history::{Bucket, Row, Spread};
use chrono::{DateTime, SecondsFormat};

use self::parquet::{Kind, Values};
use crate::types::output;

mod parquet;

/// The name of a column, or its end, and what stands there.
type Column<From, To> = (&'static str, fn(&From) -> To);

/// Counts, by the names of their columns.
const COUNTS: [Column<Bucket, u64>; 6] = [
    ("cycles", |b| b.cycles),
    ("lost", |b| b.lost),
    ("late", |b| b.late),
    ("bad", |b| b.bad),
    ("manual", |b| b.manual),
    ("mode_changes", |b| b.mode_changes),
];

/// What is told of a spread, by the ends of the columns' names.
const PARTS: [Column<Spread, Option<f64>>; 3] = [
    ("min", Spread::least),
    ("max", Spread::greatest),
    ("mean", Spread::mean),
];

/// Why a file could not be made.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ExportError {
    #[error("the CSV could not be written: report this, it is a fault of the program")]
    Csv(#[source] csv::Error),
}

impl From<csv::Error> for ExportError {
    fn from(error: csv::Error) -> Self {
        Self::Csv(error)
    }
}

/// Which file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum FileKind {
    Csv,
    Parquet,
}

impl FileKind {
    /// Its media type.
    pub(crate) const fn media_type(self) -> &'static str {
        match self {
            Self::Csv => "text/csv; charset=utf-8",
            Self::Parquet => "application/vnd.apache.parquet",
        }
    }

    /// Ending of its name.
    pub(crate) const fn ending(self) -> &'static str {
        match self {
            Self::Csv => "csv",
            Self::Parquet => "parquet",
        }
    }
}

/// Where values of a column come from.
#[derive(Debug, Clone)]
enum Source {
    Setpoint,
    Measurement,
    StepUs,
    Output(String),
}

impl Source {
    fn name(&self) -> String {
        match self {
            Self::Setpoint => "setpoint".to_owned(),
            Self::Measurement => "measurement".to_owned(),
            Self::StepUs => "step_us".to_owned(),
            Self::Output(port) => format!("out_{port}"),
        }
    }

    fn value(&self, row: &Row, part: fn(&Spread) -> Option<f64>) -> Option<f64> {
        let value = match self {
            Self::Setpoint => part(&row.bucket.setpoint),
            Self::Measurement => part(&row.bucket.measurement),
            Self::StepUs => part(&row.bucket.step_ns).map(|ns| ns / 1e3),
            Self::Output(port) => part(&output(row, port)),
        };
        value.filter(|value| value.is_finite())
    }
}

fn sources(outputs: impl IntoIterator<Item = String>) -> Vec<Source> {
    let mut sources = vec![Source::Setpoint, Source::Measurement, Source::StepUs];
    sources.extend(outputs.into_iter().map(Source::Output));
    sources
}

/// A file on its way: rows go in, bytes come out.
pub(crate) struct Export {
    sources: Vec<Source>,
    /// None for CSV.
    parquet: Option<parquet::File>,
    /// The first bytes, until they are given.
    first: Vec<u8>,
}

impl Export {
    /// Begins a file with columns for these outputs.
    pub(crate) fn begin(kind: FileKind, outputs: impl IntoIterator<Item = String>) -> Result<Self, ExportError> {
        let sources = sources(outputs);
        let (parquet, first) = match kind {
            FileKind::Csv => (None, csv_of(std::iter::once(names(&sources)))?),
            FileKind::Parquet => {
                let kinds = [Kind::Time, Kind::Number]
                    .into_iter()
                    .chain([Kind::Whole; COUNTS.len()]);
                let kinds = kinds.chain(std::iter::repeat(Kind::MaybeNumber));
                let (file, first) = parquet::File::begin(names(&sources).into_iter().zip(kinds).collect());
                (Some(file), first)
            }
        };
        Ok(Self {
            sources,
            parquet,
            first,
        })
    }

    /// Takes pieces; gives the bytes that they made.
    pub(crate) fn put(&mut self, rows: &[Row]) -> Result<Vec<u8>, ExportError> {
        let mut bytes = std::mem::take(&mut self.first);
        match &mut self.parquet {
            None => bytes.extend(csv_of(rows.iter().map(|row| fields(row, &self.sources)))?),
            Some(_) if rows.is_empty() => {}
            Some(file) => bytes.extend(file.put(rows.len(), &values(rows, &self.sources))),
        }
        Ok(bytes)
    }

    /// Ends the file; gives its last bytes.
    pub(crate) fn end(self) -> Vec<u8> {
        let mut bytes = self.first;
        bytes.extend(self.parquet.map(parquet::File::end).unwrap_or_default());
        bytes
    }
}

fn csv_of(lines: impl Iterator<Item = Vec<String>>) -> Result<Vec<u8>, ExportError> {
    let mut writer = csv::Writer::from_writer(Vec::new());
    for line in lines {
        writer.write_record(line)?;
    }
    writer
        .into_inner()
        .map_err(|error| ExportError::Csv(csv::Error::from(error.into_error())))
}

fn names(sources: &[Source]) -> Vec<String> {
    let fixed = ["time", "duration_s"].into_iter().map(str::to_owned);
    let counts = COUNTS.iter().map(|(name, _)| (*name).to_owned());
    let values = sources
        .iter()
        .flat_map(|source| PARTS.iter().map(|(part, _)| format!("{}_{part}", source.name())));
    fixed.chain(counts).chain(values).collect()
}

fn fields(row: &Row, sources: &[Source]) -> Vec<String> {
    let counts = COUNTS.iter().map(|(_, count)| count(&row.bucket).to_string());
    let values = sources.iter().flat_map(|source| {
        PARTS.iter().map(|(_, part)| {
            source
                .value(row, *part)
                .map(|value| value.to_string())
                .unwrap_or_default()
        })
    });
    [utc(row.start_ns()), (row.step_ns as f64 / 1e9).to_string()]
        .into_iter()
        .chain(counts)
        .chain(values)
        .collect()
}

/// A time as RFC 3339 has it, in UTC, to the µs.
pub(crate) fn utc(ns: u64) -> String {
    let us = i64::try_from(ns / 1_000).unwrap_or(i64::MAX);
    DateTime::from_timestamp_micros(us)
        .map(|time| time.to_rfc3339_opts(SecondsFormat::Micros, true))
        .unwrap_or_default()
}

/// The columns of some pieces.
fn values(rows: &[Row], sources: &[Source]) -> Vec<Values> {
    let whole = |value: u64| i64::try_from(value).unwrap_or(i64::MAX);
    let mut columns = vec![
        Values::Whole(rows.iter().map(|row| whole(row.start_ns() / 1_000)).collect()),
        Values::Number(rows.iter().map(|row| row.step_ns as f64 / 1e9).collect()),
    ];
    for (_, count) in COUNTS {
        columns.push(Values::Whole(
            rows.iter().map(|row| whole(count(&row.bucket))).collect(),
        ));
    }
    for source in sources {
        for (_, part) in PARTS {
            columns.push(Values::MaybeNumber(
                rows.iter().map(|row| source.value(row, part)).collect(),
            ));
        }
    }
    columns
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use std::sync::Arc;

    use bumpless_core::history::{Layout, Seen};

    use super::*;

    fn row(start_ns: u64, measurement: Option<f64>) -> Row {
        let mut bucket = Bucket::at(start_ns);
        bucket.take(&Seen {
            setpoint: 40.0,
            measurement,
            outputs: &[12.5],
            lost: 2,
            step_ns: Some(20_000),
            ..Seen::default()
        });
        Row {
            step_ns: 1_000_000_000,
            layout: Arc::new(Layout {
                outputs: vec!["out".into()],
                period_ns: 1,
            }),
            bucket,
        }
    }

    #[test]
    fn a_csv_has_one_line_for_each_piece() {
        let mut export = Export::begin(FileKind::Csv, ["out".to_owned()]).unwrap();
        let mut text = export.put(&[row(1_700_000_000_000_000_000, Some(39.5))]).unwrap();
        text.extend(export.put(&[row(1_700_000_001_000_000_000, None)]).unwrap());
        text.extend(export.end());
        let text = String::from_utf8(text).unwrap();
        assert_eq!(
            text,
            "time,duration_s,cycles,lost,late,bad,manual,mode_changes,setpoint_min,setpoint_max,setpoint_mean,\
             measurement_min,measurement_max,measurement_mean,step_us_min,step_us_max,step_us_mean,\
             out_out_min,out_out_max,out_out_mean\n\
             2023-11-14T22:13:20.000000Z,1,1,2,0,0,0,0,40,40,40,39.5,39.5,39.5,20,20,20,12.5,12.5,12.5\n\
             2023-11-14T22:13:21.000000Z,1,1,2,0,0,0,0,40,40,40,,,,20,20,20,12.5,12.5,12.5\n"
        );
    }

    #[test]
    fn a_parquet_file_comes_in_parts_and_is_whole_at_its_end() {
        let mut export = Export::begin(FileKind::Parquet, ["out".to_owned()]).unwrap();
        let mut bytes = export.put(&[row(1_000, Some(1.0))]).unwrap();
        assert!(export.put(&[]).unwrap().is_empty());
        bytes.extend(export.put(&[row(2_000, None), row(3_000, Some(3.0))]).unwrap());
        bytes.extend(export.end());
        assert!(bytes.starts_with(b"PAR1") && bytes.ends_with(b"PAR1"));
        let empty = Export::begin(FileKind::Parquet, []).unwrap().end();
        assert!(empty.starts_with(b"PAR1") && empty.ends_with(b"PAR1"));
    }
}
