//! The jobs of a host: one bounded queue per bus, and what is told of each job.
//!
//! Never: runs a job, or forgets one that waits or runs.

use std::{
    collections::{BTreeMap, HashMap, VecDeque},
    sync::Arc,
    time::Duration,
};

use bumpless_core::HostId;
use bumpless_io::{Clock, JobStep, scan::ScanPlan};
use parking_lot::Mutex;
use tokio::{
    sync::{Notify, watch},
    time::Instant,
};

use super::{JobDraft, JobState, JobView};
use crate::{
    error::Error,
    limits::{JOBS_KEPT_MAX, JOBS_PER_START_MAX, JOBS_WAITING_MAX},
};

/// What it does, resolved.
#[derive(Debug)]
pub(super) enum Work {
    Steps(Vec<JobStep>, u8),
    Scan(ScanPlan),
}

/// One job.
#[derive(Debug)]
pub(super) struct Job {
    pub(super) number: u64,
    pub(super) draft: JobDraft,
    pub(super) work: Work,
    pub(super) time: Duration,
    pub(super) queue_until: Instant,
    pub(super) view: Mutex<JobView>,
    /// Who cancelled it.
    pub(super) cancelled: watch::Sender<Option<String>>,
}

/// How a job was taken in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Taken {
    /// It was there already.
    Known,
    /// It waits, and the bus has a task that works its queue off.
    Queued,
    /// It waits, and the bus needs such a task.
    Idle,
}

#[derive(Debug, Default)]
pub(super) struct Inside {
    taken: u64,
    jobs: BTreeMap<u64, Arc<Job>>,
    /// Those that wait, by bus. A bus with an entry has a task that works it off.
    queues: HashMap<String, VecDeque<u64>>,
    running: HashMap<String, u64>,
}

/// The jobs of this host.
#[derive(Debug)]
pub(crate) struct Jobs {
    /// Number of this start of the host: numbers of jobs never come twice.
    start: u64,
    clock: Clock,
    pub(super) inside: Mutex<Inside>,
    /// Wakes whoever looks after those that wait too long.
    pub(super) waits: Notify,
}

impl Jobs {
    pub(in crate::commissioning) fn new(start: u64, clock: Clock) -> Self {
        Self {
            start,
            clock,
            inside: Mutex::default(),
            waits: Notify::new(),
        }
    }

    /// All that are known, oldest first, without their results.
    pub(in crate::commissioning) fn all(&self) -> Vec<JobView> {
        let inside = self.inside.lock();
        inside.jobs.values().map(|job| inside.view(job, false)).collect()
    }

    /// Jobs of a bus that wait or run.
    pub(in crate::commissioning) fn waiting(&self, bus: &str) -> u32 {
        let inside = self.inside.lock();
        let queued = inside.queues.get(bus).map_or(0, VecDeque::len);
        (queued + usize::from(inside.running.contains_key(bus))) as u32
    }

    pub(super) fn get(&self, number: u64) -> Option<Arc<Job>> {
        self.inside.lock().jobs.get(&number).cloned()
    }

    /// Puts a job into its bus's queue, or finds the one that was taken in for the same key. One lock from the look at the
    /// bound to the place in the queue: many clients at once do not pass it together.
    pub(super) fn take(
        &self,
        here: &HostId,
        draft: JobDraft,
        work: Work,
        time: Duration,
    ) -> Result<(Arc<Job>, Taken), Error> {
        let mut inside = self.inside.lock();
        if let Some(key) = &draft.key
            && let Some(known) = inside.jobs.values().find(|job| job.draft.key.as_ref() == Some(key))
        {
            if known.draft.bus == draft.bus && known.draft.task == draft.task {
                return Ok((Arc::clone(known), Taken::Known));
            }
            return Err(Error::refused(
                format!("the key {key:?} was given to another job, {}", known.view.lock().id),
                "give each wish a key of its own",
            ));
        }
        let waiting = inside.queues.get(&draft.bus).map_or(0, VecDeque::len);
        if waiting >= JOBS_WAITING_MAX {
            return Err(Error::busy(
                format!("{waiting} jobs wait for bus {}", draft.bus),
                "wait for their ends, or cancel one",
            ));
        }
        if inside.taken >= JOBS_PER_START_MAX {
            return Err(Error::busy(
                "this host has used up its numbers for jobs",
                "restart it when it suits the plant",
            ));
        }
        inside.taken += 1;
        let number = self
            .start
            .saturating_mul(JOBS_PER_START_MAX + 1)
            .saturating_add(inside.taken);
        let steps = match &work {
            Work::Steps(steps, _) => steps.len(),
            Work::Scan(plan) => plan.units.len(),
        };
        let view = JobView {
            id: format!("{here}.{number}"),
            host: here.clone(),
            bus: draft.bus.clone(),
            task: draft.task.name().to_owned(),
            by: draft.by.clone(),
            key: draft.key.clone(),
            state: JobState::Queued,
            ahead: 0,
            step: 0,
            steps: steps as u32,
            reason: String::new(),
            result: Vec::new(),
            asked_unix_ms: self.clock.unix_ms(),
            began_unix_ms: None,
            ended_unix_ms: None,
        };
        let job = Arc::new(Job {
            number,
            work,
            time,
            queue_until: Instant::now() + Duration::from_millis(draft.queue_ms),
            view: Mutex::new(view),
            cancelled: watch::Sender::new(None),
            draft,
        });
        inside.jobs.insert(number, Arc::clone(&job));
        while inside.jobs.len() > JOBS_KEPT_MAX {
            // Those that wait or run are bounded by their queues, far below what is kept.
            let ended = inside
                .jobs
                .values()
                .find(|job| job.view.lock().state.ended())
                .map(|job| job.number);
            match ended {
                Some(oldest) => inside.jobs.remove(&oldest),
                None => break,
            };
        }
        let idle = !inside.queues.contains_key(&job.draft.bus);
        inside
            .queues
            .entry(job.draft.bus.clone())
            .or_default()
            .push_back(number);
        drop(inside);
        self.waits.notify_one();
        Ok((job, if idle { Taken::Idle } else { Taken::Queued }))
    }

