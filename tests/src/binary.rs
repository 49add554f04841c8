//! Where the `bumpless` binary is.
//!
//! Never: builds it. A test must not build a large program beside the others; `cargo xtask test` builds it first.

use std::{env, path::PathBuf, process::Command};

use crate::{Error, repository};

/// The `bumpless` binary.
#[derive(Debug, Clone)]
pub struct Binary {
    path: PathBuf,
}

impl Binary {
    /// The one that `BUMPLESS_BIN` names, else the one in the target folder, of the profile that this code is built with.
    ///
    /// # Errors
    /// [`Error::NoBinary`] with the command that builds it.
    pub fn find() -> Result<Self, Error> {
        let (profile, command) = if cfg!(debug_assertions) {
            ("debug", "cargo build --package bumpless-app")
        } else {
            ("release", "cargo build --release --package bumpless-app")
        };
        let path = env::var_os("BUMPLESS_BIN").map_or_else(
            || {
                let target = env::var_os("CARGO_TARGET_DIR").map_or_else(|| repository().join("target"), PathBuf::from);
                target.join(profile).join("bumpless")
            },
            PathBuf::from,
        );
        if path.is_file() {
            Ok(Self { path })
        } else {
            Err(Error::NoBinary { path, command })
        }
    }

    /// Its path.
    #[must_use]
    pub fn path(&self) -> &std::path::Path {
        &self.path
    }

    /// A command of it.
    #[must_use]
    pub fn command(&self) -> Command {
        Command::new(&self.path)
    }
}
