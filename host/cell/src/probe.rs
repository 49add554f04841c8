//! Measures this machine and this process.
//!
//! The load is that of the processors that the process may run on (its affinity): a host that is bound to one busy core is
//! busy, however idle the others are.
//!
//! Never: reads more than a handful of files in `/proc` per sample; a sample takes well under a millisecond, but belongs
//! on no cycle's thread.

use rustix::thread::CpuSet;
use sysinfo::{Cpu, Pid, ProcessRefreshKind, ProcessesToUpdate, System};

use crate::error::Error;

/// One sample.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Measured {
    /// Load of the processors that this process may run on since the sample before, by anyone, 0 to 1.
    pub cpu: f32,
    /// This process's part of it, 0 to 1.
    pub cpu_process: f32,
    /// Resident memory of this process, in bytes.
    pub memory_bytes: u64,
    /// Memory of the machine that is in use, in bytes.
    pub memory_used_bytes: u64,
    /// Memory of the machine, in bytes.
    pub memory_total_bytes: u64,
    /// Processors that this process may run on.
    pub processors: usize,
}

/// The sampler. Loads are means since the sample before: take one at an even pace, 200 ms apart or more.
#[derive(Debug)]
pub struct Probe {
    system: System,
    pid: Pid,
}

impl Probe {
    /// Starts, with a first sample to measure from.
    ///
    /// # Errors
    /// [`Error::Probe`] where the system does not tell its load or this process's number.
    pub fn new() -> Result<Self, Error> {
        let pid = sysinfo::get_current_pid().map_err(Error::Probe)?;
        let mut probe = Self {
            system: System::new().map_err(Error::Probe)?,
            pid,
        };
        probe.sample();
        Ok(probe)
    }

    /// Measures now.
    pub fn sample(&mut self) -> Measured {
        self.system.refresh_cpu_usage();
        self.system.refresh_memory();
        self.system.refresh_processes_specifics(
            ProcessesToUpdate::Some(&[self.pid]),
            false,
            ProcessRefreshKind::nothing().with_cpu().with_memory(),
        );
        let loads = self.system.cpus().iter().map(|cpu| (processor(cpu), cpu.usage()));
        // The thread that samples stands for the process. A system that does not tell its affinity means all of them.
        let (load, processors) = mean_load(loads, rustix::thread::sched_getaffinity(None).ok().as_ref());
        let process = self.system.process(self.pid);
        // The process's figure is in % of one processor.
        #[allow(clippy::cast_precision_loss, reason = "a count of processors is small")]
        let whole = 100.0 * processors as f32;
        Measured {
            cpu: share(load / 100.0),
            cpu_process: share(process.map_or(0.0, |p| p.cpu_usage() / whole)),
            memory_bytes: process.map_or(0, sysinfo::Process::memory),
            memory_used_bytes: self.system.used_memory(),
            memory_total_bytes: self.system.total_memory(),
            processors,
        }
    }
}

/// Number of a processor from its name in `/proc/stat`: `cpu3` is 3.
fn processor(cpu: &Cpu) -> Option<usize> {
    cpu.name().strip_prefix("cpu")?.parse().ok()
}

/// Mean load, in %, of the processors that are in `allowed`, and how many they are; of all where none would be left.
fn mean_load(loads: impl Iterator<Item = (Option<usize>, f32)> + Clone, allowed: Option<&CpuSet>) -> (f32, usize) {
    let is_allowed = |number: Option<usize>| match (number, allowed) {
        (Some(number), Some(allowed)) => number < CpuSet::MAX_CPU && allowed.is_set(number),
        _ => true,
    };
    let sum = |(total, count): (f32, usize), (_, load): (_, f32)| (total + load, count + 1);
    let (mut total, mut count) = loads
        .clone()
        .filter(|(number, _)| is_allowed(*number))
        .fold((0.0, 0), sum);
    if count == 0 {
        (total, count) = loads.fold((0.0, 0), sum);
    }
    #[allow(clippy::cast_precision_loss, reason = "a count of processors is small")]
    (total / count.max(1) as f32, count.max(1))
}

/// Rounding in the source may give 100.3 %, and the first sample may give no number.
fn share(value: f32) -> f32 {
    if value.is_finite() { value.clamp(0.0, 1.0) } else { 0.0 }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    #[test]
    fn a_process_has_memory_and_shares_are_shares() {
        let measured = Probe::new().unwrap().sample();
        assert!(measured.memory_bytes > 100_000, "{measured:?}");
        assert!(
            measured.memory_total_bytes >= measured.memory_used_bytes,
            "{measured:?}"
        );
        assert!(
            (0.0..=1.0).contains(&measured.cpu) && (0.0..=1.0).contains(&measured.cpu_process),
            "{measured:?}"
        );
        assert!(measured.processors > 0);
    }

    #[test]
    fn only_the_processors_that_the_process_may_use_count() {
        let loads = [(Some(0), 10.0), (Some(1), 90.0), (Some(2), 50.0), (None, 30.0)];
        let only = |numbers: &[usize]| {
            let mut set = CpuSet::new();
            numbers.iter().for_each(|&number| set.set(number));
            mean_load(loads.into_iter().take(3), Some(&set))
        };
        assert_eq!(only(&[1]), (90.0, 1));
        assert_eq!(only(&[0, 2]), (30.0, 2));
        // An affinity that names none of the processors that are known cannot be; then all of them count.
        assert_eq!(only(&[7]), (50.0, 3));
        assert_eq!(mean_load(loads.into_iter(), None), (45.0, 4));
        // A processor without a number cannot be told apart, so it counts.
        assert_eq!(mean_load(loads.into_iter().skip(2), Some(&CpuSet::new())), (30.0, 1));
        assert_eq!(mean_load(std::iter::empty(), None), (0.0, 1));
    }

    #[test]
    fn a_share_is_never_outside_0_to_1() {
        for (raw, kept) in [
            (-0.1, 0.0),
            (0.5, 0.5),
            (1.003, 1.0),
            (f32::NAN, 0.0),
            (f32::INFINITY, 0.0),
        ] {
            assert_eq!(share(raw).to_bits(), f32::to_bits(kept), "{raw}");
        }
    }
}
