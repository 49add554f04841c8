//! The alarms of one loop and what people did about them.
//!
//! Never: decides who may do it, keeps it on a disk or tells anybody; what changed is the answer.

use std::collections::{BTreeMap, VecDeque};

use serde::{Deserialize, Serialize};

use super::{
    ALARMS_PER_LOOP_MAX, AlarmError, Condition, Definition, FLOOD_ALARMS, FLOOD_WINDOW_NS, Kind, Look, SHELVE_NS_MAX,
    Shelf, State,
};
use crate::frame::{AlarmChange, Priority};

/// Characters of a note or of who left it.
const NOTE_CHARS_MAX: usize = 256;
/// Delay before a fault, an overrun or a lost replica counts as over, in s: they come in single cycles.
const SETTLED_S: f64 = 5.0;
/// Comings that are remembered for the flood: more than that is a flood anyway.
const RECENT_MAX: usize = 256;

/// One alarm as it stands.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Standing {
    /// What it is.
    pub definition: Definition,
    /// Where it is in its life.
    pub state: State,
    /// Since when, in ns of the home's clock; 0 where it never came.
    pub since_ns: u64,
    /// The value when it last came.
    pub value: Option<f64>,
    /// Words of the controller, for its own alarms.
    pub text: String,
    /// How often it came.
    pub comings: u64,
    /// Was it the first of its group?
    pub first_out: bool,
    /// Who acknowledged it last, and with which note.
    pub acknowledged_by: Option<(String, String)>,
    /// Kept quiet by a person, for a time.
    pub shelf: Option<Shelf>,
    /// Kept quiet by design.
    pub suppressed: bool,
    /// Taken out of service: by whom, and why.
    pub out_of_service: Option<(String, String)>,
    condition: Condition,
}

impl Standing {
    fn new(definition: Definition) -> Self {
        Self {
            definition,
            state: State::Normal,
            since_ns: 0,
            value: None,
            text: String::new(),
            comings: 0,
            first_out: false,
            acknowledged_by: None,
            shelf: None,
            suppressed: false,
            out_of_service: None,
            condition: Condition::default(),
        }
    }

    /// Is it kept from the operator?
    #[must_use]
    pub const fn is_quiet(&self) -> bool {
        self.shelf.is_some() || self.suppressed || self.out_of_service.is_some()
    }
}

/// What happened to an alarm.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum What {
    /// Its condition came.
    Came,
    /// Its condition went.
    Went,
    /// A person has seen it.
    Acknowledged,
    /// A latched one was reset.
    Reset,
    /// Kept quiet for a time.
    Shelved,
    /// The time is over, or a person ended it.
    Unshelved,
    /// Kept quiet by design.
    Suppressed,
    /// No longer.
    Unsuppressed,
    /// Taken out of service.
    TakenOut,
    /// Put back.
    PutBack,
    /// Defined anew, or otherwise than before.
    Defined,
    /// Removed.
    Removed,
}

/// One change, for those who keep and tell it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Change {
    /// When, in ns of the home's clock.
    pub at_ns: u64,
    /// The alarm.
    pub alarm: String,
    /// What happened.
    pub what: What,
    /// Its state after it.
    pub state: State,
    /// Its priority.
    pub priority: Priority,
    /// The value then, where it has one.
    pub value: Option<f64>,
    /// Who did it; none where the process did.
    pub by: Option<String>,
    /// A person's note, or the controller's words.
    pub note: String,
    /// Is it kept from the operator?
    pub quiet: bool,
    /// Is it the first of its group?
    pub first_out: bool,
}

/// How many alarms an operator was told of lately.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Flood {
    /// Comings within the last ten minutes.
    pub comings: usize,
    /// More than an operator can take.
    pub is_flood: bool,
}

/// What one record shows of a loop.
#[derive(Debug, Clone, Copy)]
pub struct Sight<'a> {
    /// Time of the record, in ns of the home's clock.
    pub at_ns: u64,
    /// The setpoint in force.
    pub setpoint: f64,
    /// Value of each port that has a current one, and whether it may be used; `""` is the measured port.
    pub ports: &'a BTreeMap<String, (Option<f64>, bool)>,
    /// Kinds that belong to the whole loop and are so.
    pub so: &'a [Kind],
    /// What the controller raised and cleared.
    pub raised: &'a [AlarmChange],
}

/// All alarms of one loop.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Board {
    alarms: BTreeMap<String, Standing>,
    /// Names of the controller's own alarms that stand.
    controllers: BTreeMap<String, bool>,
    recent_ns: VecDeque<u64>,
}

