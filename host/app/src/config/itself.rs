//! Checks of what a host says of itself: its labels, and how far a drill moves its date.
//!
//! Never: reads the file; `config` does.

use bumpless_core::{HostId, limits::HOST_LABELS_MAX};

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
