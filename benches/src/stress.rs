//! Load on one core: a process that only computes, bound to that core; and hosts bound to theirs.

use std::{
    collections::HashSet,
    process::{Child, Command, Stdio},
};

use rustix::{
    process::Pid,
    thread::{CpuSet, sched_getaffinity, sched_setaffinity},
};

use crate::error::Error;

/// Processes that burn one core between them. They end with it.
#[derive(Debug)]
pub(crate) struct Burner(Vec<Child>);

impl Burner {
    /// Starts as many processes of this program, bound to a core.
    pub(crate) fn start(core: usize, processes: usize) -> Result<Self, Error> {
        let program = std::env::current_exe().map_err(Error::io("this program has no path"))?;
        let mut burner = Self(Vec::new());
        for _ in 0..processes {
            let child = Command::new(&program)
                .args(["burn", &core.to_string()])
                // It ends when its standard input does: also when this program is killed.
                .stdin(Stdio::piped())
                .spawn()
                .map_err(Error::io("the load cannot be started"))?;
            burner.0.push(child);
        }
        Ok(burner)
    }
}

impl Drop for Burner {
    fn drop(&mut self) {
        for child in &mut self.0 {
            // It may have ended before.
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

/// The load itself: computes on one core until the standard input ends.
pub(crate) fn burn(core: usize) -> Result<(), Error> {
    bind_thread(None, core)?;
    std::thread::Builder::new()
        .name("burn".to_owned())
        .spawn(|| {
            let mut x = 0_u64;
            loop {
                x = std::hint::black_box(x.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1));
            }
        })
        .map_err(Error::io("the load's thread cannot be started"))?;
    let mut input = Vec::new();
    // However the input ended, so does this process.
    let _ = std::io::Read::read_to_end(&mut std::io::stdin(), &mut input);
    Ok(())
}

/// Cores that this process may use.
pub(crate) fn cores() -> Vec<usize> {
    sched_getaffinity(None)
        .map(|set| (0..CpuSet::MAX_CPU).filter(|&core| set.is_set(core)).collect())
        .unwrap_or_default()
}

fn bind_thread(thread: Option<Pid>, core: usize) -> Result<(), Error> {
    let mut set = CpuSet::new();
    set.set(core);
    sched_setaffinity(thread, &set)
        .map_err(|error| Error::io(format!("a thread cannot be bound to core {core}"))(error.into()))
}

/// Binds every thread of a process to a core. Threads made meanwhile take after the one that made them, so it looks again
/// until there is none that it has not bound.
pub(crate) fn bind(pid: u32, core: usize) -> Result<(), Error> {
    let folder = format!("/proc/{pid}/task");
    let mut bound = HashSet::new();
    loop {
        let before = bound.len();
        let tasks = std::fs::read_dir(&folder).map_err(Error::io(format!("{folder} cannot be read")))?;
        for task in tasks.flatten() {
            let number = task.file_name().to_str().and_then(|name| name.parse::<i32>().ok());
            if let Some(thread) = number.and_then(Pid::from_raw).filter(|thread| !bound.contains(thread)) {
                // A thread that has ended meanwhile needs no core.
                if bind_thread(Some(thread), core).is_ok() {
                    bound.insert(thread);
                }
            }
        }
        if bound.is_empty() {
            return Err(Error::Waited {
                what: format!("process {pid} to be bound to core {core}"),
                seconds: 0,
            });
        }
        if bound.len() == before {
            return Ok(());
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    #[test]
    fn a_process_is_bound_with_all_its_threads() {
        let mut child = Command::new("sleep").arg("60").spawn().unwrap();
        let core = *cores().last().unwrap();
        bind(child.id(), core).unwrap();
        let status = std::fs::read_to_string(format!("/proc/{}/status", child.id())).unwrap();
        child.kill().unwrap();
        child.wait().unwrap();
        let list = status.lines().find_map(|line| line.strip_prefix("Cpus_allowed_list:"));
        assert_eq!(list.map(str::trim), Some(core.to_string().as_str()));
        assert!(bind(child.id(), core).is_err(), "it is gone");
    }
}
