//! Steps asked for from outside: a component on a replica chosen by a strategy, with state in and out.
//!
//! The cell as a control service. Never: keeps state between calls, touches a loop or an output.
//!
//! ```text
//! call ─► select ─► replica ─ answer ─► reply
//!                     │ silent: the next, this host at the latest
//! ```

use std::{collections::HashMap, sync::Arc};

use bumpless_core::{
    Digest, Effects, Fault, Frame, HostId, LoopId,
    protocol::{StepAnswer, StepRequest},
    seat::{Ask, Attempts},
    select,
};
use bumpless_engine::Instance;

use crate::{
    event::{CallEnd, CallRequest, ReplyToCall},
    worker::{Timer, Worker},
};

/// Calls that one worker may have on their way; beyond it they are refused, for a caller that waits is better told.
const CALLS_MAX: usize = 4096;
/// Components that one worker keeps an instance of for calls; the least used goes.
const INSTANCES_MAX: usize = 16;
/// A silent replica is given up after this time, in ns, plus the step's limit.
const HEDGE_NS: u64 = 50_000_000;
/// A call steps here at the latest after this time, in ns, plus the step's limit.
const HERE_NS: u64 = 200_000_000;
/// Names of calls in step requests start so; no loop's name may start with a dot.
const CALL_NAME: &str = "call";

/// Is this the name of a call? Loops with that name are refused at deployment.
pub(crate) fn is_call(id: &LoopId) -> bool {
    id.as_str() == CALL_NAME
}

struct Pending {
    request: CallRequest,
    attempts: Attempts,
    asked: HostId,
    asked_at_ns: u64,
    started_ns: u64,
    fault: Option<Fault>,
}

#[derive(Default)]
pub(crate) struct Calls {
    pending: HashMap<u64, Pending>,
    instances: HashMap<Digest, (Instance, u64)>,
    uses: u64,
}

impl Worker {
    pub(crate) fn call(&mut self, request: CallRequest) {
        if self.calls.pending.len() >= CALLS_MAX {
            return (request.reply)(Err(Fault::Limit(format!(
                "{CALLS_MAX} calls are on their way; try again"
            ))));
        }
        let now_ns = self.shared.now_ns();
        // A host without controllers is no candidate, not even this one; `Attempts` falls back to it when nobody else can.
        let members = self.shared.replicas.controllers();
        let mut candidates = self
            .shared
            .replicas
            .candidates(&members, &self.shared.here, &request.digest, now_ns);
        let prepared_here = self.shared.engine.prepared(&request.digest).is_some();
        for candidate in candidates.iter_mut().filter(|c| c.here) {
            candidate.ready = prepared_here;
        }
        let id = call_id();
        let random = self.random();
        let order: Vec<HostId> = select::select(request.strategy, &candidates, &id, request.frame.cycle.seq, random)
            .into_iter()
            .filter_map(|i| candidates.get(i).map(|c| c.host.clone()))
            .collect();
        let limit_ns = request.limit_ns;
        let attempts = Attempts::new(
            order,
            self.shared.here.clone(),
            HEDGE_NS + limit_ns,
            now_ns + HERE_NS + limit_ns,
        );
        let pending = Pending {
            request,
            attempts,
            asked: self.shared.here.clone(),
            asked_at_ns: now_ns,
            started_ns: now_ns,
            fault: None,
        };
        self.advance_call(pending);
    }

    fn advance_call(&mut self, mut pending: Pending) {
        loop {
            let now_ns = self.shared.now_ns();
            match pending.attempts.next(now_ns) {
                Ask::Remote(host, until_ns) => {
                    let correlation = self.correlation();
                    let request = StepRequest {
                        from: self.shared.here.clone(),
                        correlation,
                        loop_id: call_id(),
                        digest: pending.request.digest,
                        limit_ns: pending.request.limit_ns,
                        frame: pending.request.frame.clone(),
                        state: Arc::clone(&pending.request.state),
                        switch: None,
                    };
                    self.shared.wire.send_step(&host, &request);
                    pending.asked = host;
                    pending.asked_at_ns = now_ns;
                    self.calls.pending.insert(correlation, pending);
                    return self.at(until_ns, Timer::Call(correlation));
                }
                Ask::Here => {
                    let CallRequest { digest, limit_ns, .. } = pending.request;
                    let frame = std::mem::replace(&mut pending.request.frame, empty_frame());
                    let state = Arc::clone(&pending.request.state);
                    let result = self.step_for_call(&digest, &frame, &state, limit_ns);
                    pending.request.frame = frame;
                    let step_ns = self.shared.now_ns() - now_ns;
                    match result {
                        Ok(effects) => {
                            let answer = StepAnswer {
                                from: self.shared.here.clone(),
                                correlation: 0,
                                loop_id: call_id(),
                                result: Ok(effects),
                                step_ns,
                            };
                            return end(pending.request.reply, answer, self.shared.now_ns() - pending.started_ns);
                        }
                        Err(fault) => pending.fault = Some(fault),
                    }
                }
                Ask::Nobody => {
                    let fault = pending.fault.unwrap_or_else(|| Fault::NotReady {
                        host: "any replica".to_owned(),
                        reason: "no replica answered in time".to_owned(),
                    });
                    return (pending.request.reply)(Err(fault));
                }
            }
        }
    }

