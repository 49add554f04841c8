//! `/v1/points/{name}`, `/v1/buses` and `/v1/jobs`: points by hand, and what takes long.

use axum::{
    Json as JsonAnswer,
    extract::State,
    http::{HeaderValue, StatusCode, header},
    response::{IntoResponse as _, Response},
};
use bumpless_core::PointId;
use bumpless_deploy::audit::Asker;
use serde::Deserialize;
use utoipa::IntoParams;

use crate::{
    error::Problem,
    extract::{InPath, InQuery, Json},
    paging::{Listed, Order, Page},
    server::App,
    types::{Bus, Buses, ByRequest, ForceRequest, Job, JobRequest, JobState, Jobs, Point, WriteRequest},
};

/// Shows a point with its value, its quality and who holds it.
#[utoipa::path(get, operation_id = "show_point", path = "/v1/points/{name}", tag = "field",
    params(("name" = String, Path, description = "The point")),
    responses(
        (status = 200, description = "The point", body = Point),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn point(State(app): State<App>, InPath(name): InPath<String>) -> Result<JsonAnswer<Point>, Problem> {
    Ok(JsonAnswer(app.cell.point(PointId::new(name)?).await?.into()))
}

/// Writes a point that no loop writes and nobody forces.
#[utoipa::path(post, operation_id = "write_point", path = "/v1/points/{name}/write", tag = "field",
    params(("name" = String, Path, description = "The point")), request_body = WriteRequest,
    responses(
        (status = 200, description = "It is on its way to the device; the point as it is now", body = Point),
        (status = 409, description = "A loop writes it, or it is forced", body = Problem, content_type = "application/problem+json"),
        (status = "default", description = "Anything else", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn write(
    State(app): State<App>,
    InPath(name): InPath<String>,
    Json(request): Json<WriteRequest>,
) -> Result<JsonAnswer<Point>, Problem> {
    let view = app
        .cell
        .write_point(PointId::new(name)?, request.value, Asker::signed(request.by))
        .await?;
    Ok(JsonAnswer(view.into()))
}

/// Holds a point at a value: an input reads it, with the quality `forced`; an output's actuator gets it, whatever its loop
/// commits. It outlives takeovers and restarts, and ends by itself.
#[utoipa::path(post, operation_id = "force_point", path = "/v1/points/{name}/force", tag = "field",
    params(("name" = String, Path, description = "The point")), request_body = ForceRequest,
    responses(
        (status = 200, description = "It is forced; the point as it is now", body = Point),
        (status = 422, description = "The value or the time cannot be", body = Problem, content_type = "application/problem+json"),
        (status = "default", description = "Anything else", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn force(
    State(app): State<App>,
    InPath(name): InPath<String>,
    Json(request): Json<ForceRequest>,
) -> Result<JsonAnswer<Point>, Problem> {
    Ok(JsonAnswer(
        app.cell.force(PointId::new(name)?, request.into()).await?.into(),
    ))
}

/// Lets a point go before its time.
#[utoipa::path(post, operation_id = "unforce_point", path = "/v1/points/{name}/unforce", tag = "field",
    params(("name" = String, Path, description = "The point")), request_body = ByRequest,
    responses(
        (status = 200, description = "It is free; the point as it is now", body = Point),
        (status = 409, description = "It was not forced", body = Problem, content_type = "application/problem+json"),
        (status = "default", description = "Anything else", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn unforce(
    State(app): State<App>,
    InPath(name): InPath<String>,
    Json(request): Json<ByRequest>,
) -> Result<JsonAnswer<Point>, Problem> {
    Ok(JsonAnswer(
        app.cell
            .unforce(PointId::new(name)?, Asker::signed(request.by))
            .await?
            .into(),
    ))
}

/// Which buses, and which part of the list; all of what is given must hold.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(crate) struct BusesQuery {
    /// Only buses of this host.
    host: Option<String>,
    /// Only buses whose device answers, or does not.
    connected: Option<bool>,
    /// Only what comes after this: `next` of the part before, `bus@host`.
    after: Option<String>,
    /// At most so many, 1 to 10,000; 1,000 where not given.
    #[param(minimum = 1, maximum = 10_000)]
    limit: Option<usize>,
}

/// Lists the buses of all hosts, by name: how their devices are, and which jobs they know.
#[utoipa::path(get, operation_id = "list_buses", path = "/v1/buses", tag = "field", params(BusesQuery),
    responses((status = 200, description = "The buses", body = Buses)))]
pub(crate) async fn buses(
    State(app): State<App>,
    InQuery(query): InQuery<BusesQuery>,
) -> Result<Listed<Buses>, Problem> {
    let page = Page::of(query.limit, query.after)?;
    let mut buses: Vec<Bus> = app.cell.buses().await?.into_iter().map(Into::into).collect();
    buses.retain(|bus| {
        query.host.as_ref().is_none_or(|host| *host == bus.host)
            && query.connected.is_none_or(|connected| connected == bus.connected)
    });
    let (buses, next) = page.cut(buses, Order::Otherwise, |bus| format!("{}@{}", bus.name, bus.host))?;
    Ok(Listed(
        Buses {
            buses,
            next: next.clone(),
        },
        next,
    ))
}

/// Takes a job in: this is the first of its two replies. What becomes of it is at the address in `location`, and on the
/// live feed as `field` events.
#[utoipa::path(post, operation_id = "start_job", path = "/v1/jobs", tag = "field", request_body = JobRequest,
    responses(
        (status = 202, description = "It was taken in (or was before, with this key)", body = Job),
        (status = 409, description = "It would write what a loop writes, or its key is another job's", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "Too many jobs wait for the bus", body = Problem, content_type = "application/problem+json"),
        (status = "default", description = "Anything else", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn start(State(app): State<App>, Json(request): Json<JobRequest>) -> Result<Response, Problem> {
    let job: Job = app.cell.start_job(request.try_into()?).await?.into();
    // A host's name and a number: always a good value.
    let location = HeaderValue::try_from(format!("/v1/jobs/{}", job.id)).ok();
    let mut response = (StatusCode::ACCEPTED, JsonAnswer(job)).into_response();
    if let Some(location) = location {
        response.headers_mut().insert(header::LOCATION, location);
    }
    Ok(response)
}

/// Which jobs, and which part of the list; all of what is given must hold.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(crate) struct JobsQuery {
    /// Only jobs of this host.
    host: Option<String>,
    /// Only jobs of this bus.
    bus: Option<String>,
    /// Only jobs in this state.
    state: Option<JobState>,
    /// Only what comes after this: `next` of the part before, a job's id.
    after: Option<String>,
    /// At most so many, 1 to 10,000; 1,000 where not given.
    #[param(minimum = 1, maximum = 10_000)]
    limit: Option<usize>,
}

/// Lists the jobs of all hosts, those that ended a while ago too, without their results.
#[utoipa::path(get, operation_id = "list_jobs", path = "/v1/jobs", tag = "field", params(JobsQuery),
    responses((status = 200, description = "The jobs, oldest first", body = Jobs)))]
pub(crate) async fn jobs(State(app): State<App>, InQuery(query): InQuery<JobsQuery>) -> Result<Listed<Jobs>, Problem> {
    let page = Page::of(query.limit, query.after)?;
    let mut jobs: Vec<Job> = app.cell.jobs().await?.into_iter().map(Into::into).collect();
    jobs.retain(|job| {
        query.host.as_ref().is_none_or(|host| *host == job.host)
            && query.bus.as_ref().is_none_or(|bus| *bus == job.bus)
            && query.state.is_none_or(|state| state == job.state)
    });
    let (jobs, next) = page.cut(jobs, Order::Otherwise, |job| job.id.clone())?;
    Ok(Listed(
        Jobs {
            jobs,
            next: next.clone(),
        },
        next,
    ))
}

/// Shows a job with its result so far: once it has ended, the second of its two replies.
#[utoipa::path(get, operation_id = "show_job", path = "/v1/jobs/{id}", tag = "field",
    params(("id" = String, Path, description = "The job, as its start named it")),
    responses(
        (status = 200, description = "The job", body = Job),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn job(State(app): State<App>, InPath(id): InPath<String>) -> Result<JsonAnswer<Job>, Problem> {
    Ok(JsonAnswer(app.cell.job(id).await?.into()))
}

/// Cancels a job: at once while it waits, between two requests while it runs. What is done stays done.
#[utoipa::path(post, operation_id = "cancel_job", path = "/v1/jobs/{id}/cancel", tag = "field",
    params(("id" = String, Path, description = "The job, as its start named it")), request_body = ByRequest,
    responses(
        (status = 200, description = "It is cancelled, or will be before its next request", body = Job),
        (status = 409, description = "It has ended", body = Problem, content_type = "application/problem+json"),
        (status = "default", description = "Anything else", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn cancel(
    State(app): State<App>,
    InPath(id): InPath<String>,
    Json(request): Json<ByRequest>,
) -> Result<JsonAnswer<Job>, Problem> {
    Ok(JsonAnswer(
        app.cell.cancel_job(id, Asker::signed(request.by)).await?.into(),
    ))
}
