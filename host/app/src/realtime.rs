//! Puts the threads of a host before other work of the machine: the cycle's threads into the kernel's real-time class.
//!
//! ```text
//! Linux SCHED_FIFO   30   bl-epoch     stops a guest that spins, so it goes before the guest
//!                    20   loops-n      a cycle's own work, some tens of µs at a time
//!                         tx-n, rx-n, net-n, acc-n, app-n   the bus: what carries a cycle between hosts
//!                    10   record-writer, cycle-writer, io-journal, loops-reaper: they take what a cycle leaves
//! usual class, nice −10   all others: API, deployment, field buses, disk
//! SCHED_IDLE              the process that compiles
//!
//!   raised ──(the watch sleeps 50 ms and wakes up a quarter of a second late: the host was held up)──► usual class
//!     ▲                                                                                                    │
//!     └───────────────────────────────(a quarter of a second to catch up)──────────────────────────────────┘
//! ```
//! A host that stood still finds seconds of messages before it. While it works them off, it goes behind others: with its
//! real-time priority it would hold up the hosts beside it for tens of milliseconds, for cycles that are long over.
//! Loops and bus have one priority: they share locks, and a thread that finds one taken yields to its equals alone. With
//! loops above the bus a remote step took six times the processor time that it takes in the usual class. Whoever takes from a queue that a cycle fills is in
//! the class too: a sender that meets a receiver in the middle of its work yields until it is done, and would never let a thread
//! of the usual class get there.
//!
//! A machine that compiles, or on which another host starts, then delays a cycle by microseconds instead of milliseconds.
//! Threads that a thread makes later inherit its class.
//!
//! Owns: the one system call that the standard library and rustix do not have. Never: is needed; without the right to it a
//! host runs as any other program and says so once. The kernel itself keeps a part of each second for the other classes
//! (`/proc/sys/kernel/sched_rt_runtime_us`, 5 % unless it was changed).

use std::{
    io,
    time::{Duration, Instant},
};

use rustix::{process::setpriority_process, thread::Pid};
use serde::{Deserialize, Serialize};

use crate::error::Error;

/// Nice value of what is not the cycle's. The compiling child goes to 19 by itself, and into SCHED_IDLE by [`yield_to_all`].
const NICE: i32 = -10;
/// Real-time priority of the watch: it decides before the backlog of a host that was held up is touched.
const WATCH: i32 = 30;
/// Name of the watch's thread.
const WATCH_NAME: &str = "bl-watch";
/// The watch looks this often: twenty times a second is no load.
const LOOK: Duration = Duration::from_millis(50);
/// A watch that is this late means that the whole host stood still: stopped, or its machine was.
const HELD_UP: Duration = Duration::from_millis(250);
/// Time to work off what has come meanwhile: links hold about a megabyte each, which takes some tens of ms.
const CATCH_UP: Duration = Duration::from_millis(250);
/// Real-time priority of everything that a cycle crosses: in the lower half, below what a machine's own drivers use.
const CYCLE: i32 = 20;
/// Real-time priority of the threads that take what a cycle leaves: behind it, and before everything else.
const TAKER: i32 = 10;
/// Classes by the beginning of a thread's name. Source of the bus's names: zenoh-runtime, `ZRuntime`.
const PRIORITIES: [(&str, i32); 12] = [
    (WATCH_NAME, WATCH),
    ("bl-epoch", 30),
    // Before "loops-": it only drops memory.
    ("loops-reaper", TAKER),
    ("record-writer", TAKER),
    ("cycle-writer", TAKER),
    ("io-journal", TAKER),
    ("loops-", CYCLE),
    ("tx-", CYCLE),
    ("rx-", CYCLE),
    ("net-", CYCLE),
    ("acc-", CYCLE),
    ("app-", CYCLE),
];

/// What the configuration asks for.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Realtime {
    /// Where the system allows it.
    #[default]
    Auto,
    /// The host does not start without it.
    Required,
    /// The host runs as any other program.
    Off,
}

/// Raises every thread that there is. To be called once a host is ready: one that starts is work like any other, and must
/// not hold up those that run.
///
/// # Errors
/// [`Error::Start`] where it is required and the system refuses it.
pub fn raise(wish: Realtime) -> Result<(), Error> {
    if wish == Realtime::Off {
        return Ok(());
    }
    let raised = raise_all();
    if raised.is_ok() {
        std::thread::Builder::new()
            .name(WATCH_NAME.to_owned())
            .spawn(watch)
            .map_err(|error| Error::start("the real-time class", error.to_string()))?;
    }
    match raised {
        Ok(()) => tracing::info!("the cycle's threads run in the real-time class"),
        Err(error) if wish == Realtime::Required => {
            let cure = "the capability CAP_SYS_NICE, or a limit LimitRTPRIO=30 and LimitNICE=-10, would allow it";
            return Err(Error::start("the real-time class", format!("{error}; {cure}")));
        }
        Err(error) => tracing::info!(
            %error,
            "the host runs at the usual priority; CAP_SYS_NICE would put its cycles before other work"
        ),
    }
    Ok(())
}

/// Every thread of this process gets its class by its name.
fn raise_all() -> io::Result<()> {
    for (id, name) in threads()? {
        gone_is_fine(setpriority_process(Some(id), NICE).map_err(io::Error::from))?;
        let class = PRIORITIES.iter().find(|(prefix, _)| name.starts_with(prefix));
        if let Some((_, priority)) = class {
            gone_is_fine(schedule(id, libc::SCHED_FIFO, *priority))?;
        }
    }
    Ok(())
}