    /// A replica's time is up.
    pub(crate) fn call_due(&mut self, correlation: u64, now_ns: u64) {
        if let Some(pending) = self.calls.pending.remove(&correlation) {
            self.shared
                .replicas
                .silent(&pending.asked, now_ns, now_ns.saturating_sub(pending.asked_at_ns));
            self.advance_call(pending);
        }
    }

    /// A replica answered.
    pub(crate) fn call_answer(&mut self, answer: StepAnswer) {
        let now_ns = self.shared.now_ns();
        let Some(mut pending) = self.calls.pending.remove(&answer.correlation) else {
            return;
        };
        if pending.asked != answer.from {
            self.calls.pending.insert(answer.correlation, pending);
            return;
        }
        self.shared
            .replicas
            .answered(&answer.from, now_ns.saturating_sub(pending.asked_at_ns));
        match &answer.result {
            Ok(_) => end(pending.request.reply, answer, now_ns - pending.started_ns),
            // The component's own fault would be the same everywhere; only a host that is not ready is worth another try.
            Err(Fault::NotReady { .. }) => self.advance_call(pending),
            Err(fault) => {
                pending.fault = Some(fault.clone());
                (pending.request.reply)(Err(fault.clone()));
            }
        }
    }

    /// Steps on this worker's own instance of the component.
    pub(crate) fn step_for_call(
        &mut self,
        digest: &Digest,
        frame: &Frame,
        state: &[u8],
        limit_ns: u64,
    ) -> Result<Effects, Fault> {
        let here = &self.shared.here;
        let not_ready = |reason: String| Fault::NotReady {
            host: here.to_string(),
            reason,
        };
        if !self.calls.instances.contains_key(digest) {
            let prepared = self
                .shared
                .engine
                .prepared(digest)
                .ok_or_else(|| not_ready("the component is not compiled here".to_owned()))?;
            let instance = prepared.instantiate().map_err(|error| not_ready(error.to_string()))?;
            if self.calls.instances.len() >= INSTANCES_MAX {
                let least = self
                    .calls
                    .instances
                    .iter()
                    .min_by_key(|(_, (_, used))| *used)
                    .map(|(d, _)| *d);
                if let Some((old, _)) = least.and_then(|d| self.calls.instances.remove(&d)) {
                    self.shared.bury(old);
                }
            }
            self.calls.instances.insert(*digest, (instance, 0));
        }
        self.calls.uses += 1;
        let uses = self.calls.uses;
        let Some((instance, used)) = self.calls.instances.get_mut(digest) else {
            return Err(not_ready("the instance is gone".to_owned()));
        };
        *used = uses;
        instance.step(frame, state, limit_ns)
    }
}

fn end(reply: ReplyToCall, answer: StepAnswer, total_ns: u64) {
    reply(Ok(CallEnd { answer, total_ns }));
}

fn empty_frame() -> Frame {
    let cycle = bumpless_core::Cycle {
        seq: 0,
        at_ns: 0,
        dt_ns: 1,
        mode: bumpless_core::Mode::Automatic,
        setpoint: 0.0,
    };
    Frame {
        cycle,
        readings: Vec::new(),
        messages: Vec::new(),
    }
}

#[allow(clippy::expect_used, reason = "a constant that a test checks")]
pub(crate) fn call_id() -> LoopId {
    static ID: std::sync::OnceLock<LoopId> = std::sync::OnceLock::new();
    ID.get_or_init(|| LoopId::new(CALL_NAME).expect("a valid name")).clone()
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_name_of_calls_is_a_name() {
        assert!(super::is_call(&super::call_id()));
    }
}
