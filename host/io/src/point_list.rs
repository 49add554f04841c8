//! A device's points as a table that spreadsheets keep whole: CSV out, CSV in.
//!
//! One row per point, one column per key of `[[bus.point]]`; `raw` is the two columns `raw_low` and `raw_high`. Empty cells
//! are keys that are left out.
//!
//! What spreadsheets do to a file, and what is done about it: a byte order mark is written, so that `°C` survives, and passed
//! over when read; commas, semicolons and tabs separate; where commas do not, a number may have a decimal comma; `TRUE` is
//! true; a text that begins like a formula is written with an apostrophe before it, which is taken off again; empty rows and
//! columns are passed over. What cannot be meant is refused with its line and column.
//!
//! Never: reads or writes a file, or checks what needs the other points (`ModbusConfig::plan` does).

use std::collections::BTreeSet;

use serde::Deserialize as _;
use toml::{Table as TomlTable, Value};

use crate::{Error, limits::POINTS_MAX, modbus::ModbusPoint};

/// Columns in the order in which they are written; keys that are not among them follow.
const COLUMNS: [&str; 20] = [
    "id",
    "table",
    "address",
    "unit_id",
    "type",
    "word_order",
    "byte_order",
    "period_ms",
    "scale",
    "offset",
    "raw_low",
    "raw_high",
    "signal",
    "clamp",
    "unit",
    "low",
    "high",
    "writable",
    "safe",
    "text",
];

/// Keys whose values are texts, whatever they look like.
const TEXTS: [&str; 8] = [
    "id",
    "table",
    "type",
    "word_order",
    "byte_order",
    "signal",
    "unit",
    "text",
];

/// Keys whose values are whole numbers.
const WHOLE: [&str; 3] = ["address", "unit_id", "period_ms"];

/// Keys whose values are true or false.
const YES_NO: [&str; 2] = ["clamp", "writable"];

/// The points as CSV, with a byte order mark and CRLF at the ends of lines.
///
/// # Errors
/// [`Error::Config`] where a point cannot be written; a fault of the program.
pub fn write(points: &[ModbusPoint]) -> Result<String, Error> {
    let failed = |error: &dyn std::fmt::Display| Error::config("the point list", error.to_string());
    let mut rows = Vec::with_capacity(points.len());
    for point in points {
        let mut row = TomlTable::try_from(point).map_err(|error| failed(&error))?;
        if let Some(Value::Array(raw)) = row.remove("raw") {
            for (name, value) in ["raw_low", "raw_high"].into_iter().zip(raw) {
                row.insert(name.to_owned(), value);
            }
        }
        rows.push(row);
    }
    let others: BTreeSet<&str> = rows
        .iter()
        .flat_map(|row| row.keys())
        .map(String::as_str)
        .filter(|key| !COLUMNS.contains(key))
        .collect();
    let columns: Vec<&str> = COLUMNS.into_iter().chain(others).collect();
    let mut out = csv::WriterBuilder::new()
        .terminator(csv::Terminator::CRLF)
        .from_writer("\u{feff}".as_bytes().to_vec());
    out.write_record(&columns).map_err(|error| failed(&error))?;
    for row in &rows {
        let cells = columns
            .iter()
            .map(|column| row.get(*column).map_or_else(String::new, cell));
        out.write_record(cells).map_err(|error| failed(&error))?;
    }
    let bytes = out.into_inner().map_err(|error| failed(&error))?;
    String::from_utf8(bytes).map_err(|error| failed(&error))
}

/// One value as a cell.
fn cell(value: &Value) -> String {
    match value {
        Value::String(text) if text.starts_with(['=', '+', '-', '@', '\t', '\'']) => format!("'{text}"),
        Value::String(text) => text.clone(),
        other => other.to_string(),
    }
}

/// The points of a CSV text.
///
/// # Errors
/// [`Error::Config`] with line and column of the first cell that cannot be meant.
pub fn read(text: &str) -> Result<Vec<ModbusPoint>, Error> {
    let text = text.strip_prefix('\u{feff}').unwrap_or(text);
    let separator = separator(text);
    let mut reader = csv::ReaderBuilder::new()
        .delimiter(separator)
        .flexible(true)
        .has_headers(false)
        .from_reader(text.as_bytes());
    let mut rows = reader.records();
    let at_line = |line: u64, problem: String| Error::config(format!("line {line}"), problem);
    let header = match rows.next() {
        Some(Ok(header)) => header,
        Some(Err(error)) => return Err(at_line(1, error.to_string())),
        None => {
            return Err(at_line(
                1,
                format!(
                    "there is no heading; the first line names the columns, for example {}",
                    COLUMNS.join(",")
                ),
            ));
        }
    };
    let columns: Vec<String> = header.iter().map(|name| name.trim().to_ascii_lowercase()).collect();
    for needed in ["id", "table", "address"] {
        if !columns.iter().any(|name| name == needed) {
            return Err(at_line(
                1,
                format!("no column is named {needed:?}; export a list to see how it looks"),
            ));
        }
    }
    for (number, name) in columns.iter().enumerate() {
        if !name.is_empty() && columns.iter().take(number).any(|other| other == name) {
            return Err(at_line(1, format!("two columns are named {name:?}; remove one")));
        }
    }
    let mut points = Vec::new();
    let mut lines = Lines { text, byte: 0, line: 1 };
    for row in rows {
        let row = row.map_err(|error| {
            let line = error.position().map_or(0, csv::Position::line);
            at_line(line, error.to_string())
        })?;
        let line = row.position().map_or(0, |position| lines.of(position.byte()));
        if row.iter().all(|cell| cell.trim().is_empty()) {
            continue;
        }
        if points.len() >= POINTS_MAX {
            return Err(at_line(line, format!("a list has at most {POINTS_MAX} points")));
        }
        points.push(point(&columns, &row, line, separator)?);
    }
    Ok(points)
}

