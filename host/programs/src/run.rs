//! One run of a program: its surroundings, its last lines, and how it is.
//!
//! Owns: the bounds of what it may say in a second. Never: decides when it begins.

use std::{
    collections::VecDeque,
    sync::Arc,
    time::{Duration, Instant},
};

use bumpless_core::{Digest, Fault, HostId, LogLevel, Message, ProgramId, ProgramSpec, program::Status};
use bumpless_engine::{Answer, Later, ProgramSlot, Question, Reply, Sight, Surroundings, Turn, Usage};
use parking_lot::Mutex;

use crate::{
    exchange::{Exchange, Mailbox},
    gate::Gate,
    share::{Next, Share},
    timer::Timer,
};

/// Lines of a run that are kept, the newest.
const LINES_MAX: usize = 500;
/// Lines in a second; beyond them they are counted and dropped.
const LINES_PER_S_MAX: u32 = 50;
/// Messages in a second that a program may publish; who would send more waits.
const MESSAGES_PER_S_MAX: u32 = 1000;

/// What a program reaches of the cell. Called on the programs' threads; nothing here may block them.
pub trait Reach: Send + Sync {
    /// What a granted point shows, in the point's unit. `slot` counts the grants in order of their names.
    fn read(&self, slot: usize) -> Answer<'_, Sight>;
    /// Writes a granted point, in the point's unit.
    fn write(&self, slot: usize, value: f64) -> Answer<'_, Result<(), String>>;
    /// Tells all hosts, this one too. Never blocks.
    fn publish(&self, message: Message) -> Result<(), String>;
    /// A step of another component.
    fn step(&self, question: Question) -> Later<'_, Result<Reply, Fault>>;
    /// Keeps a checkpoint at the program's home.
    fn save(&self, data: Vec<u8>) -> Later<'_, Result<(), String>>;
}

/// A line that a program wrote.
#[derive(Debug, Clone, PartialEq)]
pub struct Line {
    /// Counts the lines of the run, from 1.
    pub number: u64,
    /// When, in ms since the run began.
    pub at_ms: u64,
    /// How much it matters.
    pub level: LogLevel,
    /// Its text.
    pub text: String,
}

/// How a run is.
#[derive(Debug, Clone, PartialEq)]
pub struct RunView {
    /// The program.
    pub id: ProgramId,
    /// Its component.
    pub digest: Digest,
    /// The host for which it runs.
    pub home: HostId,
    /// Number of the ownership under which it was started.
    pub term: u64,
    /// What it does.
    pub status: Status,
    /// Why it is in fault; empty otherwise.
    pub reason: String,
    /// Processor time so far, in ns.
    pub used_ns: u64,
    /// Linear memory, in bytes.
    pub memory_bytes: u64,
    /// Time since it was started, in ms.
    pub up_ms: u64,
    /// Lines that it wrote, and how many of them were too many.
    pub lines: (u64, u64),
    /// Messages that came and were dropped for newer ones.
    pub messages_dropped: u64,
}

#[derive(Debug, Default)]
struct Log {
    lines: VecDeque<Line>,
    written: u64,
    dropped: u64,
    second: Option<Instant>,
    in_second: u32,
}

#[derive(Debug)]
struct Rate {
    second_ns: u64,
    in_second: u32,
}

/// One run. Shared by the task that polls it and whoever asks how it is.
pub(crate) struct Run {
    pub(crate) spec: ProgramSpec,
    pub(crate) term: u64,
    pub(crate) usage: Arc<Usage>,
    pub(crate) gate: Arc<Gate>,
    slots: Vec<ProgramSlot>,
    reach: Arc<dyn Reach>,
    timer: Timer,
    exchange: Exchange,
    mailbox: Arc<Mailbox>,
    share: Mutex<Share>,
    published: Mutex<Rate>,
    log: Mutex<Log>,
    started: Instant,
    ended: Mutex<Option<Result<(), Fault>>>,
}

