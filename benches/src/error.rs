//! Why a bench could not be run. A bound that does not hold is no error; it is a result.

use std::path::PathBuf;

/// Why a bench could not be run.
#[derive(Debug, thiserror::Error)]
pub(crate) enum Error {
    /// A file or socket.
    #[error("{what}")]
    Io {
        /// What was being done.
        what: String,
        /// Why it failed.
        #[source]
        source: std::io::Error,
    },
    /// The components could not be built.
    #[error("the components could not be built")]
    Components(#[source] xtask::components::Error),
    /// The example of another language could not be built.
    #[error("an example could not be built")]
    Example(#[source] xtask::Error),
    /// The sandbox refused something.
    #[error("the sandbox refused {what}")]
    Engine {
        /// What.
        what: String,
        /// Why.
        #[source]
        source: bumpless_engine::Error,
    },
    /// A component's own fault.
    #[error("a step failed")]
    Step(#[from] bumpless_core::Fault),
    /// The simulated plant.
    #[error("the simulated plant could not be opened")]
    Plant(#[source] bumpless_io::Error),
    /// The bus.
    #[error("the bus could not be joined")]
    Bus(#[source] bumpless_cell::Error),
    /// The lab.
    #[error("the lab")]
    Lab(#[from] bumpless_lab::Error),
    /// The disk.
    #[error("the store")]
    Store(#[from] bumpless_store::Error),
    /// The loops.
    #[error("the loops did not take it")]
    Loops(#[from] bumpless_loops::Error),
    /// A loop's specification does not fit its component.
    #[error("the loop does not fit the component")]
    Spec(#[from] bumpless_core::spec::SpecError),
    /// A wish that cannot be fulfilled.
    #[error("{0}")]
    Wish(String),
    /// A picture.
    #[error("the picture could not be drawn: {0}")]
    Picture(String),
    /// Too few cores.
    #[error("this process may use {0} cores; the bench needs 2, to load one and leave the others alone")]
    Cores(usize),
    /// The cell of processes.
    #[error("the cell")]
    Cell(#[from] bumpless_tests::Error),
    /// A name of ours that is no name.
    #[error(transparent)]
    Name(#[from] bumpless_core::NameError),
    /// A process said something else than expected.
    #[error("{who} said {said:?} instead of {expected}")]
    Said {
        /// Which process.
        who: String,
        /// Its line, cut.
        said: String,
        /// What was expected.
        expected: &'static str,
    },
    /// Something that had to happen did not.
    #[error("{what} did not happen within {seconds} s")]
    Waited {
        /// What was waited for.
        what: String,
        /// How long.
        seconds: u64,
    },
    /// A component is missing from the folder of components.
    #[error("{0} is missing: run cargo xtask components")]
    Missing(PathBuf),
}

impl Error {
    /// For `map_err` on a file or socket.
    pub(crate) fn io(what: impl Into<String>) -> impl FnOnce(std::io::Error) -> Self {
        let what = what.into();
        move |source| Self::Io { what, source }
    }
}
