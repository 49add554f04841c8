//! A crate becomes a component: cargo for `wasm32-unknown-unknown`, then wit-component.
//!
//! Never: changes a project's files; what it needs goes on cargo's command line.

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

use serde::Deserialize;
use wit_component::ComponentEncoder;

use crate::{Built, Error};

const TARGET: &str = "wasm32-unknown-unknown";
/// A controller needs little stack; 16 KiB cuts its first memory from 17 pages to 2.
const STACK: &str = r#"target.wasm32-unknown-unknown.rustflags=["-Clink-arg=-zstack-size=16384"]"#;
/// A profile beside the author's own, so that the two do not build over each other: the same code, with lines.
const LINES: [&str; 3] = [
    r#"profile.lines.inherits="release""#,
    r#"profile.lines.debug="line-tables-only""#,
    r#"profile.lines.strip="none""#,
];
/// Where a project may take its version from; see the template.
const VERSION: &str = "BUMPLESS_VERSION";

/// One line of cargo's JSON output; other kinds of lines are passed over.
#[derive(Deserialize)]
struct Artifact {
    reason: String,
    #[serde(default)]
    manifest_path: PathBuf,
    #[serde(default)]
    filenames: Vec<PathBuf>,
}

fn run(program: &'static str, command: &mut Command) -> Result<Vec<u8>, Error> {
    // What an outer cargo put there would change the component and make cargo build everything anew.
    for name in [
        "RUSTFLAGS",
        "CARGO_ENCODED_RUSTFLAGS",
        "RUSTC_WORKSPACE_WRAPPER",
        "CARGO_BUILD_TARGET",
    ] {
        command.env_remove(name);
    }
    let output = command
        .stdin(Stdio::null())
        .output()
        .map_err(|source| Error::NoProgram { program, source })?;
    if output.status.success() {
        return Ok(output.stdout);
    }
    Err(Error::Program {
        program,
        output: String::from_utf8_lossy(&output.stderr).trim_end().to_owned(),
    })
}

/// Builds the crate in a folder; with debug information where faults shall name lines.
pub(crate) fn build(folder: &Path, version: Option<&str>, lines: bool) -> Result<Built, Error> {
    let mut cargo = Command::new("cargo");
    cargo.current_dir(folder).args([
        "build",
        "--quiet",
        "--lib",
        "--target",
        TARGET,
        "--message-format",
        "json-render-diagnostics",
        "--config",
        STACK,
    ]);
    cargo.args(["--profile", if lines { "lines" } else { "release" }]);
    for setting in LINES.iter().filter(|_| lines) {
        cargo.args(["--config", setting]);
    }
    if let Some(version) = version {
        cargo.env(VERSION, version);
    }
    let text = run("cargo", &mut cargo)?;
    let own = fs::canonicalize(folder.join("Cargo.toml")).map_err(|source| Error::file(folder, "read", source))?;
    let module = text
        .split(|&byte| byte == b'\n')
        .filter_map(|line| serde_json::from_slice::<Artifact>(line).ok())
        .filter(|artifact| artifact.reason == "compiler-artifact" && artifact.manifest_path == own)
        .flat_map(|artifact| artifact.filenames)
        .find(|file| file.extension().is_some_and(|end| end == "wasm"))
        .ok_or_else(|| Error::NoModule {
            path: folder.to_owned(),
        })?;
    let bytes = fs::read(&module).map_err(|source| Error::file(&module, "read", source))?;
    let component = ComponentEncoder::default()
        .module(&bytes)
        .map(|encoder| encoder.validate(true))
        .and_then(ComponentEncoder::encode)
        .map_err(|error| Error::Encode(format!("{error:#}")))?;
    let name = module
        .file_name()
        .map_or_else(|| "controller.wasm".into(), ToOwned::to_owned);
    Ok(Built {
        component,
        output: folder.join(name),
        source: folder.to_owned(),
    })
}