/// Every thread but the watch itself goes back to the usual class; it keeps its nice value.
fn lower_all() -> io::Result<()> {
    for (id, name) in threads()? {
        if name != WATCH_NAME {
            gone_is_fine(schedule(id, libc::SCHED_OTHER, 0))?;
        }
    }
    Ok(())
}

/// Watches for this host having been held up, for as long as the process lives.
fn watch() {
    // Threads that are made later do not inherit from this one, so it raises itself.
    if let Err(error) = schedule(rustix::thread::gettid(), libc::SCHED_FIFO, WATCH) {
        tracing::warn!(%error, "a host that was held up will work off its backlog before others");
    }
    loop {
        let before = Instant::now();
        std::thread::sleep(LOOK);
        if before.elapsed() < LOOK + HELD_UP {
            continue;
        }
        let lowered = lower_all();
        std::thread::sleep(CATCH_UP);
        let raised = raise_all();
        match lowered.and(raised) {
            Ok(()) => tracing::info!(
                held_up_ms = before.elapsed().saturating_sub(LOOK + CATCH_UP).as_millis(),
                "this host was held up; it worked off its backlog behind others"
            ),
            Err(error) => tracing::warn!(%error, "threads stay in the class that they have"),
        }
    }
}

/// Puts the calling thread where a host's cycles run: for measurements beside them. False where the system refuses it.
#[must_use]
pub fn raise_this_thread() -> bool {
    schedule(rustix::thread::gettid(), libc::SCHED_FIFO, CYCLE).is_ok()
}

/// Puts this process behind everything else: its threads run where nobody else wants to, and are stopped at once where somebody
/// does. The lowest nice value alone is not that: of two ordinary threads the one that wakes up may have to wait for some ms.
/// To be called before there are other threads. False where the system refuses it.
#[must_use]
pub fn yield_to_all() -> bool {
    schedule(rustix::thread::gettid(), libc::SCHED_IDLE, 0).is_ok()
}

/// The threads of this process and their names.
fn threads() -> io::Result<Vec<(Pid, String)>> {
    let mut threads = Vec::new();
    for task in std::fs::read_dir("/proc/self/task")? {
        let task = task?;
        let id = task.file_name().to_str().and_then(|text| text.parse().ok());
        // A thread that ended between the two reads has no name any more, and needs no class.
        let name = std::fs::read_to_string(task.path().join("comm")).unwrap_or_default();
        threads.extend(id.and_then(Pid::from_raw).map(|id| (id, name.trim_end().to_owned())));
    }
    Ok(threads)
}

/// A thread that ended meanwhile is no failure.
fn gone_is_fine(result: io::Result<()>) -> io::Result<()> {
    match result {
        Err(error) if error.raw_os_error() == Some(libc::ESRCH) => Ok(()),
        other => other,
    }
}

fn schedule(thread: Pid, policy: i32, priority: i32) -> io::Result<()> {
    let parameters = libc::sched_param {
        sched_priority: priority,
    };
    // SAFETY: the kernel reads `parameters`, which outlives the call, and no memory else; a number that is no thread of this
    // system, or a priority out of range, is an error code. Source: sched_setscheduler(2).
    #[allow(
        unsafe_code,
        reason = "a system call that no safe crate of the workspace has; see SAFETY"
    )]
    let status = unsafe { libc::sched_setscheduler(thread.as_raw_nonzero().get(), policy, &raw const parameters) };
    if status == 0 {
        Ok(())
    } else {
        Err(io::Error::last_os_error())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    /// The scheduling policy and real-time priority of this thread. Source: proc_pid_stat(5), fields 41 and 40.
    fn class() -> (i32, i32) {
        let stat = std::fs::read_to_string("/proc/thread-self/stat").unwrap();
        let fields: Vec<&str> = stat.rsplit(") ").next().unwrap().split(' ').collect();
        (fields[38].parse().unwrap(), fields[37].parse().unwrap())
    }

    #[test]
    fn a_thread_is_in_the_real_time_class_or_the_system_refused_it() {
        // A thread of its own: the class stays with it.
        let (raised, class) = std::thread::spawn(|| (raise_this_thread(), class())).join().unwrap();
        let expected = if raised {
            (libc::SCHED_FIFO, 20)
        } else {
            (libc::SCHED_OTHER, 0)
        };
        assert_eq!(class, expected);
    }

    #[test]
    fn every_thread_has_a_name_and_the_reaper_goes_behind_the_loops() {
        assert!(threads().unwrap().iter().any(|(_, name)| !name.is_empty()));
        let class = |name: &str| {
            PRIORITIES
                .iter()
                .find(|(prefix, _)| name.starts_with(prefix))
                .map(|(_, p)| *p)
        };
        assert_eq!(
            (class("loops-0"), class("loops-reaper"), class("async")),
            (Some(CYCLE), Some(TAKER), None)
        );
    }

    #[test]
    fn a_thread_that_is_gone_is_no_failure() {
        let nobody = Pid::from_raw(i32::MAX - 1).unwrap();
        assert!(gone_is_fine(schedule(nobody, libc::SCHED_FIFO, 20)).is_ok() || !raise_this_thread());
    }
}
