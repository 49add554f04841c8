//! `dev`: builds at each save, swaps what came out into a running loop, and shows the loop meanwhile.
//!
//! ```text
//! save ─► build ── wrong ──► its places, and wait for the next save
//!            └─► upload ─► swap ── refused ──► why; the loop goes on as it was
//!                             └─► in force; builds that no loop needs any more are taken out of the library
//! ```
//! A thread builds and asks the cell; the screen, or the lines where there is none, go on meanwhile. Each build is a version of its
//! own, for the library of a cell keeps each once. Never: ends because a build or a swap failed.

use std::{
    io::IsTerminal as _,
    sync::{
        atomic::Ordering,
        mpsc::{Receiver, SyncSender, TryRecvError, sync_channel},
    },
    time::{Duration, Instant},
};

use bumpless_api::types::{Apply, Component, Components, Loop, SwapRequest};
use bumpless_build::Watch;

use super::{
    feed::{Feed, News},
    lines::row,
    screen,
    story::Story,
};
use crate::{
    cli::DevArgs,
    client::{Client, encoded},
    commands::{author, components, library},
    error::Error,
    show, stop,
};

/// How often somebody who watches the files looks whether anybody still listens.
const LOOK_EVERY: Duration = Duration::from_millis(200);
/// How often a cycle is shown where there is no screen.
const SHOW_EVERY: Duration = Duration::from_secs(1);
/// Words on their way to the screen; the thread that builds waits where nobody takes them.
const SAID_MAX: usize = 64;
/// Old builds that are taken out of the library after one round.
const TAKEN_OUT_MAX: usize = 8;
/// What marks a build in the library.
const LABEL: (&str, &str) = ("dev", "yes");

/// What becomes of a build.
pub(super) enum Said {
    /// One has begun.
    Begun,
    /// It is in force; or something beside it.
    Done(String),
    /// Why it is not; lines as a compiler writes them.
    Wrong(String),
    /// Nothing more comes.
    Ended(Result<(), Error>),
}

/// Runs until somebody has seen enough, or until so many builds were made; then what became of the last one is the answer.
pub(crate) fn run(client: &Client, args: &DevArgs) -> Result<(), Error> {
    // Asked first, so that a wrong name is an error and not a silence.
    let path = format!("/v1/loops/{}", encoded(&args.name));
    let found: Loop = client.get(&path)?.decode()?;
    let watch = Watch::new(&args.source).map_err(author::failed)?;
    let feed = Feed::start(client, &found.name)?;
    let story = Story::new(&found);
    let (sender, said) = sync_channel(SAID_MAX);
    let bench = Bench {
        client: client.clone(),
        source: args.source.clone(),
        path,
        builds_max: args.builds,
        said: sender,
    };
    std::thread::Builder::new()
        .name("builds".to_owned())
        .spawn(move || bench.work(watch))
        .map_err(|error| Error::start("the thread that builds", error))?;
    if args.plain || !std::io::stdout().is_terminal() {
        lines(&feed, &said)
    } else {
        screen::run(&feed, story, None, Some(&said))
    }
}

/// Without a screen: what becomes of builds as it comes, and a cycle a second.
fn lines(feed: &Feed, said: &Receiver<Said>) -> Result<(), Error> {
    let stop = stop::on_signals()?;
    let mut shown: Option<Instant> = None;
    while !stop.load(Ordering::Relaxed) {
        match said.try_recv() {
            Ok(Said::Begun) => {}
            Ok(Said::Done(text)) => show::line(&format!("* {text}"))?,
            Ok(Said::Wrong(text)) => show::note(&text),
            Ok(Said::Ended(end)) => return end,
            Err(TryRecvError::Disconnected) => return Err(Error::start("the thread that builds", "it ended")),
            Err(TryRecvError::Empty) => {}
        }
        match feed.next(LOOK_EVERY / 4) {
            Some(News::Record(record, _)) if shown.is_none_or(|shown| shown.elapsed() >= SHOW_EVERY) => {
                show::line(&row(&record))?;
                shown = Some(Instant::now());
            }
            Some(News::Gone(reason)) => {
                return Err(Error::Unreachable {
                    api: "the cell".to_owned(),
                    reason,
                });
            }
            _ => {}
        }
    }
    Ok(())
}

/// Where builds are made.
struct Bench {
    client: Client,
    source: std::path::PathBuf,
    /// The loop in the API.
    path: String,
    builds_max: Option<u32>,
    said: SyncSender<Said>,
}

