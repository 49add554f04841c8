//! `history`: what a loop or a point did, for years, as a table or as a file.
//!
//! Never: holds a whole file in memory, or leaves half of one behind.

use std::{
    fs::File,
    io::{self, Write as _},
    time::Duration,
};

use bumpless_api::types::{History, HistoryValues};

use crate::{
    cli::{FormatWord, HistoryArgs},
    client::{Client, encoded},
    error::Error,
    show,
};

/// Pieces of a table: what fits on a screen.
const TABLE_PIECES: u32 = 24;

/// Longest silence of a file on its way: the cell may have to gather a page of it from hosts that do not answer.
const SILENCE_MAX: Duration = Duration::from_secs(60);

/// Does it.
pub(crate) fn run(client: &Client, json: bool, args: &HistoryArgs) -> Result<(), Error> {
    let kind = if args.point { "points" } else { "loops" };
    let fineness = match (args.step, args.buckets) {
        (Some(step), _) => format!("step={}", step.name()),
        (None, Some(buckets)) => format!("buckets={buckets}"),
        (None, None) if args.format.is_none() => format!("buckets={TABLE_PIECES}"),
        (None, None) => "buckets=500".to_owned(),
    };
    let path = format!(
        "/v1/{kind}/{}/history?from={}&to={}&{fineness}",
        encoded(&args.name),
        encoded(&args.from),
        encoded(&args.to)
    );
    match args.format {
        None => {
            let answer = client.get(&path)?;
            if json {
                show::json(&answer.text)
            } else {
                table(&answer.decode()?)
            }
        }
        Some(format) => file(client, &format!("{path}&format={}", format.name()), format, args),
    }
}

fn file(client: &Client, path: &str, format: FormatWord, args: &HistoryArgs) -> Result<(), Error> {
    let mut body = client.stream(path, SILENCE_MAX)?;
    let Some(target) = &args.output else {
        let mut out = io::stdout().lock();
        let end = io::copy(&mut body, &mut out).and_then(|_| out.flush());
        return match end {
            // A reader that went away (`| head`) is no failure.
            Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(()),
            end => end.map_err(|source| Error::Failed {
                what: "the download",
                source: source.into(),
            }),
        };
    };
    let failed = |action| {
        move |source| Error::File {
            path: target.clone(),
            action,
            source,
        }
    };
    // Beside its place first, so that a connection that breaks off leaves no half file under the name.
    let draft = target.with_extension(format!("{}.part", format.name()));
    let mut out = File::create(&draft).map_err(failed("created"))?;
    let end = io::copy(&mut body, &mut out).and_then(|bytes| out.sync_all().map(|()| bytes));
    let end = end.map_err(failed("written"));
    let bytes = end.inspect_err(|_| {
        let _ = std::fs::remove_file(&draft);
    })?;
    std::fs::rename(&draft, target).map_err(failed("put into its place"))?;
    show::line(&format!("{}: {bytes} bytes", target.display()))
}

fn table(found: &History) -> Result<(), Error> {
    let first_output = found.outputs.iter().next();
    let mut heads = vec![
        "time (UTC)",
        "cycles",
        "lost",
        "late",
        "bad",
        "setpoint",
        "measured",
        "least",
        "greatest",
    ];
    heads.extend(first_output.map(|_| "output"));
    let mut table = show::table(&heads);
    let value = |column: &[Option<f64>], row: usize| show::maybe(column.get(row).copied().flatten());
    let count = |column: &[u64], row: usize| column.get(row).copied().unwrap_or_default().to_string();
    for (row, at) in found.at_unix_us.iter().enumerate() {
        let measured: &HistoryValues = &found.measurement;
        let mut cells = vec![
            show::utc(*at),
            count(&found.cycles, row),
            count(&found.lost, row),
            count(&found.late, row),
            count(&found.bad, row),
            value(&found.setpoint.mean, row),
            value(&measured.mean, row),
            value(&measured.min, row),
            value(&measured.max, row),
        ];
        cells.extend(first_output.map(|(_, output)| value(&output.mean, row)));
        table.add_row(cells);
    }
    show::print(&table)?;
    for gap in &found.gaps {
        show::line(&format!(
            "  nothing is known from {} to {}",
            show::utc(gap.from_unix_us),
            show::utc(gap.to_unix_us)
        ))?;
    }
    for silent in &found.silent {
        show::note(&format!("{} did not answer: {}", silent.host, silent.reason));
    }
    if found.sources.is_empty() {
        return Ok(());
    }
    show::line(&format!("  from {}", found.sources.join(", ")))
}