impl Run {
    pub(crate) fn new(spec: ProgramSpec, term: u64, reach: Arc<dyn Reach>, timer: Timer, exchange: Exchange) -> Self {
        let slots = spec
            .grants
            .iter()
            .map(|(name, grant)| ProgramSlot {
                name: name.clone(),
                writable: grant.write,
                unit: if grant.raw.is_some() {
                    String::new()
                } else {
                    grant.unit.clone()
                },
            })
            .collect();
        Self {
            share: Mutex::new(Share::new(spec.share_percent, timer.now_ns())),
            spec,
            term,
            usage: Arc::default(),
            gate: Arc::default(),
            slots,
            reach,
            timer,
            exchange,
            mailbox: Arc::default(),
            published: Mutex::new(Rate {
                second_ns: 0,
                in_second: 0,
            }),
            log: Mutex::default(),
            started: Instant::now(),
            ended: Mutex::default(),
        }
    }

    /// It has come to its end; the first word counts.
    pub(crate) fn end(&self, end: Result<(), Fault>) {
        self.exchange.forget(&self.mailbox);
        let mut ended = self.ended.lock();
        if ended.is_none() {
            *ended = Some(end);
        }
    }

    pub(crate) fn view(&self) -> RunView {
        let (status, reason) = match &*self.ended.lock() {
            Some(Ok(())) => (Status::Stopped, String::new()),
            Some(Err(fault)) => (Status::Fault, fault.to_string()),
            None if self.gate.is_shut() => (Status::Paused, String::new()),
            None => (Status::Running, String::new()),
        };
        let log = self.log.lock();
        RunView {
            id: self.spec.id.clone(),
            digest: self.spec.digest,
            home: self.spec.home.clone(),
            term: self.term,
            status,
            reason,
            used_ns: self.usage.used_ns(),
            memory_bytes: self.usage.memory_bytes(),
            up_ms: u64::try_from(self.started.elapsed().as_millis()).unwrap_or(u64::MAX),
            lines: (log.written, log.dropped),
            messages_dropped: self.mailbox.dropped(),
        }
    }

    /// The newest lines after one of that number, oldest first.
    pub(crate) fn lines(&self, after: u64, max: usize) -> Vec<Line> {
        let log = self.log.lock();
        let newer = log.lines.iter().filter(|line| line.number > after);
        let skip = newer.clone().count().saturating_sub(max);
        newer.skip(skip).cloned().collect()
    }

    async fn sleep(&self, time_ns: u64) {
        self.timer.until(time_ns).await;
        self.gate.pass().await;
    }

    /// When the next message may go, in ns; now where it is 0.
    fn publish_at_ns(&self) -> u64 {
        let now_ns = self.timer.now_ns();
        let mut rate = self.published.lock();
        if now_ns.saturating_sub(rate.second_ns) >= 1_000_000_000 {
            *rate = Rate {
                second_ns: now_ns,
                in_second: 0,
            };
        }
        rate.in_second += 1;
        if rate.in_second <= MESSAGES_PER_S_MAX {
            return 0;
        }
        rate.second_ns + 1_000_000_000
    }
}

impl Surroundings for Run {
    fn slots(&self) -> &[ProgramSlot] {
        &self.slots
    }

