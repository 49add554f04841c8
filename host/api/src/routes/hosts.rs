//! `/v1/hosts` and `/v1/points`.

use axum::{Json as JsonAnswer, extract::State};

use crate::{
    error::Problem,
    server::App,
    types::{Hosts, Points},
};

/// Lists the hosts of the cell.
#[utoipa::path(get, operation_id = "list_hosts", path = "/v1/hosts", tag = "cell",
    responses((status = 200, description = "The hosts, by name", body = Hosts)))]
pub(crate) async fn list(State(app): State<App>) -> JsonAnswer<Hosts> {
    JsonAnswer(Hosts {
        hosts: app.cell.hosts().into_iter().map(Into::into).collect(),
    })
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
