//! What can be typed about alarms.
//!
//! Never: does the work; `commands::alarms` does.

use std::path::PathBuf;

use clap::Subcommand;

/// What can be done with alarms.
#[derive(Debug, Subcommand)]
pub(crate) enum AlarmCommand {
    /// List what stands or waits for a person, the most urgent first.
    List {
        /// Only those of this loop.
        #[arg(long = "loop", value_name = "LOOP")]
        loop_name: Option<String>,
        /// All, those that are normal and those that are quiet too.
        #[arg(long)]
        all: bool,
    },
    /// What happened, newest first.
    History {
        /// Only those of this loop.
        #[arg(long = "loop", value_name = "LOOP")]
        loop_name: Option<String>,
        /// At most so many.
        #[arg(long, default_value_t = 50)]
        limit: u32,
    },
    /// Follow what happens to alarms, as it happens.
    Watch {
        /// Only those of this loop.
        #[arg(long = "loop", value_name = "LOOP")]
        loop_name: Option<String>,
        /// Stop after so many happenings.
        #[arg(long, value_name = "N")]
        count: Option<u64>,
    },
    /// Acknowledge: a person has seen it.
    Ack {
        #[command(flatten)]
        of: Of,
        /// A note for those who look later.
        #[arg(long, default_value = "")]
        note: String,
    },
    /// Let a latched alarm go back to normal.
    Reset {
        #[command(flatten)]
        of: Of,
    },
    /// Keep it quiet for a time.
    Shelve {
        #[command(flatten)]
        of: Of,
        /// For how long: 30s, 10m, 2h; at most 12h.
        #[arg(long = "for", value_name = "TIME", value_parser = seconds)]
        seconds: f64,
        /// Why.
        #[arg(long)]
        reason: String,
    },
    /// Tell a shelved alarm again.
    Unshelve {
        #[command(flatten)]
        of: Of,
    },
    /// Take it out of service.
    Out {
        #[command(flatten)]
        of: Of,
        /// Why.
        #[arg(long)]
        reason: String,
    },
    /// Put it back into service.
    Back {
        #[command(flatten)]
        of: Of,
    },
    /// Define the alarms of a file: `[LOOP.ALARM]` tables with kind, limit, priority and more.
    Define {
        /// A TOML file.
        file: PathBuf,
    },
    /// Remove an alarm of a loop.
    Remove {
        #[command(flatten)]
        of: Of,
    },
}

impl AlarmCommand {
    /// What `bumpless alarm` alone does.
    pub(crate) const fn standing() -> Self {
        Self::List {
            loop_name: None,
            all: false,
        }
    }
}

/// Which alarm, and who does it.
#[derive(Debug, clap::Args)]
pub(crate) struct Of {
    /// The loop.
    pub(crate) loop_name: String,
    /// The alarm.
    pub(crate) alarm: String,
    /// Who does it, for people.
    #[arg(long, env = "USER", default_value = "")]
    pub(crate) by: String,
}

/// `30s`, `10m`, `2h`.
fn seconds(text: &str) -> Result<f64, String> {
    let unit = |end| text.strip_suffix(end).and_then(|number| number.parse::<f64>().ok());
    let seconds = unit("s")
        .or_else(|| unit("m").map(|minutes| minutes * 60.0))
        .or_else(|| unit("h").map(|hours| hours * 3600.0));
    seconds
        .filter(|seconds| seconds.is_finite() && *seconds > 0.0)
        .ok_or_else(|| format!("{text:?} is no time: write it as 30s, 10m or 2h"))
}
