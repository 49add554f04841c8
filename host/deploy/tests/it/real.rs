//! The same facade over real loops: cycles run, records are taken, a swap goes through the arbiter.

use std::{collections::BTreeMap, sync::Arc};

use bumpless_cell::{Roles, Session};
use bumpless_core::{BusId, CommandBody, HostId, Record};
use bumpless_deploy::{Change, Deploy, DeployArrival, Error, Parts};
use bumpless_io::{Clock, IoServer};
use bumpless_loops::{Loops, LoopsEvent};
use bumpless_store::{CycleLog, RecordWriter, Store};
use parking_lot::Mutex;

use crate::harness::{Cell, component, draft, engine, id, until};

type Slot<T> = Arc<Mutex<Option<T>>>;

pub(crate) struct Real {
    pub(crate) deploy: Deploy,
    pub(crate) loops: Loops,
    session: Session,
    writer: Arc<RecordWriter>,
    pub(crate) cycles: Arc<CycleLog>,
    slots: (Slot<Deploy>, Slot<Loops>),
    /// The first record that was taken.
    first: Slot<Arc<Record>>,
}

impl Real {
    pub(crate) async fn stop(self) {
        let Self {
            deploy,
            loops,
            session,
            writer,
            cycles,
            slots,
            first: _,
        } = self;
        deploy.shutdown().await;
        tokio::task::spawn_blocking(move || loops.stop()).await.unwrap();
        session.close().await;
        // Loops and bus know deployment, which knows them.
        *slots.0.lock() = None;
        *slots.1.lock() = None;
        drop((deploy, slots));
        let alone = || Arc::strong_count(&writer) == 1 && Arc::strong_count(&cycles) == 1;
        until("the disk is let go", || alone().then_some(())).await;
    }
}