    fn read(&self, slot: usize) -> Answer<'_, Sight> {
        let scaled = move |mut sight: Sight| {
            if let Some(grant) = self.spec.grants.values().nth(slot).filter(|grant| grant.raw.is_some()) {
                sight.reading.value = sight.reading.value.map(|value| grant.to_program(value));
                sight.reading.last_good = grant.to_program(sight.reading.last_good);
            }
            sight
        };
        match self.reach.read(slot) {
            Answer::Now(sight) => Answer::Now(scaled(sight)),
            Answer::Later(later) => Answer::Later(Box::pin(async move {
                let sight = later.await;
                self.gate.pass().await;
                scaled(sight)
            })),
        }
    }

    fn write(&self, slot: usize, value: f64) -> Answer<'_, Result<(), String>> {
        let Some(grant) = self.spec.grants.values().nth(slot) else {
            return Answer::Now(Err("the point is not granted".to_owned()));
        };
        // The guest may run for another ms.
        if self.gate.has_ended() {
            return Answer::Now(Err("the run has been ended".to_owned()));
        }
        match self.reach.write(slot, grant.to_point(value)) {
            Answer::Now(end) => Answer::Now(end),
            Answer::Later(later) => Answer::Later(Box::pin(async move {
                let end = later.await;
                self.gate.pass().await;
                end
            })),
        }
    }

    fn now_ns(&self) -> u64 {
        self.timer.now_ns()
    }

    fn sleep_until(&self, time_ns: u64) -> Later<'_, ()> {
        Box::pin(self.sleep(time_ns))
    }

    fn publish(&self, message: Message) -> Answer<'_, Result<(), String>> {
        if !self.spec.may_publish(&message.topic) {
            return Answer::Now(Err(format!(
                "the program is not granted to publish on {:?}",
                message.topic
            )));
        }
        if self.gate.has_ended() {
            return Answer::Now(Err("the run has been ended".to_owned()));
        }
        match self.publish_at_ns() {
            0 => Answer::Now(self.reach.publish(message)),
            at_ns => Answer::Later(Box::pin(async move {
                self.sleep(at_ns).await;
                self.reach.publish(message)
            })),
        }
    }

    fn listen(&self, topic: String, depth: usize) -> Result<(), String> {
        if !self.spec.may_listen(&topic) {
            return Err(format!("the program is not granted to listen to {topic:?}"));
        }
        self.exchange.listen(&self.mailbox, topic, depth);
        Ok(())
    }

    fn forget(&self) {
        self.exchange.forget(&self.mailbox);
    }

    fn receive(&self) -> Option<Message> {
        self.mailbox.receive()
    }

    fn wait(&self, timeout_ns: u64) -> Later<'_, Option<Message>> {
        let until_ns = self.timer.now_ns().saturating_add(timeout_ns);
        Box::pin(async move {
            let message = tokio::select! {
                message = self.mailbox.wait() => Some(message),
                () = self.timer.until(until_ns) => None,
            };
            self.gate.pass().await;
            message
        })
    }

    fn step(&self, question: Question) -> Later<'_, Result<Reply, Fault>> {
        let granted = self.spec.components.iter().any(|granted| {
            *granted == question.component || question.component.split('@').next() == Some(granted.as_str())
        });
        if !granted {
            let refused = Fault::Failed(format!(
                "the program is not granted to ask {} for steps",
                question.component.chars().take(64).collect::<String>()
            ));
            return Box::pin(std::future::ready(Err(refused)));
        }
        Box::pin(async move {
            let end = self.reach.step(question).await;
            self.gate.pass().await;
            end
        })
    }

    fn save(&self, data: Vec<u8>) -> Later<'_, Result<(), String>> {
        Box::pin(async move {
            let end = self.reach.save(data).await;
            self.gate.pass().await;
            end
        })
    }

    fn log(&self, level: LogLevel, text: String) {
        let mut log = self.log.lock();
        log.written += 1;
        if log.second.is_none_or(|from| from.elapsed() >= Duration::from_secs(1)) {
            log.second = Some(Instant::now());
            log.in_second = 0;
        }
        log.in_second += 1;
        if log.in_second > LINES_PER_S_MAX {
            log.dropped += 1;
            return;
        }
        if log.lines.len() >= LINES_MAX {
            log.lines.pop_front();
        }
        let number = log.written;
        log.lines.push_back(Line {
            number,
            at_ms: u64::try_from(self.started.elapsed().as_millis()).unwrap_or(u64::MAX),
            level,
            text,
        });
    }

    fn turn(&self, used_ns: u64) -> Turn {
        if self.gate.has_ended() {
            // The task drops the run at its next look; it only has to come to one.
            return Turn::Wait(Box::pin(tokio::task::yield_now()));
        }
        if self.gate.is_shut() {
            let gate = Arc::clone(&self.gate);
            return Turn::Wait(Box::pin(async move { gate.pass().await }));
        }
        match self.share.lock().next(self.timer.now_ns(), used_ns) {
            Next::Go => Turn::Go,
            Next::Yield => Turn::Wait(Box::pin(tokio::task::yield_now())),
            Next::At(at_ns) => Turn::Wait(Box::pin(self.timer.until(at_ns))),
        }
    }
}
