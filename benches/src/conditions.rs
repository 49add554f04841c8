//! Under which conditions a bench ran: figures mean little without them.
//!
//! Never: fails; what cannot be found out is "unknown".

use std::{
    fmt,
    fs::read_to_string,
    process::Command,
    time::{SystemTime, UNIX_EPOCH},
};

/// The machine and the build at the start of a bench.
#[derive(Debug)]
pub(crate) struct Conditions {
    bench: &'static str,
    counts: &'static str,
    date: String,
    processor: String,
    cores: usize,
    kernel: String,
    compiler: String,
    build: &'static str,
    load: String,
}

impl Conditions {
    /// Looks at the machine now.
    pub(crate) fn now(bench: &'static str, quick: bool) -> Self {
        let unknown = || "unknown".to_owned();
        let line_of = |path: &str| read_to_string(path).ok().map(|text| text.trim().to_owned());
        let processor = read_to_string("/proc/cpuinfo").ok().and_then(|text| {
            let line = text.lines().find(|line| line.starts_with("model name"))?;
            Some(line.split(':').nth(1)?.trim().to_owned())
        });
        let rustc = Command::new("rustc").arg("--version").output().ok();
        let compiler = rustc.map(|output| String::from_utf8_lossy(&output.stdout).trim().to_owned());
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        Self {
            bench,
            counts: if quick { "quick" } else { "full" },
            date: date(now.as_secs()),
            processor: processor.unwrap_or_else(unknown),
            cores: std::thread::available_parallelism().map_or(0, usize::from),
            kernel: line_of("/proc/sys/kernel/osrelease").unwrap_or_else(unknown),
            compiler: compiler.filter(|text| !text.is_empty()).unwrap_or_else(unknown),
            build: if cfg!(debug_assertions) {
                "dev: figures mean nothing"
            } else {
                "release"
            },
            load: line_of("/proc/loadavg").unwrap_or_else(unknown),
        }
    }
}

impl fmt::Display for Conditions {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "bench      {} ({})", self.bench, self.counts)?;
        writeln!(f, "date       {}", self.date)?;
        writeln!(f, "processor  {} × {}", self.cores, self.processor)?;
        writeln!(f, "kernel     {}", self.kernel)?;
        writeln!(f, "compiler   {}", self.compiler)?;
        writeln!(f, "build      {}", self.build)?;
        writeln!(f, "load       {}\n", self.load)
    }
}

/// Date and time, UTC, from seconds since 1970. Source: Howard Hinnant, "chrono-Compatible Low-Level Date Algorithms",
/// `civil_from_days`.
fn date(unix_s: u64) -> String {
    let (days, second) = (unix_s / 86_400 + 719_468, unix_s % 86_400);
    let (era, day_of_era) = (days / 146_097, days % 146_097);
    let year_of_era = (day_of_era - day_of_era / 1460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let shifted_month = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * shifted_month + 2) / 5 + 1;
    let month = if shifted_month < 10 {
        shifted_month + 3
    } else {
        shifted_month - 9
    };
    let year = era * 400 + year_of_era + u64::from(month <= 2);
    let (hour, minute) = (second / 3600, second / 60 % 60);
    format!("{year}-{month:02}-{day:02} {hour:02}:{minute:02} UTC")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates_are_those_of_the_calendar() {
        for (unix_s, text) in [
            (0, "1970-01-01 00:00 UTC"),
            (951_782_399, "2000-02-28 23:59 UTC"),
            (951_782_400, "2000-02-29 00:00 UTC"),
            (1_709_164_800, "2024-02-29 00:00 UTC"),
            (1_798_761_600, "2027-01-01 00:00 UTC"),
        ] {
            assert_eq!(date(unix_s), text);
        }
    }
}
