//! Why programs cannot be run here.

/// Everything that this room can refuse.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A thread cannot be made.
    #[error("the threads of programs cannot be started; check the limits on threads of this machine")]
    Thread(#[source] std::io::Error),
    /// There is none of that name here.
    #[error("no program {0} runs here; start it")]
    NotHere(bumpless_core::ProgramId),
    /// It runs already, under this term or a later one.
    #[error("program {0} runs here already, in ownership {1}; stop it first")]
    Runs(bumpless_core::ProgramId, u64),
}
