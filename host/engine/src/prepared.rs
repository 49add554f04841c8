//! A component that is ready on this host: compiled, linked, described. Shared by all its instances.
//!
//! Never: changes; another digest is another `Prepared`.

use std::{sync::Arc, time::Duration};

use bumpless_core::{Descriptor, Digest, Fault};
use wasmtime::{
    Store, Trap, UpdateDeadline,
    component::{Component, HasSelf, Linker},
};

use crate::{
    Error, Instance, Limits,
    admission::{check_export, check_imports, check_needs},
    bindings::{Controller, ControllerPre},
    capacity::{Places, Turnstile},
    convert,
    error::brief,
    sandbox::{CALL_BYTES_MAX, Call, PortFace, Sandbox, Stop, faces},
    ticker::{Calls, Ticker, monotonic_ns},
};

/// What every component and instance of an engine shares. Declared so that the clock outlives all stores.
pub(crate) struct Core {
    pub(crate) engine: wasmtime::Engine,
    pub(crate) linker: Linker<Sandbox>,
    pub(crate) limits: Limits,
    pub(crate) places: Places,
    /// Instances for trials: apart from those of loops, so that a full host can still try what is uploaded.
    pub(crate) trials: Places,
    /// As many at once as there are spare slots.
    pub(crate) inspections: Turnstile,
    /// Calls that run, watched by the ticker.
    pub(crate) calls: Calls,
    /// Never read: it looks after them until the last user of the engine is gone.
    pub(crate) _ticker: Ticker,
}

impl Core {
    /// The linker with every interface of the world.
    pub(crate) fn linker(engine: &wasmtime::Engine) -> Result<Linker<Sandbox>, Error> {
        let mut linker = Linker::new(engine);
        Controller::add_to_linker::<_, HasSelf<Sandbox>>(&mut linker, |sandbox| sandbox)
            .map_err(|error| Error::Engine { reason: brief(&error) })?;
        Ok(linker)
    }
}

/// A guest that can be called. A trap or an overrun ends its life.
pub(crate) struct Live {
    pub(crate) store: Store<Sandbox>,
    pub(crate) guest: Controller,
}

/// A component, ready to be instantiated.
pub struct Prepared {
    pub(crate) core: Arc<Core>,
    digest: Digest,
    descriptor: Descriptor,
    ports: Arc<[PortFace]>,
    imports: Vec<String>,
    /// Places that an instance takes.
    weight: u32,
    pre: ControllerPre<Sandbox>,
}

