//! What must hold at every write of every actuator, and of every acknowledgement.
//!
//! Owns what the actuators and the people saw: the truth that no host knows. Never: helps a host.

use bumpless_core::{HostId, Record};

use crate::law;

/// The rules by name.
pub const RULES: [&str; 6] = [
    "one writer",
    "the position only grows",
    "output and state are of one record",
    "records are one chain",
    "what was acknowledged stays",
    "loops go on once faults end",
];

/// A rule that did not hold.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Violation {
    /// Which.
    pub rule: &'static str,
    /// The loop's number.
    pub number: u32,
    /// When, in ns since the start.
    pub at_ns: u64,
    /// What was seen.
    pub seen: String,
}

/// Who made it certain that an outcome outlives the home, when it was told.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Keeper {
    /// The home's disk.
    Disk,
    /// Another host, in this life of it.
    Member { host: u32, life: u32 },
    /// Nobody: the rule is broken on purpose, or the product is.
    Nobody,
}

/// An actuator, and what was promised about its loop.
#[derive(Debug, Clone)]
pub(crate) struct Actuator {
    pub(crate) value: f64,
    pub(crate) position: (u64, u64),
    count: u64,
    /// The home died since the last write.
    pub(crate) home_died: bool,
    /// When the last write came, in ns of simulated time.
    pub(crate) written_at_ns: u64,
    /// The greatest setpoint that somebody was told of, and who has it.
    pub(crate) setpoint_told: f64,
    /// The greatest revision that somebody was told of.
    pub(crate) revision_told: u64,
    pub(crate) keeper: Keeper,
}

impl Default for Actuator {
    fn default() -> Self {
        Self {
            value: 0.0,
            position: (0, 0),
            count: 0,
            home_died: false,
            written_at_ns: 0,
            setpoint_told: 0.0,
            revision_told: 1,
            keeper: Keeper::Disk,
        }
    }
}

/// A write as the actuator sees it: what came with it, and who owned the loop then.
pub(crate) struct Write<'a> {
    /// As its owner made it.
    pub(crate) made: &'a Record,
    /// What is sent to the device.
    pub(crate) value: f64,
    /// The owner when it came.
    pub(crate) owner_then: Option<&'a HostId>,
    /// The record that the home goes on from; none for a first one.
    pub(crate) base: Option<&'a Record>,
}

impl Actuator {
    /// Does the last record of the loop hold what was told?
    pub(crate) fn holds_what_was_told(&self, record: Option<&Record>) -> bool {
        let (setpoint, revision) = record.map_or((0.0, 1), |r| (r.setpoint, r.revision));
        setpoint >= self.setpoint_told && revision >= self.revision_told
    }

    /// Takes a write; says which rule it breaks, and what was seen.
    pub(crate) fn write(&mut self, write: &Write<'_>, now_ns: u64) -> Result<(), (&'static str, String)> {
        let [writer, position, whole, chain, told, _] = RULES;
        let Write {
            made,
            value,
            owner_then,
            base,
        } = *write;
        let after_death = std::mem::take(&mut self.home_died);
        if owner_then != Some(&made.owner) {
            return Err((
                writer,
                format!("{} wrote, and {owner_then:?} owned the loop", made.owner),
            ));
        }
        let (here, last) = (made.position(), self.position);
        if here <= last || (here.1 <= last.1 && !after_death) {
            return Err((position, format!("{here:?} after {last:?}")));
        }
        let count = law::count(&made.state);
        let base_count = base.map_or(0, |r| law::count(&r.state));
        let stepped = count == base_count + 1;
        let good = match made.faults_in_row {
            0 => stepped && value == count as f64,
            // Without a good step state and output stay.
            _ => count == base_count && value == self.value,
        };
        if !good {
            let seen = format!(
                "output {value} with state {count} after {base_count}, {} faults in a row, the actuator held {}",
                made.faults_in_row, self.value
            );
            return Err((whole, seen));
        }
        if !after_death && count < self.count {
            return Err((chain, format!("state {count} after {}", self.count)));
        }
        if !after_death && made.after != last {
            return Err((
                chain,
                format!("{here:?} goes on from {:?}, the last is {last:?}", made.after),
            ));
        }
        if !self.holds_what_was_told(Some(made)) {
            let seen = format!(
                "setpoint {} and revision {}; told were {} and {}",
                made.setpoint, made.revision, self.setpoint_told, self.revision_told
            );
            return Err((told, seen));
        }
        (self.value, self.position, self.count, self.written_at_ns) = (value, here, count, now_ns);
        Ok(())
    }
}
