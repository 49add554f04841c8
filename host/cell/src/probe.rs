//! Measures this machine and this process.
//!
//! Never: reads more than a handful of files in `/proc` per sample; a sample takes well under a millisecond, but belongs
//! on no cycle's thread.

use sysinfo::{Pid, ProcessRefreshKind, ProcessesToUpdate, System};

use crate::error::Error;

/// One sample.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Measured {
    /// Load of the whole machine since the sample before, 0 to 1 over all its processors.
    pub cpu: f32,
    /// This process's part of it, 0 to 1.
    pub cpu_process: f32,
    /// Resident memory of this process, in bytes.
    pub memory_bytes: u64,
    /// Memory of the machine that is in use, in bytes.
    pub memory_used_bytes: u64,
    /// Memory of the machine, in bytes.
    pub memory_total_bytes: u64,
    /// Processors of the machine.
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
        let processors = self.system.cpus().len().max(1);
        let process = self.system.process(self.pid);
        // The process's figure is in % of one processor.
        #[allow(clippy::cast_precision_loss, reason = "a count of processors is small")]
        let whole = 100.0 * processors as f32;
        Measured {
            cpu: share(self.system.global_cpu_usage() / 100.0),
            cpu_process: share(process.map_or(0.0, |p| p.cpu_usage() / whole)),
            memory_bytes: process.map_or(0, sysinfo::Process::memory),
            memory_used_bytes: self.system.used_memory(),
            memory_total_bytes: self.system.total_memory(),
            processors,
        }
    }
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
