//! `/v1/demo`: faults on request, only where `bumpless demo` started this host.
//!
//! The host does nothing to itself: it passes the wish to the demonstration, its parent, which knows the processes. A host that
//! was started otherwise has nobody to pass it to, and refuses. Never: a way to harm a host in service.

use axum::{Json as JsonAnswer, extract::State, http::StatusCode};
use bumpless_core::HostId;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::{
    error::{Kind, Problem},
    extract::Json,
    limits::FAULT_S_MAX,
    server::App,
};

/// What can be done to a host of the demonstration.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "kebab-case")]
pub enum FaultKind {
    /// `kill -9`.
    Kill,
    /// Stopped like by a debugger, then continued.
    Pause,
    /// All cores of the machine kept busy.
    Stress,
    /// What passes between it and the plant comes 30 ms later, each way.
    Delay,
    /// A tenth of what passes between it and the plant is lost and sent again.
    Lose,
    /// Started again, where it is dead.
    Start,
}

/// A fault that somebody wishes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Fault {
    /// What.
    pub fault: FaultKind,
    /// The host; of no meaning for `stress`, which all hosts of the machine feel.
    pub host: String,
    /// For so long, in s, 1 to 60: `pause`, `stress`, `delay` and `lose`; 3 where not given.
    #[serde(default = "three")]
    pub seconds: u32,
}

const fn three() -> u32 {
    3
}

/// Is this the demonstration?
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Demo {
    /// Did `bumpless demo` start this host? Only then are faults done on request.
    pub demo: bool,
}

/// Says whether this host is part of the demonstration.
#[utoipa::path(get, operation_id = "is_demo", path = "/v1/demo", tag = "operation",
    responses((status = 200, description = "Whether faults can be asked for", body = Demo)))]
pub(crate) async fn show(State(app): State<App>) -> JsonAnswer<Demo> {
    JsonAnswer(Demo {
        demo: app.faults.is_some(),
    })
}

/// Does a fault to a host of the demonstration, on this machine.
#[utoipa::path(post, operation_id = "do_fault", path = "/v1/demo/faults", tag = "operation", request_body = Fault,
    responses(
        (status = 202, description = "It will be done at once"),
        (status = 409, description = "This host is not part of a demonstration", body = Problem, content_type = "application/problem+json"),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn fault(State(app): State<App>, Json(fault): Json<Fault>) -> Result<StatusCode, Problem> {
    let Some(faults) = &app.faults else {
        return Err(Problem::new(
            Kind::Refused,
            "this host was not started by the demonstration",
            "faults are for `bumpless demo` only",
        ));
    };
    HostId::new(&fault.host)?;
    if !(1..=FAULT_S_MAX).contains(&fault.seconds) {
        return Err(Problem::new(
            Kind::Invalid,
            format!("seconds = {}", fault.seconds),
            format!("use 1 to {FAULT_S_MAX}"),
        ));
    }
    faults.try_send(fault).map_err(|_| {
        Problem::new(
            Kind::Busy,
            "the demonstration has not done the last faults yet",
            "try again in a second",
        )
    })?;
    Ok(StatusCode::ACCEPTED)
}
