//! Components by name: the stock ones in their folder, others by path; compiled once, whoever asks.
//!
//! Never: steps one. Controllers and plants are told apart by their world, not by their name.

use std::{
    collections::{BTreeMap, HashMap},
    fs,
    path::{Path, PathBuf},
    sync::{Arc, Mutex, PoisonError},
};

use bumpless_core::Digest;
use bumpless_engine::{Engine, PlantInstance, PlantRole, PlantView, Prepared, PreparedPlant};
use bumpless_io::sim::{Halted, Model, ModelMaker, Signal, SignalRole};

use crate::{error::Error, limits::CALL_NS_MAX};

/// Where the plants lie in a folder of components.
const PLANTS: &str = "plants";
/// What stands before the name of a plant that was uploaded.
const UPLOADED: &str = "library:";
/// Longest time of one advance of a plant on a live host, in ns: its thread is its own, and its next step is due soon.
const LIVE_CALL_NS_MAX: u64 = 200_000_000;

/// Components, ready.
pub struct Library {
    engine: Engine,
    folders: Vec<PathBuf>,
    controllers: Mutex<HashMap<String, Arc<Prepared>>>,
    plants: Mutex<HashMap<String, Arc<PreparedPlant>>>,
    uploaded: Option<Uploaded>,
}

/// Bytes of a plant that was uploaded, by what an engineer calls it; or why there are none, in words.
type Uploaded = Box<dyn Fn(&str) -> Result<Vec<u8>, String> + Send + Sync>;

impl std::fmt::Debug for Library {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Library")
            .field("folders", &self.folders)
            .finish_non_exhaustive()
    }
}

impl Library {
    /// A library over an engine; names are looked for in these folders, in order.
    #[must_use]
    pub fn new(engine: Engine, folders: Vec<PathBuf>) -> Self {
        Self {
            engine,
            folders,
            controllers: Mutex::default(),
            plants: Mutex::default(),
            uploaded: None,
        }
    }

    /// With a way to plants that were uploaded: `library:NAME`, `library:NAME@VERSION` or `library:DIGEST` asks it.
    #[must_use]
    pub fn with_uploaded(mut self, uploaded: impl Fn(&str) -> Result<Vec<u8>, String> + Send + Sync + 'static) -> Self {
        self.uploaded = Some(Box::new(uploaded));
        self
    }

    /// The file of a component. A name with a dot or a slash is a path.
    fn file(&self, what: &'static str, name: &str) -> Result<PathBuf, Error> {
        let places: Vec<PathBuf> = if name.contains(['/', '.']) {
            vec![PathBuf::from(name)]
        } else {
            let inner = if what == "plant" { PLANTS } else { "" };
            let file = |folder: &PathBuf| folder.join(inner).join(format!("{name}.wasm"));
            self.folders.iter().map(file).collect()
        };
        places.iter().find(|path| path.is_file()).cloned().ok_or_else(|| {
            let looked: Vec<String> = places.iter().map(|p| p.display().to_string()).collect();
            Error::NoComponent {
                what,
                name: name.to_owned(),
                looked: looked.join(", "),
            }
        })
    }

    fn bytes(&self, what: &'static str, name: &str) -> Result<Vec<u8>, Error> {
        let path = self.file(what, name)?;
        fs::read(&path).map_err(Error::file("reading", path))
    }

    /// A controller.
    ///
    /// # Errors
    /// [`Error::NoComponent`], [`Error::File`], or [`Error::Component`] with the sandbox's words.
    pub fn controller(&self, name: &str) -> Result<Arc<Prepared>, Error> {
        if let Some(found) = self
            .controllers
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .get(name)
        {
            return Ok(Arc::clone(found));
        }
        let bytes = self.bytes("controller", name)?;
        let prepared = self.engine.prepare(&bytes).map_err(|source| Error::Component {
            what: "controller",
            name: name.to_owned(),
            source,
        })?;
        let mut table = self.controllers.lock().unwrap_or_else(PoisonError::into_inner);
        Ok(Arc::clone(table.entry(name.to_owned()).or_insert(prepared)))
    }

    /// The file of a controller, for whoever wants to send it elsewhere.
    ///
    /// # Errors
    /// [`Error::NoComponent`].
    pub fn controller_file(&self, name: &str) -> Result<PathBuf, Error> {
        self.file("controller", name)
    }

    /// A plant.
    ///
    /// # Errors
    /// As [`Library::controller`].
    pub fn plant(&self, name: &str) -> Result<Arc<PreparedPlant>, Error> {
        if let Some(found) = self.plants.lock().unwrap_or_else(PoisonError::into_inner).get(name) {
            return Ok(Arc::clone(found));
        }
        let bytes = match name.strip_prefix(UPLOADED) {
            None => self.bytes("plant", name)?,
            Some(reference) => match &self.uploaded {
                Some(uploaded) => {
                    uploaded(reference).map_err(|problem| Error::at(format!("plant {name:?}"), problem))?
                }
                None => {
                    return Err(Error::at(
                        format!("plant {name:?}"),
                        "the library of a cell is asked by its hosts alone; here write the path of the component's file",
                    ));
                }
            },
        };
        let prepared = self.engine.open_plant(&bytes).map_err(|source| Error::Component {
            what: "plant",
            name: name.to_owned(),
            source,
        })?;
        let mut table = self.plants.lock().unwrap_or_else(PoisonError::into_inner);
        Ok(Arc::clone(table.entry(name.to_owned()).or_insert(prepared)))
    }

