//! `/v1/hosts` and `/v1/points`.

use axum::{Json as JsonAnswer, extract::State};
use bumpless_core::HostId;
use bumpless_deploy::{DrainOrder, PointView};
use serde::Deserialize;
use utoipa::IntoParams;

use crate::{
    error::Problem,
    extract::{InPath, InQuery, Json},
    paging::{Listed, Order, Page},
    server::{App, finish},
    types::{Drain, DrainRequest, Hosts, Points},
};

/// Which hosts, and which part of the list; all of what is given must hold.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(crate) struct HostsQuery {
    /// Only hosts that are alive, or are not.
    alive: Option<bool>,
    /// Only hosts with this label.
    label: Option<String>,
    /// Only what comes after this: `next` of the part before.
    after: Option<String>,
    /// At most so many, 1 to 10,000; 1,000 where not given.
    #[param(minimum = 1, maximum = 10_000)]
    limit: Option<usize>,
}

/// Lists the hosts of the cell, by name.
#[utoipa::path(get, operation_id = "list_hosts", path = "/v1/hosts", tag = "cell", params(HostsQuery),
    responses((status = 200, description = "The hosts", body = Hosts)))]
pub(crate) async fn list(
    State(app): State<App>,
    InQuery(query): InQuery<HostsQuery>,
) -> Result<Listed<Hosts>, Problem> {
    let page = Page::of(query.limit, query.after)?;
    let mut hosts = app.cell.hosts();
    hosts.retain(|host| {
        query.alive.is_none_or(|alive| alive == host.alive)
            && query.label.as_ref().is_none_or(|label| host.labels.contains(label))
    });
    hosts.sort_by(|a, b| a.id.cmp(&b.id));
    let (hosts, next) = page.cut(hosts, Order::ByKey, |host| host.id.to_string())?;
    let hosts = hosts.into_iter().map(Into::into).collect();
    Ok(Listed(
        Hosts {
            hosts,
            next: next.clone(),
        },
        next,
    ))
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

/// Which points, and which part of the list; all of what is given must hold.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(crate) struct PointsQuery {
    /// Only points of this host.
    host: Option<String>,
    /// Only points of this bus.
    bus: Option<String>,
    /// Only points that are forced, or are not.
    forced: Option<bool>,
    /// A part of name or description, in any case of letters.
    text: Option<String>,
    /// Only what comes after this: `next` of the part before, `point@host`.
    after: Option<String>,
    /// At most so many, 1 to 10,000; 1,000 where not given.
    #[param(minimum = 1, maximum = 10_000)]
    limit: Option<usize>,
}

impl PointsQuery {
    fn takes(&self, point: &PointView) -> bool {
        let text = self.text.as_deref().unwrap_or_default().to_lowercase();
        self.host.as_ref().is_none_or(|host| *host == point.host.as_str())
            && self.bus.as_ref().is_none_or(|bus| *bus == point.bus)
            && self.forced.is_none_or(|forced| forced == point.force.is_some())
            && (point.id.as_str().to_lowercase().contains(&text) || point.text.to_lowercase().contains(&text))
    }
}

/// Lists the points of all hosts with their values, by name.
#[utoipa::path(get, operation_id = "list_points", path = "/v1/points", tag = "cell", params(PointsQuery),
    responses((status = 200, description = "The points", body = Points)))]
pub(crate) async fn points(
    State(app): State<App>,
    InQuery(query): InQuery<PointsQuery>,
) -> Result<Listed<Points>, Problem> {
    let page = Page::of(query.limit, query.after.clone())?;
    let mut points = app.cell.points().await?;
    points.retain(|point| query.takes(point));
    // Of a device with two masters both hosts have the points.
    let place = |point: &PointView| format!("{}@{}", point.id, point.host);
    let (points, next) = page.cut(points, Order::Otherwise, place)?;
    let points = points.into_iter().map(Into::into).collect();
    Ok(Listed(
        Points {
            points,
            next: next.clone(),
        },
        next,
    ))
}
