//! What a guest's store carries: what the guest may see in this call, what it has done so far, and its bounds.
//!
//! Owns: the buffers of one call, the bounds on memory and tables, and the reading of an engine error as a fault.
//! Never: keeps anything of one call for the next, except the memory of its buffers.
//!
//! ```text
//!            open_*(…)                 guest returns ok
//!   empty ───────────────▶ in a call ───────────────────▶ take_effects ──▶ empty
//!                              │ guest returns a fault: the buffers are cleared at the next opening
//!                              └ trap, overrun or stop: the store with its sandbox is dropped
//! ```

use std::{collections::VecDeque, sync::Arc};

use bumpless_core::{
    AlarmChange, Cycle, Descriptor, Direction, Effects, Fault, Frame, LogLevel, LogLine, Message, Mode, Reading,
    limits::{LOG_LINES_PER_STEP_MAX, PORTS_MAX, TEXT_CHARS_MAX},
};
use rustix::time::{ClockId, clock_gettime};
use wasmtime::{ResourceLimiter, Trap};

use crate::{config::Limits, place, ticker::monotonic_ns};

/// Core instances of one component. A Rust component has 3; an interpreter comes as many modules linked to each other, CPython
/// as 38. A core instance is some KiB of bookkeeping, allocated as it is made; what it may hold, memories and tables bound.
pub(crate) const CORE_INSTANCES_MAX: usize = 48;
/// Memories of one component. A Rust component has 1; one that is composed of others has one of each: a JavaScript one has 3,
/// two of them empty. All of them together are within the memory of one instance.
pub(crate) const MEMORIES_MAX: usize = 4;
/// Memories for which a place among the instances pays; a component with more of them takes several places.
pub(crate) const MEMORIES_PER_PLACE: usize = 2;
/// Tables of one component. A Rust component has 2, a JavaScript one 3.
pub(crate) const TABLES_MAX: usize = 4;

/// Bytes that one call may move from the guest to the host: the largest state with room for a descriptor's texts.
pub(crate) const CALL_BYTES_MAX: usize = 256 * 1024;

/// Which function of the guest runs. Only a step may have effects.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Call {
    Describe,
    Start,
    Migrate,
    Step,
}

/// A port as the imports need it.
#[derive(Debug)]
pub(crate) struct PortFace {
    pub(crate) name: String,
    pub(crate) is_output: bool,
}

/// The ports of a component, by number.
pub(crate) fn faces(descriptor: &Descriptor) -> Arc<[PortFace]> {
    descriptor
        .ports
        .iter()
        .map(|p| PortFace {
            name: p.name.clone(),
            is_output: p.direction == Direction::Output,
        })
        .collect()
}

/// Data of a store.
pub(crate) struct Sandbox {
    memory_bytes_max: usize,
    table_elements_max: usize,
    /// Linear memory that it was given, in bytes.
    memory_bytes: usize,
    /// What the guest asked for and did not get, in bytes or elements.
    refused: Option<Refused>,
    /// When the call must be over, in ns of [`monotonic_ns`].
    deadline_ns: u64,
    /// Processor time of its own that the call may still use after that, in ns.
    own_time_ns: u64,
    /// The thread's own processor time when the deadline was first seen to have passed, in ns.
    late_from_ns: Option<u64>,
    pub(crate) call: Call,
    pub(crate) ports: Arc<[PortFace]>,
    pub(crate) cycle: Cycle,
    pub(crate) readings: Vec<Reading>,
    pub(crate) inbox: VecDeque<Message>,
    /// Values written, by port number; valid where the bit in `written` is set.
    pub(crate) values: [f64; PORTS_MAX],
    pub(crate) written: u64,
    pub(crate) messages: Vec<Message>,
    pub(crate) alarms: Vec<AlarmChange>,
    pub(crate) log: Vec<LogLine>,
    pub(crate) lines_dropped: u64,
}

/// Processor time that a guest may still use after its deadline, in ns, least and most: a quarter of its limit, and no more
/// than half a millisecond.
const OWN_TIME_NS: (u64, u64) = (50_000, 500_000);

/// Processor time of this thread, in ns.
pub(crate) fn thread_time_ns() -> u64 {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    let (seconds, ns) = (u64::try_from(time.tv_sec), u64::try_from(time.tv_nsec));
    seconds
        .unwrap_or(0)
        .saturating_mul(1_000_000_000)
        .saturating_add(ns.unwrap_or(0))
}

#[derive(Debug, Clone, Copy)]
enum Refused {
    Memory(usize),
    Table(usize),
}

/// A fault that an import raises; it ends the call.
#[derive(Debug, thiserror::Error)]
#[error("the host stopped the call: {0}")]
pub(crate) struct Stop(pub(crate) Fault);