/// One host that serves points and runs controllers.
pub(crate) async fn host(cell: &Cell, dir: &std::path::Path) -> Real {
    let slot: Slot<Deploy> = Arc::default();
    let loops_slot: Slot<Loops> = Arc::default();
    let (deploy, loops) = (Arc::clone(&slot), Arc::clone(&loops_slot));
    let sink = Arc::new(move |arrival| {
        let left = loops.lock().clone().and_then(|loops| loops.arrive(arrival));
        if let (Some(left), Some(deploy)) = (left, deploy.lock().clone()) {
            deploy.arrive(DeployArrival::Bus(left));
        }
    });
    let session = Session::open(&cell.config("io"), sink).await.unwrap();
    let (clock, engine, here) = (Clock::start(), engine(), HostId::new("io").unwrap());
    let sim =
        bumpless_io::sim::SimConfig::first_order(BusId::new("io").unwrap(), bumpless_io::sim::FopdtSettings::default());
    let config = bumpless_io::Config {
        buses: vec![bumpless_io::BusConfig::Sim(sim)],
    };
    let io = Arc::new(IoServer::open(&config, clock, &tokio::runtime::Handle::current()).unwrap());
    let deploy = Arc::clone(&slot);
    let first: Slot<Arc<Record>> = Arc::default();
    let taken = Arc::clone(&first);
    let events = Arc::new(move |event| {
        if let LoopsEvent::Record(record) = &event {
            taken.lock().get_or_insert_with(|| Arc::clone(record));
        }
        if let Some(deploy) = deploy.lock().clone() {
            deploy.arrive(DeployArrival::Loops(event));
        }
    });
    let config = bumpless_loops::Config {
        workers: 2,
        ..bumpless_loops::Config::default()
    };
    let wire = Arc::new(session.clone());
    let loops = Loops::start(
        &config,
        here,
        clock,
        Some(Arc::clone(&io)),
        engine.clone(),
        wire,
        events,
    )
    .unwrap();
    *loops_slot.lock() = Some(loops.clone());
    let store = Store::open(dir).unwrap();
    let writer = Arc::new(RecordWriter::start(store.clone()).unwrap());
    let cycles = Arc::new(CycleLog::open(&store, 16 * 1024 * 1024, u64::MAX).unwrap());
    let deploy = Deploy::start(Parts {
        session: session.clone(),
        writer: Arc::clone(&writer),
        cycles: Some(Arc::clone(&cycles)),
        archive: None,
        history_points: Vec::new(),
        store,
        engine,
        io: Some(io),
        clock,
        field: Arc::new(loops.clone()),
        roles: Roles {
            io: true,
            control: true,
        },
        api: None,
        labels: vec![],
        version: "test".to_owned(),
        audit_bytes_max: 64 * 1024 * 1024,
        webhooks: vec![],
        host_alarms: bumpless_deploy::HostAlarms::default(),
        trust_roots: Vec::new(),
        secured: false,
    })
    .unwrap();
    *slot.lock() = Some(deploy.clone());
    Real {
        deploy,
        loops,
        session,
        writer,
        cycles,
        slots: (slot, loops_slot),
        first,
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_loop_runs_is_commanded_changed_swapped_and_deleted() {
    let (cell, disk) = (Cell::new(), tempfile::tempdir().unwrap());
    let real = host(&cell, &disk.path().join("io")).await;
    let (deploy, loops) = (&real.deploy, &real.loops);
    for name in ["pid", "pidplus", "on-off"] {
        deploy.upload(component(name), "t", "").await.unwrap();
    }
    let mut first = draft("l", "pid", "io", 0);
    first.parameters = BTreeMap::from([("ti".to_owned(), 5.0)]);
    let end = deploy.apply(first).await.unwrap();
    assert!(end.created);
    let l = id("l");
    let last = || deploy.loop_view(&l).unwrap().last;
    until("cycles run", || last().filter(|r| r.seq > 5)).await;
    let end = deploy.command(&l, None, CommandBody::Setpoint(60.0)).await.unwrap();
    assert_eq!(end.setpoint, 60.0);
    let error = deploy
        .command(&l, None, CommandBody::Setpoint(600.0))
        .await
        .expect_err("outside its range");
    assert!(matches!(error, Error::Refused(_)), "{error:?}");
    let change = Change {
        parameters: BTreeMap::from([("k".to_owned(), 0.5)]),
        strategy: None,
    };
    let end = deploy.set(&l, change).await.unwrap();
    assert_eq!(end.revision, 2);
    assert_eq!(last().unwrap().setpoint, 60.0, "a change keeps what the operator set");
    let end = deploy.swap(&l, "pidplus").await.unwrap();
    let hand_over = end.hand_over.expect("a hand-over");
    assert!(hand_over.bump_percent <= 5.0, "{hand_over:?}");
    let swapped = until("the new component steps", || {
        last().filter(|r| r.revision == end.revision)
    })
    .await;
    assert_eq!(swapped.digest, deploy.resolve("pidplus").unwrap().digest);
    // Full on or full off is further than the loop's bump limit allows; the old component goes on.
    let error = deploy.swap(&l, "on-off").await.expect_err("a bump");
    assert!(
        matches!(&error, Error::Refused(w) if w.cure.contains("stays in force")),
        "{error:?}"
    );
    assert_eq!(deploy.loop_view(&l).unwrap().spec.revision, end.revision);
    let call = bumpless_deploy::Call {
        component: "pid".to_owned(),
        strategy: bumpless_core::Strategy::RoundRobin,
        parameters: BTreeMap::new(),
        state: None,
        track: BTreeMap::from([("out".to_owned(), 40.0)]),
        inputs: BTreeMap::from([("pv".to_owned(), 50.0)]),
        setpoint: 50.0,
        mode: bumpless_core::Mode::Automatic,
        dt_ns: 100_000_000,
        seq: 1,
    };
    assert!((deploy.call(call).await.unwrap().outputs["out"] - 40.0).abs() < 1e-6);
    deploy.delete(&l).await.unwrap();
    assert!(deploy.loops().is_empty() && loops.home_view(&l).is_none());
    real.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_loop_goes_on_after_a_restart_of_everything() {
    let (cell, disk) = (Cell::new(), tempfile::tempdir().unwrap());
    let real = host(&cell, &disk.path().join("io")).await;
    real.deploy.upload(component("pid"), "t", "").await.unwrap();
    real.deploy.apply(draft("l", "pid", "io", 0)).await.unwrap();
    let l = id("l");
    let end = real
        .deploy
        .command(&l, None, CommandBody::Setpoint(60.0))
        .await
        .unwrap();
    real.stop().await;
    let before = Store::open(&disk.path().join("io"))
        .unwrap()
        .last_record(&l)
        .unwrap()
        .expect("a record");
    assert!(before.position() >= end.position);

    let real = host(&cell, &disk.path().join("io")).await;
    let after = until("a cycle runs", || real.first.lock().clone()).await;
    // The same cell goes on from the very record that the actuator saw last, with what the operator had set.
    assert_eq!((after.after, after.setpoint), (before.position(), 60.0));
    assert!(
        after.term > before.term && after.seq > before.seq,
        "{:?}",
        after.position()
    );
    let again = real
        .deploy
        .command(&l, Some(end.applied.id), CommandBody::Setpoint(60.0))
        .await
        .unwrap();
    assert_eq!(again.applied, end.applied, "and with the outcomes of its commands");
    real.stop().await;
}
