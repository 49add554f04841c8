//! What can be typed about points, devices and jobs.
//!
//! Never: does the work; `commands::io`, `commands::jobs` and `commands::point_lists` do.

use std::path::PathBuf;

use bumpless_io::modbus::Table;
use clap::{Args, Subcommand};

/// What can be done with points, devices and jobs.
#[derive(Debug, Subcommand)]
pub(crate) enum IoCommand {
    /// Find which units and addresses of a Modbus TCP device answer: of any device, or of a bus by its host.
    Scan(ScanArgs),
    /// Read points as their hosts see them now.
    Read {
        /// The points.
        #[arg(required = true, value_name = "POINT")]
        points: Vec<String>,
    },
    /// Write a point that no loop writes.
    Write {
        /// The point.
        point: String,
        /// In its unit.
        #[arg(allow_negative_numbers = true)]
        value: f64,
        #[command(flatten)]
        by: By,
    },
    /// Print points again and again: one line each time one has changed.
    Watch {
        /// The points.
        #[arg(required = true, value_name = "POINT")]
        points: Vec<String>,
        /// Look so often, in ms.
        #[arg(long, default_value_t = 500, value_parser = clap::value_parser!(u64).range(50..=3_600_000))]
        every_ms: u64,
        /// Stop after so many looks.
        #[arg(long)]
        looks: Option<u64>,
    },
    /// Hold a point at a value: an input reads it, an output's actuator gets it whatever its loop wants.
    Force {
        /// The point.
        point: String,
        /// In its unit.
        #[arg(allow_negative_numbers = true)]
        value: f64,
        /// For so long: `90s`, `10m`, `2h`; at most 24 h. Then it ends by itself.
        #[arg(long = "for", value_name = "TIME", value_parser = seconds)]
        seconds: u64,
        /// Why: the next shift will ask.
        #[arg(long)]
        why: String,
        #[command(flatten)]
        by: By,
    },
    /// Let a point go before its time.
    Unforce {
        /// The point.
        point: String,
        #[command(flatten)]
        by: By,
    },
    /// List the points that are forced: at what, by whom, why and until when.
    Forced,
    /// List the buses: how their devices are, and which jobs they know.
    Buses,
    /// Jobs: what takes long is acknowledged at once and told of later.
    Job {
        #[command(subcommand)]
        what: JobCommand,
    },
    /// Show how the points of a configuration become requests, without a device.
    Map {
        /// The host's configuration file.
        #[arg(long, value_name = "FILE")]
        config: PathBuf,
        /// Only this bus.
        #[arg(long)]
        bus: Option<String>,
    },
    /// Print the points of a Modbus bus as CSV, for a spreadsheet.
    Export {
        /// The host's configuration file.
        #[arg(long, value_name = "FILE")]
        config: PathBuf,
        /// The bus.
        #[arg(long)]
        bus: String,
        /// Write it here instead of printing it.
        #[arg(long, short = 'o', value_name = "FILE")]
        output: Option<PathBuf>,
    },
    /// Check a point list (CSV) and print it as configuration; with --write, put it into the configuration file.
    Import {
        /// The list.
        list: PathBuf,
        /// The host's configuration file.
        #[arg(long, value_name = "FILE")]
        config: PathBuf,
        /// The bus.
        #[arg(long)]
        bus: String,
        /// Replace the bus's points in the file. Everything else in it stays as it is.
        #[arg(long)]
        write: bool,
    },
}

/// Who asks.
#[derive(Debug, Clone, Args)]
pub(crate) struct By {
    /// Who asks, for the log and the next shift; the user's name where not given.
    #[arg(long, env = "BUMPLESS_BY", value_name = "NAME")]
    by: Option<String>,
}

impl By {
    /// The name.
    pub(crate) fn name(&self) -> String {
        let user = || {
            ["USER", "LOGNAME"]
                .iter()
                .find_map(|key| std::env::var(key).ok().filter(|name| !name.is_empty()))
        };
        self.by
            .clone()
            .or_else(user)
            .unwrap_or_else(|| "the command line".to_owned())
    }
}

/// What to look at.
#[derive(Debug, Args)]
pub(crate) struct ScanArgs {
    /// `host:port` of any device; asked from this machine.
    #[arg(required_unless_present = "bus", conflicts_with = "bus")]
    pub(crate) address: Option<String>,
    /// A bus of the cell instead; asked by its host, as a job.
    #[arg(long)]
    pub(crate) bus: Option<String>,
    /// The host of the bus, where several have one of that name.
    #[arg(long, requires = "bus")]
    pub(crate) host: Option<String>,
    /// Units: `1-10,17`.
    #[arg(long, default_value = "1-10", value_parser = units)]
    pub(crate) units: Units,
    /// Tables: coil, discrete, holding, input; all where not given.
    #[arg(long = "table", value_name = "TABLE", value_parser = table)]
    pub(crate) tables: Vec<Table>,
    /// First address, from 0.
    #[arg(long, default_value_t = 0)]
    pub(crate) first: u16,
    /// Last address.
    #[arg(long, default_value_t = 99)]
    pub(crate) last: u16,
    /// Longest wait for an answer, in ms.
    #[arg(long, default_value_t = 300)]
    pub(crate) timeout_ms: u64,
    /// Pause between two requests, in ms.
    #[arg(long, default_value_t = 10)]
    pub(crate) pause_ms: u64,
    #[command(flatten)]
    pub(crate) by: By,
}

