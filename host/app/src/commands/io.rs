//! `io scan | read | write | watch | force | unforce | forced | buses`: points and devices.
//!
//! Never: decides; the host of the point or bus does. Only `scan` of an address asks a device itself.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

use bumpless_api::types::{
    Buses, ByRequest, Force, ForceRequest, JobRequest, Point, Points, Quality, Redundant, ScanRequest, WriteRequest,
};
use bumpless_io::scan::{ScanPlan, scan};

use super::{jobs, point_lists};
use crate::{
    cli::io::{IoCommand, ScanArgs},
    client::{Answer, Client, encoded},
    error::Error,
    show,
};

/// Does one thing. Some of them need no cell.
pub(crate) fn run(client: impl FnOnce() -> Result<Client, Error>, json: bool, what: IoCommand) -> Result<(), Error> {
    match what {
        IoCommand::Map { config, bus } => point_lists::map(&config, bus.as_deref()),
        IoCommand::Export { config, bus, output } => point_lists::export(&config, &bus, output.as_deref()),
        IoCommand::Import {
            list,
            config,
            bus,
            write,
        } => point_lists::import(&list, &config, &bus, write),
        IoCommand::Scan(args) => match &args.address {
            Some(address) => scan_address(json, address, &args),
            None => scan_bus(&client()?, json, args),
        },
        IoCommand::Read { points } => read(&client()?, json, &points),
        IoCommand::Write { point, value, by } => {
            let request = WriteRequest { value, by: by.name() };
            one(json, &client()?.post(&path(&point, "/write"), &request)?)
        }
        IoCommand::Force {
            point,
            value,
            seconds,
            why,
            by,
        } => {
            let request = ForceRequest {
                value,
                seconds,
                by: by.name(),
                why,
            };
            one(json, &client()?.post(&path(&point, "/force"), &request)?)
        }
        IoCommand::Unforce { point, by } => one(
            json,
            &client()?.post(&path(&point, "/unforce"), &ByRequest { by: by.name() })?,
        ),
        IoCommand::Forced => forced(&client()?, json),
        IoCommand::Buses => buses(&client()?, json),
        IoCommand::Job { what } => jobs::run(&client()?, json, what),
        IoCommand::Watch {
            points,
            every_ms,
            looks,
        } => watch(&client()?, json, &points, every_ms, looks),
    }
}

fn path(point: &str, rest: &str) -> String {
    format!("/v1/points/{}{rest}", encoded(point))
}

fn one(json: bool, answer: &Answer) -> Result<(), Error> {
    if json {
        return show::json(&answer.text);
    }
    show::line(&line(&answer.decode()?))
}

/// How long a force still lasts.
fn left(force: &Force) -> String {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    let now_ms = u64::try_from(now.as_millis()).unwrap_or(u64::MAX);
    show::age(force.until_unix_ms.saturating_sub(now_ms))
}

/// A point in one line.
fn line(point: &Point) -> String {
    let mut text = format!("{} = {}", point.name, show::with_unit(point.value, &point.unit));
    match point.quality {
        Quality::Good => {}
        quality if point.reason.is_empty() => text.push_str(&format!("  ({})", quality.name())),
        quality => text.push_str(&format!("  ({}: {})", quality.name(), point.reason)),
    }
    if let Some(force) = &point.force {
        text.push_str(&format!(
            "  forced to {} by {} for another {}: {}",
            show::with_unit(force.value, &point.unit),
            force.by,
            left(force),
            force.why
        ));
    }
    if let Some(writer) = &point.written_by {
        text.push_str(&format!("  written by loop {writer}"));
    }
    text
}

fn read(client: &Client, json: bool, points: &[String]) -> Result<(), Error> {
    for point in points {
        one(json, &client.get(&path(point, ""))?)?;
    }
    Ok(())
}

fn watch(client: &Client, json: bool, points: &[String], every_ms: u64, looks: Option<u64>) -> Result<(), Error> {
    let mut last: Vec<Option<String>> = vec![None; points.len()];
    let mut look = 0;
    loop {
        for (point, last) in points.iter().zip(&mut last) {
            let answer = client.get(&path(point, ""))?;
            let text = line(&answer.decode()?);
            if last.as_ref() != Some(&text) {
                if json {
                    show::line(&answer.text)?;
                } else {
                    show::line(&text)?;
                }
                *last = Some(text);
            }
        }
        look += 1;
        if looks.is_some_and(|looks| look >= looks) {
            return Ok(());
        }
        std::thread::sleep(Duration::from_millis(every_ms));
    }
}

