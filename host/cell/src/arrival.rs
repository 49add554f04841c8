//! What reaches a host from the bus.
//!
//! Never: more than one kind per key; a message that could be read as two things does not exist.

use std::sync::Arc;

use bumpless_core::{
    HostId, Record,
    protocol::{Answer, Sample, StepAnswer, StepRequest},
};

use crate::{request::Responder, vitals::Vitals};

/// One thing that arrived.
///
/// Messages of one sender on one lane arrive in the order in which they were sent; across lanes and senders there is no
/// order. A message may be missing (the link was full), none comes twice.
#[derive(Debug)]
pub enum Arrival {
    /// A cycle to run.
    Sample(Box<Sample>),
    /// What an owner answers to a sample of ours.
    Answer {
        /// Who answers.
        from: HostId,
        /// The answer.
        answer: Box<Answer>,
    },
    /// What an arbiter took. Own records do not come back.
    Record(Arc<Record>),
    /// A step to run for another host.
    StepRequest(Box<StepRequest>),
    /// What came of a step that we asked for.
    StepAnswer(Box<StepAnswer>),
    /// To be answered with [`Session::pong`](crate::Session::pong) by whoever runs steps, so that the asker measures what
    /// a step would feel.
    Ping {
        /// Who asks.
        from: HostId,
        /// To be given back.
        token: u64,
    },
    /// The answer to a ping of ours.
    Pong {
        /// Who answers.
        from: HostId,
        /// As it was sent.
        token: u64,
    },
    /// Another host of the cell is there, and can be sent to.
    HostUp(HostId),
    /// It went away, or a new life of it is about to be announced.
    HostDown(HostId),
    /// How another host is.
    Vitals(Vitals),
    /// Something changed at another host.
    Notice {
        /// Where.
        from: HostId,
        /// What; at most [`NOTICE_BYTES_MAX`](crate::limits::NOTICE_BYTES_MAX) bytes.
        payload: Vec<u8>,
    },
    /// Another host asks for something and waits.
    Request {
        /// Who asks.
        from: HostId,
        /// What for; at most [`REQUEST_BYTES_MAX`](crate::limits::REQUEST_BYTES_MAX) bytes.
        payload: Vec<u8>,
        /// Takes the reply.
        responder: Responder,
    },
    /// A process that joined the cell before has this host's name. It could not be seen when this one joined. This host's token
    /// is taken back; it must stop.
    NameTaken {
        /// The other's instance.
        instance: String,
    },
    /// Bytes that were no message. At most ten reports a second.
    Malformed {
        /// The key that they came on, cut.
        key: String,
        /// What is wrong.
        reason: String,
    },
}

/// Where arrivals go. It runs on the threads that read the network: it must not block, and hand longer work on.
pub type Sink = Arc<dyn Fn(Arrival) + Send + Sync>;
