//! Builds every controller (`controllers/*`), plant, program (`programs/*`), example (`examples/*`) and test guest
//! (`tests/guests/*`) into a component.
//!
//! ```text
//!   cargo build --target wasm32-unknown-unknown ─► core module ─► wit-component ─► check of imports ─► target/components
//! ```
//! Owns the folder `target/components`: `<name>.wasm` for controllers, and a folder for each other kind, as `guests/<name>.wasm`;
//! the name is the crate's folder. A crate takes part when it has a `cdylib` target. A component may import nothing but
//! `bumpless:control@0.1.0`; a guest whose misdeed is another import says so with `[package.metadata.component] imports = "any"`.
//! Safe to run from several processes at once: one works, the others wait and find the work done.
//! Never: downloads anything but, through rustup, the compiler's own target.

use std::{
    fs, io,
    io::Write as _,
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

use bumpless_core::Digest;
use serde::Deserialize;
use wit_component::{ComponentEncoder, DecodedWasm};

/// The target that brings no imports of its own.
const TARGET: &str = "wasm32-unknown-unknown";

/// The only package that a component may import from.
const PACKAGE: &str = "bumpless:control@0.1.0";

/// Cargo profile of components; see the root Cargo.toml.
const PROFILE: &str = "component";

/// Why components could not be built.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A program is not there or cannot be run.
    #[error("{program} cannot be run: install it and put it on the path")]
    Program {
        /// Its name.
        program: &'static str,
        /// What the system says.
        source: io::Error,
    },
    /// A program ended badly.
    #[error("`{command}` failed:\n{output}")]
    Failed {
        /// The command line.
        command: String,
        /// What it wrote to its error output.
        output: String,
    },
    /// The target is missing, and rustup cannot add it.
    #[error("the target {target} is missing: `rustup target add {target}` adds it")]
    Target {
        /// Which.
        target: &'static str,
        /// What rustup says.
        source: Box<Error>,
    },
    /// Cargo's messages are not what is expected.
    #[error("cargo wrote a message that cannot be read: use the Rust version of rust-toolchain or rust-version")]
    Message(#[source] serde_json::Error),
    /// A file or folder cannot be read or written.
    #[error("{path}: cannot be {action}")]
    File {
        /// Which.
        path: PathBuf,
        /// "read", "written" or "locked".
        action: &'static str,
        /// What the system says.
        source: io::Error,
    },
    /// wit-component refuses the module.
    #[error("{name}: the module does not become a component: {reason}")]
    Encode {
        /// The component.
        name: String,
        /// In wit-component's words.
        reason: String,
    },
    /// The component imports what the sandbox does not give.
    #[error("{name} imports {import}, but only {PACKAGE} is given: remove what uses it")]
    Import {
        /// The component.
        name: String,
        /// The import.
        import: String,
    },
    /// A crate that should have become a module did not.
    #[error("cargo built no module for {0}")]
    NoModule(String),
}

/// What a component is for. In the order of the table.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// A stock controller.
    Controller,
    /// An example of the documents.
    Example,
    /// A stock program: it runs freely.
    Program,
    /// A simulated plant.
    Plant,
    /// A guest for tests.
    Guest,
}

impl Kind {
    const ALL: [Self; 5] = [Self::Controller, Self::Example, Self::Program, Self::Plant, Self::Guest];

    /// The folder of its crates in the workspace.
    const fn place(self) -> &'static str {
        match self {
            Self::Controller => "controllers",
            Self::Example => "examples",
            Self::Program => "programs",
            Self::Plant => "plants",
            Self::Guest => "tests/guests",
        }
    }

    /// The folder of its components in the one of all; controllers lie in that one itself.
    const fn folder(self) -> &'static str {
        match self {
            Self::Controller => "",
            Self::Example => "examples",
            Self::Program => "programs",
            Self::Plant => "plants",
            Self::Guest => "guests",
        }
    }
}

/// One component.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Built {
    /// Folder name of the crate.
    pub name: String,
    /// Where the component is.
    pub path: PathBuf,
    /// What it is for.
    pub kind: Kind,
    /// Its size.
    pub bytes: u64,
    /// Its digest.
    pub digest: Digest,
}

#[derive(Deserialize)]
struct Metadata {
    packages: Vec<Package>,
    target_directory: PathBuf,
    workspace_root: PathBuf,
}

#[derive(Deserialize)]
struct Package {
    id: String,
    name: String,
    manifest_path: PathBuf,
    targets: Vec<Target>,
    metadata: Option<PackageMetadata>,
}

#[derive(Deserialize)]
struct Target {
    kind: Vec<String>,
}