const NO_CYCLE: Cycle = Cycle {
    seq: 0,
    at_ns: 0,
    dt_ns: 0,
    mode: Mode::Manual,
    setpoint: 0.0,
};

impl Sandbox {
    pub(crate) fn new(limits: &Limits, ports: Arc<[PortFace]>, deadline_ns: u64) -> Self {
        Self {
            memory_bytes_max: limits.memory_bytes_max,
            table_elements_max: limits.table_elements_max,
            memory_bytes: 0,
            refused: None,
            deadline_ns,
            own_time_ns: OWN_TIME_NS.1,
            late_from_ns: None,
            call: Call::Describe,
            ports,
            cycle: NO_CYCLE,
            readings: Vec::new(),
            inbox: VecDeque::new(),
            values: [0.0; PORTS_MAX],
            written: 0,
            messages: Vec::new(),
            alarms: Vec::new(),
            log: Vec::new(),
            lines_dropped: 0,
        }
    }

    /// Linear memory that the guest has, in bytes.
    pub(crate) const fn memory_bytes(&self) -> usize {
        self.memory_bytes
    }

    /// When the next call must be over, and its limit in ns.
    pub(crate) fn set_deadline(&mut self, deadline_ns: u64, limit_ns: u64) {
        self.deadline_ns = deadline_ns;
        self.own_time_ns = (limit_ns / 4).clamp(OWN_TIME_NS.0, OWN_TIME_NS.1);
        self.late_from_ns = None;
    }

    /// At a tick: shall the guest be stopped? Its deadline must have passed, and it must then have used
    /// its share of [`OWN_TIME_NS`] of processor time: a guest that was held up by other work of the machine, and is about to end, is
    /// late but not at fault. Costs nothing before the deadline, where all honest steps end.
    pub(crate) fn is_overdue(&mut self) -> bool {
        if monotonic_ns() < self.deadline_ns {
            return false;
        }
        let used_ns = thread_time_ns();
        let from_ns = *self.late_from_ns.get_or_insert(used_ns);
        used_ns.saturating_sub(from_ns) >= self.own_time_ns
    }

    /// Before any call but a step: nothing to see.
    pub(crate) fn open(&mut self, call: Call) {
        self.clear();
        self.call = call;
        self.cycle = NO_CYCLE;
    }

    /// Before a step. The readings' buffer is reused, so only messages cost an allocation.
    pub(crate) fn open_step(&mut self, frame: &Frame) {
        self.clear();
        self.call = Call::Step;
        self.cycle = frame.cycle;
        self.readings.extend_from_slice(&frame.readings);
        self.inbox.extend(frame.messages.iter().cloned());
    }

    fn clear(&mut self) {
        self.refused = None;
        self.readings.clear();
        self.inbox.clear();
        self.written = 0;
        self.messages.clear();
        self.alarms.clear();
        self.log.clear();
        self.lines_dropped = 0;
    }

    /// What a port reads; a port without a reading in the frame is not connected.
    pub(crate) fn reading(&self, port: usize) -> Reading {
        self.readings.get(port).copied().unwrap_or(Reading::unconnected())
    }

    /// Buffers a line; beyond the limit it is counted and dropped, for a chatty guest is a nuisance and not a fault.
    pub(crate) fn push_line(&mut self, level: LogLevel, text: &str) {
        if self.log.len() < LOG_LINES_PER_STEP_MAX {
            self.log.push(LogLine { level, text: cut(text) });
        } else {
            self.lines_dropped += 1;
        }
    }

    /// The effects of a step that returned `state`.
    pub(crate) fn take_effects(&mut self, state: Vec<u8>) -> Effects {
        let mut writes = Vec::with_capacity(self.written.count_ones() as usize);
        if self.written != 0 {
            let values = (0_u8..).zip(self.values);
            writes.extend(values.filter(|(port, _)| self.written >> port & 1 == 1));
        }
        Effects {
            state,
            writes,
            messages: std::mem::take(&mut self.messages),
            alarms: std::mem::take(&mut self.alarms),
            log: self.take_log(),
        }
    }

    /// The lines; where some were dropped, the last line kept gives way to one that says how many.
    pub(crate) fn take_log(&mut self) -> Vec<LogLine> {
        if self.lines_dropped > 0 {
            self.log.truncate(LOG_LINES_PER_STEP_MAX - 1);
            let dropped = self.lines_dropped + 1;
            let text = format!("{dropped} more lines were dropped: at most {LOG_LINES_PER_STEP_MAX} per step are kept");
            self.log.push(LogLine {
                level: LogLevel::Warning,
                text,
            });
        }
        std::mem::take(&mut self.log)
    }

