//! How answers look in a terminal: tables, numbers, times.

use std::io::Write as _;

use comfy_table::{ContentArrangement, Table, presets};

use crate::error::Error;

/// Writes text and a newline to the standard output. A reader that went away (`| head`) is no failure.
pub(crate) fn line(text: &str) -> Result<(), Error> {
    let mut out = std::io::stdout().lock();
    match out
        .write_all(text.as_bytes())
        .and_then(|()| out.write_all(b"\n"))
        .and_then(|()| out.flush())
    {
        Err(error) if error.kind() == std::io::ErrorKind::BrokenPipe => Ok(()),
        end => end.map_err(|source| Error::Terminal {
            action: "written",
            source,
        }),
    }
}

/// Writes a line to the error output: for people, beside the answer.
pub(crate) fn note(text: &str) {
    // Nothing helps where even the error output is gone.
    let _ = writeln!(std::io::stderr().lock(), "{text}");
}

/// Pretty JSON as it came.
pub(crate) fn json(text: &str) -> Result<(), Error> {
    match serde_json::from_str::<serde_json::Value>(text) {
        Ok(value) => line(&format!("{value:#}")),
        Err(_) => line(text),
    }
}

/// A table with a header and no lines, as wide as the terminal.
pub(crate) fn table(header: &[&str]) -> Table {
    let mut table = Table::new();
    table
        .load_style(presets::NOTHING)
        .set_content_arrangement(ContentArrangement::Dynamic);
    table.set_header(header.iter().map(|word| word.to_uppercase()).collect::<Vec<_>>());
    table
}

/// Writes a table.
pub(crate) fn print(table: &Table) -> Result<(), Error> {
    line(&table.trim_fmt())
}

/// A number with what matters of it: five digits, no zeros behind.
pub(crate) fn number(value: f64) -> String {
    if value == 0.0 {
        return "0".to_owned();
    }
    if !value.is_finite() {
        return "–".to_owned();
    }
    let magnitude = value.abs();
    if !(1e-3..1e7).contains(&magnitude) {
        return format!("{value:.4e}");
    }
    let decimals = (4 - magnitude.log10().floor() as i32).clamp(0, 7) as usize;
    let text = format!("{value:.decimals$}");
    if text.contains('.') {
        text.trim_end_matches('0').trim_end_matches('.').to_owned()
    } else {
        text
    }
}

/// A number, or a dash where there is none.
pub(crate) fn maybe(value: Option<f64>) -> String {
    value.map_or_else(|| "–".to_owned(), number)
}

/// A number with its unit.
pub(crate) fn with_unit(value: Option<f64>, unit: &str) -> String {
    match (value, unit) {
        (None, _) => "–".to_owned(),
        (Some(value), "") => number(value),
        (Some(value), unit) => format!("{} {unit}", number(value)),
    }
}

/// A time in ms as people say it.
pub(crate) fn age(ms: u64) -> String {
    match ms {
        0..1_000 => format!("{ms} ms"),
        1_000..60_000 => format!("{:.1} s", ms as f64 / 1e3),
        60_000..3_600_000 => format!("{} min", ms / 60_000),
        _ => format!("{} h", ms / 3_600_000),
    }
}

/// A time in µs since 1970 as RFC 3339 has it, in UTC, to the second.
pub(crate) fn utc(us: u64) -> String {
    let us = i64::try_from(us).unwrap_or(i64::MAX);
    chrono::DateTime::from_timestamp_micros(us)
        .map(|time| time.to_rfc3339_opts(chrono::SecondsFormat::Secs, true))
        .unwrap_or_default()
}

/// Bytes as people say them.
pub(crate) fn size(bytes: u64) -> String {
    match bytes {
        0..1_024 => format!("{bytes} B"),
        1_024..1_048_576 => format!("{:.1} KiB", bytes as f64 / 1024.0),
        _ => format!("{:.1} MiB", bytes as f64 / 1_048_576.0),
    }
}

/// The first 12 digits of a digest.
pub(crate) fn short(digest: &str) -> &str {
    digest.get(..12).unwrap_or(digest)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_show_what_matters() {
        for (value, text) in [
            (0.0, "0"),
            (1.5, "1.5"),
            (1.0 / 3.0, "0.33333"),
            (-1234.5678, "-1234.6"),
            (123_456.7, "123457"),
            (100.0, "100"),
            (0.001, "0.001"),
            (1e-9, "1.0000e-9"),
            (f64::NAN, "–"),
        ] {
            assert_eq!(number(value), text);
        }
        assert_eq!(with_unit(Some(1.25), "bar"), "1.25 bar");
        assert_eq!(
            (age(999).as_str(), age(1_500).as_str(), age(7_200_000).as_str()),
            ("999 ms", "1.5 s", "2 h")
        );
        assert_eq!((size(17).as_str(), size(41_984).as_str()), ("17 B", "41.0 KiB"));
    }

    #[test]
    fn tables_are_plain_text() {
        let mut table = table(&["name", "value"]);
        table.add_row(["a", "1"]);
        assert_eq!(table.trim_fmt(), " NAME  VALUE\n a     1");
    }
}
