//! The task of one Modbus address: it owns the connection, polls the groups and sends the writes.
//!
//! ```text
//! connecting ──► serving ──lost, timed out──► waiting (doubling, with spread) ──► connecting
//!     └──failed──► waiting        └──stop──► last writes ──► ended
//! ```
//!
//! One request at a time, because many devices bear no more; writes go before polls. A unit that does not answer behind
//! a gateway is left alone for a growing while, so that the others keep their pace. After a time-out the connection is
//! closed: a late answer must not be taken for the next one's.
//!
//! Never: blocks a thread, or touches another bus.

use std::{borrow::Cow, collections::HashMap, sync::Arc, time::Duration};

use bumpless_core::{NoData, Quality};
use tokio::{
    net::TcpStream,
    sync::{mpsc, watch},
    time::{Instant, timeout},
};
use tokio_modbus::{
    ExceptionCode, Request, Response, Slave,
    client::{Client, Context, tcp},
    slave::SlaveContext,
};

use super::{
    WriteWith,
    backoff::Backoff,
    driver::Shared,
    group::{Group, Item, Table},
    outbox::{Wish, encoded},
    wire::Wire,
};
use crate::{
    config::OnStop,
    errand::{Errand, ErrandError, Posted},
    limits::{BITS_PER_WRITE_MAX, REGISTERS_PER_WRITE_MAX},
};

/// A group and when it is due.
#[derive(Debug)]
struct Poll {
    group: Group,
    due: Instant,
}

/// How a request went wrong.
#[derive(Debug)]
enum Failure {
    /// The device answered with an exception; the connection is sound.
    Exception(u8),
    /// No answer in time; the connection is no longer to be trusted.
    TimedOut,
    /// The connection is gone, or the answer made no sense.
    Lost(String),
}

/// How a connection ended.
enum End {
    Stopped,
    Lost,
}

/// A unit that did not answer.
#[derive(Debug)]
struct Quiet {
    backoff: Backoff,
    until: Instant,
}

/// The task's own state.
pub(crate) struct Link {
    shared: Arc<Shared>,
    stop: watch::Receiver<bool>,
    errands: mpsc::Receiver<Posted>,
    polls: Vec<Poll>,
    backoff: Backoff,
    quiet: HashMap<u8, Quiet>,
}

impl Link {
    pub(crate) fn new(shared: Arc<Shared>, stop: watch::Receiver<bool>, errands: mpsc::Receiver<Posted>) -> Self {
        let now = Instant::now();
        let polls = shared
            .plan
            .groups
            .iter()
            .map(|group| Poll {
                group: group.clone(),
                due: now,
            })
            .collect();
        let (min_ms, max_ms) = shared.plan.backoff_ms;
        let backoff = Backoff::new(min_ms, max_ms, shared.clock.now_ns());
        Self {
            shared,
            stop,
            errands,
            polls,
            backoff,
            quiet: HashMap::new(),
        }
    }

    /// Runs until told to stop.
    pub(crate) async fn run(mut self) {
        while !self.stopping() {
            if let Some(mut context) = self.connect().await {
                let end = self.serve(&mut context).await;
                let stopped = matches!(end, End::Stopped);
                if stopped {
                    self.last_writes(&mut context).await;
                }
                self.shared.status.update(|s| s.connected = false);
                if stopped {
                    // The device sees an orderly end; one that does not care is left to the system.
                    let _ = timeout(self.time_limit(), context.disconnect()).await;
                    return;
                }
            }
            // Whoever waits here also wakes for the stop, or for a server that is gone.
            let wait = self.backoff.next_wait();
            let _ = timeout(wait, self.stop.wait_for(|stop| *stop)).await;
        }
    }

    /// Was the task told to stop, or is nobody left to tell it?
    fn stopping(&self) -> bool {
        *self.stop.borrow() || self.stop.has_changed().is_err()
    }

    fn time_limit(&self) -> Duration {
        Duration::from_millis(self.shared.plan.timeout_ms)
    }