#[derive(Deserialize, Default)]
struct PackageMetadata {
    component: Option<ComponentMetadata>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ComponentMetadata {
    #[serde(default)]
    imports: Imports,
    /// Is it built by a script of its own (`languages`)?
    #[serde(default)]
    script: bool,
}

#[derive(Deserialize, Default, Clone, Copy, PartialEq, Eq)]
#[serde(rename_all = "kebab-case")]
enum Imports {
    /// Only those of the interfaces.
    #[default]
    Ours,
    /// Imports are not checked.
    Any,
}

/// One line of cargo's JSON output; other kinds of lines are passed over.
#[derive(Deserialize)]
struct Artifact {
    reason: String,
    package_id: Option<String>,
    #[serde(default)]
    filenames: Vec<PathBuf>,
    #[serde(default)]
    fresh: bool,
}

/// A crate that becomes a component.
struct Source {
    id: String,
    package: String,
    name: String,
    kind: Kind,
    any_import: bool,
}

/// The workspace's root, as it was when this tool was built.
pub(crate) fn workspace_root() -> &'static Path {
    let own = Path::new(env!("CARGO_MANIFEST_DIR"));
    own.parent().unwrap_or(own)
}

/// Builds what is not built yet. Gives the folder with the components.
pub fn build() -> Result<PathBuf, Error> {
    build_all().map(|(folder, _)| folder)
}

/// `cargo xtask components`: builds and prints a table.
#[allow(clippy::print_stdout, reason = "a command-line tool speaks to its terminal")]
pub fn run() -> Result<(), Error> {
    let (folder, built) = build_all()?;
    println!("{}", folder.display());
    println!("{:<28} {:>8}  sha-256", "component", "bytes");
    for c in &built {
        let name = Path::new(c.kind.folder()).join(&c.name);
        println!("{:<28} {:>8}  {}", name.display(), c.bytes, c.digest);
    }
    Ok(())
}

/// Builds what is not built yet. Gives the folder and what is in it: by kind, then by name.
pub fn build_all() -> Result<(PathBuf, Vec<Built>), Error> {
    let metadata = metadata()?;
    let sources = sources(&metadata);
    let folder = metadata.target_directory.join("components");
    for inner in Kind::ALL.map(|kind| folder.join(kind.folder())) {
        fs::create_dir_all(&inner).map_err(|source| Error::File {
            path: inner.clone(),
            action: "written",
            source,
        })?;
    }

    // Released when the file is closed, also when this process is killed.
    let lock_path = folder.join(".lock");
    let lock = fs::File::create(&lock_path)
        .and_then(|file| file.lock().map(|()| file))
        .map_err(|source| Error::File {
            path: lock_path,
            action: "locked",
            source,
        })?;
    ensure_target()?;
    let artifacts = cargo_build(&sources)?;
    let built = sources
        .iter()
        .map(|source| componentize(source, &artifacts, &folder))
        .collect::<Result<_, _>>()?;
    drop(lock);
    Ok((folder, built))
}

/// A command in the workspace's root, without what an outer `cargo` put into the environment: flags for the host would
/// change the guests and make cargo build them anew.
pub(crate) fn command(program: &str) -> Command {
    let mut command = Command::new(program);
    command.current_dir(workspace_root()).stdin(Stdio::null());
    for name in [
        "RUSTFLAGS",
        "CARGO_ENCODED_RUSTFLAGS",
        "RUSTC_WORKSPACE_WRAPPER",
        "CARGO_BUILD_TARGET",
    ] {
        command.env_remove(name);
    }
    command
}

fn output(program: &'static str, command: &mut Command) -> Result<Vec<u8>, Error> {
    let output = command.output().map_err(|source| Error::Program { program, source })?;
    if output.status.success() {
        return Ok(output.stdout);
    }
    Err(Error::Failed {
        command: format!("{command:?}"),
        output: String::from_utf8_lossy(&output.stderr).into_owned(),
    })
}

fn metadata() -> Result<Metadata, Error> {
    let text = output(
        "cargo",
        command("cargo").args(["metadata", "--no-deps", "--format-version", "1"]),
    )?;
    serde_json::from_slice(&text).map_err(Error::Message)
}

