//! A folder with a `build.sh` becomes a component: the script with the tools of its language, then wit-component where it leaves a core
//! module.
//!
//! ```text
//!   sh build.sh OUT, BUMPLESS_VERSION ─► component, or core module with the types of its world ─► component
//! ```
//! Never: knows a language.

use std::{
    ffi::OsStr,
    fs,
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

use wit_component::ComponentEncoder;

use crate::{Built, Error};

/// The script.
pub(crate) const SCRIPT: &str = "build.sh";
/// Where a project takes its version from, where its author wants another than the one in the source.
const VERSION: &str = "BUMPLESS_VERSION";
/// First bytes of a core module, version 1. WebAssembly core specification, 5.5.16.
const CORE_MODULE: [u8; 8] = *b"\0asm\x01\0\0\0";
/// Characters of a failed script's words that are shown: the end, where the reason stands.
const SAID_CHARS_MAX: usize = 8_000;

/// Builds the project in a folder.
pub(crate) fn build(folder: &Path, version: Option<&str>) -> Result<Built, Error> {
    let folder = fs::canonicalize(folder).map_err(|source| Error::file(folder, "read", source))?;
    let parts = folder.join("build");
    fs::create_dir_all(&parts).map_err(|source| Error::file(&parts, "made", source))?;
    let made = parts.join("made.wasm");
    // What an earlier run left must not be taken for what this one made.
    match fs::remove_file(&made) {
        Err(source) if source.kind() != std::io::ErrorKind::NotFound => {
            return Err(Error::file(&made, "removed", source));
        }
        _ => {}
    }
    let mut script = Command::new("sh");
    script.arg(SCRIPT).arg(&made).current_dir(&folder).stdin(Stdio::null());
    script.env_remove(VERSION);
    if let Some(version) = version {
        script.env(VERSION, version);
    }
    let done = script
        .output()
        .map_err(|source| Error::NoShell { program: "sh", source })?;
    if !done.status.success() {
        // Compilers differ in where they write what is wrong.
        let said = format!(
            "{}{}",
            String::from_utf8_lossy(&done.stdout),
            String::from_utf8_lossy(&done.stderr)
        );
        let said = said.trim_end();
        let from = said.chars().count().saturating_sub(SAID_CHARS_MAX);
        return Err(Error::Program {
            program: "build.sh",
            output: said.chars().skip(from).collect(),
        });
    }
    let bytes = fs::read(&made).map_err(|_| Error::NoOutput { path: folder.clone() })?;
    let component = if bytes.starts_with(&CORE_MODULE) {
        ComponentEncoder::default()
            .module(&bytes)
            .map(|encoder| encoder.validate(true))
            .and_then(ComponentEncoder::encode)
            .map_err(|error| Error::Encode(format!("{error:#}")))?
    } else {
        bytes
    };
    Ok(Built {
        component,
        output: output(&folder),
        source: folder,
    })
}

/// `level-loop/` makes `level-loop/level_loop.wasm`.
fn output(folder: &Path) -> PathBuf {
    let name = folder.file_name().and_then(OsStr::to_str).unwrap_or("controller");
    folder.join(format!("{}.wasm", name.replace('-', "_")))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use super::*;

    fn project(script: &str) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join(SCRIPT), script).unwrap();
        folder
    }

    #[test]
    fn what_a_script_leaves_is_taken_and_it_is_told_the_version() {
        let folder = project("printf \"%s\" \"${BUMPLESS_VERSION:-none}\" > \"$1\"");
        assert_eq!(build(folder.path(), None).unwrap().component, b"none");
        let built = build(folder.path(), Some("0.0.7")).unwrap();
        assert_eq!(built.component, b"0.0.7");
        assert_eq!(built.output.extension(), Some(OsStr::new("wasm")));
    }

    #[test]
    fn what_goes_wrong_is_told() {
        let text = |script: &str| build(project(script).path(), None).unwrap_err().to_string();
        assert_eq!(text("echo one; echo two >&2; exit 3"), "build.sh failed:\none\ntwo");
        assert!(
            text("exit 0").ends_with("build.sh left no component: it writes the file that its first argument names")
        );
        let said = text("printf '\\0asm\\1\\0\\0\\0half' > \"$1\"");
        assert!(said.starts_with("the module does not become a component"), "{said}");
        assert!(text("i=0; while [ $i -lt 9000 ]; do echo x; i=$((i+1)); done; exit 1").len() < 9_000);
    }

    #[test]
    fn an_earlier_result_is_not_taken_for_this_one() {
        let folder = project("printf old > \"$1\"");
        build(folder.path(), None).unwrap();
        fs::write(folder.path().join(SCRIPT), "exit 0").unwrap();
        assert!(matches!(build(folder.path(), None), Err(Error::NoOutput { .. })));
    }
}