/// Numbers lines as an editor does. The reader's own count stands at the empty lines before a row.
struct Lines<'a> {
    text: &'a str,
    byte: usize,
    line: u64,
}

impl Lines<'_> {
    /// The line of the first row at or behind this byte. Bytes only grow from call to call.
    fn of(&mut self, byte: u64) -> u64 {
        let bytes = self.text.as_bytes();
        let from = usize::try_from(byte).unwrap_or(usize::MAX).min(bytes.len());
        let empty = bytes
            .iter()
            .skip(from)
            .take_while(|b| matches!(b, b'\r' | b'\n'))
            .count();
        let to = from + empty;
        let passed = bytes.get(self.byte..to).unwrap_or_default();
        self.line += passed.iter().filter(|b| **b == b'\n').count() as u64;
        self.byte = to;
        self.line
    }
}

/// What separates the cells: what the first line has most of.
fn separator(text: &str) -> u8 {
    let heading = text.lines().next().unwrap_or_default();
    let count = |separator: &u8| heading.bytes().filter(|byte| byte == separator).count();
    // Of equals the last wins, so the comma stands last.
    b"\t;,".iter().copied().max_by_key(count).unwrap_or(b',')
}

/// One row.
fn point(columns: &[String], row: &csv::StringRecord, line: u64, separator: u8) -> Result<ModbusPoint, Error> {
    let mut table = TomlTable::new();
    let mut raw: [Option<Value>; 2] = [None, None];
    for (number, text) in row.iter().enumerate() {
        let text = text.trim();
        if text.is_empty() {
            continue;
        }
        let place = |name: &str| format!("line {line}, column {} ({name})", number + 1);
        let Some(name) = columns.get(number).filter(|name| !name.is_empty()) else {
            return Err(Error::config(
                place("no heading"),
                format!("{text:?} stands under no heading; is a text with the separator in it without quotes?"),
            ));
        };
        let value = value(name, text, separator).map_err(|problem| Error::config(place(name), problem))?;
        match name.as_str() {
            "raw_low" => raw[0] = Some(value),
            "raw_high" => raw[1] = Some(value),
            _ => {
                // Alone with what every point needs, so that what is wrong with it is told of its own column.
                let mut alone: TomlTable = [
                    ("id", Value::from("x")),
                    ("table", Value::from("holding")),
                    ("address", Value::from(0)),
                ]
                .into_iter()
                .map(|(key, value)| (key.to_owned(), value))
                .collect();
                alone.insert(name.clone(), value.clone());
                if let Err(error) = ModbusPoint::deserialize(alone) {
                    let problem = error.message().to_owned();
                    return Err(Error::config(place(name), problem));
                }
                table.insert(name.clone(), value);
            }
        }
    }
    match raw {
        [None, None] => {}
        [Some(low), Some(high)] => {
            table.insert("raw".to_owned(), Value::Array(vec![low, high]));
        }
        _ => {
            return Err(Error::config(
                format!("line {line}"),
                "raw_low and raw_high are needed together, or none of them",
            ));
        }
    }
    ModbusPoint::deserialize(table).map_err(|error| Error::config(format!("line {line}"), error.message().to_owned()))
}