    async fn connect(&mut self) -> Option<Context> {
        let (address, longest) = (&self.shared.plan.address, self.time_limit());
        let connected = tokio::select! {
            _ = self.stop.wait_for(|stop| *stop) => return None,
            connected = timeout(longest, TcpStream::connect(address.as_str())) => connected,
        };
        let problem = match connected {
            Ok(Ok(stream)) => {
                // Small requests must leave at once. Where the system refuses, they leave a little later.
                let _ = stream.set_nodelay(true);
                self.shared.outbox.forget();
                self.shared.status.update(|s| s.connections += 1);
                tracing::info!(bus = %self.shared.plan.bus, address, "connected");
                return Some(tcp::attach(Wire(stream)));
            }
            Ok(Err(error)) => error.to_string(),
            Err(_) => format!("no connection within {} ms", self.shared.plan.timeout_ms),
        };
        self.report(&format!("{address}: {problem}"));
        self.lose_all();
        None
    }

    /// Polls and writes until something ends it.
    async fn serve(&mut self, context: &mut Context) -> End {
        // Groups that fell due while there was no connection are due now, once.
        let now = Instant::now();
        self.polls.iter_mut().for_each(|p| p.due = p.due.max(now));
        loop {
            if self.stopping() {
                return End::Stopped;
            }
            if self.shared.outbox.is_waiting()
                && let Err(end) = self.send_writes(context).await
            {
                return end;
            }
            // One between two polls, so that neither waits for the other for long.
            if let Ok(posted) = self.errands.try_recv()
                && let Err(end) = self.errand(context, posted).await
            {
                return end;
            }
            let Some((number, due)) = self.next_poll() else {
                // A plan has points, so there are groups; without any there is nothing to do but wait for the stop.
                let _ = self.stop.wait_for(|stop| *stop).await;
                continue;
            };
            if due > Instant::now() {
                let posted = tokio::select! {
                    biased;
                    _ = self.stop.wait_for(|stop| *stop) => None,
                    () = self.shared.outbox.notify.notified() => None,
                    posted = self.errands.recv() => posted,
                    () = tokio::time::sleep_until(due) => None,
                };
                if let Some(posted) = posted
                    && let Err(end) = self.errand(context, posted).await
                {
                    return end;
                }
                continue;
            }
            if let Err(end) = self.poll(context, number).await {
                return end;
            }
        }
    }

    /// The group that is due first, and when; quiet units count as due when their time is over.
    fn next_poll(&self) -> Option<(usize, Instant)> {
        let due = |poll: &Poll| match self.quiet.get(&poll.group.unit_id) {
            Some(quiet) => poll.due.max(quiet.until),
            None => poll.due,
        };
        self.polls
            .iter()
            .enumerate()
            .map(|(number, poll)| (number, due(poll)))
            .min_by_key(|(_, due)| *due)
    }

    async fn poll(&mut self, context: &mut Context, number: usize) -> Result<(), End> {
        let Some(poll) = self.polls.get_mut(number) else {
            return Ok(());
        };
        let group = poll.group.clone();
        let period = Duration::from_millis(group.period_ms);
        let now = Instant::now();
        let late = now.saturating_duration_since(poll.due) > period;
        // Keeps the beat; a beat that is lost is not made up for.
        poll.due += period;
        if poll.due <= now {
            poll.due = now + period;
        }
        if late {
            self.shared.status.update(|s| s.polls_late += 1);
        }
        let request = match group.table {
            Table::Coil => Request::ReadCoils(group.start, group.count),
            Table::Discrete => Request::ReadDiscreteInputs(group.start, group.count),
            Table::Holding => Request::ReadHoldingRegisters(group.start, group.count),
            Table::Input => Request::ReadInputRegisters(group.start, group.count),
        };
        let sent_ns = self.shared.clock.now_ns();
        let answer = self.request(context, group.unit_id, request).await;
        let now_ns = self.shared.clock.now_ns();
        // Somewhere between question and answer the device looked; the middle errs least.
        let at_ns = sent_ns + now_ns.saturating_sub(sent_ns) / 2;
        let place = || {
            let last = u32::from(group.start) + u32::from(group.count) - 1;
            format!(
                "unit {}, {} {} to {last}",
                group.unit_id,
                group.table.name(),
                group.start
            )
        };
        match answer {
            Ok(response) => {
                if self.take(&group, &response, at_ns) {
                    self.answered(group.unit_id);
                    self.shared.status.update(|s| s.polls += 1);
                    Ok(())
                } else {
                    self.report(&format!("{}: the answer has another length than asked for", place()));
                    self.lose_unit(group.unit_id);
                    Err(End::Lost)
                }
            }
            Err(Failure::Exception(code)) => {
                self.answered(group.unit_id);
                let parts = if code == u8::from(ExceptionCode::IllegalDataAddress) {
                    group.without_gaps()
                } else {
                    Vec::new()
                };
                if parts.len() > 1 {
                    tracing::info!(bus = %self.shared.plan.bus, "{}: read without gaps from now on", place());
                    self.polls.swap_remove(number);
                    self.polls
                        .extend(parts.into_iter().map(|group| Poll { group, due: now }));
                    return Ok(());
                }
                self.report(&format!("{}: exception {code}, {}", place(), exception_name(code)));
                for item in &group.items {
                    self.shared
                        .image
                        .set(item.point, Err(NoData::DeviceError(code)), Quality::Bad, at_ns);
                }
                Ok(())
            }
            Err(failure) => Err(self.lost(group.unit_id, &place(), failure)),
        }
    }

