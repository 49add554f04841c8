//! The task of one connection of a Modbus bus: it polls the groups of its units and sends their writes.
//!
//! ```text
//! connecting ──► serving ──lost──► waiting (doubling, with spread) ──► connecting
//!     └──failed──► waiting   └──stop──► last writes ──► ended
//! ```
//!
//! One request at a time, because many devices bear no more; writes go before polls. A unit that does not answer is left
//! alone for a growing while, so that the others behind the same address keep their pace. On TCP and on a line the
//! connection outlives that: a late answer is told from the next one's. After some silences in a row, and at once where
//! answers carry no number, it is made anew.
//!
//! Never: blocks a thread, or touches another bus.

use std::{
    collections::{HashMap, HashSet},
    sync::Arc,
    time::Duration,
};

use bumpless_core::{NoData, Quality};
use tokio::{
    net::TcpStream,
    sync::watch,
    time::{Instant, timeout},
};

use super::{
    backoff::Backoff,
    connection::{Connection, Failure},
    driver::Shared,
    exception::Exception,
    group::{Group, Item},
    outbox::{Wish, encoded},
    plan::{Plan, Way},
    request::{Answer, Request},
    serial::Serial,
};
use crate::{
    config::OnStop,
    errand::Errands,
    limits::{REFUSED_AGAIN_MS, SILENT_IN_ROW_MAX},
};

mod errands;
mod writes;

/// A group and when it is due.
#[derive(Debug)]
struct Poll {
    group: Arc<Group>,
    due: Instant,
    /// It was cut out of a greater one because the device refused an address of that.
    cut_out: bool,
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
    lane: usize,
    units: Vec<u8>,
    stop: watch::Receiver<bool>,
    errands: Errands,
    polls: Vec<Poll>,
    backoff: Backoff,
    quiet: HashMap<u8, Quiet>,
    silent_in_row: u32,
    /// Units without function 22.
    without_mask: HashSet<u8>,
    /// Writes that the device, or the lease of another master, refused.
    refused: u64,
}

impl Link {
    /// The task of connection `lane`, for these units.
    pub(crate) fn new(
        shared: Arc<Shared>,
        lane: usize,
        units: Vec<u8>,
        stop: watch::Receiver<bool>,
        errands: Errands,
    ) -> Self {
        let polls = planned(&shared.plan, &units);
        let (min_ms, max_ms) = shared.plan.backoff_ms;
        let backoff = Backoff::new(min_ms, max_ms, shared.clock.now_ns().wrapping_add(lane as u64));
        Self {
            shared,
            lane,
            units,
            stop,
            errands,
            polls,
            backoff,
            quiet: HashMap::new(),
            silent_in_row: 0,
            without_mask: HashSet::new(),
            refused: 0,
        }
    }