    /// The digest of a plant, for the name of a kept result.
    ///
    /// # Errors
    /// As [`Library::controller`].
    pub fn plant_digest(&self, name: &str) -> Result<Digest, Error> {
        Ok(*self.plant(name)?.digest())
    }

    /// A plant at its start, as a model.
    ///
    /// # Errors
    /// As [`Library::controller`], and in words what the plant says of its constants.
    pub fn model(&self, name: &str, constants: &BTreeMap<String, f64>, seed: u64) -> Result<Box<dyn Model>, Error> {
        self.model_within(name, constants, seed, CALL_NS_MAX)
    }

    fn model_within(
        &self,
        name: &str,
        constants: &BTreeMap<String, f64>,
        seed: u64,
        limit_ns: u64,
    ) -> Result<Box<dyn Model>, Error> {
        let prepared = self.plant(name)?;
        let place = || format!("plant {name:?}");
        let given = constants.iter().map(|(name, value)| (name.as_str(), *value));
        let constants = prepared
            .info()
            .constant_values(given)
            .map_err(|problem| Error::at(place(), problem))?;
        let mut instance = prepared.instantiate().map_err(|source| Error::Component {
            what: "plant",
            name: name.to_owned(),
            source,
        })?;
        let view = instance
            .begin(&constants, seed, limit_ns)
            .map_err(|fault| Error::at(place(), fault.to_string()))?;
        Ok(Box::new(ComponentModel::new(instance, view, limit_ns)))
    }
}

/// Models for simulated buses of a live host: `component:NAME`, `component:PATH`, or `library:` and a reference.
impl ModelMaker for Library {
    fn make(&self, model: &str, constants: &BTreeMap<String, f64>, seed: u64) -> Result<Box<dyn Model>, String> {
        let uploaded = model.starts_with(UPLOADED).then_some(model);
        let name = uploaded.or_else(|| model.strip_prefix("component:")).ok_or_else(|| {
            format!("plant = {model:?} is unknown: write component:NAME, component:PATH, library:NAME, or a table")
        })?;
        self.model_within(name, constants, seed, LIVE_CALL_NS_MAX)
            .map_err(|error| {
                let mut text = error.to_string();
                let mut cause = std::error::Error::source(&error);
                while let Some(next) = cause {
                    text = format!("{text}: {next}");
                    cause = next.source();
                }
                text
            })
    }
}

/// A plant in the sandbox as a model.
#[derive(Debug)]
struct ComponentModel {
    instance: PlantInstance,
    signals: Vec<Signal>,
    inputs: Vec<f64>,
    view: PlantView,
    now_ns: u64,
    limit_ns: u64,
}

impl ComponentModel {
    fn new(instance: PlantInstance, view: PlantView, limit_ns: u64) -> Self {
        let info = instance.prepared().info();
        let signals = info
            .signals
            .iter()
            .map(|s| Signal {
                name: s.name.clone(),
                role: match s.role {
                    PlantRole::Measures => SignalRole::Measures,
                    PlantRole::Sets => SignalRole::Sets,
                    PlantRole::Disturbs => SignalRole::Disturbs,
                },
                unit: s.unit.clone(),
                low: s.low,
                high: s.high,
                digital: false,
                text: s.text.clone(),
            })
            .collect();
        Self {
            inputs: info.signals.iter().map(|s| s.initial).collect(),
            signals,
            instance,
            view,
            now_ns: 0,
            limit_ns,
        }
    }

    fn value(&self, signal: usize, of: &[f64]) -> f64 {
        let measured = self.signals.get(signal).is_some_and(|s| s.role == SignalRole::Measures);
        let values = if measured { of } else { &self.inputs };
        values.get(signal).copied().unwrap_or(f64::NAN)
    }
}

impl Model for ComponentModel {
    fn signals(&self) -> &[Signal] {
        &self.signals
    }

    fn advance(&mut self, to_ns: u64) -> Result<(), Halted> {
        let dt_ns = to_ns.saturating_sub(self.now_ns);
        if dt_ns == 0 {
            return Ok(());
        }
        self.view = self
            .instance
            .advance(dt_ns, &self.inputs, self.limit_ns)
            .map_err(|fault| Halted(fault.to_string()))?;
        self.now_ns = to_ns;
        Ok(())
    }

    fn truth(&self, signal: usize) -> f64 {
        self.value(signal, &self.view.truth)
    }

    fn shown(&self, signal: usize) -> f64 {
        self.value(signal, &self.view.shown)
    }

    fn set(&mut self, signal: usize, value: f64) {
        let sets = self.signals.get(signal).is_some_and(|s| s.role != SignalRole::Measures);
        if let (true, Some(slot)) = (sets, self.inputs.get_mut(signal)) {
            *slot = value;
        }
    }
}

/// The folders in which stock components are: the one named, else beside the program, else where a work tree builds them.
#[must_use]
pub fn folders(named: Option<&Path>) -> Vec<PathBuf> {
    if let Some(named) = named {
        return vec![named.to_owned()];
    }
    let program = std::env::current_exe().ok();
    let beside = program.iter().flat_map(|program| program.ancestors().skip(1).take(2));
    let mut folders: Vec<PathBuf> = beside.map(|dir| dir.join("components")).collect();
    folders.push(PathBuf::from("target/components"));
    folders
}
