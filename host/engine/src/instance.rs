//! One replica's instance of a component: called once per cycle, remade after a failure.
//!
//! Owns: one store and its guest.
//! Never: keeps a state between calls; it comes in with each call and goes out with it.
//!
//! ```text
//!            call returns (ok, or a fault in the guest's words)
//!          ┌──────────┐
//!          ▼          │
//!   ──▶ alive ────────┴─ trap, overrun or limit ──▶ dead ── next call: remade within that call's limit ──▶ alive
//! ```

use std::{sync::Arc, time::Duration};

use bumpless_core::{Effects, Fault, Frame, LogLevel};

use crate::{
    Prepared,
    bindings::bumpless::control::types,
    capacity::Place,
    convert, place,
    prepared::Live,
    sandbox::{Call, Sandbox},
    ticker::monotonic_ns,
};

/// A guest that has grown until only this part of its memory is left, is made anew. CPython takes a mebibyte at a time, of 16.
const MEMORY_LEFT_PART: usize = 8;

/// Where a state that is to be taken over comes from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Origin {
    /// Name of the component that wrote the state.
    pub name: String,
    /// Its version.
    pub version: String,
    /// Its state layout.
    pub state_layout: u32,
}

/// An instance of a component. It can move between threads, and each thread that calls it needs 1 MiB of stack.
///
/// `limit_ns` bounds each call by the clock; a guest that goes on is stopped once it has used a quarter of the limit
/// of processor time beyond it (50 µs to 500 µs): at most 0.7 ms later on an idle machine, 0.3 ms where limits are under 1 ms, and
/// never because the machine held it up. A call that ends between its limit and that is good.
pub struct Instance {
    // Dropped in this order: the place is given back only when the store is gone.
    live: Option<Live>,
    prepared: Arc<Prepared>,
    last_step_ns: u64,
    stopped_in: Option<String>,
    /// What it was when a trap last ended its life.
    core: Option<Vec<u8>>,
    /// Its linear memory after the first step of this life, in bytes.
    young_bytes: Option<usize>,
    _place: Place,
}

impl Instance {
    pub(crate) fn new(prepared: Arc<Prepared>, live: Live, place: Place) -> Self {
        Self {
            live: Some(live),
            prepared,
            last_step_ns: 0,
            stopped_in: None,
            core: None,
            young_bytes: None,
            _place: place,
        }
    }

    /// The component.
    #[must_use]
    pub const fn prepared(&self) -> &Arc<Prepared> {
        &self.prepared
    }

    /// Time of the last call, in ns, with the time of making the guest again where that was needed.
    #[must_use]
    pub const fn last_step_ns(&self) -> u64 {
        self.last_step_ns
    }

    /// Where the guest was when a trap or a limit last ended its life: a function, with file and line under
    /// [`Config::lines`](crate::Config::lines). None where that never happened, or nothing is known of the place.
    #[must_use]
    pub fn stopped_in(&self) -> Option<&str> {
        self.stopped_in.as_deref()
    }

    /// Its frames, globals and memories as they were when a trap or a limit last ended its life, under
    /// [`Config::lines`](crate::Config::lines); once. As large as its memory and some. Source of the form: the core dumps of the
    /// WebAssembly tool conventions.
    pub fn take_core(&mut self) -> Option<Vec<u8>> {
        self.core.take()
    }

    /// Linear memory that the guest has, in bytes; 0 where its life has ended.
    #[must_use]
    pub fn memory_bytes(&self) -> usize {
        self.live.as_ref().map_or(0, |live| live.store.data().memory_bytes())
    }

    /// A first state. `parameters` holds one value per parameter and `track` what the actuator of each output port holds,
    /// both in the descriptor's order.
    ///
    /// # Errors
    /// Whatever the guest did wrong; it may be called again all the same.
    pub fn start(&mut self, parameters: &[f64], track: &[f64], limit_ns: u64) -> Result<Vec<u8>, Fault> {
        let state = self.call(limit_ns, |live| {
            live.store.data_mut().open(Call::Start);
            live.guest
                .bumpless_control_control()
                .call_start(&mut live.store, parameters, track)
        })?;
        self.report_log();
        within_limit(state)
    }

    /// One step: the frame and the state go in, the effects with the next state come out, or nothing at all.
    ///
    /// A port without a reading in the frame counts as not connected.
    ///
    /// # Errors
    /// Whatever the guest did wrong; it may be called again all the same.
    pub fn step(&mut self, frame: &Frame, state: &[u8], limit_ns: u64) -> Result<Effects, Fault> {
        let cycle = convert::cycle(frame, self.prepared.port_count());
        let state = self.call(limit_ns, |live| {
            live.store.data_mut().open_step(frame);
            live.guest
                .bumpless_control_control()
                .call_step(&mut live.store, cycle, state)
        })?;
        let state = within_limit(state)?;
        // A call that returned a state leaves the guest alive.
        let Some(live) = &mut self.live else {
            return Err(Fault::Trap("the instance was lost after its step".to_owned()));
        };
        let effects = live.store.data_mut().take_effects(state);
        self.end_old_age();
        Ok(effects)
    }