/// The crates with a `cdylib` that lie where a kind has its place, in the order of the kinds, by name.
fn sources(metadata: &Metadata) -> Vec<Source> {
    let mut sources: Vec<Source> = metadata
        .packages
        .iter()
        .filter(|p| p.targets.iter().any(|t| t.kind.iter().any(|k| k == "cdylib")))
        .filter_map(|p| {
            let folder = p.manifest_path.parent()?;
            let place = folder.strip_prefix(&metadata.workspace_root).ok()?.parent()?;
            let kind = Kind::ALL.into_iter().find(|kind| place == Path::new(kind.place()))?;
            let name = folder.file_name()?.to_str()?.to_owned();
            let component = p.metadata.as_ref().and_then(|m| m.component.as_ref());
            let any_import = component.is_some_and(|c| c.imports == Imports::Any);
            if component.is_some_and(|c| c.script) {
                return None;
            }
            Some(Source {
                id: p.id.clone(),
                package: p.name.clone(),
                name,
                kind,
                any_import,
            })
        })
        .collect();
    sources.sort_by(|a, b| (a.kind, &a.name).cmp(&(b.kind, &b.name)));
    sources
}

/// Adds the wasm target through rustup where the compiler does not have it.
pub(crate) fn ensure_target() -> Result<(), Error> {
    ensure(TARGET)
}

/// The target whose standard library asks for an operating system.
pub(crate) fn ensure_wasip2() -> Result<(), Error> {
    ensure("wasm32-wasip2")
}

fn ensure(target: &'static str) -> Result<(), Error> {
    let text = output(
        "rustc",
        command("rustc").args(["--print", "target-libdir", "--target", target]),
    )?;
    if Path::new(String::from_utf8_lossy(&text).trim()).is_dir() {
        return Ok(());
    }
    output("rustup", command("rustup").args(["target", "add", target]))
        .map(drop)
        .map_err(|e| Error::Target {
            target,
            source: Box::new(e),
        })
}

/// Compiler flags, as a cargo setting that is joined with `.cargo/config.toml`: panic messages name files, and without these
/// the same source would give other bytes, and so another digest, in another folder.
fn path_flags() -> String {
    let cargo_home = std::env::var_os("CARGO_HOME").map(PathBuf::from);
    let cargo_home = cargo_home.or_else(|| std::env::home_dir().map(|home| home.join(".cargo")));
    let folders = [(cargo_home, "/cargo"), (Some(workspace_root().to_owned()), "/bumpless")];
    let flags = folders
        .into_iter()
        .filter_map(|(from, to)| from.map(|f| format!("--remap-path-prefix={}={to}", f.display())));
    // A path as a TOML text needs the quoting of Rust's.
    format!("target.{TARGET}.rustflags={:?}", flags.collect::<Vec<_>>())
}

/// Builds the modules; gives for each package its module and whether it was up to date.
fn cargo_build(sources: &[Source]) -> Result<Vec<(String, PathBuf, bool)>, Error> {
    let mut cargo = command("cargo");
    cargo.args([
        "build",
        "--target",
        TARGET,
        "--profile",
        PROFILE,
        "--lib",
        "--message-format",
        "json-render-diagnostics",
    ]);
    cargo.args(["--config", &path_flags()]);
    for source in sources {
        cargo.args(["--package", &source.package]);
    }
    let text = output("cargo", &mut cargo)?;
    let mut modules = Vec::new();
    for line in text.split(|&byte| byte == b'\n').filter(|line| line.starts_with(b"{")) {
        let artifact: Artifact = serde_json::from_slice(line).map_err(Error::Message)?;
        if artifact.reason != "compiler-artifact" {
            continue;
        }
        let module = artifact
            .filenames
            .into_iter()
            .find(|f| f.extension().is_some_and(|e| e == "wasm"));
        if let (Some(id), Some(module)) = (artifact.package_id, module) {
            modules.push((id, module, artifact.fresh));
        }
    }
    Ok(modules)
}

fn componentize(source: &Source, modules: &[(String, PathBuf, bool)], folder: &Path) -> Result<Built, Error> {
    let (_, module, fresh) = modules
        .iter()
        .find(|(id, ..)| *id == source.id)
        .ok_or_else(|| Error::NoModule(source.package.clone()))?;
    let path = folder.join(source.kind.folder()).join(format!("{}.wasm", source.name));
    if !(*fresh && is_newer(&path, module)) {
        let bytes = encode(&source.name, source.any_import, &read(module)?)?;
        write_whole(&path, &bytes)?;
    }
    let bytes = read(&path)?;
    let digest = Digest::of(&bytes);
    Ok(Built {
        name: source.name.clone(),
        path,
        kind: source.kind,
        bytes: bytes.len() as u64,
        digest,
    })
}

/// Was `path` written after `other`?
fn is_newer(path: &Path, other: &Path) -> bool {
    let time = |p: &Path| fs::metadata(p).and_then(|m| m.modified()).ok();
    matches!((time(path), time(other)), (Some(a), Some(b)) if a >= b)
}

pub(crate) fn read(path: &Path) -> Result<Vec<u8>, Error> {
    fs::read(path).map_err(|source| Error::File {
        path: path.to_owned(),
        action: "read",
        source,
    })
}