/// What can be done with jobs.
#[derive(Debug, Subcommand)]
pub(crate) enum JobCommand {
    /// Start a job of the bus's configuration, or write or read neighbouring addresses.
    Start(JobArgs),
    /// Show a job with its result so far.
    Show {
        /// Its name, as `plant.1000001`.
        id: String,
    },
    /// List the jobs of all hosts, oldest first.
    List,
    /// Cancel a job: at once while it waits, between two requests while it runs.
    Cancel {
        /// Its name, as `plant.1000001`.
        id: String,
        #[command(flatten)]
        by: By,
    },
}

/// A job to start.
#[derive(Debug, Args)]
pub(crate) struct JobArgs {
    /// The bus.
    pub(crate) bus: String,
    /// A job of its configuration, or `write-block`, `read-block`.
    pub(crate) name: String,
    /// The host of the bus, where several have one of that name.
    #[arg(long)]
    pub(crate) host: Option<String>,
    /// For blocks: the table.
    #[arg(long, value_parser = table)]
    pub(crate) table: Option<Table>,
    /// For blocks: the first address, from 0.
    #[arg(long)]
    pub(crate) address: Option<u16>,
    /// For `read-block`: how many.
    #[arg(long)]
    pub(crate) count: Option<u16>,
    /// For `write-block`: the values, separated by commas.
    #[arg(long, value_delimiter = ',')]
    pub(crate) values: Vec<u16>,
    /// For `write-block`: do not read back.
    #[arg(long)]
    pub(crate) no_verify: bool,
    /// For blocks: the unit, if not the bus's.
    #[arg(long)]
    pub(crate) unit_id: Option<u8>,
    /// Your own name for the wish: asked again with it, it is done once.
    #[arg(long)]
    pub(crate) key: Option<String>,
    /// Longest wait for its turn, in ms.
    #[arg(long)]
    pub(crate) queue_ms: Option<u64>,
    /// Longest time once it runs, in ms.
    #[arg(long)]
    pub(crate) timeout_ms: Option<u64>,
    /// Wait for its end, and print it.
    #[arg(long)]
    pub(crate) wait: bool,
    #[command(flatten)]
    pub(crate) by: By,
}

/// Numbers of units.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Units(pub(crate) Vec<u8>);

/// `1-10,17`.
fn units(text: &str) -> Result<Units, String> {
    let number = |text: &str| {
        text.trim()
            .parse::<u8>()
            .map_err(|_| format!("{text:?} is no unit: 0 to 255"))
    };
    let mut all = Vec::new();
    for part in text.split(',') {
        match part.split_once('-') {
            Some((first, last)) => {
                let (first, last) = (number(first)?, number(last)?);
                if first > last {
                    return Err(format!("{part:?}: the first unit lies behind the last"));
                }
                all.extend(first..=last);
            }
            None => all.push(number(part)?),
        }
    }
    all.sort_unstable();
    all.dedup();
    Ok(Units(all))
}

/// A table's name.
fn table(text: &str) -> Result<Table, String> {
    match text {
        "coil" => Ok(Table::Coil),
        "discrete" => Ok(Table::Discrete),
        "holding" => Ok(Table::Holding),
        "input" => Ok(Table::Input),
        _ => Err(format!("{text:?} is none of coil, discrete, holding, input")),
    }
}

/// `90s`, `10m`, `2h`; a number alone is seconds.
fn seconds(text: &str) -> Result<u64, String> {
    let (number, factor) = match text.char_indices().last() {
        Some((at, 's')) => (text.get(..at), 1),
        Some((at, 'm')) => (text.get(..at), 60),
        Some((at, 'h')) => (text.get(..at), 3_600),
        _ => (Some(text), 1),
    };
    number
        .and_then(|number| number.trim().parse::<u64>().ok())
        .and_then(|number| number.checked_mul(factor))
        .filter(|seconds| (1..=86_400).contains(seconds))
        .ok_or_else(|| format!("{text:?} is no time from 1s to 24h; write it as 90s, 10m or 2h"))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]
    use super::*;

    #[test]
    fn units_and_times_are_read_as_people_write_them() {
        assert_eq!(units("1-3,7, 2").unwrap(), Units(vec![1, 2, 3, 7]));
        assert_eq!(units("0-255").unwrap().0.len(), 256);
        for bad in ["", "x", "3-1", "256", "1,,2"] {
            assert!(units(bad).is_err(), "{bad}");
        }
        for (text, s) in [("90s", 90), ("10m", 600), ("24h", 86_400), ("5", 5)] {
            assert_eq!(seconds(text), Ok(s));
        }
        for bad in ["", "0s", "25h", "h", "-1s", "1d", "ä"] {
            assert!(seconds(bad).is_err(), "{bad}");
        }
        assert!(table("coils").is_err());
    }
}
