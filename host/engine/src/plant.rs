//! Simulated plants in the sandbox: the same walls as for controllers, another world.
//!
//! Owns: what a plant says of itself, checked, and its calls.
//! Never: gives a plant a clock, a file or a random number. A plant keeps its state in its own memory, so it ends with the
//! first trap or overrun, and nobody can go on from there.
//!
//! ```text
//! Engine::open_plant ──► PreparedPlant ── instantiate ──► PlantInstance: begin, then advance, advance, … ── trap ──► ended
//! ```

use std::{sync::Arc, time::Duration};

use bumpless_core::{Digest, Fault, LogLevel, ParameterSpec, limits::PARAMETERS_MAX, limits::PORTS_MAX};
use wasmtime::{Store, component::Component};

use crate::{
    Error,
    admission::{check_imports, check_needs, check_plant_export},
    bindings::bumpless::control::types,
    capacity::Place,
    convert,
    error::brief,
    plant_bindings::{Plant, PlantPre, exports::bumpless::control::process as wit},
    prepared::{Core, nanos, store},
    sandbox::{Call, Sandbox, cut},
    ticker::monotonic_ns,
};

/// Which way a plant's signal goes, seen from the plant.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PlantRole {
    /// An instrument shows it.
    Measures,
    /// A controller sets it.
    Sets,
    /// The world sets it.
    Disturbs,
}

/// One named value of a plant; its position is its number.
#[derive(Debug, Clone, PartialEq)]
pub struct PlantSignal {
    /// Short name.
    pub name: String,
    /// Which way it goes.
    pub role: PlantRole,
    /// Unit as text; empty for none.
    pub unit: String,
    /// Least value.
    pub low: f64,
    /// Greatest value.
    pub high: f64,
    /// Value at the start, of one that is set.
    pub initial: f64,
    /// One line for people.
    pub text: String,
}

/// What a plant says of itself, checked.
#[derive(Debug, Clone, PartialEq)]
pub struct PlantInfo {
    /// Name of the plant.
    pub name: String,
    /// Semantic version of the model.
    pub version: String,
    /// One line for people.
    pub text: String,
    /// Signals, by number.
    pub signals: Vec<PlantSignal>,
    /// Constants, in the order in which values are given.
    pub constants: Vec<ParameterSpec>,
}

impl PlantInfo {
    /// One value per constant: those given, by name, else their defaults.
    ///
    /// # Errors
    /// In words: a name that does not exist, or a value outside its range.
    pub fn constant_values<'a>(&self, given: impl IntoIterator<Item = (&'a str, f64)>) -> Result<Vec<f64>, String> {
        let mut values: Vec<f64> = self.constants.iter().map(|c| c.default).collect();
        for (name, value) in given {
            let found = self.constants.iter().zip(&mut values).find(|(c, _)| c.name == name);
            let Some((spec, slot)) = found else {
                let known: Vec<&str> = self.constants.iter().map(|c| c.name.as_str()).collect();
                return Err(format!(
                    "plant {} has no constant {name:?}; it has {}",
                    self.name,
                    known.join(", ")
                ));
            };
            if !(spec.minimum..=spec.maximum).contains(&value) {
                return Err(format!(
                    "constant {name:?} = {value} {} is outside {} to {}",
                    spec.unit, spec.minimum, spec.maximum
                ));
            }
            *slot = value;
        }
        Ok(values)
    }

    fn check(&self) -> Result<(), Error> {
        let wrong = |reason: String| Err(Error::PlantInfo { reason });
        let name_ok = |name: &str, dots: bool| {
            (1..=32).contains(&name.len())
                && name
                    .bytes()
                    .all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-' || (dots && b == b'.'))
        };
        if !name_ok(&self.name, false) {
            return wrong(format!(
                "name {:?}: use 1 to 32 lower-case letters, digits and dashes",
                cut(&self.name)
            ));
        }
        if self.signals.len() > PORTS_MAX || self.constants.len() > PARAMETERS_MAX {
            return wrong(format!(
                "{} signals and {} constants; at most {PORTS_MAX} and {PARAMETERS_MAX} are allowed",
                self.signals.len(),
                self.constants.len()
            ));
        }
        if self.signals.iter().all(|s| s.role != PlantRole::Measures) {
            return wrong("no signal is measured; a plant shows at least one".to_owned());
        }
        for (n, s) in self.signals.iter().enumerate() {
            let initial_ok = s.role == PlantRole::Measures || (s.low..=s.high).contains(&s.initial);
            let range_ok = s.low.is_finite() && s.high.is_finite() && s.low < s.high;
            if !(name_ok(&s.name, true) && range_ok && initial_ok) {
                return wrong(format!(
                    "signal {:?}: its name must have 1 to 32 lower-case letters, digits, dots and dashes, its range two \
                     finite numbers in order, and its initial value must lie between them",
                    cut(&s.name)
                ));
            }
            if self.signals.iter().take(n).any(|other| other.name == s.name) {
                return wrong(format!("signal {:?} is described twice", s.name));
            }
        }
        for (n, c) in self.constants.iter().enumerate() {
            let range_ok =
                c.minimum.is_finite() && c.maximum.is_finite() && (c.minimum..=c.maximum).contains(&c.default);
            if !(name_ok(&c.name, false) && range_ok) {
                return wrong(format!(
                    "constant {:?}: its name must have 1 to 32 lower-case letters, digits and dashes, and minimum <= default \
                     <= maximum must hold, all finite",
                    cut(&c.name)
                ));
            }
            if self.constants.iter().take(n).any(|other| other.name == c.name) {
                return wrong(format!("constant {:?} is described twice", c.name));
            }
        }
        Ok(())
    }
}

