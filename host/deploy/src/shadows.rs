//! Shadows: candidates that follow running loops, here at their home, which sees every record in its order.
//!
//! Owns: the list of shadows, and a thread for each that runs. A shadow survives the death of any owner; it ends with its
//! cycles, its loop, another component of its loop, or its home.
//! Never: holds up a cycle. A record is put into a bounded queue without waiting and without waking anybody; what does not
//! fit is counted, and the candidate begins anew after the gap.
//!
//! ```text
//! following ── all its cycles seen | the loop swapped, rolled back or deleted | stopped ──► ended, kept for a while
//! ```

use std::{
    collections::VecDeque,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    time::Duration,
};

use bumpless_core::{Digest, LoopId, Record};
use parking_lot::{Mutex, RwLock};

use crate::{
    aside::aside,
    error::Error,
    rehearsal::Rehearsal,
    report::{ShadowView, TrialReport},
};

/// Shadows that follow loops at one home at a time. Each steps a component as often as its loop does.
pub(crate) const SHADOWS_MAX: usize = 4;

/// Ended shadows that are kept to be looked at: some 200 KB each.
const ENDED_KEPT_MAX: usize = 16;

/// Records that wait for a shadow: a second of a loop at 1 kHz.
const QUEUE_MAX: usize = 1024;

/// How often a shadow looks for records. It is not woken, because to wake costs the waker a system call.
const LOOK_EVERY: Duration = Duration::from_millis(20);

/// Records on their way to a shadow. The cycle's thread looks once whether the lock is free and never waits for it: whoever has
/// it runs at the lowest priority, and a channel's way of waiting, to yield and look again, would never let that one run.
type Queue = Mutex<VecDeque<Arc<Record>>>;

/// What a shadow found.
enum Desk {
    Following(Box<Rehearsal>),
    Ended {
        reason: String,
        complete: bool,
        report: Box<TrialReport>,
    },
}

impl Desk {
    /// Ends it, and lets go of the candidate.
    fn end(&mut self, reason: &str, complete: bool) {
        if let Self::Following(rehearsal) = self {
            let report = Box::new(rehearsal.report());
            *self = Self::Ended {
                reason: reason.to_owned(),
                complete,
                report,
            };
        }
    }
}

struct Shadow {
    id: u64,
    loop_id: LoopId,
    cycles_wanted: u64,
    started_at_unix_ms: u64,
    missed: Arc<AtomicU64>,
    running: Arc<AtomicBool>,
    desk: Arc<Mutex<Desk>>,
}

/// The way of records to one shadow. Its thread ends when the last copy is gone.
#[derive(Clone)]
struct Route {
    id: u64,
    loop_id: LoopId,
    queue: Arc<Queue>,
    missed: Arc<AtomicU64>,
    running: Arc<AtomicBool>,
}

impl Shadow {
    fn view(&self, with_points: bool) -> ShadowView {
        let desk = self.desk.lock();
        let (ended, complete, mut report) = match &*desk {
            Desk::Following(rehearsal) => (None, false, rehearsal.report()),
            Desk::Ended {
                reason,
                complete,
                report,
            } => (Some(reason.clone()), *complete, (**report).clone()),
        };
        drop(desk);
        if !with_points {
            report.points.clear();
        }
        ShadowView {
            id: self.id,
            cycles_wanted: self.cycles_wanted,
            missed: self.missed.load(Ordering::Relaxed),
            started_at_unix_ms: self.started_at_unix_ms,
            ended,
            complete,
            report,
        }
    }
}

/// The shadows of one home.
#[derive(Default)]
pub(crate) struct Shadows {
    /// What a record's passage looks at. Apart from `all`, which is held while somebody waits for a step; this is held for
    /// as long as a pointer is copied.
    routes: RwLock<Arc<Vec<Route>>>,
    all: Mutex<Vec<Shadow>>,
    ids: AtomicU64,
}

impl Shadows {
    /// A record was taken. Never waits.
    pub(crate) fn pass(&self, record: &Arc<Record>) {
        let routes = Arc::clone(&self.routes.read());
        for route in routes.iter().filter(|route| route.loop_id == record.loop_id) {
            let queue = route.queue.try_lock().filter(|queue| queue.len() < QUEUE_MAX);
            let passed = queue.map(|mut queue| queue.push_back(Arc::clone(record))).is_some();
            if !passed && route.running.load(Ordering::Relaxed) {
                route.missed.fetch_add(1, Ordering::Relaxed);
            }
        }
    }

    /// Keeps the routes for which `keep` holds, and adds some. The caller has `all`, so that one does this at a time.
    fn reroute(&self, keep: impl Fn(&Route) -> bool, more: Option<Route>) {
        let kept = self
            .routes
            .read()
            .iter()
            .filter(|route| keep(route))
            .cloned()
            .chain(more)
            .collect();
        let old = std::mem::replace(&mut *self.routes.write(), Arc::new(kept));
        drop(old);
    }

