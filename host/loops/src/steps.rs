//! Single steps: here, for a cycle that this host runs or for another host, and the request that asks another host for one.
//!
//! Never: decides whose step counts; that is `seat` and `vote`.

use std::sync::Arc;

use bumpless_core::{
    Effects, Fault, Frame, HostId, LoopId,
    protocol::{StepAnswer, StepRequest, Switch},
};

use crate::{
    revise::repeat,
    seat::{Asked, Running},
    worker::Worker,
};

impl Worker {
    /// The request for a step of the cycle; [`Worker::ask`] numbers it. None where the revision is not held (any more).
    pub(crate) fn request(&self, id: &LoopId, running: &Running) -> Option<StepRequest> {
        let seat = self.seats.get(id)?;
        let in_force = running.sample.revision;
        let (revision, readings) = match &running.switch {
            Some(switching) => (switching.to(), switching.readings()),
            None => (in_force, running.frame.readings.as_slice()),
        };
        let held = seat.held.iter().find(|h| h.spec.revision == revision)?;
        let (from, to) = (in_force, revision);
        Some(StepRequest {
            from: self.shared.here.clone(),
            correlation: 0,
            loop_id: id.clone(),
            digest: held.spec.digest,
            limit_ns: held.spec.step_limit_ns(),
            frame: Frame {
                cycle: running.frame.cycle,
                readings: readings.to_vec(),
                messages: running.frame.messages.clone(),
            },
            state: Arc::clone(&running.state),
            switch: running.switch.as_ref().map(|_| Switch { from, to }),
        })
    }

    /// Sends the request to a host under a number of its own.
    pub(crate) fn ask(&mut self, running: &mut Running, request: &mut StepRequest, host: HostId, now_ns: u64) {
        request.correlation = self.correlation();
        self.shared.wire.send_step(&host, request);
        running.asked.push(Asked {
            correlation: request.correlation,
            host,
            at_ns: now_ns,
        });
    }

    /// Steps the revision in force here; gives the result and its time in ns. None where it is not held (any more).
    pub(crate) fn step_here(&mut self, id: &LoopId, running: &Running) -> Option<(Result<Effects, Fault>, u64)> {
        let held = self.seats.get_mut(id)?.held(running.sample.revision)?;
        let limit_ns = held.spec.step_limit_ns();
        let began_ns = self.shared.now_ns();
        let mut step = held.instance.step(&running.frame, &running.state, limit_ns);
        let step_ns = self.shared.now_ns() - began_ns;
        self.shared.disturb(&mut step);
        Some((step, step_ns))
    }

    /// A step for another host.
    pub(crate) fn step_request(&mut self, request: StepRequest) {
        let StepRequest {
            from,
            correlation,
            loop_id,
            digest,
            limit_ns,
            frame,
            state,
            switch,
        } = request;
        let began_ns = self.shared.now_ns();
        let here = self.shared.here.clone();
        let not_ready = |reason: &str| Fault::NotReady {
            host: here.to_string(),
            reason: reason.to_owned(),
        };
        let seat = self.seats.get_mut(&loop_id);
        let step = match (seat, switch) {
            (Some(seat), Some(switch)) => repeat(seat, switch, &frame, &state),
            (Some(seat), None) => {
                let held = seat.held.iter_mut().find(|h| h.spec.digest == digest);
                held.map(|held| held.instance.step(&frame, &state, limit_ns))
            }
            (None, _) => None,
        };
        let mut result = match step {
            Some(result) => result,
            None if crate::calls::is_call(&loop_id) => self.step_for_call(&digest, &frame, &state, limit_ns),
            None => Err(not_ready("the loop is not held here")),
        };
        let step_ns = self.shared.now_ns() - began_ns;
        self.shared.disturb(&mut result);
        let answer = StepAnswer {
            from: self.shared.here.clone(),
            correlation,
            loop_id,
            result,
            step_ns,
        };
        self.shared.wire.send_step_answer(&from, &answer);
    }
}