impl Default for Board {
    fn default() -> Self {
        Self::new()
    }
}

impl Board {
    /// A board with the alarms that every loop has: fault, overrun, redundancy lost, dissent, and a bad measurement.
    #[must_use]
    pub fn new() -> Self {
        let of_every_loop = [
            ("fault", Kind::Fault, Priority::High),
            ("overrun", Kind::Overrun, Priority::Medium),
            ("redundancy-lost", Kind::RedundancyLost, Priority::Low),
            ("dissent", Kind::Dissent, Priority::High),
            ("bad-measurement", Kind::BadQuality, Priority::High),
        ];
        let alarms = of_every_loop
            .into_iter()
            .map(|(name, kind, priority)| {
                let definition = Definition {
                    // A new loop's hosts still get their component, and a host may start again: lost is what stays away.
                    on_delay_s: if kind == Kind::RedundancyLost { SETTLED_S } else { 0.0 },
                    off_delay_s: SETTLED_S,
                    ..Definition::new(name, kind, priority)
                };
                (name.to_owned(), Standing::new(definition))
            })
            .collect();
        Self {
            alarms,
            controllers: BTreeMap::new(),
            recent_ns: VecDeque::new(),
        }
    }

    /// The board of a host, which is no loop: its clock, its disk, and what it runs unsigned.
    #[must_use]
    pub fn of_host() -> Self {
        let alarms = [
            ("clock", Kind::Clock, Priority::Medium),
            ("disk", Kind::Disk, Priority::High),
            ("signature", Kind::Signature, Priority::Medium),
        ];
        let one = |(name, kind, priority)| {
            let definition = Definition {
                off_delay_s: SETTLED_S,
                ..Definition::new(name, kind, priority)
            };
            (name.to_owned(), Standing::new(definition))
        };
        Self {
            alarms: alarms.into_iter().map(one).collect(),
            controllers: BTreeMap::new(),
            recent_ns: VecDeque::new(),
        }
    }

    /// Takes the alarms of another board that this one, kept by an earlier version, does not have.
    pub fn complete(&mut self, other: Self) {
        for (name, standing) in other.alarms {
            self.alarms.entry(name).or_insert(standing);
        }
    }

    /// All alarms, by name.
    pub fn all(&self) -> impl Iterator<Item = &Standing> {
        self.alarms.values()
    }

    /// One alarm.
    #[must_use]
    pub fn get(&self, name: &str) -> Option<&Standing> {
        self.alarms.get(name)
    }

    /// Comings that were told within the ten minutes before `now_ns`.
    #[must_use]
    pub fn flood(&self, now_ns: u64) -> Flood {
        let from_ns = now_ns.saturating_sub(FLOOD_WINDOW_NS);
        let comings = self.recent_ns.iter().filter(|at_ns| **at_ns > from_ns).count();
        Flood {
            comings,
            is_flood: comings > FLOOD_ALARMS,
        }
    }

    /// Looks at one record. Gives what changed, in the order in which it is to be told: the most urgent first.
    pub fn see(&mut self, sight: Sight<'_>) -> Vec<Change> {
        self.hear(sight.raised);
        for (name, standing) in &mut self.alarms {
            let definition = &standing.definition;
            let port = sight.ports.get(definition.port.as_deref().unwrap_or_default());
            let is_so = match definition.kind {
                Kind::BadQuality => port.is_some_and(|(_, usable)| !usable),
                Kind::Controller => self.controllers.get(name).copied().unwrap_or(false),
                kind => sight.so.contains(&kind),
            };
            let look = Look {
                at_ns: sight.at_ns,
                value: port.and_then(|(value, usable)| value.filter(|_| *usable)),
                setpoint: sight.setpoint,
                is_so,
            };
            standing.condition.look(definition, look);
            if let Some((Some(value), _)) = port
                && standing.condition.stands()
                && !standing.state.stands()
            {
                standing.value = Some(*value);
            }
        }
        let mut changes = self.settle_quiet(sight.at_ns);
        let mut names: Vec<(Priority, String)> = self
            .alarms
            .iter()
            .filter(|(_, standing)| standing.condition.stands() != standing.state.stands())
            .map(|(name, standing)| (standing.definition.priority, name.clone()))
            .collect();
        names.sort_by(|a, b| b.0.cmp(&a.0).then_with(|| a.1.cmp(&b.1)));
        for (_, name) in names {
            changes.extend(self.turn(&name, sight.at_ns));
        }
        changes
    }

