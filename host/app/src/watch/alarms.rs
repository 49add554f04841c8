//! What happens to alarms as lines, as it happens.
//!
//! Never: asks for the list; `alarm list` says how things stand.

use std::{sync::atomic::Ordering, time::Duration};

use bumpless_api::types::{AlarmHappening, Priority};

use super::feed::{Feed, News};
use crate::{client::Client, error::Error, show, stop};

/// How often an order to stop is looked for while nothing comes.
const LOOK_EVERY: Duration = Duration::from_millis(200);

/// One happening as a line.
pub(super) fn row(event: &AlarmHappening) -> String {
    let priority = match event.priority {
        Priority::Low => "low",
        Priority::Medium => "medium",
        Priority::High => "high",
    };
    let at = std::time::UNIX_EPOCH + Duration::from_micros(event.at_unix_us);
    let mut text = format!(
        "{} {priority:<6} {} {}: {}",
        humantime::format_rfc3339_seconds(at),
        event.loop_name,
        event.alarm,
        event.what
    );
    if let Some(value) = event.value.filter(|_| event.what == "came") {
        text.push_str(&format!(" at {}", show::number(value)));
    }
    for (said, before) in [
        (event.by.as_deref().unwrap_or_default(), " by "),
        (event.note.as_str(), ": "),
    ] {
        if !said.is_empty() {
            text.push_str(before);
            text.push_str(said);
        }
    }
    if event.first_out {
        text.push_str(" (first)");
    }
    if event.quiet {
        text.push_str(" (kept quiet)");
    }
    text
}

/// Follows until `count` have come, or the reader or Ctrl-C ends it.
pub(crate) fn alarms(client: &Client, json: bool, loop_name: Option<&str>, count: Option<u64>) -> Result<(), Error> {
    let stop = stop::on_signals()?;
    let feed = Feed::of_alarms(client, loop_name)?;
    let mut seen = 0;
    while !stop.load(Ordering::Relaxed) && count.is_none_or(|count| seen < count) {
        match feed.next(LOOK_EVERY) {
            Some(News::Alarm(event, text)) => {
                seen += 1;
                show::line(&if json { text } else { row(&event) })?;
            }
            Some(News::Disconnected(reason)) => {
                show::note(&format!("the feed ended ({reason}); another host is tried"));
            }
            Some(News::Gone(reason)) => {
                return Err(Error::Unreachable {
                    api: client.api().to_owned(),
                    reason,
                });
            }
            Some(News::Record(..) | News::Hosts(_) | News::Lost(_) | News::Connected(_)) | None => {}
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_happening_is_one_line() {
        let event = AlarmHappening {
            id: "plant-7".to_owned(),
            host: "plant".to_owned(),
            at_unix_us: 1_767_225_600_000_000,
            loop_name: "pressure".to_owned(),
            alarm: "high".to_owned(),
            what: "came".to_owned(),
            state: bumpless_api::types::AlarmState::Active,
            priority: Priority::High,
            value: Some(2.25),
            by: None,
            note: String::new(),
            quiet: false,
            first_out: true,
        };
        assert_eq!(
            row(&event),
            "2026-01-01T00:00:00Z high   pressure high: came at 2.25 (first)"
        );
        let seen = AlarmHappening {
            what: "acknowledged".to_owned(),
            by: Some("ann".to_owned()),
            note: "valve opened".to_owned(),
            quiet: true,
            first_out: false,
            ..event
        };
        let wanted = "2026-01-01T00:00:00Z high   pressure high: acknowledged by ann: valve opened (kept quiet)";
        assert_eq!(row(&seen), wanted);
    }
}
