//! Runs of experiments: side by side on all cores, and only those that were not made before.
//!
//! Owns: resolving an experiment against components and plant, the workers, and the store of kept results. A result is kept
//! under the digest of everything that it follows from: experiment, seed, components, plant, and this program's version.
//! Never: decides by time; the order of results is that of the experiment, whoever was first.

use std::{
    collections::HashMap,
    fs,
    path::{Path, PathBuf},
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicBool, AtomicUsize, Ordering::Relaxed},
    },
};

use bumpless_core::{Descriptor, Digest, Direction, LoopId, LoopSpec, OutputLimit, PointId, Wiring};
use bumpless_engine::Prepared;
use bumpless_io::sim::{Model, Stock, model::stock};

use crate::{
    error::Error,
    experiment::{ControllerPlan, Event, Experiment, LoopPlan, Value},
    library::Library,
    recorded::{RecordedModel, Window},
    result::{Outcome, RunResult, VariantResult},
    seat::Revision,
    sensitivity,
    variant::{Variant, variants},
    world::{LoopParts, Parts, World},
};

/// Grows when the same experiment would give other bytes.
const RESULT_VERSION: u32 = 1;

/// How runs are made.
#[derive(Debug, Clone, Default)]
pub struct Options {
    /// Runs side by side; as many as the machine has cores where 0.
    pub jobs: usize,
    /// Folder of kept results; none to keep nothing.
    pub kept_in: Option<PathBuf>,
    /// Folder that paths in the experiment start from.
    pub base: PathBuf,
}

/// How far the work is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Progress {
    /// Runs in all.
    pub runs: usize,
    /// Runs that are there.
    pub done: usize,
    /// Of them, those that were kept from before.
    pub kept: usize,
}

/// A controller that was chosen.
#[derive(Debug, Clone, PartialEq)]
pub struct Chosen {
    /// Its component's file.
    pub file: PathBuf,
    /// Its name in the experiment.
    pub component: String,
    /// Its component's digest.
    pub digest: Digest,
    /// Parameters that differ from their defaults.
    pub parameters: std::collections::BTreeMap<String, f64>,
}

/// The lab.
#[derive(Debug)]
pub struct Lab {
    library: Library,
}

impl Lab {
    /// A lab over a library.
    #[must_use]
    pub const fn new(library: Library) -> Self {
        Self { library }
    }

    /// Its components.
    #[must_use]
    pub const fn library(&self) -> &Library {
        &self.library
    }

    /// Runs an experiment: every case at every point of the sweeps with every seed.
    ///
    /// # Errors
    /// What is wrong with the experiment, or [`Error::Stopped`] where `stop` was set. A run that fails is no error; its result
    /// says why.
    pub fn run(
        &self,
        experiment: &Experiment,
        document: &toml::Table,
        place: &str,
        options: &Options,
        stop: &AtomicBool,
        progress: &(dyn Fn(Progress) + Sync),
    ) -> Result<Outcome, Error> {
        let variants = variants(experiment, document, place)?;
        let seeds = experiment.seeds.list();
        // Everything that can be wrong is found before the first run.
        let mut units = Vec::new();
        for (n, variant) in variants.iter().enumerate() {
            let place = format!("{place}: {}", variant.title());
            let setup = self.setup(&variant.experiment, &options.base, &place)?;
            if n == 0 {
                units = setup.units;
            }
        }
        let jobs: Vec<(usize, u64, bool)> = variants
            .iter()
            .enumerate()
            .flat_map(|(v, _)| seeds.iter().enumerate().map(move |(s, seed)| (v, *seed, s == 0)))
            .collect();
        let results: Vec<Mutex<Option<Result<RunResult, Error>>>> = jobs.iter().map(|_| Mutex::new(None)).collect();
        let (next, done, kept) = (AtomicUsize::new(0), AtomicUsize::new(0), AtomicUsize::new(0));
        let report = || {
            progress(Progress {
                runs: jobs.len(),
                done: done.load(Relaxed),
                kept: kept.load(Relaxed),
            });
        };
        report();
        let work = || {
            while let Some((job, slot)) = {
                let n = next.fetch_add(1, Relaxed);
                jobs.get(n).zip(results.get(n))
            } {
                if stop.load(Relaxed) {
                    break;
                }
                let (v, seed, traced) = *job;
                let Some(variant) = variants.get(v) else { break };
                let result = self.once(variant, seed, traced, options, stop, &kept);
                *slot.lock().unwrap_or_else(PoisonError::into_inner) = Some(result);
                done.fetch_add(1, Relaxed);
                report();
            }
        };
        let workers = match options.jobs {
            0 => std::thread::available_parallelism().map_or(1, std::num::NonZero::get),
            n => n,
        };
        std::thread::scope(|scope| {
            for _ in 1..workers.min(jobs.len()) {
                scope.spawn(work);
            }
            work();
        });
        let mut all = results.into_iter().map(|slot| {
            slot.into_inner()
                .unwrap_or_else(PoisonError::into_inner)
                .unwrap_or(Err(Error::Stopped))
        });
        let mut outcome = Vec::new();
        for variant in variants {
            let runs = all.by_ref().take(seeds.len()).collect::<Result<Vec<_>, _>>()?;
            let component = variant
                .experiment
                .loops
                .first()
                .and_then(|l| variant.experiment.controller_of(l))
                .map_or_else(String::new, |c| c.component.clone());
            outcome.push(VariantResult {
                case: variant.case,
                at: variant.at,
                component,
                runs,
            });
        }
        Ok(Outcome {
            name: experiment.name.clone(),
            text: experiment.text.clone(),
            loops: experiment.loops.iter().map(|l| l.name.clone()).collect(),
            units,
            variants: outcome,
            duration_s: experiment.duration_s,
        })
    }

