//! A component in the sandbox with its state, and tables of cycles.

use std::{fmt::Write as _, sync::OnceLock};

use bumpless_core::{Cycle, Effects, Fault, Frame, Mode, NoData, PortKind, Quality, Reading};
use bumpless_engine::{Config, Engine, Instance, Origin};
use bumpless_st::{Compiled, compile};

/// Far longer than any step takes, also on a busy machine.
const PATIENCE_NS: u64 = 20_000_000_000;

pub(crate) struct Cell {
    pub(crate) compiled: Compiled,
    instance: Instance,
    pub(crate) state: Vec<u8>,
    /// What the actuators hold, by port.
    pub(crate) held: Vec<f64>,
    pub(crate) mode: Mode,
    pub(crate) setpoint: f64,
    seq: u64,
    at_ns: u64,
}

pub(crate) fn compiled(source: &str) -> Compiled {
    compile(source).unwrap_or_else(|error| panic!("{error}\n{source}"))
}

/// One for all tests: each has a clock thread.
fn engine() -> &'static Engine {
    static ENGINE: OnceLock<Engine> = OnceLock::new();
    ENGINE.get_or_init(|| {
        Engine::new(Config {
            instances_max: 256,
            ..Config::default()
        })
        .expect("engine")
    })
}

impl Cell {
    pub(crate) fn new(source: &str) -> Self {
        Self::tracking(source, &[])
    }

    /// Starts from what the actuators hold.
    pub(crate) fn tracking(source: &str, track: &[f64]) -> Self {
        let compiled = compiled(source);
        let (_, prepared) = engine().open(&compiled.component).unwrap_or_else(|error| {
            let mut text = error.to_string();
            let mut next = std::error::Error::source(&error);
            while let Some(source) = next {
                text = format!("{text}: {source}");
                next = source.source();
            }
            panic!("{text}")
        });
        let descriptor = prepared.descriptor().clone();
        let parameters: Vec<f64> = descriptor.parameters.iter().map(|p| p.default).collect();
        let outputs = descriptor
            .ports
            .iter()
            .filter(|p| p.direction == bumpless_core::Direction::Output)
            .count();
        let mut from = track.to_vec();
        from.resize(outputs, 0.0);
        let mut instance = prepared.instantiate().expect("instance");
        let state = instance.start(&parameters, &from, PATIENCE_NS).expect("start");
        assert_eq!(state.len(), compiled.state_bytes);
        Self {
            compiled,
            instance,
            state,
            held: vec![0.0; descriptor.ports.len()],
            mode: Mode::Automatic,
            setpoint: 0.0,
            seq: 0,
            at_ns: 0,
        }
    }

    pub(crate) fn retune(&mut self, parameters: &[f64], track: &[f64]) {
        let from = self.origin();
        let state = self.state.clone();
        self.state = self
            .instance
            .migrate(&from, &state, parameters, track, PATIENCE_NS)
            .expect("retune");
    }

    pub(crate) fn origin(&self) -> Origin {
        Origin {
            name: self.compiled.name.clone(),
            version: self.compiled.version.clone(),
            state_layout: self.compiled.state_layout,
        }
    }

    /// Takes a state of another over.
    pub(crate) fn take(&mut self, from: &Origin, state: &[u8], track: &[f64]) -> Result<(), Fault> {
        let parameters: Vec<f64> = self
            .instance
            .prepared()
            .descriptor()
            .parameters
            .iter()
            .map(|p| p.default)
            .collect();
        self.state = self.instance.migrate(from, state, &parameters, track, PATIENCE_NS)?;
        Ok(())
    }

    /// One step; `inputs` by port in order, none where there is no value.
    pub(crate) fn try_step(&mut self, dt_ms: u64, inputs: &[Option<f64>]) -> Result<Effects, Fault> {
        let descriptor = self.instance.prepared().descriptor().clone();
        self.seq += 1;
        self.at_ns += dt_ms * 1_000_000;
        let mut given = inputs.iter();
        let readings = descriptor
            .ports
            .iter()
            .zip(&self.held)
            .map(|(port, held)| match port.direction {
                bumpless_core::Direction::Output => Reading::good(*held, self.at_ns),
                bumpless_core::Direction::Input => match given.next().copied().flatten() {
                    Some(value) => Reading::good(value, self.at_ns),
                    None => Reading {
                        value: Err(NoData::CommsLost),
                        quality: Quality::Bad,
                        ..Reading::good(0.0, self.at_ns)
                    },
                },
            })
            .collect();
        let frame = Frame {
            cycle: Cycle {
                seq: self.seq,
                at_ns: self.at_ns,
                dt_ns: dt_ms * 1_000_000,
                mode: self.mode,
                setpoint: self.setpoint,
            },
            readings,
            messages: Vec::new(),
        };
        let effects = self.instance.step(&frame, &self.state, PATIENCE_NS)?;
        self.state.clone_from(&effects.state);
        for (port, value) in &effects.writes {
            self.held[usize::from(*port)] = *value;
        }
        Ok(effects)
    }

    /// One good step of 100 ms; gives the outputs in order.
    pub(crate) fn step(&mut self, inputs: &[f64]) -> Vec<f64> {
        self.step_of(100, inputs)
    }

    pub(crate) fn step_of(&mut self, dt_ms: u64, inputs: &[f64]) -> Vec<f64> {
        let inputs: Vec<Option<f64>> = inputs.iter().copied().map(Some).collect();
        let effects = self.try_step(dt_ms, &inputs).unwrap_or_else(|fault| panic!("{fault}"));
        effects.writes.iter().map(|(_, value)| *value).collect()
    }

    pub(crate) fn kinds(&self) -> Vec<PortKind> {
        self.instance
            .prepared()
            .descriptor()
            .ports
            .iter()
            .map(|port| port.kind)
            .collect()
    }
}

/// What expressions give, as LREAL; `before` stands before the program, `variables` in it, `statements` before the expressions.
pub(crate) fn values(before: &str, variables: &str, statements: &str, cases: &[(&str, f64)]) {
    for chunk in cases.chunks(40) {
        let (mut outputs, mut body) = (String::new(), String::new());
        for (n, (expression, _)) in chunk.iter().enumerate() {
            let _infallible = write!(outputs, "r{n} : LREAL; ");
            let _infallible = writeln!(body, "r{n} := {expression};");
        }
        let source = format!(
            "{before}\nPROGRAM p VAR_OUTPUT {outputs} END_VAR VAR unused : BOOL; {variables} END_VAR\n{statements}\n{body}\nEND_PROGRAM"
        );
        let given = Cell::new(&source).step(&[]);
        for ((expression, wanted), given) in chunk.iter().zip(given) {
            assert!(*wanted == given, "{expression} is {given}, not {wanted}");
        }
    }
}
