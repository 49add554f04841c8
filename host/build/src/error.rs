//! Why something was not built. Never: a compiler's words without its own places.

use std::{
    io,
    path::{Path, PathBuf},
};

/// Why something was not built.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file or folder.
    #[error("{path} could not be {action}: {source}", path = path.display())]
    File {
        /// Which.
        path: PathBuf,
        /// "read" and the like.
        action: &'static str,
        /// What the system says.
        source: io::Error,
    },
    /// Nothing that can be built.
    #[error("{path} is no source of a controller: give a .st file, a folder with one, or a folder with a Cargo.toml or a build.sh", path = path.display())]
    NoSource {
        /// Which.
        path: PathBuf,
    },
    /// A text of Structured Text is wrong.
    #[error("{}", located(path, error))]
    Text {
        /// Which.
        path: PathBuf,
        /// In the compiler's words.
        error: bumpless_st::Error,
    },
    /// A program is not there or cannot be run.
    #[error("{program} cannot be run: {source}; install Rust from https://rustup.rs and put it on the path")]
    NoProgram {
        /// Its name.
        program: &'static str,
        /// What the system says.
        source: io::Error,
    },
    /// A program ended badly.
    #[error("{program} failed:\n{output}")]
    Program {
        /// Its name.
        program: &'static str,
        /// What it wrote.
        output: String,
    },
    /// There is no shell.
    #[error("{program} cannot be run: {source}; a build.sh needs a shell on the path")]
    NoShell {
        /// Its name.
        program: &'static str,
        /// What the system says.
        source: io::Error,
    },
    /// A script ended well and left nothing.
    #[error("{path}: build.sh left no component: it writes the file that its first argument names", path = path.display())]
    NoOutput {
        /// The project's folder.
        path: PathBuf,
    },
    /// Cargo built something else.
    #[error("{path}: cargo built no module: give the crate `crate-type = [\"cdylib\", \"rlib\"]`", path = path.display())]
    NoModule {
        /// The crate's folder.
        path: PathBuf,
    },
    /// The module does not become a component.
    #[error(
        "the module does not become a component: {0}; a controller uses bumpless-sdk and is built for wasm32-unknown-unknown"
    )]
    Encode(String),
    /// A name that a component cannot have.
    #[error("{0:?} is no name of a project: use 1 to 32 lower-case letters, digits and single dashes, a letter first")]
    Name(String),
    /// A project would go over something else.
    #[error("{path} is there already: choose another name", path = path.display())]
    Exists {
        /// Which.
        path: PathBuf,
    },
    /// The system does not watch a folder.
    #[error("{path} cannot be watched: {source}; \"no space\" means too many watched folders: sysctl fs.inotify.max_user_watches", path = path.display())]
    Watch {
        /// Which.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
    /// The SDK for Rust was not found.
    #[error("the folder guest-sdk of Bumpless was not found beside here or the program: name it with --sdk FOLDER")]
    NoSdk,
}

impl Error {
    pub(crate) fn file(path: &Path, action: &'static str, source: io::Error) -> Self {
        Self::File {
            path: path.to_owned(),
            action,
            source,
        }
    }
}

/// Each diagnostic with its file, as editors read it.
fn located(path: &Path, error: &bumpless_st::Error) -> String {
    let path = path.display();
    match error {
        bumpless_st::Error::Source(all) => {
            let lines: Vec<String> = all.iter().map(|one| format!("{path}:{one}")).collect();
            lines.join("\n")
        }
        other => format!("{path}: {other}"),
    }
}