    /// The controller of the first loop of one case at one point of the sweeps: its file, its name and its parameters as
    /// numbers. For whoever wants to bring it to a live loop.
    ///
    /// # Errors
    /// What is wrong with the experiment, or that there is no such case.
    pub fn controller_of(
        &self,
        experiment: &Experiment,
        document: &toml::Table,
        place: &str,
        base: &Path,
        (case, at): (&str, &[crate::variant::Setting]),
    ) -> Result<Chosen, Error> {
        let found = variants(experiment, document, place)?
            .into_iter()
            .find(|v| v.case == case && v.at == at)
            .ok_or_else(|| Error::at(place, format!("there is no case {case:?}")))?;
        let plan = found.experiment.loops.first();
        let controller = plan
            .and_then(|l| found.experiment.controller_of(l))
            .ok_or_else(|| Error::at(place, "the first loop has no controller"))?;
        let name = located(&controller.component, base);
        let prepared = self.library.controller(&name)?;
        Ok(Chosen {
            file: self.library.controller_file(&name)?,
            component: controller.component.clone(),
            digest: *prepared.digest(),
            parameters: parameters(controller, prepared.descriptor()).map_err(|problem| Error::at(place, problem))?,
        })
    }

    /// One run, kept from before or made now.
    fn once(
        &self,
        variant: &Variant,
        seed: u64,
        traced: bool,
        options: &Options,
        stop: &AtomicBool,
        kept: &AtomicUsize,
    ) -> Result<RunResult, Error> {
        let experiment = &variant.experiment;
        let path = match &options.kept_in {
            Some(folder) => {
                let name = self.digest(experiment, seed, traced, &options.base)?;
                let path = folder.join(format!("{name}.run"));
                if let Some(found) = read_kept(&path) {
                    kept.fetch_add(1, Relaxed);
                    return Ok(found);
                }
                Some(path)
            }
            None => None,
        };
        let result = self.make(experiment, seed, traced, &options.base, &|| stop.load(Relaxed))?;
        if let Some(path) = path {
            keep(&path, &result)?;
        }
        Ok(result)
    }