    /// What an engine error means. `limit_ns` is the limit that the call had.
    pub(crate) fn fault(&self, error: &wasmtime::Error, limit_ns: u64) -> Fault {
        if let Some(Stop(fault)) = error.downcast_ref::<Stop>() {
            return fault.clone();
        }
        let trap = error.downcast_ref::<Trap>();
        if trap == Some(&Trap::Interrupt) {
            return Fault::Overrun {
                limit_us: limit_ns / 1000,
            };
        }
        match self.refused {
            Some(Refused::Memory(bytes)) => {
                let max = self.memory_bytes_max;
                return Fault::Limit(format!("it asked for {bytes} bytes of memory; at most {max} are given"));
            }
            Some(Refused::Table(elements)) => {
                let max = self.table_elements_max;
                return Fault::Limit(format!(
                    "it asked for a table of {elements} elements; at most {max} are given"
                ));
            }
            None => {}
        }
        let root = error.root_cause().to_string();
        // wasmtime keeps this error's type to itself, so its text is all there is to know it by.
        if root.contains("fuel allocated for hostcalls") {
            return Fault::Limit(format!("one call moved more than {CALL_BYTES_MAX} bytes to the host"));
        }
        let cause = trap.map_or(root, ToString::to_string);
        let cause = cause.strip_prefix("wasm trap: ").unwrap_or(&cause);
        let place = place::of(error).map(|place| format!(" in {place}")).unwrap_or_default();
        Fault::Trap(cut(&format!("{cause}{place}")))
    }
}

/// At most as many characters as a text may have.
pub(crate) fn cut(text: &str) -> String {
    match text.char_indices().nth(TEXT_CHARS_MAX) {
        Some((end, _)) => text[..end].to_owned(),
        None => text.to_owned(),
    }
}

impl ResourceLimiter for Sandbox {
    fn memory_growing(&mut self, current: usize, desired: usize, _maximum: Option<usize>) -> wasmtime::Result<bool> {
        // Of all memories together: which of them it is, nobody says.
        let whole = self.memory_bytes.saturating_add(desired.saturating_sub(current));
        let fits = whole <= self.memory_bytes_max;
        if fits {
            self.memory_bytes = whole;
        } else {
            self.refused = Some(Refused::Memory(whole));
        }
        Ok(fits)
    }

    fn table_growing(&mut self, _current: usize, desired: usize, _maximum: Option<usize>) -> wasmtime::Result<bool> {
        let fits = desired <= self.table_elements_max;
        if !fits {
            self.refused = Some(Refused::Table(desired));
        }
        Ok(fits)
    }

    fn instances(&self) -> usize {
        CORE_INSTANCES_MAX
    }

    fn tables(&self) -> usize {
        TABLES_MAX
    }

    fn memories(&self) -> usize {
        MEMORIES_MAX
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]
    use super::*;

    fn sandbox() -> Sandbox {
        Sandbox::new(&Limits::default(), Arc::from([]), monotonic_ns())
    }

    #[test]
    fn all_memories_of_an_instance_share_one_limit() {
        let (mut sandbox, max) = (sandbox(), Limits::default().memory_bytes_max);
        assert!(sandbox.memory_growing(0, max / 2, None).unwrap());
        assert!(sandbox.memory_growing(0, max / 4, None).unwrap());
        assert!(!sandbox.memory_growing(max / 4, max * 3 / 4, None).unwrap());
        assert!(sandbox.memory_growing(max / 4, max / 2, None).unwrap());
        assert_eq!(sandbox.memory_bytes(), max);
        assert!(!sandbox.memory_growing(0, 65_536, None).unwrap());
    }

    #[test]
    fn texts_are_cut_at_characters() {
        assert_eq!(cut("für"), "für");
        let long = "ü".repeat(TEXT_CHARS_MAX + 1);
        assert_eq!(cut(&long).chars().count(), TEXT_CHARS_MAX);
    }

    #[test]
    fn dropped_lines_are_counted_within_the_limit() {
        let mut sandbox = sandbox();
        for i in 0..LOG_LINES_PER_STEP_MAX + 5 {
            sandbox.push_line(LogLevel::Info, &i.to_string());
        }
        let log = sandbox.take_log();
        assert_eq!(log.len(), LOG_LINES_PER_STEP_MAX);
        assert_eq!(
            log.last().unwrap().text,
            "6 more lines were dropped: at most 16 per step are kept"
        );
        assert_eq!(log.first().unwrap().text, "0");
    }

    #[test]
    fn writes_come_out_by_port_number() {
        let mut sandbox = sandbox();
        sandbox.values[63] = 2.0;
        sandbox.values[0] = 1.0;
        sandbox.written = 1 | 1 << 63;
        assert_eq!(sandbox.take_effects(vec![]).writes, [(0, 1.0), (63, 2.0)]);
        sandbox.open(Call::Start);
        assert_eq!(sandbox.take_effects(vec![]).writes, []);
    }
}