    /// Puts an answer into the image; false where it does not hold what was asked for.
    fn take(&self, group: &Group, response: &Response, at_ns: u64) -> bool {
        // Registers of each point, and a bit as one register.
        let mut taken: Vec<(&Item, Vec<u16>)> = Vec::with_capacity(group.items.len());
        match (group.table, response) {
            (Table::Coil, Response::ReadCoils(bits)) | (Table::Discrete, Response::ReadDiscreteInputs(bits)) => {
                for item in &group.items {
                    let Some(on) = bits.get(usize::from(item.start - group.start)) else {
                        return false;
                    };
                    taken.push((item, vec![u16::from(*on)]));
                }
            }
            (Table::Holding, Response::ReadHoldingRegisters(words))
            | (Table::Input, Response::ReadInputRegisters(words)) => {
                if words.len() != usize::from(group.count) {
                    return false;
                }
                for item in &group.items {
                    let start = usize::from(item.start - group.start);
                    let Some(own) = words.get(start..start + usize::from(item.count)) else {
                        return false;
                    };
                    taken.push((item, own.to_vec()));
                }
            }
            _ => return false,
        }
        for (item, words) in taken {
            self.shared.outbox.seen(item.point, &words);
            self.show(item.point, &words, at_ns);
        }
        true
    }

    /// Puts the registers of one point into the image.
    fn show(&self, point: usize, words: &[u16], at_ns: u64) {
        if let Some(p) = self.shared.plan.points.get(point)
            && let Some(raw) = p.value_type.decode(words, p.word_order, p.byte_order)
        {
            let (value, quality) = p.scaling.reading(raw);
            self.shared.image.set(point, value, quality, at_ns);
        }
    }

    /// Sends all that waits, neighbours together.
    async fn send_writes(&mut self, context: &mut Context) -> Result<(), End> {
        let (wishes, expired) = self.shared.outbox.take(self.shared.clock.now_ns());
        if expired > 0 {
            self.report(&format!(
                "{expired} values waited too long for the device and were given up"
            ));
        }
        let mut batches = self.batches(wishes).into_iter();
        while let Some(batch) = batches.next() {
            let Some((unit_id, place, request)) = self.write_request(&batch) else {
                continue;
            };
            // A unit that is quiet keeps its wishes until it is asked again, or they expire.
            if self.quiet.get(&unit_id).is_some_and(|q| q.until > Instant::now()) {
                batch.iter().for_each(|wish| self.shared.outbox.put_back(wish));
                continue;
            }
            match self.request(context, unit_id, request).await {
                Ok(_) => {
                    let now_ns = self.shared.clock.now_ns();
                    self.answered(unit_id);
                    for wish in &batch {
                        self.shared.outbox.sent(wish, now_ns);
                        self.show(wish.point, wish.words.as_slice(), now_ns);
                    }
                    self.shared.status.update(|s| s.writes += batch.len() as u64);
                }
                Err(Failure::Exception(code)) => {
                    self.answered(unit_id);
                    self.report(&format!("write to {place}: exception {code}, {}", exception_name(code)));
                    let now_ns = self.shared.clock.now_ns();
                    for wish in &batch {
                        self.shared
                            .image
                            .set(wish.point, Err(NoData::DeviceError(code)), Quality::Bad, now_ns);
                    }
                }
                Err(failure) => {
                    // This batch and the ones behind it wait for the next connection.
                    for wish in batch.iter().chain(batches.flatten().collect::<Vec<_>>().iter()) {
                        self.shared.outbox.put_back(wish);
                    }
                    return Err(self.lost(unit_id, &format!("write to {place}"), failure));
                }
            }
        }
        Ok(())
    }