impl Prepared {
    /// Checks and links a compiled component and lets it say what it is.
    pub(crate) fn new(core: Arc<Core>, digest: Digest, component: &Component) -> Result<Self, Error> {
        let imports = check_imports(component)?;
        check_export(component)?;
        let weight = check_needs(component, &core.limits)?;
        let world = |error: wasmtime::Error| Error::World { reason: brief(&error) };
        let pre = ControllerPre::new(core.linker.instantiate_pre(component).map_err(world)?).map_err(world)?;
        let descriptor = describe(&core, &pre)?;
        descriptor.check()?;
        let ports = faces(&descriptor);
        Ok(Self {
            core,
            digest,
            descriptor,
            ports,
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

    /// What it says of itself, checked.
    #[must_use]
    pub const fn descriptor(&self) -> &Descriptor {
        &self.descriptor
    }

    /// Interfaces that it imports.
    pub(crate) fn imports(&self) -> &[String] {
        &self.imports
    }

    /// Ports that it has.
    pub(crate) fn port_count(&self) -> usize {
        self.ports.len()
    }

    /// A new instance. Its first calls are slower than later ones, because memory is touched for the first time: let it
    /// step a few times before it takes part in a cycle.
    ///
    /// # Errors
    /// [`Error::Full`] where the host has no place left, [`Error::Instantiate`] where the guest fails at its start.
    pub fn instantiate(self: &Arc<Self>) -> Result<Instance, Error> {
        let place = self.core.places.take(self.weight)?;
        let limit = self.core.limits.describe_time_max;
        let live = self
            .make(monotonic_ns(), nanos(limit))
            .map_err(|failed| Error::Instantiate(failed.fault(limit)))?;
        Ok(Instance::new(Arc::clone(self), live, place))
    }

    /// A new instance for a trial, of the few that are kept apart from the loops'.
    ///
    /// # Errors
    /// [`Error::Busy`] where others are being tried, [`Error::Instantiate`] where the guest fails at its start.
    pub fn instantiate_for_trial(self: &Arc<Self>) -> Result<Instance, Error> {
        let place = self.core.trials.take(self.weight).map_err(|_| Error::Busy {
            doing: "tried",
            waited_s: 0,
        })?;
        let limit = self.core.limits.describe_time_max;
        let live = self
            .make(monotonic_ns(), nanos(limit))
            .map_err(|failed| Error::Instantiate(failed.fault(limit)))?;
        Ok(Instance::new(Arc::clone(self), live, place))
    }

    /// A store with a guest in it, made within the limit from now on.
    pub(crate) fn make(&self, now_ns: u64, limit_ns: u64) -> Result<Live, Failed> {
        make(&self.core, &self.pre, Arc::clone(&self.ports), now_ns, limit_ns)
    }
}

impl std::fmt::Debug for Prepared {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Prepared")
            .field("name", &self.descriptor.name)
            .field("digest", &self.digest)
            .finish_non_exhaustive()
    }
}

/// A guest that failed at its start: what the engine said, and the sandbox that knows what it means.
pub(crate) struct Failed {
    error: wasmtime::Error,
    sandbox: Box<Sandbox>,
}

impl Failed {
    /// Why a component that was never instantiated before cannot be. The types of its functions are checked only when
    /// the bindings take hold of them, so not every failure is the guest's doing.
    fn at_first(&self, limit: Duration) -> Error {
        if self.error.is::<Trap>() || self.error.is::<Stop>() {
            return Error::Instantiate(self.fault(limit));
        }
        let reason = brief(&self.error);
        if reason.contains("resource limit") {
            Error::Needs { reason }
        } else {
            Error::World { reason }
        }
    }

    pub(crate) fn fault(&self, limit: Duration) -> Fault {
        self.sandbox.fault(&self.error, nanos(limit))
    }
}

/// A time in ns.
pub(crate) fn nanos(time: Duration) -> u64 {
    u64::try_from(time.as_nanos()).unwrap_or(u64::MAX)
}

/// A store within its bounds; whatever runs in it must be over at the deadline, in ns of [`monotonic_ns`].
pub(crate) fn store(core: &Core, ports: Arc<[PortFace]>, deadline_ns: u64) -> Store<Sandbox> {
    let mut store = Store::new(&core.engine, Sandbox::new(&core.limits, ports, deadline_ns));
    store.limiter(|sandbox| sandbox);
    store.set_hostcall_fuel(CALL_BYTES_MAX);
    // The epoch is shared by all stores, so a late call only makes a store look at its own deadline.
    store.epoch_deadline_callback(|mut context| {
        Ok(if context.data_mut().is_overdue() {
            UpdateDeadline::Interrupt
        } else {
            UpdateDeadline::Continue(1)
        })
    });
    store.set_epoch_deadline(1);
    store
}

fn make(
    core: &Core,
    pre: &ControllerPre<Sandbox>,
    ports: Arc<[PortFace]>,
    now_ns: u64,
    limit_ns: u64,
) -> Result<Live, Failed> {
    let mut store = store(core, ports, now_ns.saturating_add(limit_ns));
    let _watched = core.calls.begin(now_ns, limit_ns);
    match pre.instantiate(&mut store) {
        Ok(guest) => Ok(Live { store, guest }),
        Err(error) => Err(Failed {
            error,
            sandbox: Box::new(store.into_data()),
        }),
    }
}

/// Asks a component what it is, in a store of its own.
fn describe(core: &Core, pre: &ControllerPre<Sandbox>) -> Result<Descriptor, Error> {
    let limit = core.limits.describe_time_max;
    let _turn = core.inspections.enter(limit * 8)?;
    let (now_ns, limit_ns) = (monotonic_ns(), nanos(limit));
    let mut live = make(core, pre, Arc::from([]), now_ns, limit_ns).map_err(|failed| failed.at_first(limit))?;
    live.store.data_mut().open(Call::Describe);
    // The deadline of the making goes on: both together have the limit.
    let _watched = core.calls.begin(now_ns, limit_ns);
    match live.guest.bumpless_control_control().call_describe(&mut live.store) {
        Ok(said) => Ok(convert::descriptor(said)),
        Err(error) => {
            let sandbox = Box::new(live.store.into_data());
            Err(Error::Describe(Failed { error, sandbox }.fault(limit)))
        }
    }
}