/// What a plant shows: one value per signal.
#[derive(Debug, Clone, PartialEq)]
pub struct PlantView {
    /// Without the instruments' noise.
    pub truth: Vec<f64>,
    /// As the instruments show it; NaN where one shows nothing.
    pub shown: Vec<f64>,
}

/// A plant, ready to be instantiated.
pub struct PreparedPlant {
    core: Arc<Core>,
    digest: Digest,
    info: PlantInfo,
    imports: Vec<String>,
    /// Places that an instance takes.
    weight: u32,
    pre: PlantPre<Sandbox>,
}

impl PreparedPlant {
    /// Checks and links a compiled component and lets it say what it is.
    pub(crate) fn new(core: Arc<Core>, digest: Digest, component: &Component) -> Result<Self, Error> {
        let imports = check_imports(component)?;
        check_plant_export(component)?;
        let weight = check_needs(component, &core.limits)?;
        let world = |error: wasmtime::Error| Error::PlantWorld { reason: brief(&error) };
        let pre = PlantPre::new(core.linker.instantiate_pre(component).map_err(world)?).map_err(world)?;
        let info = describe(&core, &pre)?;
        info.check()?;
        Ok(Self {
            core,
            digest,
            info,
            imports,
            weight,
            pre,
        })
    }

    /// The component's digest.
    #[must_use]
    pub const fn digest(&self) -> &Digest {
        &self.digest
    }

    /// What it says of itself.
    #[must_use]
    pub const fn info(&self) -> &PlantInfo {
        &self.info
    }

    /// Interfaces that it imports, in its own order.
    #[must_use]
    pub fn imports(&self) -> &[String] {
        &self.imports
    }

    /// A plant of its own.
    ///
    /// # Errors
    /// [`Error::Full`] where the host has no place left, [`Error::Instantiate`] where the guest fails at its start.
    pub fn instantiate(self: &Arc<Self>) -> Result<PlantInstance, Error> {
        let place = self.core.places.take(self.weight)?;
        let limit = self.core.limits.describe_time_max;
        let (store, guest) = live(&self.core, &self.pre, limit)?;
        Ok(PlantInstance {
            live: Some((store, guest)),
            prepared: Arc::clone(self),
            _place: place,
        })
    }
}

impl std::fmt::Debug for PreparedPlant {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("PreparedPlant")
            .field("name", &self.info.name)
            .field("digest", &self.digest)
            .finish_non_exhaustive()
    }
}

fn live(core: &Core, pre: &PlantPre<Sandbox>, limit: Duration) -> Result<(Store<Sandbox>, Plant), Error> {
    let (now_ns, limit_ns) = (monotonic_ns(), nanos(limit));
    let mut store = store(core, Arc::from([]), now_ns.saturating_add(limit_ns));
    let _watched = core.calls.begin(now_ns, limit_ns);
    match pre.instantiate(&mut store) {
        Ok(guest) => Ok((store, guest)),
        Err(error) => Err(Error::Instantiate(store.data().fault(&error, nanos(limit)))),
    }
}

/// Asks a plant what it is, in a store of its own.
fn describe(core: &Core, pre: &PlantPre<Sandbox>) -> Result<PlantInfo, Error> {
    let limit = core.limits.describe_time_max;
    let _turn = core.inspections.enter(limit * 8)?;
    let (mut store, guest) = live(core, pre, limit)?;
    store.data_mut().open(Call::Describe);
    // The deadline of the making goes on: both together have the limit.
    let _watched = core.calls.begin(monotonic_ns(), nanos(limit));
    match guest.bumpless_control_process().call_describe_plant(&mut store) {
        Ok(said) => Ok(info(said)),
        Err(error) => Err(Error::Describe(store.data().fault(&error, nanos(limit)))),
    }
}