impl Bench {
    /// Says it; false where nobody listens any more.
    fn say(&self, said: Said) -> bool {
        self.said.send(said).is_ok()
    }

    fn work(&self, mut watch: Watch) {
        let mut saved_at = Instant::now();
        let mut builds = 0;
        loop {
            builds += 1;
            if !self.say(Said::Begun) {
                return;
            }
            let last = self.builds_max.is_some_and(|most| builds >= most);
            let heard = match self.round(saved_at) {
                Ok(text) => self.say(Said::Done(text)) && (!last || !self.say(Said::Ended(Ok(())))),
                Err(error) if last => !self.say(Said::Ended(Err(error))),
                Err(error) => self.say(Said::Wrong(error.report())),
            };
            if !heard || last {
                return;
            }
            saved_at = loop {
                match watch.wait(LOOK_EVERY) {
                    Ok(Some(at)) => break at,
                    // A word that says nothing, to learn whether anybody listens, would be worse than a thread that ends with the
                    // process.
                    Ok(None) => {}
                    Err(error) => {
                        self.say(Said::Ended(Err(author::failed(error))));
                        return;
                    }
                }
            };
        }
    }

    /// One build on its way into the loop; in words, with the times since the save.
    fn round(&self, saved_at: Instant) -> Result<String, Error> {
        let known: Components = self.client.list("/v1/components", "components")?.decode()?;
        let begun = Instant::now();
        let built = bumpless_build::build(&self.source, Some(&next_version(&known))).map_err(author::failed)?;
        let built_in = begun.elapsed();
        author::write(&built.output, &built.component)?;
        let begun = Instant::now();
        let query = format!("note=dev&labels={}%3D{}&force=false&dry_run=false", LABEL.0, LABEL.1);
        let (component, _): (Component, String) = components::send(&self.client, &built.output, &query, false)?;
        let sent_in = begun.elapsed();
        let begun = Instant::now();
        let swap = SwapRequest {
            component: component.digest.clone(),
        };
        let end: Apply = self.client.post(&format!("{}/swap", self.path), &swap)?.decode()?;
        let (swapped_in, in_all) = (begun.elapsed(), saved_at.elapsed());
        self.take_out(&known, &component);
        let hand_over = end.hand_over.as_ref();
        let mut text = format!(
            "{}@{} is in force {:.2} s after the save (build {:.2}, upload and trial {:.2}, swap {:.2}): revision {}, state by {}, \
             bump {} % of span",
            component.name,
            component.version,
            in_all.as_secs_f64(),
            built_in.as_secs_f64(),
            sent_in.as_secs_f64(),
            swapped_in.as_secs_f64(),
            end.revision,
            hand_over.map_or("–", |hand_over| hand_over.by.as_str()),
            show::maybe(hand_over.and_then(|hand_over| hand_over.bump_percent))
        );
        for (what, names) in [("parameters", &end.dropped_parameters), ("ports", &end.dropped_ports)] {
            if !names.is_empty() {
                text.push_str(&format!(
                    "; {what} that it does not have are left out: {}",
                    names.join(", ")
                ));
            }
        }
        for warning in &end.warnings {
            text.push_str(&format!("; {warning}"));
        }
        Ok(text)
    }

    /// Takes this author's builds of the component that no loop may go back to out of the library.
    fn take_out(&self, known: &Components, now: &Component) {
        let me = library::me();
        let old = known.components.iter().filter(|component| {
            let is_build = component.labels.get(LABEL.0).is_some_and(|value| value == LABEL.1);
            is_build
                && component.used_by.is_empty()
                && (component.name.as_str(), component.uploaded_by.as_str()) == (now.name.as_str(), me.as_str())
                && component.digest != now.digest
        });
        for component in old.take(TAKEN_OUT_MAX) {
            // Where a loop began to use it meanwhile the cell refuses, and is right.
            let _ = self
                .client
                .delete(&format!("/v1/components/{}", encoded(&component.digest)));
        }
    }
}

/// `0.0.N` with N above that of every build in the library: a version that no release has.
fn next_version(known: &Components) -> String {
    let last = known
        .components
        .iter()
        .filter_map(|component| component.version.strip_prefix("0.0.")?.parse::<u32>().ok())
        .max()
        .unwrap_or(0);
    format!("0.0.{}", last.saturating_add(1))
}
