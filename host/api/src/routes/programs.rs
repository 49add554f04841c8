//! `/v1/programs`: free-running programs and scripts.

use axum::{
    Json as JsonAnswer,
    extract::State,
    http::{StatusCode, header},
    response::{IntoResponse as _, Response},
};
use bumpless_core::ProgramId;
use serde::Deserialize;
use utoipa::IntoParams;

use crate::{
    error::{Kind, Problem},
    extract::{InPath, InQuery, Json},
    paging::{Listed, Order, Page},
    server::{App, finish},
    types::{Program, ProgramLog, ProgramOrderRequest, ProgramRequest, ProgramStatus, Programs},
};

fn name(text: &str) -> Result<ProgramId, Problem> {
    ProgramId::new(text)
        .map_err(|error| Problem::new(Kind::NotFound, error.to_string(), "list the programs for their names"))
}

/// Creates a program, or changes one of the name: its run then begins anew. The host of its points is its home, and gives it to a
/// control host to run.
#[utoipa::path(post, operation_id = "create_program", path = "/v1/programs", tag = "programs", request_body = ProgramRequest,
    responses(
        (status = 201, description = "It is there", body = Program),
        (status = 409, description = "A point has another writer", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "What was asked for cannot be; says why", body = Problem, content_type = "application/problem+json"),
        (status = "default", description = "Anything else", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn create(State(app): State<App>, Json(request): Json<ProgramRequest>) -> Result<Response, Problem> {
    let view = finish(app.cell.create_program(request.into())).await?;
    Ok((StatusCode::CREATED, JsonAnswer(Program::from(view))).into_response())
}

/// Which programs, and which part of the list; all of what is given must hold.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(crate) struct ProgramsQuery {
    /// Only programs in this status.
    status: Option<ProgramStatus>,
    /// Only programs that this host runs.
    owner: Option<String>,
    /// Only what comes after this: `next` of the part before, a program's name.
    after: Option<String>,
    /// At most so many, 1 to 10,000; 1,000 where not given.
    #[param(minimum = 1, maximum = 10_000)]
    limit: Option<usize>,
}

/// Lists the programs of all hosts. How they are is what their homes heard last, at most a second or two ago.
#[utoipa::path(get, operation_id = "list_programs", path = "/v1/programs", tag = "programs", params(ProgramsQuery),
    responses((status = 200, description = "The programs", body = Programs)))]
pub(crate) async fn list(
    State(app): State<App>,
    InQuery(query): InQuery<ProgramsQuery>,
) -> Result<Listed<Programs>, Problem> {
    let page = Page::of(query.limit, query.after)?;
    let mut all: Programs = app.cell.programs().await?.into();
    all.programs.retain(|program| {
        query.status.is_none_or(|status| status == program.status)
            && query.owner.as_ref().is_none_or(|owner| *owner == program.owner)
    });
    let (programs, next) = page.cut(all.programs, Order::Otherwise, |program| program.name.clone())?;
    Ok(Listed(
        Programs {
            programs,
            next: next.clone(),
            silent: all.silent,
        },
        next,
    ))
}

/// Shows a program, as its owner says now.
#[utoipa::path(get, operation_id = "show_program", path = "/v1/programs/{name}", tag = "programs", params(("name" = String, Path)),
    responses(
        (status = 200, description = "The program", body = Program),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn show(State(app): State<App>, InPath(text): InPath<String>) -> Result<JsonAnswer<Program>, Problem> {
    Ok(JsonAnswer(app.cell.program(name(&text)?).await?.into()))
}

/// Starts, stops, pauses or resumes a program. It takes effect at once, even where the program spins.
#[utoipa::path(post, operation_id = "order_program", path = "/v1/programs/{name}/order", tag = "programs", params(("name" = String, Path)),
    request_body = ProgramOrderRequest,
    responses(
        (status = 200, description = "The program", body = Program),
        (status = 409, description = "It does not run", body = Problem, content_type = "application/problem+json"),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn order(
    State(app): State<App>,
    InPath(text): InPath<String>,
    Json(request): Json<ProgramOrderRequest>,
) -> Result<JsonAnswer<Program>, Problem> {
    let view = finish(app.cell.order_program(name(&text)?, request.order.into())).await?;
    Ok(JsonAnswer(view.into()))
}

/// Ends a program and forgets it, with its checkpoint.
#[utoipa::path(delete, operation_id = "remove_program", path = "/v1/programs/{name}", tag = "programs", params(("name" = String, Path)),
    responses(
        (status = 204, description = "It is gone"),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn remove(State(app): State<App>, InPath(text): InPath<String>) -> Result<StatusCode, Problem> {
    finish(app.cell.remove_program(name(&text)?)).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// Which lines.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(crate) struct LogQuery {
    /// Only lines after the one of this number.
    #[serde(default)]
    after: u64,
    /// At most so many, the newest; 1 to 500.
    #[param(minimum = 1, maximum = 500)]
    limit: Option<u32>,
}

/// What a program's present or last run printed; its owner keeps the newest 500 lines.
#[utoipa::path(get, operation_id = "program_log", path = "/v1/programs/{name}/log", tag = "programs", params(("name" = String, Path), LogQuery),
    responses(
        (status = 200, description = "The lines", body = ProgramLog),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn log(
    State(app): State<App>,
    InPath(text): InPath<String>,
    InQuery(query): InQuery<LogQuery>,
) -> Result<JsonAnswer<ProgramLog>, Problem> {
    let max = query.limit.unwrap_or(100);
    if !(1..=500).contains(&max) {
        return Err(Problem::new(Kind::Invalid, format!("limit = {max}"), "use 1 to 500"));
    }
    Ok(JsonAnswer(
        app.cell.program_log(name(&text)?, query.after, max).await?.into(),
    ))
}

/// What a program saved last, byte by byte.
#[utoipa::path(get, operation_id = "program_checkpoint", path = "/v1/programs/{name}/checkpoint", tag = "programs", params(("name" = String, Path)),
    responses(
        (status = 200, description = "The checkpoint", body = Vec<u8>, content_type = "application/octet-stream"),
        (status = 404, description = "It saved nothing", body = Problem, content_type = "application/problem+json"),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn checkpoint(State(app): State<App>, InPath(text): InPath<String>) -> Result<Response, Problem> {
    let bytes = app.cell.program_checkpoint(name(&text)?).await?;
    let bytes = bytes.ok_or_else(|| Problem::new(Kind::NotFound, format!("program {text} saved nothing"), ""))?;
    Ok(([(header::CONTENT_TYPE, "application/octet-stream")], bytes).into_response())
}

/// The script of a component, byte by byte as it was uploaded.
#[utoipa::path(get, operation_id = "component_script", path = "/v1/components/{reference}/script", tag = "components", params(("reference" = String, Path)),
    responses(
        (status = 200, description = "The script", body = Vec<u8>, content_type = "application/octet-stream"),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn script(State(app): State<App>, InPath(reference): InPath<String>) -> Result<Response, Problem> {
    let bytes = app.cell.script(reference).await?;
    Ok(([(header::CONTENT_TYPE, "application/octet-stream")], bytes).into_response())
}
