//! Programs of other projects that cargo builds: an installed one of the wanted version, or one that is built now.
//!
//! Owns `target/tools`. Built without optimisation: each runs for seconds. Never: changes what is installed elsewhere.

use std::{fs, path::PathBuf, time::Instant};

use crate::{
    Error,
    run::{cargo, output, program, run, say, target_folder},
};

/// A program of crates.io.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Tool {
    /// Its crate, and the program in it.
    pub(crate) name: &'static str,
    /// The version that this project is written for.
    pub(crate) version: &'static str,
    /// What else cargo is told, with spaces between.
    pub(crate) arguments: &'static str,
}

impl Tool {
    /// Where it is. Builds it where it is not installed: minutes.
    ///
    /// # Errors
    /// It cannot be fetched or built.
    pub(crate) fn path(self) -> Result<PathBuf, Error> {
        let Self {
            name,
            version,
            arguments,
        } = self;
        let own = target_folder().join("tools");
        let built = own.join("bin").join(name);
        for path in [PathBuf::from(name), built.clone()] {
            if output(program(&path).arg("--version")).is_some_and(|text| text.ends_with(version)) {
                return Ok(path);
            }
        }
        say(&format!(
            "{name} {version} is not installed: building it into {}",
            own.display()
        ));
        let start = Instant::now();
        // A target folder of its own, kept small: the tool shares no build with the project.
        let build = own.join("build");
        run(cargo("install --locked --debug --quiet")
            .args(arguments.split_whitespace())
            .args(["--version", version, name])
            .arg("--root")
            .arg(&own)
            .arg("--target-dir")
            .arg(&build)
            .env("CARGO_PROFILE_DEV_DEBUG", "0"))?;
        fs::remove_dir_all(&build).map_err(|source| Error::File { path: build, source })?;
        say(&format!("built in {:.0} s", start.elapsed().as_secs_f64()));
        Ok(built)
    }
}