/// One cell as the value of its key.
fn value(name: &str, text: &str, separator: u8) -> Result<Value, String> {
    if TEXTS.contains(&name) {
        return Ok(Value::from(text.strip_prefix('\'').unwrap_or(text)));
    }
    let yes_no = match text.to_ascii_lowercase().as_str() {
        "true" | "yes" => Some(true),
        "false" | "no" => Some(false),
        "1" if YES_NO.contains(&name) => Some(true),
        "0" if YES_NO.contains(&name) => Some(false),
        _ => None,
    };
    if let Some(yes) = yes_no {
        return Ok(Value::from(yes));
    }
    if YES_NO.contains(&name) {
        return Err(format!("{text:?} is neither true nor false"));
    }
    if WHOLE.contains(&name) {
        let number: i64 = text
            .parse()
            .map_err(|_| format!("{text:?} is no whole number; format the column as a number without decimals"))?;
        return Ok(Value::from(number));
    }
    let decimal = if separator == b',' {
        text.to_owned()
    } else {
        text.replace(',', ".")
    };
    match decimal.parse::<f64>() {
        Ok(number) if number.is_finite() => {
            // A key that came later may want a whole number or a text; a number with a point is meant as one.
            let known = COLUMNS.contains(&name);
            match text.parse::<i64>() {
                Ok(whole) if !known => Ok(Value::from(whole)),
                _ => Ok(Value::from(number)),
            }
        }
        _ if COLUMNS.contains(&name) => Err(format!("{text:?} is no number")),
        _ => Ok(Value::from(text)),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]
    use proptest::prelude::*;

    use super::*;
    use crate::modbus::Table;

    const LIST: &str = "id,table,address,type,raw_low,raw_high,unit,low,high,writable,safe,text\r\n\
                        oven.pv,input,0,i16,,,°C,0,150,,,\"hot, and measured\"\r\n\
                        oven.out,holding,2,,0,10000,%,0,100,TRUE,0,'=valve\r\n\
                        ,,,,,,,,,,,\r\n\
                        oven.lamp,coil,7,,,,,,,yes,,\r\n";

    #[test]
    fn a_list_comes_back_as_it_went() {
        let points = read(LIST).unwrap();
        assert_eq!(points.len(), 3);
        assert_eq!(
            (points[0].unit.as_str(), points[0].text.as_str()),
            ("°C", "hot, and measured")
        );
        assert_eq!(
            (points[1].raw, points[1].writable, points[1].text.as_str()),
            (Some([0.0, 10_000.0]), true, "=valve")
        );
        assert_eq!((points[2].table, points[2].address), (Table::Coil, 7));
        let text = write(&points).unwrap();
        assert!(
            text.starts_with('\u{feff}') && text.contains("'=valve") && text.contains("\r\n"),
            "{text}"
        );
        assert_eq!(read(&text).unwrap(), points);
    }

    #[test]
    fn what_a_spreadsheet_makes_of_it_is_understood() {
        let semicolons = "ID;Table;Address;Low;High;Scale;;\nt;input;3;-0,5;1,5;0,01;;\n;;;;;;;\n";
        let points = read(semicolons).unwrap();
        assert_eq!(
            (points[0].low, points[0].high, points[0].scale),
            (Some(-0.5), Some(1.5), Some(0.01))
        );
        let tabs = "id\ttable\taddress\nt\tcoil\t3\n";
        assert_eq!(read(tabs).unwrap()[0].address, 3);
    }

    #[test]
    fn errors_name_line_and_column() {
        for (text, part) in [
            ("", "line 1: there is no heading"),
            ("id,address\n", "line 1: no column is named \"table\""),
            ("id,table,address,id\n", "two columns are named \"id\""),
            (
                "id,table,address\nt,input,x\n",
                "line 2, column 3 (address): \"x\" is no whole number",
            ),
            ("id,table,address\nt,input,70000\n", "line 2, column 3 (address): "),
            (
                "id,table,address\nt,inputs,0\n",
                "line 2, column 2 (table): unknown variant",
            ),
            ("id,table,address\n\nT 1,input,0\n", "line 3, column 1 (id): "),
            (
                "id,table,address,low\nt,input,0,1.5.2\n",
                "line 2, column 4 (low): \"1.5.2\" is no number",
            ),
            ("id,table,address,writable\nt,coil,0,maybe\n", "neither true nor false"),
            (
                "id,table,address,colour\nt,coil,0,red\n",
                "line 2, column 4 (colour): unknown field",
            ),
            (
                "id,table,address,raw_low\nt,input,0,4\n",
                "line 2: raw_low and raw_high are needed together",
            ),
            ("id,table,address\nt,coil,0,surplus\n", "line 2, column 4 (no heading)"),
            ("id,table,address\nt,coil\n", "line 2: missing field `address`"),
        ] {
            let error = read(text).expect_err(part).to_string();
            assert!(error.contains(part), "{text:?}: {error}");
        }
    }

    proptest! {
        #[test]
        fn any_text_is_a_list_or_an_error(text in ".{0,200}") {
            let _ = read(&text);
            let _ = read(&format!("id,table,address,text\n{text}"));
        }

        #[test]
        fn any_words_and_numbers_survive(text in "[^\r\n]{0,40}", low in -1e9..1e9_f64, address in 0_u16..=65_535) {
            let mut points = read(LIST).unwrap();
            points[0].text = text.trim().to_owned();
            points[0].low = Some(low);
            points[0].address = address;
            prop_assert_eq!(read(&write(&points).unwrap()).unwrap(), points);
        }
    }
}