    /// When the next of those that wait will have waited too long; none where none waits.
    pub(super) fn next_over(&self) -> Option<Instant> {
        let inside = self.inside.lock();
        let waiting = inside.queues.values().flatten();
        waiting
            .filter_map(|number| inside.jobs.get(number).map(|job| job.queue_until))
            .min()
    }

    /// Takes those out that have waited too long.
    pub(super) fn take_over(&self, now: Instant) -> Vec<Arc<Job>> {
        let late: Vec<Arc<Job>> = {
            let inside = self.inside.lock();
            let waiting = inside.queues.values().flatten();
            waiting
                .filter_map(|number| inside.jobs.get(number).filter(|job| job.queue_until <= now).cloned())
                .collect()
        };
        let reason = "its turn did not come in time; nothing was sent";
        late.into_iter()
            .filter(|job| self.drop_queued(job, JobState::Expired, reason))
            .collect()
    }

    /// The next job of a bus, which runs from now on; none where the queue is empty: its task ends then.
    pub(super) fn next(&self, bus: &str) -> Option<Arc<Job>> {
        let mut inside = self.inside.lock();
        inside.running.remove(bus);
        loop {
            let next = inside.queues.get_mut(bus).and_then(VecDeque::pop_front);
            let Some(number) = next else {
                inside.queues.remove(bus);
                return None;
            };
            let Some(job) = inside.jobs.get(&number).cloned() else {
                continue;
            };
            let mut view = job.view.lock();
            if view.state != JobState::Queued {
                continue;
            }
            view.state = JobState::Running;
            view.began_unix_ms = Some(self.clock.unix_ms());
            drop(view);
            inside.running.insert(bus.to_owned(), number);
            return Some(job);
        }
    }

    /// Takes a job that waits out of its queue, with how it ended. False where it waits no more.
    pub(super) fn drop_queued(&self, job: &Job, state: JobState, reason: &str) -> bool {
        let mut inside = self.inside.lock();
        let mut view = job.view.lock();
        if view.state != JobState::Queued {
            return false;
        }
        view.state = state;
        reason.clone_into(&mut view.reason);
        view.ended_unix_ms = Some(self.clock.unix_ms());
        drop(view);
        if let Some(queue) = inside.queues.get_mut(&job.draft.bus) {
            queue.retain(|number| *number != job.number);
        }
        true
    }
}

impl Inside {
    pub(super) fn view(&self, job: &Job, with_result: bool) -> JobView {
        let view = job.view.lock();
        let mut shown = JobView {
            result: if with_result { view.result.clone() } else { Vec::new() },
            ..JobView {
                result: Vec::new(),
                ..view.clone()
            }
        };
        if shown.state == JobState::Queued {
            let queue = self.queues.get(&job.draft.bus);
            let place = queue.and_then(|queue| queue.iter().position(|number| *number == job.number));
            shown.ahead = place.unwrap_or(0) as u32 + u32::from(self.running.contains_key(&job.draft.bus));
        }
        shown
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]
    use super::*;
    use crate::commissioning::jobs::JobTask;

    fn draft(bus: &str, key: Option<&str>) -> JobDraft {
        JobDraft {
            host: None,
            bus: bus.to_owned(),
            task: JobTask::Named("x".to_owned()),
            key: key.map(str::to_owned),
            by: "ann".to_owned(),
            queue_ms: 1_000,
            timeout_ms: None,
        }
    }

    fn take(jobs: &Jobs, draft: JobDraft) -> Result<(Arc<Job>, Taken), Error> {
        let here = HostId::new("plant").unwrap();
        jobs.take(
            &here,
            draft,
            Work::Steps(vec![JobStep::Wait { ms: 1 }], 1),
            Duration::from_secs(1),
        )
    }