    /// Wishes that can go in one request, by unit, table and address.
    fn batches(&self, mut wishes: Vec<Wish>) -> Vec<Vec<Wish>> {
        let key = |wish: &Wish| {
            self.shared
                .plan
                .points
                .get(wish.point)
                .map(|p| (p.unit_id, p.table, p.address))
        };
        wishes.sort_by_key(key);
        let mut batches: Vec<Vec<Wish>> = Vec::new();
        // Where the last batch ends: unit, table, next address, addresses so far.
        let mut end: Option<(u8, Table, u32, u32)> = None;
        for wish in wishes {
            let Some((unit_id, table, address)) = key(&wish) else {
                continue;
            };
            let count = if table.is_bits() {
                1
            } else {
                wish.words.as_slice().len() as u32
            };
            let most = u32::from(if table.is_bits() {
                BITS_PER_WRITE_MAX
            } else {
                REGISTERS_PER_WRITE_MAX
            });
            let joins = self.shared.plan.write_with != WriteWith::Single
                && end.is_some_and(|(u, t, next, length)| {
                    (u, t, next) == (unit_id, table, u32::from(address)) && length + count <= most
                });
            match batches.last_mut() {
                Some(batch) if joins => batch.push(wish),
                _ => batches.push(vec![wish]),
            }
            let before = if joins {
                end.map_or(0, |(_, _, _, length)| length)
            } else {
                0
            };
            end = Some((unit_id, table, u32::from(address) + count, before + count));
        }
        batches
    }

    /// The request for a batch, with its unit and its place in words.
    fn write_request(&self, batch: &[Wish]) -> Option<(u8, String, Request<'static>)> {
        let first = batch.first()?;
        let point = self.shared.plan.points.get(first.point)?;
        let single = self.shared.plan.write_with != WriteWith::Multiple;
        let words: Vec<u16> = batch.iter().flat_map(|wish| wish.words.as_slice()).copied().collect();
        let request = match (point.table.is_bits(), words.as_slice()) {
            (true, [word]) if single => Request::WriteSingleCoil(point.address, *word != 0),
            (true, words) => Request::WriteMultipleCoils(point.address, words.iter().map(|w| *w != 0).collect()),
            (false, [word]) if single => Request::WriteSingleRegister(point.address, *word),
            (false, _) => Request::WriteMultipleRegisters(point.address, Cow::Owned(words)),
        };
        Some((
            point.unit_id,
            format!(
                "point {}, unit {}, {} {}",
                point.id,
                point.unit_id,
                point.table.name(),
                point.address
            ),
            request,
        ))
    }

    /// One errand. Its asker may be gone, or its time over: then nothing is sent.
    async fn errand(&mut self, context: &mut Context, posted: Posted) -> Result<(), End> {
        let Posted { errand, until, reply } = posted;
        if reply.is_closed() || std::time::Instant::now() >= until {
            let _ = reply.send(Err(ErrandError::NoTurn));
            return Ok(());
        }
        let (unit_id, request) = match &errand {
            Errand::Read {
                unit_id,
                table,
                start,
                count,
            } => (
                *unit_id,
                match table {
                    Table::Coil => Request::ReadCoils(*start, *count),
                    Table::Discrete => Request::ReadDiscreteInputs(*start, *count),
                    Table::Holding => Request::ReadHoldingRegisters(*start, *count),
                    Table::Input => Request::ReadInputRegisters(*start, *count),
                },
            ),
            Errand::Write {
                unit_id,
                table,
                start,
                words,
            } => (
                *unit_id,
                if table.is_bits() {
                    Request::WriteMultipleCoils(*start, words.iter().map(|word| *word != 0).collect())
                } else {
                    Request::WriteMultipleRegisters(*start, Cow::Borrowed(words))
                },
            ),
        };
        let (answer, end) = match self.request(context, unit_id, request).await {
            Ok(response) => {
                self.answered(unit_id);
                let words = match (&errand, response) {
                    (Errand::Write { .. }, _) => Ok(Vec::new()),
                    (Errand::Read { count, .. }, Response::ReadCoils(bits) | Response::ReadDiscreteInputs(bits)) => {
                        Ok(bits.into_iter().take(usize::from(*count)).map(u16::from).collect())
                    }
                    (
                        Errand::Read { count, .. },
                        Response::ReadHoldingRegisters(words) | Response::ReadInputRegisters(words),
                    ) if words.len() == usize::from(*count) => Ok(words),
                    _ => Err(ErrandError::Lost(
                        "the answer has another length than asked for".to_owned(),
                    )),
                };
                (words, Ok(()))
            }
            Err(Failure::Exception(code)) => {
                self.answered(unit_id);
                let name = exception_name(code);
                (Err(ErrandError::Exception { code, name }), Ok(()))
            }
            Err(failure) => {
                let error = match &failure {
                    Failure::Lost(problem) => ErrandError::Lost(problem.clone()),
                    _ => ErrandError::NoAnswer(self.shared.plan.timeout_ms),
                };
                (Err(error), Err(self.lost(unit_id, &errand.place(), failure)))
            }
        };
        // Nobody waits any more: that is the asker's matter.
        let _ = reply.send(answer);
        end
    }

