//! `cargo xtask languages`: builds the example law of each language by the example's own script.
//!
//! ```text
//!   tools (clang, npm install, a venv; once) ─► examples/NAME/build.sh OUT ─► check of imports ─► target/components/examples/NAME.wasm
//!      └ sources as at the last build: nothing to do
//! ```
//! Owns `target/languages/NAME`: the tools and what the script leaves. Rust's own example is built with the other crates
//! (`components`). Never: touches a source.

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use bumpless_core::Digest;

use crate::{
    Error, bindings, components,
    run::{output, program, say, target_folder, words},
};

/// Characters of a failed command's words that are shown.
const SAID_CHARS_MAX: usize = 4_000;

/// Folders beside sources that are none: whoever builds an example by hand has them.
pub(crate) const LEFT_BY_TOOLS: [&str; 5] = ["node_modules", "build", "venv", "__pycache__", "target"];

/// The examples that are built here, by their folders in `examples/`.
pub const EXAMPLES: [Example; 5] = [
    Example {
        name: "c-pid",
        tools: Tools::Clang,
    },
    Example {
        name: "js-pid",
        tools: Tools::Npm,
    },
    Example {
        name: "ts-pid",
        tools: Tools::Npm,
    },
    Example {
        name: "python-pid",
        tools: Tools::Pip,
    },
    Example {
        name: "rust-wasip2-pid",
        tools: Tools::Wasip2,
    },
];

/// A law in another language than the host's own way of Rust.
#[derive(Debug, Clone, Copy)]
pub struct Example {
    /// Its folder in `examples/`, and the name of its component.
    pub name: &'static str,
    tools: Tools,
}

/// What has to be there before the script.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Tools {
    /// Debian's clang and lld.
    Clang,
    /// What the example's lock file names.
    Npm,
    /// What the example's requirements name.
    Pip,
    /// The compiler's other target.
    Wasip2,
}

/// The example of that name.
#[must_use]
pub fn named(name: &str) -> Option<Example> {
    EXAMPLES.into_iter().find(|example| example.name == name)
}

/// Builds the named examples, or all, and says where they are.
///
/// # Errors
/// A name that is none, or an example that does not build.
pub fn run(names: &[String]) -> Result<(), Error> {
    let wanted = if names.is_empty() {
        EXAMPLES.to_vec()
    } else {
        let known = |name: &String| {
            named(name).ok_or_else(|| Error::Example {
                name: name.clone(),
                command: "cargo xtask languages".to_owned(),
                said: format!(
                    "there is no such example; there are {}",
                    EXAMPLES.map(|e| e.name).join(", ")
                ),
            })
        };
        names.iter().map(known).collect::<Result<_, _>>()?
    };
    for example in wanted {
        let path = example.build()?;
        let bytes = fs::metadata(&path).map_or(0, |file| file.len());
        say(&format!("{bytes:>10} bytes  {}", path.display()));
    }
    Ok(())
}

/// Runs it unseen; gives the end of what it wrote where it fails.
fn quiet(name: &str, command: &mut Command) -> Result<(), Error> {
    let done = command.output().map_err(|source| Error::Program {
        program: command.get_program().to_string_lossy().into_owned(),
        source,
    })?;
    if done.status.success() {
        return Ok(());
    }
    let said = format!(
        "{}{}",
        String::from_utf8_lossy(&done.stdout),
        String::from_utf8_lossy(&done.stderr)
    );
    let from = said.chars().count().saturating_sub(SAID_CHARS_MAX);
    Err(Error::Example {
        name: name.to_owned(),
        command: words(command),
        said: said.chars().skip(from).collect(),
    })
}

fn file_error(path: &Path) -> impl FnOnce(std::io::Error) -> Error + use<> {
    let path = path.to_owned();
    move |source| Error::File { path, source }
}

impl Example {
    fn folder(self) -> PathBuf {
        components::workspace_root().join("examples").join(self.name)
    }

    /// Where its tools and what its script leaves are.
    fn workshop(self) -> PathBuf {
        target_folder().join("languages").join(self.name)
    }

    /// Builds it where its sources, the interfaces or the way to build it changed. Gives the component. Safe to run from
    /// several processes at once: one works, the others wait and find the work done.
    ///
    /// # Errors
    /// A tool that is missing and cannot be had, a script that fails, imports that the sandbox does not give.
    pub fn build(self) -> Result<PathBuf, Error> {
        let out = target_folder()
            .join("components/examples")
            .join(format!("{}.wasm", self.name));
        let workshop = self.workshop();
        for folder in [&workshop, &out.with_file_name("")] {
            fs::create_dir_all(folder).map_err(file_error(folder))?;
        }
        // Released when the file is closed, also when this process is killed.
        let lock_path = workshop.join(".lock");
        let lock = fs::File::create(&lock_path).map_err(file_error(&lock_path))?;
        lock.lock().map_err(file_error(&lock_path))?;

        let (wanted, stamp_path) = (self.stamp()?, workshop.join("stamp"));
        let is_fresh = fs::read_to_string(&stamp_path).is_ok_and(|kept| kept == wanted);
        if is_fresh && out.is_file() {
            return Ok(out);
        }
        let mut script = components::command("sh");
        script
            .arg("build.sh")
            .current_dir(self.folder())
            .env("BUILD", &workshop);
        self.ready(&mut script)?;
        // What this tool does for the script in a shell, it does itself here: it is the tool.
        script.env("XTASK", ":");
        let made = workshop.join("component.wasm");
        if self.tools == Tools::Clang {
            bindings::c(&workshop)?;
        }
        quiet(self.name, script.arg(&made))?;
        if matches!(self.tools, Tools::Clang | Tools::Wasip2) {
            bindings::component(&workshop.join("module.wasm"), &made, self.tools == Tools::Wasip2)?;
        }
        let bytes = components::read(&made)?;
        components::check_imports(self.name, &bytes)?;
        components::write_whole(&out, &bytes)?;
        fs::write(&stamp_path, wanted).map_err(file_error(&stamp_path))?;
        Ok(out)
    }