    /// Makes one run.
    ///
    /// # Errors
    /// What is wrong with the experiment; a run that fails on its way is a result.
    pub fn make(
        &self,
        experiment: &Experiment,
        seed: u64,
        traced: bool,
        base: &Path,
        cancelled: &dyn Fn() -> bool,
    ) -> Result<RunResult, Error> {
        let setup = self.setup(experiment, base, &experiment.name)?;
        let model = self.model(experiment, seed, base)?;
        let mut loops = Vec::new();
        for l in setup.loops {
            loops.push(LoopParts {
                revision: revision(l.spec, &l.prepared)?,
                signals: l.signals,
                measured: l.measured,
            });
        }
        let mut waiting = HashMap::new();
        for (event, l, spec, prepared) in setup.swaps {
            waiting.insert((event, l), revision(spec, &prepared)?);
        }
        let hosts = std::iter::once("home".to_owned())
            .chain(experiment.cell.hosts.iter().map(|h| h.name.clone()))
            .collect();
        let world = World::new(Parts {
            plan: experiment,
            seed,
            traced,
            model,
            loops,
            waiting,
            cancelled,
        })?;
        match world.run() {
            Ok((mut loops, notes, notes_dropped)) => {
                for (result, plan) in loops.iter_mut().zip(&experiment.loops) {
                    if let Some(ms) = sensitivity::of_loop(experiment, plan) {
                        result.figures.insert("ms".to_owned(), ms);
                    }
                }
                Ok(RunResult {
                    seed,
                    loops,
                    notes,
                    notes_dropped,
                    hosts,
                    failed: None,
                })
            }
            Err(error @ Error::Run { .. }) => Ok(RunResult {
                seed,
                loops: Vec::new(),
                notes: Vec::new(),
                notes_dropped: 0,
                hosts,
                failed: Some(error.to_string()),
            }),
            Err(error) => Err(error),
        }
    }

    /// The plant at its start.
    fn model(&self, experiment: &Experiment, seed: u64, base: &Path) -> Result<Box<dyn Model>, Error> {
        let p = &experiment.plant;
        let made = |which: Stock| stock(&which, seed).map_err(|problem| Error::at("[plant]", problem));
        match p.model.as_str() {
            "pilot" => made(Stock::Pilot(p.pilot.unwrap_or_default())),
            "fopdt" => made(Stock::Fopdt(p.fopdt.unwrap_or_default())),
            "linear" => made(Stock::Linear(p.linear.clone().unwrap_or_default())),
            "recorded" => {
                let file = p.recorded.as_ref().map_or("", |r| r.file.as_str());
                Ok(Box::new(RecordedModel::new(&Window::read(&base.join(file))?)))
            }
            other => {
                let name = other.strip_prefix("component:").unwrap_or(other);
                self.library.model(&located(name, base), &p.constants, seed)
            }
        }
    }

    /// Resolves an experiment: components, ports, limits.
    fn setup(&self, experiment: &Experiment, base: &Path, place: &str) -> Result<Setup, Error> {
        let model = self.model(experiment, 0, base)?;
        let mut setup = Setup {
            loops: Vec::new(),
            swaps: Vec::new(),
            units: Vec::new(),
        };
        for (n, plan) in experiment.loops.iter().enumerate() {
            let place = format!("{place}: loop {:?}", plan.name);
            let controller = experiment
                .controller_of(plan)
                .ok_or_else(|| Error::at(&place, "it has no controller"))?;
            let (spec, prepared, signals) = self.spec(plan, controller, 1, &*model, base, &place)?;
            let measured = measured_port(plan, prepared.descriptor())
                .and_then(|port| plan.ports.get(port))
                .and_then(|signal| signals.get(signal).copied())
                .ok_or_else(|| Error::at(&place, "measured must name an input port that is connected"))?;
            let output = prepared
                .descriptor()
                .outputs()
                .next()
                .and_then(|(_, p)| plan.ports.get(&p.name))
                .and_then(|signal| signals.get(signal).copied());
            let unit = |n: usize| model.signals().get(n).map_or_else(String::new, |s| s.unit.clone());
            setup
                .units
                .push((unit(measured), output.map_or_else(String::new, unit)));
            let mut revision = 1;
            for (e, event) in experiment.events.iter().enumerate() {
                let Event::Swap {
                    loop_name,
                    component,
                    parameters,
                    at_s,
                } = event
                else {
                    continue;
                };
                if loop_name.as_deref().is_some_and(|wanted| wanted != plan.name) {
                    continue;
                }
                revision += 1;
                let next = ControllerPlan {
                    component: component.clone(),
                    parameters: parameters.clone(),
                };
                let place = format!("{place}: swap at {at_s} s");
                let (spec, prepared, _) = self.spec(plan, &next, revision, &*model, base, &place)?;
                setup.swaps.push((e, n, spec, prepared));
            }
            setup.loops.push(LoopSetup {
                spec,
                prepared,
                signals,
                measured,
            });
        }
        Ok(setup)
    }

