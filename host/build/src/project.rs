//! New projects: a law that controls something from the first minute, a simulated plant to try it on, and how to go on.
//!
//! Never: writes over a file that is there.

use std::{
    env, fs,
    path::{Path, PathBuf},
};

use crate::Error;

mod foreign;

use foreign::Foreign;

/// What a controller is written in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Language {
    /// Rust, with the SDK.
    Rust,
    /// Structured Text (IEC 61131-3).
    St,
    /// C, by clang.
    C,
    /// JavaScript, in QuickJS.
    Js,
    /// TypeScript, in QuickJS.
    Ts,
    /// Python, in CPython.
    Python,
}

const RUST: [(&str, &str); 7] = [
    ("Cargo.toml", include_str!("templates/Cargo.toml.txt")),
    ("src/lib.rs", include_str!("templates/lib.rs.txt")),
    ("experiment.toml", include_str!("templates/experiment.toml")),
    ("host.toml", include_str!("templates/host.toml")),
    ("loop.toml", include_str!("templates/loop.toml")),
    (".gitignore", include_str!("templates/gitignore.txt")),
    ("README.md", include_str!("templates/rust.md")),
];

const ST: [(&str, &str); 6] = [
    ("NAME.st", include_str!("templates/loop.st")),
    ("experiment.toml", include_str!("templates/experiment.toml")),
    ("host.toml", include_str!("templates/host.toml")),
    ("loop.toml", include_str!("templates/loop.toml")),
    (".gitignore", include_str!("templates/gitignore.txt")),
    ("README.md", include_str!("templates/st.md")),
];

fn own(files: &[(&str, &str)]) -> Vec<(String, Vec<u8>)> {
    files
        .iter()
        .map(|(file, text)| ((*file).to_owned(), text.as_bytes().to_vec()))
        .collect()
}

/// Makes the folder `name` in `parent` with a whole project. `sdk` is the folder `guest-sdk`, which projects in Rust need.
///
/// # Errors
/// [`Error::Name`], [`Error::Exists`], [`Error::NoSdk`], or a file that cannot be written.
pub fn create(language: Language, parent: &Path, name: &str, sdk: Option<&Path>) -> Result<PathBuf, Error> {
    let letters = name
        .bytes()
        .all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-');
    let first = name.bytes().next().is_some_and(|b| b.is_ascii_lowercase());
    if !letters || !first || name.len() > 32 || name.contains("--") || name.ends_with('-') {
        return Err(Error::Name(name.to_owned()));
    }
    let sdk = match (language, sdk) {
        (Language::Rust, Some(sdk)) => {
            let whole = fs::canonicalize(sdk).map_err(|source| Error::file(sdk, "read", source))?;
            whole.display().to_string()
        }
        (Language::Rust, None) => return Err(Error::NoSdk),
        _ => String::new(),
    };
    let files = match Foreign::of(language) {
        Some(foreign) => foreign.files(name)?,
        None => own(if language == Language::Rust { &RUST } else { &ST }),
    };
    let folder = parent.join(name);
    if folder.exists() {
        return Err(Error::Exists { path: folder });
    }
    let word = name.replace('-', "_");
    for (file, bytes) in files {
        let path = folder.join(file.replace("NAME", &word));
        let above = path.parent().unwrap_or(&folder);
        fs::create_dir_all(above).map_err(|source| Error::file(above, "made", source))?;
        // Generated bindings have a part that is no text.
        let bytes = String::from_utf8(bytes).map_or_else(std::string::FromUtf8Error::into_bytes, |text| {
            text.replace("@NAME@", name)
                .replace("@WORD@", &word)
                .replace("@SDK@", &sdk.replace('\\', "\\\\"))
                .into_bytes()
        });
        fs::write(&path, bytes).map_err(|source| Error::file(&path, "written", source))?;
    }
    // The versions that the SDK is tested with: the project builds the same tomorrow, and without a network where they are here.
    let (lock, own) = (Path::new(&sdk).join("../Cargo.lock"), folder.join("Cargo.lock"));
    if language == Language::Rust && lock.is_file() {
        fs::copy(&lock, &own).map_err(|source| Error::file(&own, "written", source))?;
    }
    Ok(folder)
}

/// The folder `guest-sdk` above here or above the program, where there is one.
#[must_use]
pub fn sdk_near() -> Option<PathBuf> {
    let here = env::current_dir().ok();
    let program = env::current_exe().ok();
    let above = here.iter().chain(program.iter()).flat_map(|path| path.ancestors());
    above
        .map(|folder| folder.join("guest-sdk"))
        .find(|sdk| sdk.join("Cargo.toml").is_file())
}
