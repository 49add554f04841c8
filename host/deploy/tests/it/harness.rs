//! Hosts of a test cell: real in everything but the loops.

use std::{
    collections::BTreeMap,
    path::PathBuf,
    sync::{
        Arc, OnceLock,
        atomic::{AtomicU32, Ordering},
    },
    time::{Duration, Instant},
};

use bumpless_cell::{Config, Roles, Session};
use bumpless_core::{CellName, ComponentInfo, HostId, LoopId, Mode, Policy, Strategy};
use bumpless_deploy::{Deploy, DeployArrival, LoopDraft, Parts, Upload};
use bumpless_engine::Engine;
use bumpless_io::{Clock, IoServer};
use bumpless_store::{RecordWriter, Store};
use parking_lot::Mutex;
use tempfile::TempDir;

use crate::field::FakeField;

/// Longer than any of this takes on a busy machine; only a failure waits for it.
pub(crate) const PATIENCE: Duration = Duration::from_secs(60);

/// Makes cells of tests that run side by side different.
static CELLS: AtomicU32 = AtomicU32::new(0);

/// A component by its path below the folder of components, without the ending.
pub(crate) fn component(name: &str) -> Vec<u8> {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    let folder = FOLDER.get_or_init(|| xtask::components::build().expect("components"));
    std::fs::read(folder.join(name).with_extension("wasm")).expect(name)
}

pub(crate) fn engine() -> Engine {
    // Compiled code is shared by all hosts of this process, so that each component is compiled once.
    static CACHE: OnceLock<TempDir> = OnceLock::new();
    let cache = CACHE.get_or_init(|| tempfile::tempdir().expect("a directory"));
    Engine::new(bumpless_engine::Config {
        cache_dir: Some(cache.path().to_owned()),
        instances_max: 32,
        ..bumpless_engine::Config::default()
    })
    .expect("an engine")
}

/// A host.
pub(crate) struct Host {
    pub(crate) deploy: Deploy,
    pub(crate) field: Arc<FakeField>,
    pub(crate) session: Session,
    pub(crate) store: Store,
    pub(crate) dir: PathBuf,
    writer: Arc<RecordWriter>,
    sink: Arc<Mutex<Option<Deploy>>>,
}

/// A cell, with the disks of its hosts.
pub(crate) struct Cell {
    name: CellName,
    disks: TempDir,
    first: OnceLock<Vec<String>>,
}

impl Cell {
    pub(crate) fn new() -> Self {
        let name = CellName::new(format!("deploy-{}", CELLS.fetch_add(1, Ordering::Relaxed))).unwrap();
        Self {
            name,
            disks: tempfile::tempdir().unwrap(),
            first: OnceLock::new(),
        }
    }

    /// How a further host, or something that is none, joins.
    pub(crate) fn config(&self, host: &str) -> Config {
        let mut config = Config::new(self.name.clone(), HostId::new(host).unwrap());
        config.connect = self.first.get().cloned().unwrap_or_default();
        // A machine that is busy with other tests must not look like a silent host; one that leaves says so at once.
        config.lease_ms = 30_000;
        config
    }

    /// The host that serves ten loops' points, `<name>.<n>.pv|out|load`, and runs controllers where wanted.
    pub(crate) async fn io(&self, name: &str, control: bool) -> Host {
        self.host(name, true, control).await
    }

    /// A host that runs controllers.
    pub(crate) async fn control(&self, name: &str) -> Host {
        self.host(name, false, true).await
    }

    /// As [`Cell::io`], where the host that it connects to is another one.
    pub(crate) async fn joined_by(&self, name: &str, connect: Vec<String>) -> Host {
        let mut config = self.config(name);
        config.connect = connect;
        self.open(config, true, true).await
    }

    async fn host(&self, name: &str, io: bool, control: bool) -> Host {
        self.open(self.config(name), io, control).await
    }