    /// Lets a candidate follow a loop that runs component `recorded`, for so many cycles. `at_unix_ms` is now, for people.
    pub(crate) fn start(
        &self,
        rehearsal: Rehearsal,
        loop_id: LoopId,
        recorded: Digest,
        cycles: u64,
        at_unix_ms: u64,
    ) -> Result<ShadowView, Error> {
        let mut all = self.all.lock();
        let following = all
            .iter()
            // As it is shown: its thread may still be on its way out when the view already says that it ended.
            .filter(|shadow| shadow.view(false).ended.is_none())
            .count();
        if following >= SHADOWS_MAX {
            return Err(Error::busy(
                format!("{following} shadows follow loops of this home already, the most there may be"),
                "stop one, or wait for its end",
            ));
        }
        let queue = Arc::new(Queue::default());
        let records = Arc::clone(&queue);
        let shadow = Shadow {
            id: self.ids.fetch_add(1, Ordering::Relaxed) + 1,
            loop_id,
            cycles_wanted: cycles,
            started_at_unix_ms: at_unix_ms,
            missed: Arc::default(),
            running: Arc::new(AtomicBool::new(true)),
            desk: Arc::new(Mutex::new(Desk::Following(Box::new(rehearsal)))),
        };
        let (desk, running) = (Arc::clone(&shadow.desk), Arc::clone(&shadow.running));
        aside("shadow", move || {
            follow(&records, &desk, recorded, cycles);
            running.store(false, Ordering::Release);
        })?;
        let route = Route {
            id: shadow.id,
            loop_id: shadow.loop_id.clone(),
            queue,
            missed: Arc::clone(&shadow.missed),
            running: Arc::clone(&shadow.running),
        };
        self.reroute(|route| route.running.load(Ordering::Acquire), Some(route));
        let view = shadow.view(false);
        all.push(shadow);
        let ended = |shadow: &&Shadow| shadow.view(false).ended.is_some();
        let ended: Vec<u64> = all.iter().filter(ended).map(|shadow| shadow.id).collect();
        let extra = ended.len().saturating_sub(ENDED_KEPT_MAX);
        all.retain(|shadow| !ended.iter().take(extra).any(|id| *id == shadow.id));
        Ok(view)
    }

    /// The shadows of a loop, oldest first, without their points.
    pub(crate) fn list(&self, loop_id: &LoopId) -> Vec<ShadowView> {
        let of_loop = |shadow: &&Shadow| shadow.loop_id == *loop_id;
        self.all
            .lock()
            .iter()
            .filter(of_loop)
            .map(|shadow| shadow.view(false))
            .collect()
    }

    /// One shadow with its points.
    pub(crate) fn show(&self, loop_id: &LoopId, id: u64) -> Result<ShadowView, Error> {
        let all = self.all.lock();
        let found = all.iter().find(|shadow| shadow.loop_id == *loop_id && shadow.id == id);
        found
            .map(|shadow| shadow.view(true))
            .ok_or_else(|| missing(loop_id, id))
    }

    /// Ends a shadow that follows, and gives what it found; one that has ended is forgotten.
    pub(crate) fn stop(&self, loop_id: &LoopId, id: u64) -> Result<ShadowView, Error> {
        let mut all = self.all.lock();
        let place = all
            .iter()
            .position(|shadow| shadow.loop_id == *loop_id && shadow.id == id);
        let Some(shadow) = place.and_then(|place| all.get_mut(place)) else {
            return Err(missing(loop_id, id));
        };
        let ended = shadow.view(true).ended.is_some();
        self.reroute(|route| route.id != id, None);
        shadow.desk.lock().end("it was stopped", false);
        let view = shadow.view(true);
        if ended {
            all.retain(|shadow| shadow.id != id);
        }
        Ok(view)
    }

    /// A loop was removed: its shadows end, and are forgotten with it.
    pub(crate) fn forget(&self, loop_id: &LoopId) {
        let mut all = self.all.lock();
        self.reroute(|route| route.loop_id != *loop_id, None);
        all.retain(|shadow| shadow.loop_id != *loop_id);
    }

    /// The home stops.
    pub(crate) fn close(&self) {
        let mut all = self.all.lock();
        self.reroute(|_| false, None);
        all.clear();
    }
}

fn missing(loop_id: &LoopId, id: u64) -> Error {
    Error::not_found(
        format!("loop {loop_id} has no shadow {id}"),
        "list its shadows; those that ended are kept only for a while, and not over a restart of the loop's home",
    )
}

/// A shadow's life.
fn follow(records: &Arc<Queue>, desk: &Mutex<Desk>, recorded: Digest, cycles: u64) {
    // All at once, so that the lock is held for the time of a swap.
    let mut taken = VecDeque::new();
    loop {
        let Some(record) = taken.pop_front() else {
            // Before the look, so that nothing comes between.
            let alone = Arc::strong_count(records) == 1;
            std::mem::swap(&mut taken, &mut *records.lock());
            if taken.is_empty() && alone {
                return desk
                    .lock()
                    .end("its loop was deleted, or the loop's home stopped", false);
            }
            if taken.is_empty() {
                std::thread::sleep(LOOK_EVERY);
            }
            continue;
        };
        // Taken per record, so that whoever looks at it waits for one step at most.
        let mut desk = desk.lock();
        let Desk::Following(rehearsal) = &mut *desk else { return };
        if record.digest != recorded {
            return desk.end("its loop went on with another component", false);
        }
        rehearsal.take(&record);
        if rehearsal.cycles() >= cycles {
            return desk.end("it saw all its cycles", true);
        }
    }
}