    fn spec(
        &self,
        plan: &LoopPlan,
        controller: &ControllerPlan,
        revision: u64,
        model: &dyn Model,
        base: &Path,
        place: &str,
    ) -> Result<Resolved, Error> {
        let wrong = |problem: String| Error::at(place, problem);
        let prepared = self.library.controller(&located(&controller.component, base))?;
        let descriptor = prepared.descriptor();
        let (mut ports, mut limits, mut signals) =
            (std::collections::BTreeMap::new(), plan.limits.clone(), HashMap::new());
        for (port, name) in &plan.ports {
            let found = model.signals().iter().enumerate().find(|(_, s)| s.name == *name);
            let Some((number, signal)) = found else {
                let known: Vec<&str> = model.signals().iter().map(|s| s.name.as_str()).collect();
                return Err(wrong(format!(
                    "the plant has no signal {name:?}; it has {}",
                    known.join(", ")
                )));
            };
            // After a swap ports that only the other component has stay unconnected.
            let Some(index) = descriptor.port(port) else {
                if revision > 1 {
                    continue;
                }
                let known: Vec<&str> = descriptor.ports.iter().map(|p| p.name.as_str()).collect();
                return Err(wrong(format!(
                    "{} has no port {port:?}; it has {}",
                    descriptor.name,
                    known.join(", ")
                )));
            };
            let point = PointId::new(name.as_str()).map_err(|e| wrong(e.to_string()))?;
            ports.insert(port.clone(), point);
            signals.insert(name.clone(), number);
            if descriptor
                .ports
                .get(index)
                .is_some_and(|p| p.direction == Direction::Output)
            {
                limits.entry(port.clone()).or_insert(OutputLimit {
                    low: signal.low,
                    high: signal.high,
                    rate_per_s: None,
                    safe: 0.0_f64.clamp(signal.low, signal.high),
                });
            }
        }
        limits.retain(|port, _| ports.contains_key(port));
        let spec = LoopSpec {
            id: LoopId::new(plan.name.as_str()).map_err(|e| wrong(e.to_string()))?,
            revision,
            digest: *prepared.digest(),
            period_ns: (plan.period_ms * 1e6).round() as u64,
            ports,
            parameters: parameters(controller, descriptor).map_err(wrong)?,
            setpoint: plan.setpoint.first().map_or(0.0, |m| m.to),
            setpoint_range: (f64::MIN, f64::MAX),
            mode: plan.mode,
            strategy: plan.strategy,
            replicas: bumpless_core::limits::REPLICAS_MAX as u8,
            limits,
            listens: plan.listens.clone(),
            fallback: None,
            fallback_parameters: std::collections::BTreeMap::new(),
            prefer: Vec::new(),
            policy: plan.policy,
        };
        spec.check().map_err(|e| wrong(e.to_string()))?;
        Wiring::new(&spec, descriptor).map_err(|e| wrong(e.to_string()))?;
        Ok((Arc::new(spec), prepared, signals))
    }

    /// What a result is kept under.
    fn digest(&self, experiment: &Experiment, seed: u64, traced: bool, base: &Path) -> Result<Digest, Error> {
        // Cases and sweeps are in the fields that they set; their other values are no matter of this run.
        let plan = Experiment {
            cases: Vec::new(),
            sweeps: Vec::new(),
            seeds: crate::experiment::Seeds::Count(1),
            text: String::new(),
            ..experiment.clone()
        };
        let mut text = format!("{RESULT_VERSION} {} {seed} {traced}\n", env!("CARGO_PKG_VERSION"));
        text += &serde_json::to_string(&plan).map_err(|e| Error::at(&experiment.name, e.to_string()))?;
        let swaps = experiment.events.iter().filter_map(|event| match event {
            Event::Swap { component, .. } => Some(component),
            _ => None,
        });
        let controllers = experiment
            .loops
            .iter()
            .filter_map(|l| experiment.controller_of(l))
            .map(|c| &c.component);
        for name in controllers.chain(swaps) {
            text += &format!("\n{}", self.library.controller(&located(name, base))?.digest());
        }
        if let Some(name) = experiment.plant.model.strip_prefix("component:") {
            text += &format!("\n{}", self.library.plant_digest(&located(name, base))?);
        }
        if let Some(recorded) = &experiment.plant.recorded {
            let path = base.join(&recorded.file);
            let bytes = fs::read(&path).map_err(Error::file("reading", path))?;
            text += &format!("\n{}", Digest::of(&bytes));
        }
        Ok(Digest::of(text.as_bytes()))
    }
}