    async fn open(&self, config: Config, io: bool, control: bool) -> Host {
        let name = config.host.as_str();
        let dir = self.disks.path().join(name);
        let store = Store::open(&dir).expect("a store");
        let writer = Arc::new(RecordWriter::start(store.clone()).unwrap());
        let deploy: Arc<Mutex<Option<Deploy>>> = Arc::default();
        let sink = Arc::clone(&deploy);
        let session = Session::open(
            &config,
            Arc::new(move |arrival| {
                let deploy = sink.lock().clone();
                if let Some(deploy) = deploy {
                    deploy.arrive(DeployArrival::Bus(arrival));
                }
            }),
        )
        .await
        .expect("the cell is joined");
        let _ = self.first.set(session.locators());
        let clock = Clock::start();
        let engine = engine();
        let io = io.then(|| {
            let fopdt = bumpless_io::sim::FopdtSettings {
                count: 10,
                ..Default::default()
            };
            let sim = bumpless_io::sim::SimConfig::first_order(bumpless_core::BusId::new(name).unwrap(), fopdt);
            let config = bumpless_io::Config {
                buses: vec![bumpless_io::BusConfig::Sim(sim)],
            };
            Arc::new(IoServer::open(&config, clock, &tokio::runtime::Handle::current()).expect("points"))
        });
        let field = Arc::new(FakeField::new(HostId::new(name).unwrap(), engine.clone()));
        let started = Deploy::start(Parts {
            session: session.clone(),
            store: store.clone(),
            writer: Arc::clone(&writer),
            // Its loops only write down what they are asked.
            cycles: None,
            archive: None,
            history_points: Vec::new(),
            engine,
            roles: Roles {
                io: io.is_some(),
                control,
            },
            io,
            clock,
            field: Arc::clone(&field) as Arc<dyn bumpless_deploy::Field>,
            labels: vec![],
            api: None,
            version: "test".to_owned(),
            audit_bytes_max: 64 * 1024 * 1024,
            webhooks: vec![],
            host_alarms: bumpless_deploy::HostAlarms::default(),
            trust_roots: Vec::new(),
            secured: false,
        })
        .expect("deployment starts");
        *field.deploy.lock() = Some(started.clone());
        *deploy.lock() = Some(started.clone());
        Host {
            deploy: started,
            field,
            session,
            store,
            dir,
            writer,
            sink: deploy,
        }
    }
}

impl Host {
    /// Waits until every one of these is seen as alive.
    pub(crate) async fn sees(&self, names: &[&str]) {
        until(&format!("{names:?} are seen"), || {
            let hosts = self.deploy.hosts();
            names
                .iter()
                .all(|name| hosts.iter().any(|h| h.id.as_str() == *name && h.alive))
                .then_some(())
        })
        .await;
    }

    /// Stops it in order; its disk can be opened again.
    pub(crate) async fn stop(self) {
        let Self {
            deploy,
            field,
            session,
            store,
            dir: _,
            writer,
            sink,
        } = self;
        deploy.shutdown().await;
        // Loops and bus know deployment, which knows them.
        *sink.lock() = None;
        *field.deploy.lock() = None;
        session.close().await;
        drop((deploy, field, store));
        // The tasks that were stopped let go of the rest when they are next polled.
        until("the disk is let go", || (Arc::strong_count(&writer) == 1).then_some(())).await;
        drop(writer);
    }
}

/// Waits until something is so.
pub(crate) async fn until<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    let started = Instant::now();
    loop {
        if let Some(found) = look() {
            return found;
        }
        assert!(started.elapsed() < PATIENCE, "{what}: not within {PATIENCE:?}");
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

/// Takes in a component that misbehaves, by force.
pub(crate) async fn forced(host: &Host, name: &str) -> ComponentInfo {
    let upload = Upload {
        by: "t".to_owned(),
        force: true,
        ..Upload::default()
    };
    host.deploy.take_in(component(name), &upload).await.expect(name)
}

/// A loop on the points of `io`.
pub(crate) fn draft(name: &str, component: &str, io: &str, number: u32) -> LoopDraft {
    LoopDraft {
        name: name.to_owned(),
        component: component.to_owned(),
        period_ms: 100.0,
        ports: BTreeMap::from([
            ("pv".to_owned(), format!("{io}.{number}.pv")),
            ("out".to_owned(), format!("{io}.{number}.out")),
        ]),
        parameters: BTreeMap::new(),
        setpoint: 50.0,
        setpoint_range: None,
        mode: Mode::Automatic,
        strategy: Strategy::RoundRobin,
        replicas: 3,
        limits: BTreeMap::new(),
        listens: Vec::new(),
        fallback: None,
        fallback_parameters: BTreeMap::new(),
        prefer: Vec::new(),
        policy: Policy::default(),
    }
}

pub(crate) fn id(name: &str) -> LoopId {
    LoopId::new(name).unwrap()
}