    /// Sets up what the script needs, and tells it where that is.
    fn ready(self, script: &mut Command) -> Result<(), Error> {
        let workshop = self.workshop();
        match self.tools {
            Tools::Clang => clang(),
            Tools::Npm => {
                self.once("package-lock.json", |_| {
                    for name in ["package.json", "package-lock.json"] {
                        let (from, to) = (self.folder().join(name), workshop.join(name));
                        fs::copy(&from, &to).map_err(file_error(&to))?;
                    }
                    let mut npm = program("npm");
                    // Not `npm ci`: it refuses lock files whose optional parts for other systems are not published.
                    npm.args(["install", "--no-audit", "--no-fund", "--loglevel", "error"]);
                    quiet(self.name, npm.current_dir(&workshop))
                })?;
                script.env("TOOLS", workshop.join("node_modules/.bin"));
                Ok(())
            }
            Tools::Pip => {
                self.once("requirements.txt", |requirements| {
                    let venv = workshop.join("venv");
                    quiet(self.name, program("python3").args(["-m", "venv", "--clear"]).arg(&venv))?;
                    let mut pip = program(venv.join("bin/pip"));
                    pip.args(["install", "--quiet", "--disable-pip-version-check", "--requirement"]);
                    quiet(self.name, pip.arg(requirements))
                })?;
                script.env("TOOLS", workshop.join("venv/bin"));
                Ok(())
            }
            Tools::Wasip2 => {
                script.env("CARGO_TARGET_DIR", target_folder());
                components::ensure_wasip2().map_err(Error::from)
            }
        }
    }

    /// Sets up once per content of a file of the example.
    fn once(self, file: &str, work: impl FnOnce(&Path) -> Result<(), Error>) -> Result<(), Error> {
        let path = self.folder().join(file);
        let done = self.workshop().join("tools-of");
        let wanted = fs::read_to_string(&path).map_err(file_error(&path))?;
        if fs::read_to_string(&done).is_ok_and(|kept| kept == wanted) {
            return Ok(());
        }
        work(&path)?;
        fs::write(&done, wanted).map_err(file_error(&done))
    }

    /// Names the sources as they are: the example's, the interfaces, and this tool's own.
    fn stamp(self) -> Result<String, Error> {
        let mut all = Vec::new();
        let root = components::workspace_root();
        let mut folders = vec![self.folder(), root.join("wit"), root.join("xtask/src")];
        if self.tools == Tools::Wasip2 {
            folders.extend([root.join("examples/rust-pid"), root.join("guest-sdk/src")]);
        }
        let mut files = Vec::new();
        while let Some(folder) = folders.pop() {
            for entry in fs::read_dir(&folder).map_err(file_error(&folder))? {
                let path = entry.map_err(file_error(&folder))?.path();
                let own = path
                    .file_name()
                    .is_some_and(|name| LEFT_BY_TOOLS.iter().all(|left| name != *left));
                if own && path.is_dir() {
                    folders.push(path);
                } else if own && path.extension().is_none_or(|kind| kind != "wasm") {
                    files.push(path);
                }
            }
        }
        files.sort();
        for path in files {
            let digest = Digest::of(&components::read(&path)?);
            all.extend_from_slice(format!("{} {digest}\n", path.display()).as_bytes());
        }
        Ok(Digest::of(&all).to_string())
    }
}

/// clang and its linker for WebAssembly; installed where the system's own way to do so is at hand.
fn clang() -> Result<(), Error> {
    let there = || {
        ["clang", "wasm-ld"]
            .iter()
            .all(|name| output(program(name).arg("--version")).is_some())
    };
    if there() {
        return Ok(());
    }
    say("clang is not installed: trying apt-get");
    run_apt()?;
    if there() {
        return Ok(());
    }
    Err(Error::Program {
        program: "clang with wasm-ld".to_owned(),
        source: std::io::Error::from(std::io::ErrorKind::NotFound),
    })
}

fn run_apt() -> Result<(), Error> {
    // A fresh machine has no lists, and finds nothing then.
    crate::run::run(program("apt-get").args(["update", "--quiet"]))?;
    crate::run::run(program("apt-get").args(["install", "--yes", "--no-install-recommends", "clang", "lld"]))
}
