//! What an author of a controller does on the own machine: begin a project, build it, see that its files changed.
//!
//! ```text
//!   loop.st ───────────── bumpless-st ──────────────────────┐
//!   folder with Cargo.toml ─ cargo (wasm32) ─ wit-component ─┼─► component
//!   folder with build.sh ─── sh ─ (wit-component) ───────────┘
//! ```
//! Owns: templates of projects, the way from a source to a component's bytes. Never: speaks to a cell or runs a component.

mod bindings;
mod cargo;
mod error;
mod project;
mod script;
mod state;
mod watch;

use std::{
    fs,
    path::{Path, PathBuf},
};

pub use bumpless_st::Diagnostic;
pub use error::Error;
pub use project::{Language, create, sdk_near};
pub use state::{Front, StateForm};
pub use watch::Watch;

/// A component that was built.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Built {
    /// Its bytes.
    pub component: Vec<u8>,
    /// The file that it goes to where nobody names another.
    pub output: PathBuf,
    /// What is to be watched for changes.
    pub source: PathBuf,
}

/// Builds what lies at a path: a text (`.st`), a folder with one, a folder with a `Cargo.toml`, or one with a
/// `build.sh`.
///
/// `version` stands for the one in the source: the library of a cell keeps each version once, and an author builds many.
///
/// # Errors
/// [`Error::Text`] and [`Error::Program`] with what is wrong in the source; the others with the file.
pub fn build(path: &Path, version: Option<&str>) -> Result<Built, Error> {
    build_as(path, version, false)
}

/// As [`build`], with what says of each instruction which line it comes from. Such a component is for tools: the information may be
/// many times as large as its code.
///
/// # Errors
/// As [`build`].
pub fn build_with_lines(path: &Path) -> Result<Built, Error> {
    build_as(path, None, true)
}

fn build_as(path: &Path, version: Option<&str>, lines: bool) -> Result<Built, Error> {
    match source(path)? {
        Source::Text(file) => {
            let text = fs::read_to_string(&file).map_err(|source| Error::file(&file, "read", source))?;
            let name = file.file_name().unwrap_or_default().to_string_lossy();
            let compiled = if lines {
                bumpless_st::compile_with_lines(&text, &name)
            } else {
                bumpless_st::compile_as(&text, version)
            };
            let compiled = compiled.map_err(|error| Error::Text {
                path: file.clone(),
                error,
            })?;
            Ok(Built {
                component: compiled.component,
                output: file.with_extension("wasm"),
                source: file,
            })
        }
        Source::Crate(folder) => cargo::build(&folder, version, lines),
        Source::Script(folder) => script::build(&folder, version),
    }
}

/// What lies at a path.
enum Source {
    Text(PathBuf),
    Crate(PathBuf),
    Script(PathBuf),
}

fn is_text(path: &Path) -> bool {
    path.extension().is_some_and(|end| end.eq_ignore_ascii_case("st"))
}

fn source(path: &Path) -> Result<Source, Error> {
    let about = fs::metadata(path).map_err(|source| Error::file(path, "read", source))?;
    if about.is_file() {
        return if is_text(path) {
            Ok(Source::Text(path.to_owned()))
        } else {
            Err(Error::NoSource { path: path.to_owned() })
        };
    }
    if path.join("Cargo.toml").is_file() {
        return Ok(Source::Crate(path.to_owned()));
    }
    if path.join(script::SCRIPT).is_file() {
        return Ok(Source::Script(path.to_owned()));
    }
    let entries = fs::read_dir(path).map_err(|source| Error::file(path, "read", source))?;
    let mut texts: Vec<PathBuf> = entries
        .filter_map(|entry| Some(entry.ok()?.path()))
        .filter(|file| is_text(file))
        .collect();
    match (texts.pop(), texts.is_empty()) {
        (Some(text), true) => Ok(Source::Text(text)),
        _ => Err(Error::NoSource { path: path.to_owned() }),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]
    use super::*;

    #[test]
    fn a_text_is_built_and_its_version_replaced() {
        let folder = tempfile::tempdir().unwrap();
        create(Language::St, folder.path(), "level-loop", None).unwrap();
        let project = folder.path().join("level-loop");
        let built = build(&project, None).unwrap();
        assert_eq!(built.output, project.join("level_loop.wasm"));
        assert_eq!(built, build(&project.join("level_loop.st"), None).unwrap());
        let other = build(&project, Some("7.8.9")).unwrap();
        assert!(
            other.component.windows(5).any(|w| w == b"7.8.9") && !built.component.windows(5).any(|w| w == b"7.8.9")
        );
        let again = create(Language::St, folder.path(), "level-loop", None).unwrap_err();
        assert!(
            again
                .to_string()
                .ends_with("level-loop is there already: choose another name"),
            "{again}"
        );
    }

    #[test]
    fn projects_in_other_languages_are_whole_and_have_a_name_of_their_own() {
        let folder = tempfile::tempdir().unwrap();
        for (language, example, law) in [
            (Language::C, "c-pid", "component.c"),
            (Language::Js, "js-pid", "law.js"),
            (Language::Ts, "ts-pid", "law.ts"),
            (Language::Python, "python-pid", "law.py"),
        ] {
            let name = format!("my-{}", &example[..example.len() - 4]);
            let project = create(language, folder.path(), &name, None).unwrap();
            let text = |file: &str| fs::read_to_string(project.join(file)).unwrap();
            assert!(text(law).contains(&format!("\"{name}\"")), "{example}");
            assert!(!text(law).contains(&format!("\"{example}\"")), "{example}");
            // What `build.sh` puts the version of a build in the place of.
            assert_eq!(text(law).matches("\"0.1.0\"").count(), 1, "{example}");
            for file in ["README.md", "build.sh", "loop.toml", "experiment.toml", "host.toml"] {
                assert!(!text(file).contains('@'), "{example}, {file}: {}", text(file));
            }
            assert!(text("loop.toml").contains("gain = 1.5") && text("experiment.toml").contains("gain = 1.5"));
            assert!(text("wit/control.wit").contains("world controller"));
            assert!(text(".gitignore").ends_with("__pycache__\n"));
            assert!(matches!(source(&project).unwrap(), Source::Script(_)));
        }
        assert!(
            folder
                .path()
                .join("my-c/bindings/controller_component_type.o")
                .is_file()
        );
    }

    #[test]
    fn what_is_no_source_is_said() {
        let folder = tempfile::tempdir().unwrap();
        let text = |path: &Path| build(path, None).unwrap_err().to_string();
        assert!(text(folder.path()).contains("no source of a controller"));
        let file = folder.path().join("a.txt");
        fs::write(&file, "x").unwrap();
        assert!(text(&file).contains("no source of a controller"));
        let bad = folder.path().join("a.st");
        fs::write(&bad, "PROGRAM p\nVAR_OUTPUT r : REAL; END_VAR\nr := x;\nEND_PROGRAM").unwrap();
        assert!(
            text(folder.path()).ends_with("a.st:3:6: there is no variable X"),
            "{}",
            text(folder.path())
        );
        for (name, good) in [
            ("a", true),
            ("a-1", true),
            ("A", false),
            ("", false),
            ("1a", false),
            ("a_b", false),
            ("a--b", false),
            ("a-", false),
        ] {
            assert_eq!(create(Language::St, folder.path(), name, None).is_ok(), good, "{name}");
        }
    }
}
