//! Ctrl-C and SIGTERM for the commands that run until somebody has seen enough: a flag that turns true.
//!
//! Never: leaves a command that does not listen running; a second signal ends the process.

use std::sync::{
    Arc,
    atomic::{AtomicBool, Ordering},
};

use tokio::signal::unix::{SignalKind, signal};

use crate::error::Error;

/// A flag that turns true with the first signal. A second one ends the process at once.
pub(crate) fn on_signals() -> Result<Arc<AtomicBool>, Error> {
    let failed = |error| Error::start("the signal handler", error);
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .map_err(failed)?;
    let stop = Arc::new(AtomicBool::new(false));
    let (mut interrupt, mut terminate) = {
        let _inside = runtime.enter();
        (
            signal(SignalKind::interrupt()).map_err(failed)?,
            signal(SignalKind::terminate()).map_err(failed)?,
        )
    };
    let flag = Arc::clone(&stop);
    let wait = move || {
        runtime.block_on(async {
            let mut any = async || {
                tokio::select! {
                    _ = interrupt.recv() => {}
                    _ = terminate.recv() => {}
                }
            };
            any().await;
            flag.store(true, Ordering::Relaxed);
            any().await;
            // 128 + SIGINT, what a shell expects of a process that was interrupted.
            std::process::exit(130);
        });
    };
    std::thread::Builder::new()
        .name("signals".to_owned())
        .spawn(wait)
        .map_err(failed)?;
    Ok(stop)
}