    #[test]
    fn many_clients_at_once_do_not_pass_the_bound_together() {
        let jobs = Jobs::new(1, Clock::start());
        let begin = std::sync::Barrier::new(8);
        let taken: usize = std::thread::scope(|scope| {
            let client = || {
                begin.wait();
                (0..JOBS_WAITING_MAX)
                    .filter(|_| take(&jobs, draft("a", None)).is_ok())
                    .count()
            };
            let clients: Vec<_> = (0..8).map(|_| scope.spawn(client)).collect();
            clients.into_iter().map(|client| client.join().unwrap()).sum()
        });
        assert_eq!(
            (taken, jobs.waiting("a") as usize),
            (JOBS_WAITING_MAX, JOBS_WAITING_MAX)
        );
    }

    #[test]
    fn those_that_waited_too_long_go_and_nothing_else_holds_them() {
        let jobs = Jobs::new(1, Clock::start());
        let (first, how) = take(&jobs, draft("a", None)).unwrap();
        assert_eq!(how, Taken::Idle);
        let (second, how) = take(
            &jobs,
            JobDraft {
                queue_ms: 60_000,
                ..draft("a", None)
            },
        )
        .unwrap();
        assert_eq!(how, Taken::Queued);
        assert_eq!(jobs.next_over(), Some(first.queue_until));
        assert!(jobs.take_over(Instant::now()).is_empty());
        let over = jobs.take_over(first.queue_until);
        assert_eq!(over.iter().map(|job| job.number).collect::<Vec<_>>(), [first.number]);
        assert_eq!(first.view.lock().state, JobState::Expired);
        assert_eq!(jobs.next_over(), Some(second.queue_until));
        jobs.drop_queued(&second, JobState::Cancelled, "");
        assert_eq!(jobs.next_over(), None);
        // The list of what is kept, this test, and no sleeper.
        drop(over);
        assert_eq!((Arc::strong_count(&first), Arc::strong_count(&second)), (2, 2));
    }

    #[test]
    fn queues_are_bounded_per_bus_and_keys_make_twice_once() {
        let jobs = Jobs::new(7, Clock::start());
        let (first, new) = take(&jobs, draft("a", Some("k"))).unwrap();
        assert!(new == Taken::Idle && first.number == 7_000_008, "{}", first.number);
        let (again, new) = take(&jobs, draft("a", Some("k"))).unwrap();
        assert!(new == Taken::Known && again.number == first.number);
        let other = JobDraft {
            task: JobTask::Named("y".to_owned()),
            ..draft("a", Some("k"))
        };
        let error = take(&jobs, other).map(drop).expect_err("another job").to_string();
        assert!(error.contains("was given to another job, plant.7000008"), "{error}");
        for _ in 1..JOBS_WAITING_MAX {
            take(&jobs, draft("a", None)).unwrap();
        }
        let error = take(&jobs, draft("a", None)).map(drop).expect_err("full");
        assert!(matches!(error, Error::Busy(_)), "{error}");
        take(&jobs, draft("b", None)).expect("another bus has its own queue");
        assert_eq!(
            (jobs.waiting("a"), jobs.waiting("b"), jobs.waiting("c")),
            (JOBS_WAITING_MAX as u32, 1, 0)
        );
    }

    #[test]
    fn one_after_the_other_and_those_that_went_are_passed_over() {
        let jobs = Jobs::new(1, Clock::start());
        let taken: Vec<_> = (0..3).map(|_| take(&jobs, draft("a", None)).unwrap().0).collect();
        let ahead = || jobs.all().iter().map(|view| view.ahead).collect::<Vec<_>>();
        assert_eq!(ahead(), [0, 1, 2]);
        assert_eq!(jobs.next("a").unwrap().number, taken[0].number);
        assert_eq!(ahead(), [0, 1, 2], "the one that runs counts");
        assert!(jobs.drop_queued(&taken[1], JobState::Cancelled, "no"));
        assert!(!jobs.drop_queued(&taken[1], JobState::Expired, "no"), "once");
        assert!(!jobs.drop_queued(&taken[0], JobState::Expired, "no"), "it runs");
        assert_eq!(jobs.next("a").unwrap().number, taken[2].number);
        assert!(jobs.next("a").is_none() && jobs.waiting("a") == 0);
    }

    #[test]
    fn what_is_kept_is_bounded_and_the_oldest_that_ended_goes() {
        let jobs = Jobs::new(1, Clock::start());
        let (waits, _) = take(&jobs, draft("b", None)).unwrap();
        for _ in 0..JOBS_KEPT_MAX {
            let (job, _) = take(&jobs, draft("a", None)).unwrap();
            jobs.drop_queued(&job, JobState::Cancelled, "");
        }
        assert_eq!(jobs.all().len(), JOBS_KEPT_MAX);
        assert!(jobs.get(waits.number).is_some());
    }
}
