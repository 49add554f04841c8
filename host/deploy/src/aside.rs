//! Work that may take processor time but must not take it from anything else: threads of the lowest priority.
//!
//! Never: for work that a cycle, or a person at a switch, waits for.

use tokio::sync::oneshot;

use crate::error::Error;

/// Nice value of such threads; the compiling child has the same.
const NICE: i32 = 19;

/// Runs work on a thread of its own.
///
/// # Errors
/// [`Error::Busy`] where the system gives no thread.
pub(crate) fn aside(name: &str, work: impl FnOnce() + Send + 'static) -> Result<(), Error> {
    let work = move || {
        // Where the system does not have it, the work is done at the usual priority.
        if let Err(error) = rustix::process::setpriority_process(Some(rustix::thread::gettid()), NICE) {
            tracing::debug!(%error, "a thread keeps its priority");
        }
        work();
    };
    let started = std::thread::Builder::new().name(name.to_owned()).spawn(work);
    started.map(drop).map_err(|error| {
        Error::busy(
            format!("the system gives no thread for {name}: {error}"),
            "try again, or raise the limit of processes",
        )
    })
}

/// Runs work on such a thread, and waits for its end.
///
/// # Errors
/// As [`aside`]; [`Error::Internal`] where the work panicked.
pub(crate) async fn done_aside<T: Send + 'static>(
    name: &str,
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<T, Error> {
    let (sender, receiver) = oneshot::channel();
    aside(name, move || {
        // The asker may have left.
        let _ = sender.send(work());
    })?;
    receiver
        .await
        .map_err(|_| Error::internal(format!("{name} ended badly; the log says more")))
}