    /// One request, within its time.
    async fn request(&self, context: &mut Context, unit_id: u8, request: Request<'_>) -> Result<Response, Failure> {
        context.set_slave(Slave(unit_id));
        let started = Instant::now();
        let answer = timeout(self.time_limit(), context.call(request)).await;
        let latency_us = u64::try_from(started.elapsed().as_micros()).unwrap_or(u64::MAX);
        self.shared.status.update(|s| {
            s.latency_us = latency_us;
            s.latency_us_max = s.latency_us_max.max(latency_us);
        });
        match answer {
            Ok(Ok(Ok(response))) => Ok(response),
            Ok(Ok(Err(exception))) => Err(Failure::Exception(exception.into())),
            Ok(Err(error)) => Err(Failure::Lost(error.to_string())),
            Err(_) => Err(Failure::TimedOut),
        }
    }

    /// A unit answered: it and the connection are well. A connection alone proves little: a frozen device's system
    /// still accepts one.
    fn answered(&mut self, unit_id: u8) {
        self.shared.status.update(|s| s.connected = true);
        self.backoff.reset();
        self.quiet.remove(&unit_id);
    }

    /// The connection is over. A time-out is one unit's fault as far as we know; anything else is the connection's.
    fn lost(&mut self, unit_id: u8, place: &str, failure: Failure) -> End {
        match failure {
            Failure::TimedOut => {
                self.report(&format!("{place}: no answer within {} ms", self.shared.plan.timeout_ms));
                self.lose_unit(unit_id);
                let (min_ms, max_ms) = self.shared.plan.backoff_ms;
                let seed = self.shared.clock.now_ns();
                let quiet = self.quiet.entry(unit_id).or_insert_with(|| Quiet {
                    backoff: Backoff::new(min_ms, max_ms, seed),
                    until: Instant::now(),
                });
                quiet.until = Instant::now() + quiet.backoff.next_wait();
            }
            Failure::Lost(problem) => {
                self.report(&format!("{place}: {problem}"));
                self.lose_all();
            }
            Failure::Exception(code) => self.report(&format!("{place}: exception {code}, {}", exception_name(code))),
        }
        End::Lost
    }

    /// Counts an error, keeps its text, and logs it once until another comes.
    fn report(&self, text: &str) {
        if self.shared.status.error(text) {
            tracing::warn!(bus = %self.shared.plan.bus, "{text}");
        }
    }

    fn lose_all(&self) {
        (0..self.shared.plan.points.len()).for_each(|point| self.shared.image.lose(point));
    }

    fn lose_unit(&self, unit_id: u8) {
        for (number, point) in self.shared.plan.points.iter().enumerate() {
            if point.unit_id == unit_id {
                self.shared.image.lose(number);
            }
        }
    }

    /// What waits is sent, then the safe values where they are wanted.
    async fn last_writes(&mut self, context: &mut Context) {
        if self.shared.plan.on_stop == OnStop::Safe {
            let now_ns = self.shared.clock.now_ns();
            for (point, planned) in self.shared.plan.points.iter().enumerate() {
                if let Some(safe) = planned.safe {
                    self.shared.outbox.put(Wish {
                        point,
                        words: encoded(planned, safe),
                        at_ns: now_ns,
                    });
                }
            }
        }
        // Failures have been reported; there is no later.
        let _ = self.send_writes(context).await;
    }
}

/// The names of the Modbus application protocol V1.1b3, section 7.
const fn exception_name(code: u8) -> &'static str {
    match code {
        1 => "illegal function",
        2 => "illegal data address",
        3 => "illegal data value",
        4 => "server device failure",
        5 => "acknowledge, still working",
        6 => "server device busy",
        8 => "memory parity error",
        10 => "gateway path unavailable",
        11 => "gateway target device failed to respond",
        _ => "unknown to the standard",
    }
}
