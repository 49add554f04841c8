//! `/v1/hosts` and `/v1/points`.

use axum::{Json as JsonAnswer, extract::State};
use bumpless_core::HostId;
use bumpless_deploy::DrainOrder;

use crate::{
    error::Problem,
    extract::{InPath, Json},
    server::{App, finish},
    types::{Drain, DrainRequest, Hosts, Points},
};

/// Lists the hosts of the cell.
#[utoipa::path(get, operation_id = "list_hosts", path = "/v1/hosts", tag = "cell",
    responses((status = 200, description = "The hosts, by name", body = Hosts)))]
pub(crate) async fn list(State(app): State<App>) -> JsonAnswer<Hosts> {
    JsonAnswer(Hosts {
        hosts: app.cell.hosts().into_iter().map(Into::into).collect(),
    })
}

/// Empties a host: its loops move to others between two cycles, and new ones stay away. Answers when it owns none any more,
/// after 15 s at the latest.
#[utoipa::path(post, operation_id = "drain_host", path = "/v1/hosts/{name}/drain", tag = "cell", params(("name" = String, Path)),
    request_body = DrainRequest,
    responses(
        (status = 200, description = "How far it is", body = Drain),
        (status = 404, description = "No host of this name", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "The host is away", body = Problem, content_type = "application/problem+json"),
        (status = "default", description = "Anything else", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn drain(
    State(app): State<App>,
    InPath(name): InPath<String>,
    Json(request): Json<DrainRequest>,
) -> Result<JsonAnswer<Drain>, Problem> {
    let order = DrainOrder {
        drain: true,
        keep: request.keep,
    };
    let end = finish(app.cell.drain(HostId::new(&name)?, order)).await?;
    Ok(JsonAnswer(end.into()))
}

/// Lets a host take loops again. Answers when it holds all that it shall, after 15 s at the latest.
#[utoipa::path(post, operation_id = "undrain_host", path = "/v1/hosts/{name}/undrain", tag = "cell", params(("name" = String, Path)),
    responses(
        (status = 200, description = "How far it is", body = Drain),
        (status = 404, description = "No host of this name", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "The host is away", body = Problem, content_type = "application/problem+json"),
        (status = "default", description = "Anything else", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn undrain(
    State(app): State<App>,
    InPath(name): InPath<String>,
) -> Result<JsonAnswer<Drain>, Problem> {
    let order = DrainOrder {
        drain: false,
        keep: false,
    };
    let end = finish(app.cell.drain(HostId::new(&name)?, order)).await?;
    Ok(JsonAnswer(end.into()))
}

/// Lists the points of all hosts with their values.
#[utoipa::path(get, operation_id = "list_points", path = "/v1/points", tag = "cell",
    responses(
        (status = 200, description = "The points, by name", body = Points),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn points(State(app): State<App>) -> Result<JsonAnswer<Points>, Problem> {
    let points = app.cell.points().await?;
    Ok(JsonAnswer(Points {
        points: points.into_iter().map(Into::into).collect(),
    }))
}
