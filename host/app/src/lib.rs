//! The `bumpless` program: the composition root of a host, and the command line.
//!
//! Owns: the configuration file, what is built in which order, the commands and how they look. The commands speak to a
//! cell through its API alone, as any other client does.
//! Never: decides anything about a loop or a component.
//!
//! Reading order: `config`, `compose`, `host` (a host's life); `cli`, `client`, `commands`, `watch` (a person's tools);
//! `demo` (a whole cell on one machine).

pub mod compose;
pub mod config;
pub mod realtime;

mod cli;
mod client;
mod commands;
mod demo;
mod dry_run;
mod error;
mod host;
mod log;
mod proof;
mod show;
mod stop;
mod systemd;
mod watch;

pub use cli::{Cli, run};
pub use commands::loop_file;
pub use config::Config;
pub use error::Error;