fn info(said: wit::Description) -> PlantInfo {
    PlantInfo {
        name: said.name,
        version: said.version,
        text: cut(&said.text),
        signals: said
            .signals
            .into_iter()
            .map(|s| PlantSignal {
                name: s.name,
                role: match s.role {
                    wit::Role::Measures => PlantRole::Measures,
                    wit::Role::Sets => PlantRole::Sets,
                    wit::Role::Disturbs => PlantRole::Disturbs,
                },
                unit: cut(&s.unit),
                low: s.low,
                high: s.high,
                initial: s.initial,
                text: cut(&s.text),
            })
            .collect(),
        constants: said
            .constants
            .into_iter()
            .map(|c| ParameterSpec {
                name: c.name,
                unit: cut(&c.unit),
                default: c.default,
                minimum: c.minimum,
                maximum: c.maximum,
                choices: Vec::new(),
                text: cut(&c.text),
            })
            .collect(),
    }
}

/// A plant that runs. It can move between threads, and each thread that calls it needs 1 MiB of stack. Limits of calls are
/// those of [`Instance`](crate::Instance).
pub struct PlantInstance {
    // Dropped in this order: the place is given back only when the store is gone.
    live: Option<(Store<Sandbox>, Plant)>,
    prepared: Arc<PreparedPlant>,
    _place: Place,
}

impl PlantInstance {
    /// The plant's component.
    #[must_use]
    pub const fn prepared(&self) -> &Arc<PreparedPlant> {
        &self.prepared
    }

    /// Puts the plant at its start. `constants` holds one value per constant.
    ///
    /// # Errors
    /// Whatever the guest did wrong. After a trap or an overrun the plant has ended.
    pub fn begin(&mut self, constants: &[f64], seed: u64, limit_ns: u64) -> Result<PlantView, Fault> {
        self.call(limit_ns, |store, guest| {
            store.data_mut().open(Call::Start);
            guest.bumpless_control_process().call_begin(store, constants, seed)
        })
    }

    /// Lets time pass. `inputs` holds one value per signal.
    ///
    /// # Errors
    /// As [`PlantInstance::begin`].
    pub fn advance(&mut self, dt_ns: u64, inputs: &[f64], limit_ns: u64) -> Result<PlantView, Fault> {
        self.call(limit_ns, |store, guest| {
            store.data_mut().open(Call::Migrate);
            guest.bumpless_control_process().call_advance(store, dt_ns, inputs)
        })
    }

    fn call(
        &mut self,
        limit_ns: u64,
        run: impl FnOnce(&mut Store<Sandbox>, &Plant) -> wasmtime::Result<Result<wit::View, types::Fault>>,
    ) -> Result<PlantView, Fault> {
        let Some((store, guest)) = &mut self.live else {
            return Err(Fault::Failed("the plant has ended".to_owned()));
        };
        let now_ns = monotonic_ns();
        let watched = self.prepared.core.calls.begin(now_ns, limit_ns);
        store.data_mut().set_deadline(now_ns.saturating_add(limit_ns), limit_ns);
        store.set_epoch_deadline(1);
        let said = run(store, guest);
        drop(watched);
        for line in store.data_mut().take_log() {
            let plant = &self.prepared.info.name;
            match line.level {
                LogLevel::Debug => tracing::debug!(%plant, text = %line.text, "a plant's line"),
                LogLevel::Info => tracing::info!(%plant, text = %line.text, "a plant's line"),
                LogLevel::Warning => tracing::warn!(%plant, text = %line.text, "a plant's line"),
            }
        }
        match said {
            Ok(Ok(view)) => self.seen(view),
            Ok(Err(said)) => Err(convert::fault(&said)),
            Err(error) => {
                let fault = store.data().fault(&error, limit_ns);
                self.live = None;
                Err(fault)
            }
        }
    }

    fn seen(&self, view: wit::View) -> Result<PlantView, Fault> {
        let signals = self.prepared.info.signals.len();
        let wit::View { truth, shown } = view;
        if truth.len() != signals || !(shown.is_empty() || shown.len() == signals) {
            return Err(Fault::Failed(format!(
                "the plant's view must have one value per signal, {signals}; it has {} and {}",
                truth.len(),
                shown.len()
            )));
        }
        let shown = if shown.is_empty() { truth.clone() } else { shown };
        Ok(PlantView { truth, shown })
    }
}

impl std::fmt::Debug for PlantInstance {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("PlantInstance")
            .field("prepared", &self.prepared)
            .field("alive", &self.live.is_some())
            .finish_non_exhaustive()
    }
}
