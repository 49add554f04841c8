//! `watch`: a loop as it runs, drawn or as lines.
//!
//! ```text
//! API of one host ─ server-sent events ─► feed (thread) ─► bounded queue ─► story ─► screen | lines
//!       └ ends ─► the next known host of the cell
//! ```
//! Never: disturbs the loop; whoever watches too slowly is told how many records were lost.

mod alarms;
mod dev;
mod feed;
mod lines;
mod screen;
mod story;

use std::io::IsTerminal as _;

use bumpless_api::types::Loop;

use crate::{
    cli::WatchArgs,
    client::{Client, encoded},
    error::Error,
};
pub(crate) use alarms::alarms;
pub(crate) use dev::run as dev;
use story::Story;
pub(crate) use story::in_words;

/// Follows a loop until the reader has seen enough.
pub(crate) fn run(client: &Client, json: bool, args: &WatchArgs) -> Result<(), Error> {
    // Asked first, so that a wrong name is an error and not a silence.
    let found: Loop = client.get(&format!("/v1/loops/{}", encoded(&args.name)))?.decode()?;
    let story = Story::new(&found);
    let feed = feed::Feed::start(client, &found.name)?;
    if json || args.plain || !std::io::stdout().is_terminal() {
        lines::run(&feed, story, json, args.cycles)
    } else {
        screen::run(&feed, story, args.cycles, None)
    }
}