/// One controller of a loop, resolved: what is run, its component, and the signals by name.
type Resolved = (Arc<LoopSpec>, Arc<Prepared>, HashMap<String, usize>);

/// An experiment, resolved.
struct Setup {
    loops: Vec<LoopSetup>,
    /// Event, loop, and what the loop goes on with.
    swaps: Vec<(usize, usize, Arc<LoopSpec>, Arc<Prepared>)>,
    units: Vec<(String, String)>,
}

struct LoopSetup {
    spec: Arc<LoopSpec>,
    prepared: Arc<Prepared>,
    signals: HashMap<String, usize>,
    measured: usize,
}

/// A component's name as it is, a path from the experiment's folder.
fn located(name: &str, base: &Path) -> String {
    if name.contains(['/', '.']) {
        base.join(name).display().to_string()
    } else {
        name.to_owned()
    }
}

fn revision(spec: Arc<LoopSpec>, prepared: &Arc<Prepared>) -> Result<Revision, Error> {
    let wiring =
        Wiring::new(&spec, prepared.descriptor()).map_err(|e| Error::at(spec.id.to_string(), e.to_string()))?;
    let instance = prepared.instantiate().map_err(|source| Error::Component {
        what: "controller",
        name: prepared.descriptor().name.clone(),
        source,
    })?;
    Ok(Revision { spec, wiring, instance })
}

/// Parameters as numbers: words of a choice become their place.
fn parameters(
    controller: &ControllerPlan,
    descriptor: &Descriptor,
) -> Result<std::collections::BTreeMap<String, f64>, String> {
    controller
        .parameters
        .iter()
        .map(|(name, value)| {
            let number = match value {
                Value::Number(number) => *number,
                Value::Word(word) => {
                    let spec = descriptor.parameters.iter().find(|p| p.name == *name);
                    let choices = spec.map_or(&[][..], |p| &p.choices);
                    let place = choices.iter().position(|c| c == word);
                    place.ok_or_else(|| {
                        format!(
                            "parameter {name:?} = {word:?}: {} has no such choice; it has {choices:?}",
                            descriptor.name
                        )
                    })? as f64
                }
            };
            Ok((name.clone(), number))
        })
        .collect()
}

/// The port that the indices are made of: as said, else `pv`, else the first input that is required.
fn measured_port<'a>(plan: &'a LoopPlan, descriptor: &'a Descriptor) -> Option<&'a str> {
    let inputs = || descriptor.ports.iter().filter(|p| p.direction == Direction::Input);
    plan.measured
        .as_deref()
        .or_else(|| inputs().find(|p| p.name == "pv").map(|p| p.name.as_str()))
        .or_else(|| inputs().find(|p| p.required).map(|p| p.name.as_str()))
}

/// A kept result; none where there is none, or none that can be read.
fn read_kept(path: &Path) -> Option<RunResult> {
    postcard::from_bytes(&fs::read(path).ok()?).ok()
}

/// Writes beside the file, then renames: a reader sees the whole result or none.
fn keep(path: &Path, result: &RunResult) -> Result<(), Error> {
    if let Some(folder) = path.parent() {
        fs::create_dir_all(folder).map_err(Error::file("making", folder))?;
    }
    let bytes = postcard::to_allocvec(result).map_err(|e| Error::Kept {
        path: path.to_owned(),
        problem: e.to_string(),
    })?;
    let beside = path.with_extension(format!("{}.new", std::process::id()));
    fs::write(&beside, bytes).map_err(Error::file("writing", &beside))?;
    fs::rename(&beside, path).map_err(Error::file("writing", path))
}
