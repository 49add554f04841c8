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
        match feed.next(LOOK_EVERY) {
            Some(News::Record(record, text)) => {
                let before = story.happenings.back().cloned();
                let line = row(&record);
                story.record(*record);
                if json {
                    show::line(&text)?;
                    continue;
                }
                let new = story
                    .happenings
                    .iter()
                    .rev()
                    .take_while(|text| Some(*text) != before.as_ref());
                let new: Vec<&String> = new.collect();
                for text in new.into_iter().rev() {
                    show::line(&format!("  * {}", text.trim_start()))?;
                }
                show::line(&line)?;
            }
            Some(News::Hosts(hosts)) => story.hosts(hosts),
            Some(News::Lost(records)) => {
                story.lost(records);
                show::note(&format!("{records} records were lost: this reader is too slow"));
            }
            Some(News::Connected(api)) => story.feed(format!("from {api}")),
            Some(News::Disconnected(reason)) => {
                show::note(&format!("the feed ended ({reason}); trying the next host"));
                story.feed(reason);
            }
            None => {}
        }
    }
    if !json {
        show::line(&format!(
            "{}: {} cycles, {} missing, {} takeovers; {}",
            story.name,
            story.cycles,
            story.missing,
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
fn row(record: &Record) -> String {
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
