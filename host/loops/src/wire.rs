//! What loops need of the bus between hosts. Sends never block and never fail loudly: a lost message shows as a silence,
//! and silence is what hedging and takeover are for.

use bumpless_cell::Session;
use bumpless_core::{
    HostId, Record,
    protocol::{Answer, Sample, StepAnswer, StepRequest},
};

/// The bus, as the cycle sees it.
pub trait Wire: Send + Sync {
    /// To the owner that it names.
    fn send_sample(&self, to: &HostId, sample: &Sample);
    /// To the loop's home.
    fn send_answer(&self, to: &HostId, answer: &Answer);
    /// To a replica.
    fn send_step(&self, to: &HostId, request: &StepRequest);
    /// Back to the owner.
    fn send_step_answer(&self, to: &HostId, answer: &StepAnswer);
    /// To everyone.
    fn publish_record(&self, record: &Record);
    /// A probe.
    fn ping(&self, to: &HostId, token: u64);
    /// Its answer.
    fn pong(&self, to: &HostId, token: u64);
}

impl Wire for Session {
    fn send_sample(&self, to: &HostId, sample: &Sample) {
        Self::send_sample(self, to, sample);
    }
    fn send_answer(&self, to: &HostId, answer: &Answer) {
        Self::send_answer(self, to, answer);
    }
    fn send_step(&self, to: &HostId, request: &StepRequest) {
        Self::send_step(self, to, request);
    }
    fn send_step_answer(&self, to: &HostId, answer: &StepAnswer) {
        Self::send_step_answer(self, to, answer);
    }
    fn publish_record(&self, record: &Record) {
        Self::publish_record(self, record);
    }
    fn ping(&self, to: &HostId, token: u64) {
        Self::ping(self, to, token);
    }
    fn pong(&self, to: &HostId, token: u64) {
        Self::pong(self, to, token);
    }
}
