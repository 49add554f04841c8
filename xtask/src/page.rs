//! The operator's page: built with Node into `host/ui/dist`, from where `host/api` embeds it, and tried in a real browser.
//!
//! ```text
//! sources as at the last build ─► nothing to do
//!      └ other ─► npm ci (once per lock file) ─► types, bundle, packed ─► stamp
//! ```
//! Never: needed by `cargo build`; a program without the page says how to get one.

use std::{
    fs,
    path::{Path, PathBuf},
};

use bumpless_core::Digest;

use crate::{
    Error, components,
    run::{output, program, run, say, target_folder},
};

/// What the page is made of, in its folder; folders whole.
const SOURCES: [&str; 8] = [
    "index.html",
    "pack.mjs",
    "package-lock.json",
    "package.json",
    "public",
    "src",
    "tsconfig.json",
    "vite.config.ts",
];
/// Browsers that the tests take, in this order, where `BUMPLESS_CHROMIUM` names none.
const BROWSERS: [&str; 3] = ["chromium", "chromium-browser", "google-chrome"];

fn folder() -> PathBuf {
    components::workspace_root().join("host/ui")
}

fn npm(arguments: &str) -> std::process::Command {
    let mut command = program("npm");
    command
        .args(arguments.split_whitespace())
        .current_dir(folder())
        // The tests use the system's browser.
        .env("PLAYWRIGHT_SKIP_BROWSER_DOWNLOAD", "1");
    command
}

/// Builds the page where it is not built from the sources as they are.
///
/// # Errors
/// There is no Node, or the page does not build.
pub fn build() -> Result<(), Error> {
    let wanted = stamp()?;
    let stamp_file = folder().join("dist/.stamp");
    if fs::read_to_string(&stamp_file).is_ok_and(|kept| kept == wanted) {
        return Ok(());
    }
    say("building the operator's page…");
    packages()?;
    run(&mut npm("run --silent build"))?;
    fs::write(&stamp_file, wanted).map_err(|source| Error::File {
        path: stamp_file,
        source,
    })
}

/// Builds the page where there is Node; without it the host has none and says so.
///
/// # Errors
/// The page does not build.
pub fn build_if_possible() -> Result<(), Error> {
    if output(npm("--version").current_dir(components::workspace_root())).is_none() {
        say("npm is not installed: the host will have no operator's page");
        return Ok(());
    }
    build()
}

/// Tries the page in a real browser, against a demonstration of its own. The host and the components must be built.
///
/// # Errors
/// No browser, or a test that fails.
pub fn test() -> Result<(), Error> {
    let browser = browser()?;
    packages()?;
    let folder = components::workspace_root();
    run(npm("run --silent test")
        .env("BUMPLESS_CHROMIUM", browser)
        .env("BUMPLESS_BIN", target_folder().join("debug/bumpless"))
        .env("BUMPLESS_COMPONENTS", target_folder().join("components"))
        .env("BUMPLESS_FIGURES", folder.join("docs/figures")))
}

/// The browser; installed where the system's own way to do so is at hand.
///
/// # Errors
/// There is none.
pub fn browser() -> Result<PathBuf, Error> {
    let named = std::env::var_os("BUMPLESS_CHROMIUM").map(PathBuf::from);
    let found = || {
        let names = named.iter().cloned().chain(BROWSERS.map(PathBuf::from));
        names
            .into_iter()
            .find(|name| output(program(name).arg("--version")).is_some())
    };
    if let Some(browser) = found() {
        return whole(&browser);
    }
    say("chromium is not installed: trying apt-get");
    run(program("apt-get").args(["install", "--yes", "--no-install-recommends", "chromium"]))?;
    found().map_or_else(
        || {
            Err(Error::Program {
                program: "chromium".to_owned(),
                source: std::io::Error::from(std::io::ErrorKind::NotFound),
            })
        },
        |browser| whole(&browser),
    )
}

/// The path of a program that may be a mere name.
fn whole(name: &Path) -> Result<PathBuf, Error> {
    if name.is_absolute() {
        return Ok(name.to_owned());
    }
    let found = output(program("which").arg(name)).map(PathBuf::from);
    found.ok_or_else(|| Error::Program {
        program: name.display().to_string(),
        source: std::io::Error::from(std::io::ErrorKind::NotFound),
    })
}

/// Installs what the lock file says, where that was not done yet.
fn packages() -> Result<(), Error> {
    let lock = folder().join("package-lock.json");
    let done = folder().join("node_modules/.of-lock");
    let wanted = fs::read_to_string(&lock).map_err(|source| Error::File { path: lock, source })?;
    if fs::read_to_string(&done).is_ok_and(|kept| kept == wanted) {
        return Ok(());
    }
    run(&mut npm("ci --no-audit --no-fund --loglevel error"))?;
    fs::write(&done, wanted).map_err(|source| Error::File { path: done, source })
}

/// Names the sources as they are.
fn stamp() -> Result<String, Error> {
    let mut files = Vec::new();
    for name in SOURCES {
        walk(&folder().join(name), &mut files)?;
    }
    files.sort();
    let mut all = Vec::new();
    for path in files {
        let bytes = fs::read(&path).map_err(|source| Error::File {
            path: path.clone(),
            source,
        })?;
        all.extend_from_slice(format!("{} {}\n", path.display(), Digest::of(&bytes)).as_bytes());
    }
    Ok(Digest::of(&all).to_string())
}

fn walk(path: &Path, files: &mut Vec<PathBuf>) -> Result<(), Error> {
    if !path.is_dir() {
        files.push(path.to_owned());
        return Ok(());
    }
    let failed = |source| Error::File {
        path: path.to_owned(),
        source,
    };
    for entry in fs::read_dir(path).map_err(failed)? {
        walk(&entry.map_err(failed)?.path(), files)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::expect_used, reason = "tests")]

    use super::*;

    #[test]
    fn the_stamp_is_of_all_sources_and_stays_while_they_do() {
        let first = stamp().expect("the sources are there");
        assert_eq!(first, stamp().expect("the sources are there"));
        assert_eq!(first.len(), 64);
    }
}
