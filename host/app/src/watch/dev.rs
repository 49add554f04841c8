//! `dev`: builds at each save, swaps what came out into a running loop, and shows its cycles meanwhile.
//!
//! ```text
//! save ─► build ── wrong ──► its places, and wait for the next save
//!            └─► upload ─► swap ── refused ──► why; the loop goes on as it was
//!                             └─► in force; the build before is taken out of the library
//! ```
//! Each build is a version of its own, for the library of a cell keeps each once. Never: ends because a build or a swap failed.

use std::{
    sync::atomic::Ordering,
    time::{Duration, Instant},
};

use bumpless_api::types::{Apply, Component, Components, Loop, SwapRequest};
use bumpless_build::Watch;

use super::{
    feed::{Feed, News},
    lines::row,
};
use crate::{
    cli::DevArgs,
    client::{Client, encoded},
    commands::{author, components},
    error::Error,
    show, stop,
};

/// How often the files are looked at.
const LOOK_EVERY: Duration = Duration::from_millis(100);
/// How often a cycle is shown.
const SHOW_EVERY: Duration = Duration::from_secs(1);
/// Pause after which a save counts as whole.
const SAVES_SETTLE: Duration = Duration::from_millis(50);

/// Runs until Ctrl-C, or until so many builds were made; then what became of the last one is the answer.
pub(crate) fn run(client: &Client, args: &DevArgs) -> Result<(), Error> {
    // Asked first, so that a wrong name is an error and not a silence.
    let path = format!("/v1/loops/{}", encoded(&args.name));
    let found: Loop = client.get(&path)?.decode()?;
    let feed = Feed::start(client, &found.name)?;
    let stop = stop::on_signals()?;
    let mut watch = Watch::new(&args.source);
    let mut before: Option<String> = None;
    let mut builds = 0;
    let mut due = true;
    let (mut shown, mut looked) = (Instant::now(), Instant::now());
    while !stop.load(Ordering::Relaxed) {
        if due {
            builds += 1;
            let last = args.builds.is_some_and(|most| builds >= most);
            match once(client, args, &path, before.as_deref()) {
                Ok(digest) => before = Some(digest),
                Err(error) if last || matches!(error, Error::Unreachable { .. }) => return Err(error),
                Err(error) => show::note(&error.report()),
            }
            if last {
                return Ok(());
            }
            due = false;
        }
        match feed.next(LOOK_EVERY) {
            Some(News::Record(record, _)) if shown.elapsed() >= SHOW_EVERY => {
                show::line(&row(&record))?;
                shown = Instant::now();
            }
            Some(News::Gone(reason)) => {
                return Err(Error::Unreachable {
                    api: client.api().to_owned(),
                    reason,
                });
            }
            _ => {}
        }
        if looked.elapsed() >= LOOK_EVERY {
            looked = Instant::now();
            due = watch.changed();
            if due {
                // An editor writes several files, or one in parts: the rest of this save belongs to it.
                while watch.changed_after(SAVES_SETTLE) {}
            }
        }
    }
    Ok(())
}

/// One build on its way into the loop; gives its digest.
fn once(client: &Client, args: &DevArgs, path: &str, before: Option<&str>) -> Result<String, Error> {
    let from = Instant::now();
    let version = next_version(client)?;
    let built = bumpless_build::build(&args.source, Some(&version)).map_err(author::failed)?;
    let built_in = from.elapsed();
    author::write(&built.output, &built.component)?;
    let (component, _): (Component, String) = components::send(
        client,
        &built.output,
        "note=dev&labels=dev%3Dyes&force=false&dry_run=false",
        false,
    )?;
    let swap = SwapRequest {
        component: component.digest.clone(),
    };
    let end: Apply = client.post(&format!("{path}/swap"), &swap)?.decode()?;
    let bump = end.hand_over.as_ref().and_then(|hand_over| hand_over.bump_percent);
    show::line(&format!(
        "* {}@{} is in force after {:.2} s (build {:.2} s), revision {}, bump {} % of span",
        component.name,
        component.version,
        from.elapsed().as_secs_f64(),
        built_in.as_secs_f64(),
        end.revision,
        show::maybe(bump)
    ))?;
    if let Some(before) = before.filter(|before| *before != component.digest) {
        // The cell keeps what a loop may go back to; then it stays.
        if let Err(error) = client.delete(&format!("/v1/components/{}", encoded(before))) {
            show::note(&format!("the build before stays in the library: {error}"));
        }
    }
    Ok(component.digest)
}

/// `0.0.N` with N above that of every build in the library: a version that no release has.
fn next_version(client: &Client) -> Result<String, Error> {
    let known: Components = client.list("/v1/components", "components")?.decode()?;
    let last = known
        .components
        .iter()
        .filter_map(|component| component.version.strip_prefix("0.0.")?.parse::<u32>().ok())
        .max()
        .unwrap_or(0);
    Ok(format!("0.0.{}", last.saturating_add(1)))
}
