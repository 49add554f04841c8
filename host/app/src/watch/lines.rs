//! A loop as lines, for logs and pipes: one per cycle, happenings between them, a summary at the end.

use std::{sync::atomic::Ordering, time::Duration};

use bumpless_api::types::Record;

use super::{
    feed::{Feed, News},
    story::Story,
};
use crate::{error::Error, show, stop};

/// How often an order to stop is looked for while nothing comes.
const LOOK_EVERY: Duration = Duration::from_millis(200);

/// Prints until `cycles` are seen, or until the reader or Ctrl-C ends it. With `json`, prints the records as they come.
pub(super) fn run(feed: &Feed, mut story: Story, json: bool, cycles: Option<u64>) -> Result<(), Error> {
    let stop = stop::on_signals()?;
    if !json {
        show::line("     cycle  term  setpoint  measured  output    by        step µs  write µs")?;
    }
    let enough = |story: &Story| cycles.is_some_and(|cycles| story.cycles >= cycles);
    while !stop.load(Ordering::Relaxed) && !enough(&story) {
        let Some(news) = feed.next(LOOK_EVERY) else { continue };
        let told = story.happened_count;
        let mut line = None;
        match news {
            News::Record(record, text) => {
                line = Some(if json { text } else { row(&record) });
                story.record(*record);
            }
            News::Hosts(hosts) => story.hosts(hosts),
            News::Alarm(event, _) => story.alarm(&event),
            News::Lost(records) => {
                story.lost(records);
                show::note(&format!("{records} records were lost: this reader is too slow"));
            }
            News::Connected(api) => story.connected(api),
            News::Disconnected(reason) => story.disconnected(&reason),
            News::Gone(reason) => return Err(story.gone(&reason)),
        }
        if !json {
            let new = usize::try_from(story.happened_count - told)
                .unwrap_or(usize::MAX)
                .min(story.happenings.len());
            for text in story.happenings.iter().skip(story.happenings.len() - new) {
                show::line(&format!("  * {}", text.trim_start()))?;
            }
        }
        if let Some(line) = line {
            show::line(&line)?;
        }
    }
    if !json {
        show::line(&format!(
            "{}: {} cycles, {} missing, {} not seen, {} takeovers; {}",
            story.name,
            story.cycles,
            story.missing,
            story.dropped,
            story.takeovers,
            story.indices_line()
        ))?;
        let steps: Vec<String> = story
            .steps
            .iter()
            .map(|(host, steps)| format!("{host} {steps}"))
            .collect();
        show::line(&format!("stepped by: {}", steps.join(", ")))?;
    }
    Ok(())
}

/// One cycle as a line.
pub(super) fn row(record: &Record) -> String {
    let output = record.outputs.values().next().copied().flatten();
    format!(
        "{:>10}  {:>4}  {:>8}  {:>8}  {:>8}  {:<8}  {:>7.1}  {:>8.1}",
        record.seq,
        record.term,
        show::maybe(record.setpoint),
        show::maybe(record.measurement),
        show::maybe(output),
        record.stepped_by,
        record.step_us,
        record.committed_after_us
    )
}