    /// Controllers name their alarms as they like; one that is new gets a place while there is one.
    fn hear(&mut self, raised: &[AlarmChange]) {
        for change in raised {
            match &change.raised {
                Some((priority, text)) => {
                    let full = self.alarms.len() >= ALARMS_PER_LOOP_MAX;
                    let standing = match self.alarms.get_mut(&change.name) {
                        Some(standing) => standing,
                        None if full => continue,
                        None => self.alarms.entry(change.name.clone()).or_insert_with(|| {
                            Standing::new(Definition::new(&change.name, Kind::Controller, *priority))
                        }),
                    };
                    if standing.definition.kind == Kind::Controller {
                        standing.text.clone_from(text);
                        self.controllers.insert(change.name.clone(), true);
                    }
                }
                None => {
                    if let Some(so) = self.controllers.get_mut(&change.name) {
                        *so = false;
                    }
                }
            }
        }
    }

    /// What is quiet by design or by a shelf, and what no longer is.
    fn settle_quiet(&mut self, at_ns: u64) -> Vec<Change> {
        let standing: Vec<String> = self
            .alarms
            .iter()
            .filter(|(_, standing)| standing.condition.stands())
            .map(|(name, _)| name.clone())
            .collect();
        let mut changes = Vec::new();
        for alarm in self.alarms.values_mut() {
            let explained = alarm
                .definition
                .suppressed_by
                .as_ref()
                .is_some_and(|by| standing.contains(by));
            if explained != alarm.suppressed {
                alarm.suppressed = explained;
                let what = if explained {
                    What::Suppressed
                } else {
                    What::Unsuppressed
                };
                changes.push(change(alarm, at_ns, what, None, ""));
            }
            if alarm.shelf.as_ref().is_some_and(|shelf| shelf.until_ns <= at_ns) {
                alarm.shelf = None;
                changes.push(change(alarm, at_ns, What::Unshelved, None, "its time is over"));
            }
        }
        changes
    }

    /// The condition came or went.
    fn turn(&mut self, name: &str, at_ns: u64) -> Option<Change> {
        let group = self.alarms.get(name)?.definition.group.clone();
        let alone = group.is_none_or(|group| {
            !self.alarms.iter().any(|(other, standing)| {
                other != name
                    && standing.definition.group.as_ref() == Some(&group)
                    && (standing.state.stands() || standing.state.waits_for_ack())
            })
        });
        let alarm = self.alarms.get_mut(name)?;
        let what = if alarm.condition.stands() {
            alarm.state = State::Active;
            alarm.since_ns = at_ns;
            alarm.comings += 1;
            alarm.first_out = alone && alarm.definition.group.is_some();
            alarm.acknowledged_by = None;
            What::Came
        } else {
            alarm.state = match (alarm.state, alarm.definition.latching) {
                (State::Acknowledged, false) => State::Normal,
                (State::Acknowledged, true) => State::Latched,
                _ => State::Returned,
            };
            What::Went
        };
        let change = change(alarm, at_ns, what, None, &alarm.text.clone());
        if what == What::Came && !change.quiet {
            if self.recent_ns.len() >= RECENT_MAX {
                self.recent_ns.pop_front();
            }
            self.recent_ns.push_back(at_ns);
        }
        Some(change)
    }

    /// A person has seen it.
    ///
    /// # Errors
    /// [`AlarmError::Unknown`]; [`AlarmError::State`] where nothing waits for it.
    pub fn acknowledge(&mut self, name: &str, by: &str, note: &str, at_ns: u64) -> Result<Change, AlarmError> {
        let alarm = self.known(name)?;
        alarm.state = match (alarm.state, alarm.definition.latching) {
            (State::Active, _) => State::Acknowledged,
            (State::Returned, false) => State::Normal,
            (State::Returned, true) => State::Latched,
            _ => return Err(state(name, "does not wait for an acknowledgement")),
        };
        alarm.acknowledged_by = Some((cut(by), cut(note)));
        Ok(change(alarm, at_ns, What::Acknowledged, Some(by), note))
    }

    /// A latched alarm goes back to normal.
    ///
    /// # Errors
    /// [`AlarmError::Unknown`]; [`AlarmError::State`] where it is not latched.
    pub fn reset(&mut self, name: &str, by: &str, at_ns: u64) -> Result<Change, AlarmError> {
        let alarm = self.known(name)?;
        if alarm.state != State::Latched {
            return Err(state(name, "is not latched"));
        }
        alarm.state = State::Normal;
        Ok(change(alarm, at_ns, What::Reset, Some(by), ""))
    }