/// Writes beside the file, then renames: a reader sees the old or the new component, never a part of one.
pub(crate) fn write_whole(path: &Path, bytes: &[u8]) -> Result<(), Error> {
    let beside = path.with_extension("wasm.new");
    fs::File::create(&beside)
        .and_then(|mut file| file.write_all(bytes))
        .and_then(|()| fs::rename(&beside, path))
        .map_err(|source| Error::File {
            path: path.to_owned(),
            action: "written",
            source,
        })
}

/// Makes a component of a core module.
pub(crate) fn encode(name: &str, any_import: bool, module: &[u8]) -> Result<Vec<u8>, Error> {
    let refused = |reason: String| Error::Encode {
        name: name.to_owned(),
        reason,
    };
    let bytes = ComponentEncoder::default()
        .module(module)
        .map(|encoder| encoder.validate(true))
        .and_then(ComponentEncoder::encode)
        .map_err(|e| refused(format!("{e:#}")))?;
    if !any_import {
        check_imports(name, &bytes)?;
    }
    Ok(bytes)
}

/// A component may import from [`PACKAGE`] alone.
pub(crate) fn check_imports(name: &str, component: &[u8]) -> Result<(), Error> {
    let imports = imports(component).map_err(|reason| Error::Encode {
        name: name.to_owned(),
        reason,
    })?;
    match imports.into_iter().find(|import| package_of(import) != PACKAGE) {
        Some(import) => Err(Error::Import {
            name: name.to_owned(),
            import,
        }),
        None => Ok(()),
    }
}

/// What a component imports, by name.
fn imports(component: &[u8]) -> Result<Vec<String>, String> {
    let decoded = wit_component::decode(component).map_err(|e| format!("{e:#}"))?;
    let DecodedWasm::Component(resolve, world) = decoded else {
        return Err("it is an interface package, not a component".to_owned());
    };
    let world = resolve.worlds.get(world).ok_or("its world is missing")?;
    Ok(world.imports.keys().map(|key| resolve.name_world_key(key)).collect())
}

/// `a:b@1` of `a:b/c@1`.
fn package_of(import: &str) -> String {
    match import.split_once('/') {
        Some((package, rest)) => match rest.split_once('@') {
            Some((_, version)) => format!("{package}@{version}"),
            None => package.to_owned(),
        },
        None => import.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::expect_used, reason = "tests")]

    use super::*;

    /// Builds, so the first run takes as long as the compiler does.
    #[test]
    fn components_are_built_once_and_import_only_what_the_host_gives() {
        let (folder, first) = build_all().expect("components build");
        let names: Vec<&str> = first
            .iter()
            .filter(|c| c.kind == Kind::Controller)
            .map(|c| c.name.as_str())
            .collect();
        assert_eq!(
            names,
            [
                "autotune",
                "cascade",
                "feedforward",
                "fuzzy",
                "gain-schedule",
                "kalman-pid",
                "lead-lag",
                "mpc",
                "on-off",
                "override-selector",
                "pid",
                "pidplus",
                "ratio",
                "smith",
                "split-range"
            ]
        );
        assert!(first.iter().any(|c| c.kind == Kind::Guest && c.name == "traps"));
        for component in &first {
            let bytes = fs::read(&component.path).expect("is there");
            assert_eq!(Digest::of(&bytes), component.digest);
            let allowed = check_imports(&component.name, &bytes);
            if component.name == "forbidden-import" {
                let text = allowed.expect_err("it wants a disk").to_string();
                assert!(
                    text.starts_with("forbidden-import imports outside:disk/files@1.0.0, but only"),
                    "{text}"
                );
            } else {
                allowed.expect("imports only ours");
            }
        }

        let written = |c: &Built| fs::metadata(&c.path).and_then(|m| m.modified()).expect("has a time");
        let before: Vec<_> = first.iter().map(written).collect();
        let (again, second) = build_all().expect("components build");
        assert_eq!((&folder, &first), (&again, &second));
        assert_eq!(
            before,
            second.iter().map(written).collect::<Vec<_>>(),
            "nothing is written twice"
        );
    }

    #[test]
    fn an_import_belongs_to_its_package_and_version() {
        for (import, package) in [
            ("bumpless:control/io@0.1.0", PACKAGE),
            ("bumpless:control/io@0.2.0", "bumpless:control@0.2.0"),
            ("bumpless:control/io", "bumpless:control"),
            ("wasi:cli/environment@0.2.0", "wasi:cli@0.2.0"),
            ("run", "run"),
        ] {
            assert_eq!(package_of(import), package, "{import}");
        }
    }
}
