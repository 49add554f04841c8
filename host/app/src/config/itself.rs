//! Checks of what a host says of itself: its labels, and how far a drill moves its date.
//!
//! Never: reads the file; `config` does.

use std::path::Path;

use bumpless_core::{HostId, limits::HOST_LABELS_MAX};
use bumpless_deploy::{HostAlarms, webhook::WebhookConfig};

use crate::error::Error;

/// Furthest that a drill moves the date, in s: a year.
const CLOCK_OFFSET_S_MAX: u64 = 366 * 86_400;

/// Checks labels and date; `wrong` makes the error of a key.
pub(super) fn check(
    labels: &[String],
    clock_offset_s: i64,
    wrong: &dyn Fn(&str, String) -> Error,
) -> Result<(), Error> {
    if labels.len() > HOST_LABELS_MAX {
        return Err(wrong("labels", format!("a host has at most {HOST_LABELS_MAX} labels")));
    }
    if let Some(bad) = labels.iter().find(|label| HostId::new(label.as_str()).is_err()) {
        let reason = format!("{bad:?} is no label; use lower-case letters, digits, '-', '_' and '.'");
        return Err(wrong("labels", reason));
    }
    if clock_offset_s.unsigned_abs() > CLOCK_OFFSET_S_MAX {
        let reason = format!("{clock_offset_s} is more than {CLOCK_OFFSET_S_MAX} s, a year, either way");
        return Err(wrong("clock_offset_s", reason));
    }
    Ok(())
}

/// From when on the host's own clock and disk are alarms, within bounds.
pub(super) fn alarms(table: HostAlarms, wrong: &dyn Fn(&str, String) -> Error) -> Result<HostAlarms, Error> {
    let HostAlarms {
        clock_offset_max_ms: clock,
        disk_free_min_mib: disk,
    } = table;
    super::in_range(wrong, "alarms.clock_offset_max_ms", Some(clock), 0, 10, 3_600_000)?;
    super::in_range(wrong, "alarms.disk_free_min_mib", Some(disk), 0, 1, 1_048_576)?;
    Ok(table)
}

/// Who is told of alarms: each by a name of its own.
pub(super) fn webhooks(
    mut tables: Vec<WebhookConfig>,
    folder: &Path,
    wrong: &dyn Fn(&str, String) -> Error,
) -> Result<Vec<WebhookConfig>, Error> {
    let most = bumpless_deploy::limits::WEBHOOKS_MAX;
    if tables.len() > most {
        return Err(wrong(
            "webhook",
            format!("there are {} of them; at most {most} are possible", tables.len()),
        ));
    }
    let mut names = std::collections::HashSet::new();
    for table in &mut tables {
        table.resolve(folder);
        table.check().map_err(|error| wrong("webhook", error.to_string()))?;
        if !names.insert(table.name.clone()) {
            return Err(wrong(
                "webhook.name",
                format!("two are named {:?}; give each its own name", table.name),
            ));
        }
    }
    Ok(tables)
}
