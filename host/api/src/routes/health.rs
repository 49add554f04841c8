//! `/livez`, `/readyz` and `/v1/hosts/{name}/health`: is a process alive, may work be sent to it, and why not.
//!
//! Supervisors restart what is not alive and route around what is not ready; the two must not be mixed up. So `/livez` looks at
//! nothing but that the process answers, and `/readyz` at all that a host needs. Never: takes a place of the requests, for health
//! is asked for most when there is none.

use std::time::Duration;

use axum::{Json as JsonAnswer, extract::State};
use bumpless_core::HostId;

use crate::{
    error::{Kind, Problem},
    extract::InPath,
    server::App,
    types::{Alive, Health},
};

/// Longest time of an answer about this host's own health.
const READY_TIME_MAX: Duration = Duration::from_secs(5);

/// Is the process alive? It says nothing about its work; see `/readyz`. The address `/healthz` does the same.
#[utoipa::path(get, operation_id = "is_alive", path = "/livez", tag = "operation",
    responses((status = 200, description = "It is", body = Alive)))]
pub(crate) async fn livez(State(app): State<App>) -> JsonAnswer<Alive> {
    JsonAnswer(Alive {
        host: app.cell.here().to_string(),
        alive: true,
    })
}

/// May work be sent to this host? The bus is open, the cell hears of it, its disk takes writes, and it is not being emptied.
#[utoipa::path(get, operation_id = "is_ready", path = "/readyz", tag = "operation",
    responses(
        (status = 200, description = "It may", body = Health),
        (status = 503, description = "Not now; says what does not hold", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn readyz(State(app): State<App>) -> Result<JsonAnswer<Health>, Problem> {
    let here = app.cell.here();
    let Ok(view) = tokio::time::timeout(READY_TIME_MAX, app.cell.health(here.clone())).await else {
        return Err(Problem::new(
            Kind::Busy,
            format!(
                "host {here} did not find out how it is within {} s",
                READY_TIME_MAX.as_secs()
            ),
            "look at its log and its disk",
        ));
    };
    let view = view?;
    if view.ready {
        return Ok(JsonAnswer(view.into()));
    }
    Err(Problem::new(
        Kind::Busy,
        format!("host {here} is not ready: {}", view.why_not()),
        "use another host of the cell",
    ))
}

/// How well a host of the cell is, in its own words: each thing that must hold before work is sent to it.
#[utoipa::path(get, operation_id = "host_health", path = "/v1/hosts/{name}/health", tag = "cell", params(("name" = String, Path)),
    responses((status = 200, description = "How well it is, be it ready or not", body = Health)))]
pub(crate) async fn of_host(
    State(app): State<App>,
    InPath(name): InPath<String>,
) -> Result<JsonAnswer<Health>, Problem> {
    Ok(JsonAnswer(app.cell.health(HostId::new(&name)?).await?.into()))
}
