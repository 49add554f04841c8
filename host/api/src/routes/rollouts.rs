//! `/v1/rollouts`: one component for many loops, one loop first and then the rest by rule.

use axum::{Json as JsonAnswer, extract::State, http::StatusCode, response::IntoResponse as _, response::Response};

use serde::Deserialize;
use utoipa::IntoParams;

use crate::{
    error::Problem,
    extract::{InPath, InQuery, Json},
    paging::{Listed, Order, Page},
    server::App,
    types::{Rollout, RolloutRequest, RolloutState, Rollouts},
};

/// Begins a rollout: the first loop is changed and watched, then the others. The host that is asked keeps it, and goes on
/// with it after a restart. Answers at once.
#[utoipa::path(post, operation_id = "start_rollout", path = "/v1/rollouts", tag = "rollouts", request_body = RolloutRequest,
    responses(
        (status = 201, description = "It began", body = Rollout),
        (status = 409, description = "A loop is part of another rollout", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "The rule, the parameters or the loops cannot be; says why", body = Problem, content_type = "application/problem+json"),
        (status = "default", description = "Anything else", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn start(State(app): State<App>, Json(request): Json<RolloutRequest>) -> Result<Response, Problem> {
    let view = app.cell.start_rollout(request.try_into()?).await?;
    Ok((StatusCode::CREATED, JsonAnswer(Rollout::from(view))).into_response())
}

/// Which rollouts, and which part of the list; all of what is given must hold.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(crate) struct RolloutsQuery {
    /// Only rollouts in this state.
    state: Option<RolloutState>,
    /// Only rollouts that this host keeps.
    host: Option<String>,
    /// Only what comes after this: `next` of the part before, a rollout's id.
    after: Option<String>,
    /// At most so many, 1 to 10,000; 1,000 where not given.
    #[param(minimum = 1, maximum = 10_000)]
    limit: Option<usize>,
}

/// Lists the rollouts of all hosts, those that ended a while ago too, without their loops.
#[utoipa::path(get, operation_id = "list_rollouts", path = "/v1/rollouts", tag = "rollouts", params(RolloutsQuery),
    responses((status = 200, description = "The rollouts", body = Rollouts)))]
pub(crate) async fn list(
    State(app): State<App>,
    InQuery(query): InQuery<RolloutsQuery>,
) -> Result<Listed<Rollouts>, Problem> {
    let page = Page::of(query.limit, query.after)?;
    let mut all: Rollouts = app.cell.rollouts().await?.into();
    all.rollouts.retain(|rollout| {
        query.state.is_none_or(|state| state == rollout.state)
            && query.host.as_ref().is_none_or(|host| *host == rollout.host)
    });
    let (rollouts, next) = page.cut(all.rollouts, Order::Otherwise, |rollout| rollout.id.clone())?;
    Ok(Listed(
        Rollouts {
            rollouts,
            next: next.clone(),
            silent: all.silent,
        },
        next,
    ))
}

/// Shows a rollout with each of its loops.
#[utoipa::path(get, operation_id = "show_rollout", path = "/v1/rollouts/{id}", tag = "rollouts", params(("id" = String, Path)),
    responses(
        (status = 200, description = "The rollout", body = Rollout),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn show(State(app): State<App>, InPath(id): InPath<String>) -> Result<JsonAnswer<Rollout>, Problem> {
    Ok(JsonAnswer(app.cell.rollout(id).await?.into()))
}

/// Stops a rollout: nothing further is changed, and what is changed stays so. One that has ended stays as it is.
#[utoipa::path(post, operation_id = "stop_rollout", path = "/v1/rollouts/{id}/stop", tag = "rollouts", params(("id" = String, Path)),
    responses(
        (status = 200, description = "How far it came", body = Rollout),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn stop(State(app): State<App>, InPath(id): InPath<String>) -> Result<JsonAnswer<Rollout>, Problem> {
    Ok(JsonAnswer(app.cell.stop_rollout(id).await?.into()))
}
