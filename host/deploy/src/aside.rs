//! Work that may take processor time but must not take it from anything else: threads of the lowest priority.
//!
//! Never: for work that a cycle, or a person at a switch, waits for.

use std::time::Duration;

use tokio::{sync::oneshot, time::timeout};

use crate::error::Error;

/// Longest wait for one piece of such work. It has milliseconds to do, on a machine that lets it.
const ASIDE_WAIT: Duration = Duration::from_secs(25);

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

/// Runs work on such a thread, and waits for its end. Work that is not done in time goes on, but nobody waits for it.
///
/// # Errors
/// As [`aside`]; [`Error::Timeout`], [`Error::Internal`] where the work panicked.
pub(crate) async fn done_aside<T: Send + 'static>(
    name: &str,
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<T, Error> {
    let (sender, receiver) = oneshot::channel();
    aside(name, move || {
        // The asker may have left.
        let _ = sender.send(work());
    })?;
    let late = |_| {
        Error::timeout(
            format!(
                "a {name} at the lowest priority did not get far within {} s",
                ASIDE_WAIT.as_secs()
            ),
            "the loop's home is too busy; try again later, or ask for less",
        )
    };
    let ended = timeout(ASIDE_WAIT, receiver).await.map_err(late)?;
    ended.map_err(|_| Error::internal(format!("a {name} ended badly; the log says more")))
}