fn forced(client: &Client, json: bool) -> Result<(), Error> {
    let mut points: Points = client.list("/v1/points?forced=true", "points")?.decode()?;
    points.points.retain(|point| point.force.is_some());
    if json {
        let text = serde_json::to_string(&points).map_err(|error| Error::Failed {
            what: "the list",
            source: error.into(),
        })?;
        return show::json(&text);
    }
    if points.points.is_empty() {
        return show::line("nothing is forced");
    }
    let mut table = show::table(&["point", "forced to", "value", "by", "why", "for", "host"]);
    for point in points.points {
        let Some(force) = point.force else { continue };
        let left = left(&force);
        table.add_row([
            point.name,
            show::with_unit(force.value, &point.unit),
            show::with_unit(point.value, &point.unit),
            force.by,
            force.why,
            left,
            point.host,
        ]);
    }
    show::print(&table)
}

fn buses(client: &Client, json: bool) -> Result<(), Error> {
    let answer = client.list("/v1/buses", "buses")?;
    if json {
        return show::json(&answer.text);
    }
    let buses: Buses = answer.decode()?;
    let mut table = show::table(&[
        "bus",
        "host",
        "driver",
        "device",
        "points",
        "polls",
        "writes",
        "errors",
        "latency",
        "jobs",
        "last error",
    ]);
    for bus in buses.buses {
        let names: Vec<String> = bus.jobs.into_iter().map(|job| job.name).collect();
        table.add_row([
            bus.name,
            bus.host,
            bus.driver,
            match (bus.connected, &bus.redundant) {
                (false, Some(Redundant { with, epoch: None, .. })) => format!("AWAY, cannot stand by for {with}"),
                (false, _) => "away".to_owned(),
                (true, None) => "answers".to_owned(),
                (
                    true,
                    Some(Redundant {
                        with,
                        epoch: None,
                        ready,
                        ..
                    }),
                ) if *ready => format!("stands by for {with}"),
                (true, Some(Redundant { with, epoch: None, .. })) => format!("cannot stand by for {with}"),
                (true, Some(Redundant { epoch: Some(epoch), .. })) => format!("master, epoch {epoch}"),
            },
            bus.points.to_string(),
            bus.polls.to_string(),
            bus.writes.to_string(),
            bus.errors.to_string(),
            format!("{:.1} ms", bus.latency_us as f64 / 1e3),
            match bus.jobs_waiting {
                0 => names.join(", "),
                waiting => format!("{} ({waiting} wait)", names.join(", ")),
            },
            bus.last_error.unwrap_or_default(),
        ]);
    }
    show::print(&table)
}

fn scan_bus(client: &Client, json: bool, args: ScanArgs) -> Result<(), Error> {
    let request = JobRequest {
        bus: args.bus.unwrap_or_default(),
        host: args.host,
        name: None,
        write_block: None,
        read_block: None,
        scan: Some(ScanRequest {
            units: Some(args.units.0),
            tables: (!args.tables.is_empty()).then(|| args.tables.into_iter().map(jobs::table).collect()),
            first: Some(args.first),
            last: Some(args.last),
            timeout_ms: Some(args.timeout_ms),
            pause_ms: Some(args.pause_ms),
        }),
        by: args.by.name(),
        key: None,
        queue_ms: None,
        timeout_ms: None,
    };
    let answer = client.post("/v1/jobs", &request)?;
    jobs::wait(client, json, &answer)
}

fn scan_address(json: bool, address: &str, args: &ScanArgs) -> Result<(), Error> {
    let usual = ScanPlan::default();
    let plan = ScanPlan {
        units: args.units.0.clone(),
        tables: if args.tables.is_empty() {
            usual.tables
        } else {
            args.tables.clone()
        },
        first: args.first,
        last: args.last,
        timeout_ms: args.timeout_ms,
        pause_ms: args.pause_ms,
    };
    let failed = |source: Box<dyn std::error::Error + Send + Sync>| Error::Failed {
        what: "the scan",
        source,
    };
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .map_err(|error| failed(error.into()))?;
    let found = runtime
        .block_on(scan(address, &plan))
        .map_err(|error| failed(error.into()))?;
    if json {
        let text = serde_json::to_string(&found).map_err(|error| failed(error.into()))?;
        return show::json(&text);
    }
    if found.units.is_empty() {
        show::note("no unit answers");
    }
    let mut table = show::table(&["unit", "table", "addresses", "count"]);
    for stretch in &found.stretches {
        table.add_row([
            stretch.unit_id.to_string(),
            jobs::table(stretch.table).name().to_owned(),
            format!("{} to {}", stretch.start, u32::from(stretch.start) + stretch.count - 1),
            stretch.count.to_string(),
        ]);
    }
    show::print(&table)?;
    for unit in &found.units {
        if !found.stretches.iter().any(|stretch| stretch.unit_id == *unit) {
            show::note(&format!("unit {unit} answers, and has none of these addresses"));
        }
    }
    if let Some(stopped) = found.stopped {
        show::note(&format!("not finished: {stopped}"));
    }
    Ok(())
}