    /// Keeps it quiet until `until_ns`; once more: the new reason and time count.
    ///
    /// # Errors
    /// [`AlarmError::Unknown`]; [`AlarmError::Shelve`] without a reason, or for longer than a shift.
    pub fn shelve(&mut self, name: &str, shelf: &Shelf, at_ns: u64) -> Result<Change, AlarmError> {
        let alarm = self.known(name)?;
        let lasts_ns = shelf.until_ns.saturating_sub(at_ns);
        if shelf.reason.trim().is_empty() || !(1_000_000_000..=SHELVE_NS_MAX).contains(&lasts_ns) {
            return Err(AlarmError::Shelve(name.to_owned()));
        }
        let (by, reason) = (cut(&shelf.by), cut(&shelf.reason));
        alarm.shelf = Some(Shelf {
            until_ns: shelf.until_ns,
            by: by.clone(),
            reason: reason.clone(),
        });
        Ok(change(alarm, at_ns, What::Shelved, Some(&by), &reason))
    }

    /// Tells it again.
    ///
    /// # Errors
    /// [`AlarmError::Unknown`]; [`AlarmError::State`] where it is not shelved.
    pub fn unshelve(&mut self, name: &str, by: &str, at_ns: u64) -> Result<Change, AlarmError> {
        let alarm = self.known(name)?;
        if alarm.shelf.take().is_none() {
            return Err(state(name, "is not shelved"));
        }
        Ok(change(alarm, at_ns, What::Unshelved, Some(by), ""))
    }

    /// Takes it out of service, with a reason, or puts it back where there is none.
    ///
    /// # Errors
    /// [`AlarmError::Unknown`]; [`AlarmError::State`] where it is so already.
    pub fn service(&mut self, name: &str, out: Option<&str>, by: &str, at_ns: u64) -> Result<Change, AlarmError> {
        let alarm = self.known(name)?;
        if out.is_some() == alarm.out_of_service.is_some() {
            return Err(state(name, "is so already"));
        }
        alarm.out_of_service = out.map(|reason| (cut(by), cut(reason)));
        let what = if out.is_some() { What::TakenOut } else { What::PutBack };
        Ok(change(alarm, at_ns, what, Some(by), out.unwrap_or_default()))
    }

    /// Defines an alarm, or changes one; its life goes on, its condition is looked at anew.
    ///
    /// # Errors
    /// [`AlarmError::Name`], [`AlarmError::Definition`], [`AlarmError::TooMany`].
    pub fn define(&mut self, definition: Definition, by: &str, at_ns: u64) -> Result<Change, AlarmError> {
        definition.check()?;
        let full = self.alarms.len() >= ALARMS_PER_LOOP_MAX;
        let alarm = match self.alarms.get_mut(&definition.name) {
            Some(alarm) => alarm,
            None if full => return Err(AlarmError::TooMany),
            None => self
                .alarms
                .entry(definition.name.clone())
                .or_insert_with(|| Standing::new(definition.clone())),
        };
        alarm.definition = definition;
        alarm.condition = Condition::default();
        Ok(change(alarm, at_ns, What::Defined, Some(by), ""))
    }

    /// Removes an alarm.
    ///
    /// # Errors
    /// [`AlarmError::Unknown`].
    pub fn remove(&mut self, name: &str, by: &str, at_ns: u64) -> Result<Change, AlarmError> {
        let alarm = self
            .alarms
            .remove(name)
            .ok_or_else(|| AlarmError::Unknown(name.to_owned()))?;
        self.controllers.remove(name);
        Ok(change(&alarm, at_ns, What::Removed, Some(by), ""))
    }

    fn known(&mut self, name: &str) -> Result<&mut Standing, AlarmError> {
        self.alarms
            .get_mut(name)
            .ok_or_else(|| AlarmError::Unknown(name.to_owned()))
    }
}

fn state(name: &str, reason: &'static str) -> AlarmError {
    AlarmError::State {
        name: name.to_owned(),
        reason,
    }
}

fn cut(text: &str) -> String {
    text.chars().take(NOTE_CHARS_MAX).collect()
}

fn change(alarm: &Standing, at_ns: u64, what: What, by: Option<&str>, note: &str) -> Change {
    Change {
        at_ns,
        alarm: alarm.definition.name.clone(),
        what,
        state: alarm.state,
        priority: alarm.definition.priority,
        value: alarm.value,
        by: by.map(cut),
        note: cut(note),
        quiet: alarm.is_quiet(),
        first_out: alarm.first_out,
    }
}
