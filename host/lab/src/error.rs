//! The one error of this room. Each message names the place and the cure.

use std::path::PathBuf;

/// What can go wrong with an experiment.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The text is no experiment.
    #[error("{place}: {problem}")]
    Experiment {
        /// The file, the case, the table.
        place: String,
        /// What is wrong and what would be right.
        problem: String,
    },
    /// A component cannot be found.
    #[error(
        "{what} {name:?} is not there: looked for {looked}; build the stock ones with `cargo xtask components`, or give a path"
    )]
    NoComponent {
        /// "controller" or "plant".
        what: &'static str,
        /// The name given.
        name: String,
        /// The files that were tried.
        looked: String,
    },
    /// The sandbox does not take it.
    #[error("{what} {name:?} cannot be used")]
    Component {
        /// "controller" or "plant".
        what: &'static str,
        /// Its name.
        name: String,
        /// Why not.
        source: bumpless_engine::Error,
    },
    /// The sandbox cannot be had.
    #[error("the sandbox cannot be started")]
    Engine(#[source] bumpless_engine::Error),
    /// A run that could not go on to its end.
    #[error("run {run} ended at {at_s:.3} s: {problem}")]
    Run {
        /// Case, sweep and seed.
        run: String,
        /// Virtual time, in s.
        at_s: f64,
        /// Why, in words.
        problem: String,
    },
    /// A file.
    #[error("{doing} {path} failed; check that the folder exists, is writable and has space")]
    File {
        /// What was tried, for example "writing".
        doing: &'static str,
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A file that was kept from another run does not say what it should.
    #[error("{path} is no result of the lab ({problem}); delete it")]
    Kept {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        problem: String,
    },
    /// A picture cannot be drawn.
    #[error("the picture {what} cannot be drawn: {problem}")]
    Picture {
        /// Which.
        what: String,
        /// Why not.
        problem: String,
    },
    /// Whoever asked for the runs wants no more.
    #[error("stopped before its end")]
    Stopped,
}

impl Error {
    /// An error in an experiment at a place.
    pub(crate) fn at(place: impl Into<String>, problem: impl Into<String>) -> Self {
        Self::Experiment {
            place: place.into(),
            problem: problem.into(),
        }
    }

    /// For `map_err` on file operations.
    pub(crate) fn file(doing: &'static str, path: impl Into<PathBuf>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.into();
        move |source| Self::File { doing, path, source }
    }
}