    /// Some interpreters give less back than they take, some bytes per step. What lasts is in the state, so a guest whose memory has
    /// grown until little is left ends here, between two steps, and the next call makes it anew: sooner than in a trap, which would
    /// cost the loop a cycle.
    fn end_old_age(&mut self) {
        let bytes = self.memory_bytes();
        let young = *self.young_bytes.get_or_insert(bytes);
        let max = self.prepared.core.limits.memory_bytes_max;
        let old = max - max / MEMORY_LEFT_PART;
        if young <= old && bytes > old {
            self.live = None;
            self.young_bytes = None;
        }
    }

    /// Takes over a state that another component, another version or other parameters left. To decline
    /// ([`Fault::BadState`]) is no failure: use [`Instance::start`] then.
    ///
    /// # Errors
    /// Whatever the guest did wrong; it may be called again all the same.
    pub fn migrate(
        &mut self,
        from: &Origin,
        state: &[u8],
        parameters: &[f64],
        track: &[f64],
        limit_ns: u64,
    ) -> Result<Vec<u8>, Fault> {
        let origin = convert::origin(from);
        let state = self.call(limit_ns, |live| {
            live.store.data_mut().open(Call::Migrate);
            live.guest
                .bumpless_control_control()
                .call_migrate(&mut live.store, &origin, state, parameters, track)
        })?;
        self.report_log();
        within_limit(state)
    }

    /// Calls the guest within a limit, making it first where the last call ended its life.
    fn call(
        &mut self,
        limit_ns: u64,
        run: impl FnOnce(&mut Live) -> wasmtime::Result<Result<Vec<u8>, types::Fault>>,
    ) -> Result<Vec<u8>, Fault> {
        let started_ns = monotonic_ns();
        if self.live.is_none() {
            let made = self.prepared.make(started_ns, limit_ns);
            self.live = Some(made.map_err(|failed| failed.fault(Duration::from_nanos(limit_ns)))?);
        }
        let Some(live) = &mut self.live else {
            return Err(Fault::Trap("the instance could not be made".to_owned()));
        };
        let watched = self.prepared.core.calls.begin(started_ns, limit_ns);
        live.store
            .data_mut()
            .set_deadline(started_ns.saturating_add(limit_ns), limit_ns);
        live.store.set_epoch_deadline(1);
        let outcome = match run(live) {
            Ok(Ok(state)) => Ok(state),
            Ok(Err(said)) => Err(convert::fault(&said)),
            Err(error) => {
                let fault = live.store.data().fault(&error, limit_ns);
                self.stopped_in = place::of(&error);
                let name = &self.prepared.descriptor().name;
                self.core = error
                    .downcast_ref::<wasmtime::WasmCoreDump>()
                    .map(|core| core.serialize(&mut live.store, name));
                // wasmtime lets nobody into a store that has trapped, and a half-run guest must not go on anyway.
                self.live = None;
                self.young_bytes = None;
                Err(fault)
            }
        };
        drop(watched);
        self.last_step_ns = monotonic_ns().saturating_sub(started_ns);
        outcome
    }

    /// Lines written outside a step have no record to travel in: they go to the host's own log.
    fn report_log(&mut self) {
        let Some(lines) = self
            .live
            .as_mut()
            .map(|live| live.store.data_mut())
            .map(Sandbox::take_log)
        else {
            return;
        };
        let component = &self.prepared.descriptor().name;
        for line in lines {
            match line.level {
                LogLevel::Debug => tracing::debug!(%component, text = %line.text, "a component's line"),
                LogLevel::Info => tracing::info!(%component, text = %line.text, "a component's line"),
                LogLevel::Warning => tracing::warn!(%component, text = %line.text, "a component's line"),
            }
        }
    }
}

impl std::fmt::Debug for Instance {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Instance")
            .field("prepared", &self.prepared)
            .field("alive", &self.live.is_some())
            .field("last_step_ns", &self.last_step_ns)
            .finish_non_exhaustive()
    }
}

fn within_limit(state: Vec<u8>) -> Result<Vec<u8>, Fault> {
    const MAX: usize = bumpless_core::limits::STATE_BYTES_MAX;
    if state.len() > MAX {
        return Err(Fault::Limit(format!(
            "a state of {} bytes; at most {MAX} are kept",
            state.len()
        )));
    }
    Ok(state)
}