    /// Runs until told to stop.
    pub(crate) async fn run(mut self) {
        while !self.stopping() {
            if let Some(mut connection) = self.connect().await {
                let end = self.serve(&mut connection).await;
                let stopped = matches!(end, End::Stopped);
                if stopped {
                    self.last_writes(&mut connection).await;
                }
                self.shared.answers(self.lane, false);
                // The device sees an orderly end; one that does not care is left to the system.
                let _ = timeout(self.time_limit(), connection.close()).await;
                if stopped {
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

    async fn connect(&mut self) -> Option<Connection> {
        let shared = Arc::clone(&self.shared);
        let longest = self.time_limit();
        let connected = tokio::select! {
            _ = self.stop.wait_for(|stop| *stop) => return None,
            connected = timeout(longest, open(&shared.plan)) => connected,
        };
        let place = shared.plan.way.place();
        let problem = match connected {
            Ok(Ok(connection)) => {
                self.shared.outbox.forget(self.lane);
                self.silent_in_row = 0;
                // Perhaps a device that started again, and has now what it did not have.
                self.polls = planned(&self.shared.plan, &self.units);
                self.shared.status.update(|s| s.connections += 1);
                tracing::info!(bus = %self.shared.plan.bus, address = place, "connected");
                return Some(connection);
            }
            Ok(Err(problem)) => problem,
            Err(_) => format!("no connection within {} ms", shared.plan.timeout_ms),
        };
        self.report(&format!("{place}: {problem}"));
        self.lose_all();
        None
    }

    /// Polls and writes until something ends it.
    async fn serve(&mut self, connection: &mut Connection) -> End {
        // Groups that fell due while there was no connection are due now, once.
        let now = Instant::now();
        self.polls.iter_mut().for_each(|p| p.due = p.due.max(now));
        loop {
            if self.stopping() {
                return End::Stopped;
            }
            if self.shared.outbox.is_waiting(self.lane)
                && let Err(end) = self.send_writes(connection).await
            {
                return end;
            }
            // One between two polls, so that neither waits for the other for long.
            if let Some(posted) = self.errands.try_recv()
                && let Err(end) = self.errand(connection, posted).await
            {
                return end;
            }
            let Some((number, due)) = self.next_poll() else {
                // A lane has units, so there are groups; without any there is nothing to do but wait for the stop.
                let _ = self.stop.wait_for(|stop| *stop).await;
                continue;
            };
            if due > Instant::now() {
                let posted = tokio::select! {
                    biased;
                    _ = self.stop.wait_for(|stop| *stop) => None,
                    () = self.shared.outbox.notified(self.lane) => None,
                    posted = self.errands.recv() => posted,
                    () = tokio::time::sleep_until(due) => None,
                };
                if let Some(posted) = posted
                    && let Err(end) = self.errand(connection, posted).await
                {
                    return end;
                }
                continue;
            }
            if let Err(end) = self.poll(connection, number).await {
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

    async fn poll(&mut self, connection: &mut Connection, number: usize) -> Result<(), End> {
        let Some(poll) = self.polls.get_mut(number) else {
            return Ok(());
        };
        let group = Arc::clone(&poll.group);
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
        let request = Request::Read {
            table: group.table,
            start: group.start,
            count: group.count,
        };
        let sent_ns = self.shared.clock.now_ns();
        let answer = self.request(connection, group.unit_id, &request).await;
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
            Ok(answer) => {
                self.take(&group, &answer, at_ns);
                self.answered(group.unit_id);
                self.shared.status.update(|s| s.polls += 1);
                Ok(())
            }
            Err(Failure::Exception(exception)) => {
                self.answered(group.unit_id);
                let parts = if exception == Exception::ADDRESS {
                    group.parts()
                } else {
                    Vec::new()
                };
                if parts.len() > 1 {
                    // One wrong address must not take its neighbours down: what is left of them in the end is the wrong one.
                    tracing::info!(bus = %self.shared.plan.bus, "{}: {exception}; read in parts from now on", place());
                    self.polls.swap_remove(number);
                    self.polls.extend(parts.into_iter().map(|group| Poll {
                        group: Arc::new(group),
                        due: now,
                        cut_out: true,
                    }));
                    return Ok(());
                }
                if let Some(poll) = self.polls.get_mut(number).filter(|poll| poll.cut_out) {
                    // It costs its neighbours a request each time, so it is not asked for often.
                    poll.due = now + period.max(Duration::from_millis(REFUSED_AGAIN_MS));
                }
                self.report(&format!("{}: {exception}", place()));
                for item in &group.items {
                    self.shared
                        .image
                        .set(item.point, Err(NoData::DeviceError(exception.0)), Quality::Bad, at_ns);
                }
                Ok(())
            }
            Err(failure) => self.failed(connection, group.unit_id, &place(), failure),
        }
    }

    /// Puts an answer into the image. Its length is what was asked for.
    fn take(&self, group: &Group, answer: &Answer, at_ns: u64) {
        for item in &group.items {
            let start = usize::from(item.start.saturating_sub(group.start));
            match answer {
                Answer::Bits(bits) => {
                    if let Some(on) = bits.get(start) {
                        self.seen(item, &[u16::from(*on)], at_ns);
                    }
                }
                Answer::Words(words) => {
                    if let Some(own) = words.get(start..start + usize::from(item.count)) {
                        self.seen(item, own, at_ns);
                    }
                }
                Answer::Done | Answer::Identity { .. } => {}
            }
        }
    }

    /// The registers of one point as they were read: for a field of bits, its number.
    fn seen(&self, item: &Item, words: &[u16], at_ns: u64) {
        let bits = self.shared.plan.points.get(item.point).and_then(|p| p.bits);
        match (bits, words) {
            (Some(bits), [register]) => {
                let number = [bits.of(*register)];
                self.shared.outbox.seen(item.point, &number);
                self.show(item.point, &number, at_ns);
            }
            _ => {
                self.shared.outbox.seen(item.point, words);
                self.show(item.point, words, at_ns);
            }
        }
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

    /// One request, within its time, and again where it is not answered and may be. Of a device with two masters only the
    /// master writes; it is asked right before the request, and nowhere earlier: see [`crate::master`].
    async fn request(&self, connection: &mut Connection, unit_id: u8, request: &Request) -> Result<Answer, Failure> {
        if request.is_write() && !self.shared.may_write() {
            return Err(Failure::Fenced);
        }
        let answer = self.request_unfenced(connection, unit_id, request).await;
        if request.is_write() {
            self.note_ended_lease(unit_id);
        }
        answer
    }

    async fn request_unfenced(
        &self,
        connection: &mut Connection,
        unit_id: u8,
        request: &Request,
    ) -> Result<Answer, Failure> {
        let mut tries = 0;
        loop {
            let started = Instant::now();
            let answer = connection.call(unit_id, request, self.time_limit()).await;
            let latency_us = u64::try_from(started.elapsed().as_micros()).unwrap_or(u64::MAX);
            let again = matches!(answer, Err(Failure::Silent(_)))
                && tries < self.shared.plan.retries
                // The lease is asked for once, and the times of two masters count with one try.
                && self.shared.mastership.is_none()
                && connection.outlives_silence()
                && !self.stopping();
            self.shared.status.update(|s| {
                s.requests += 1;
                s.retries += u64::from(again);
                s.latency_us = latency_us;
                s.latency_us_max = s.latency_us_max.max(latency_us);
            });
            if !again {
                return answer;
            }
            // Whoever looks must not wait for the tries: the loss shows now, and the value when one of them succeeds.
            self.lose_read(unit_id, request);
            tries += 1;
        }
    }

    /// A unit answered: it and the connection are well. A connection alone proves little: a frozen device's system
    /// still accepts one.
    fn answered(&mut self, unit_id: u8) {
        self.shared.answers(self.lane, true);
        self.backoff.reset();
        self.silent_in_row = 0;
        self.quiet.remove(&unit_id);
    }

    /// A request came to nothing. A silence is one unit's fault as far as we know; a lost connection is everybody's.
    fn failed(&mut self, connection: &Connection, unit_id: u8, place: &str, failure: Failure) -> Result<(), End> {
        match failure {
            Failure::Exception(exception) => {
                self.report(&format!("{place}: {exception}"));
                Ok(())
            }
            Failure::Fenced => {
                self.report(&format!("{place}: this host is not the device's master; given up"));
                Ok(())
            }
            Failure::Lost(problem) => {
                self.report(&format!("{place}: {problem}"));
                self.lose_all();
                Err(End::Lost)
            }
            Failure::Malformed(problem) => {
                self.report(&format!("{place}: {problem}"));
                self.leave_alone(unit_id);
                Ok(())
            }
            Failure::Silent(problem) => {
                self.report(&format!("{place}: {problem}"));
                self.leave_alone(unit_id);
                self.silent_in_row += 1;
                let enough =
                    self.silent_in_row >= SILENT_IN_ROW_MAX && matches!(self.shared.plan.way, Way::Network { .. });
                if enough || !connection.outlives_silence() {
                    return Err(End::Lost);
                }
                Ok(())
            }
        }
    }

    /// A unit is not asked for a growing while.
    fn leave_alone(&mut self, unit_id: u8) {
        for (number, point) in self.shared.plan.points.iter().enumerate() {
            if point.unit_id == unit_id {
                self.shared.image.lose(number);
            }
        }
        let (min_ms, max_ms) = self.shared.plan.backoff_ms;
        let seed = self.shared.clock.now_ns();
        let quiet = self.quiet.entry(unit_id).or_insert_with(|| Quiet {
            backoff: Backoff::new(min_ms, max_ms, seed),
            until: Instant::now(),
        });
        quiet.until = Instant::now() + quiet.backoff.next_wait();
        if self.units.iter().all(|unit| self.quiet.contains_key(unit)) {
            self.shared.answers(self.lane, false);
        }
    }

    /// Counts an error, keeps its text, and logs it once until another comes.
    fn report(&self, text: &str) {
        if self.shared.status.error(text) {
            tracing::warn!(bus = %self.shared.plan.bus, "{text}");
        }
    }

    /// The points of a read that was not answered.
    fn lose_read(&self, unit_id: u8, request: &Request) {
        let Request::Read { table, start, count } = request else {
            return;
        };
        let asked = |poll: &&Poll| {
            let group = &poll.group;
            (group.unit_id, group.table, group.start, group.count) == (unit_id, *table, *start, *count)
        };
        for item in self.polls.iter().filter(asked).flat_map(|poll| &poll.group.items) {
            self.shared.image.lose(item.point);
        }
    }

    fn lose_all(&self) {
        for (number, point) in self.shared.plan.points.iter().enumerate() {
            if self.units.contains(&point.unit_id) {
                self.shared.image.lose(number);
            }
        }
    }

    /// What waits is sent, then the safe values where they are wanted.
    async fn last_writes(&mut self, connection: &mut Connection) {
        if self.shared.plan.on_stop == OnStop::Safe {
            let now_ns = self.shared.clock.now_ns();
            for (point, planned) in self.shared.plan.points.iter().enumerate() {
                if let Some(safe) = planned.safe.filter(|_| self.units.contains(&planned.unit_id)) {
                    self.shared.outbox.put(Wish {
                        point,
                        words: encoded(planned, safe),
                        at_ns: now_ns,
                    });
                }
            }
        }
        // Failures have been reported; there is no later.
        let refused = self.refused;
        let end = self.send_writes(connection).await;
        let reason = if self.refused > refused {
            Some("the device refused a value".to_owned())
        } else if end.is_err() || self.shared.outbox.is_waiting(self.lane) {
            Some("the device did not answer the last writes".to_owned())
        } else {
            None
        };
        self.shared.rests.lock().insert(self.lane, reason);
    }
}

/// The groups of these units as they were planned, due now.
fn planned(plan: &Plan, units: &[u8]) -> Vec<Poll> {
    let due = Instant::now();
    let own = plan.groups.iter().filter(|group| units.contains(&group.unit_id));
    let poll = |group: &Group| Poll {
        group: Arc::new(group.clone()),
        due,
        cut_out: false,
    };
    own.map(poll).collect()
}

/// A connection, or why there is none, in words.
async fn open(plan: &Plan) -> Result<Connection, String> {
    match &plan.way {
        Way::Line { device, line } => {
            let serial = Serial::open(device, *line).map_err(|error| {
                format!("{error}; check that the line is there and that this user may use it (group dialout)")
            })?;
            Ok(Connection::over_line(serial, line.pause()))
        }
        Way::Network { address, framing, tls } => {
            let stream = TcpStream::connect(address.as_str()).await.map_err(|e| e.to_string())?;
            if plan.redundant.is_some() {
                bound_in_flight(&stream, plan.timeout_ms)?;
            }
            // Small requests must leave at once. Where the system refuses, they leave a little later.
            let _ = stream.set_nodelay(true);
            let Some(tls) = tls else {
                return Ok(Connection::over_network(stream, *framing));
            };
            let stream =
                tls.connector.connect(tls.name.clone(), stream).await.map_err(|error| {
                    format!("TLS: {error}; check tls.ca, tls.server_name and the device's certificate")
                })?;
            Ok(Connection::over_network(stream, *framing))
        }
    }
}

/// Of a device with two masters: what the network has not delivered within a time-out is given up, by the system too, and a
/// connection that is dropped takes what it has not sent with it.
fn bound_in_flight(stream: &TcpStream, timeout_ms: u64) -> Result<(), String> {
    socket2::SockRef::from(stream)
        .set_tcp_user_timeout(Some(Duration::from_millis(timeout_ms)))
        .and_then(|()| stream.set_zero_linger())
        .map_err(|error| format!("writes on their way cannot be bounded ({error}), so that two masters might overlap"))
}
