//! `/v1/loops`: what runs, its changes and its commands.

use std::collections::BTreeMap;

use axum::{Json as JsonAnswer, extract::State, http::StatusCode};
use bumpless_core::{CommandBody, CommandId, Direction, HostId, LoopId, Outcome};
use bumpless_deploy::{Change, LoopView};
use serde::Deserialize;
use utoipa::IntoParams;

use crate::{
    error::{Kind, Problem},
    extract::{IdempotencyKey, InPath, InQuery, Json},
    paging::{Listed, Order, Page},
    server::{App, finish},
    tag::{Conditions, Tag, Tagged},
    types::{
        Apply, Command, Depth, Loop, LoopDraft, Loops, ModeRequest, MoveRequest, OutputRequest, RollbackRequest,
        SetRequest, SetpointRequest, SwapRequest,
    },
};

/// A view with the names and units of its component.
fn shaped(app: &App, view: LoopView, depth: Depth) -> Loop {
    let ports = app.ports(&view.spec.digest);
    Loop::new(view, &ports, depth)
}

/// Which loops, and which part of the list; all of what is given must hold.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(crate) struct ListQuery {
    /// Only loops whose names come after this one: `next` of the part before.
    after: Option<String>,
    /// At most so many, 1 to 10,000; 1,000 where not given.
    #[param(minimum = 1, maximum = 10_000)]
    limit: Option<usize>,
    /// Only loops whose points this host serves.
    home: Option<String>,
    /// Only loops whose last cycle this host ran.
    owner: Option<String>,
    /// Only loops that run this component: `name` or `name@version`.
    component: Option<String>,
    /// A part of the loop's name, in any case of letters.
    text: Option<String>,
}

impl ListQuery {
    fn takes(&self, view: &LoopView) -> bool {
        let name = view.component.split('@').next();
        let text = self.text.as_deref().unwrap_or_default().to_lowercase();
        let owner = || view.last.as_ref().map(|record| record.owner.as_str());
        self.home.as_ref().is_none_or(|home| *home == view.home.as_str())
            && self.owner.as_ref().is_none_or(|host| owner() == Some(host))
            && (self.component.as_ref()).is_none_or(|asked| *asked == view.component || name == Some(asked))
            && view.id.as_str().contains(&text)
    }
}

/// Lists the loops, by name.
#[utoipa::path(get, operation_id = "list_loops", path = "/v1/loops", tag = "loops", params(ListQuery),
    responses((status = 200, description = "The loops", body = Loops)))]
pub(crate) async fn list(State(app): State<App>, InQuery(query): InQuery<ListQuery>) -> Result<Listed<Loops>, Problem> {
    let page = Page::of(query.limit, query.after.clone())?;
    let mut views = app.cell.loops();
    views.retain(|view| query.takes(view));
    views.sort_by(|a, b| a.id.cmp(&b.id));
    let (views, next) = page.cut(views, Order::ByKey, |view| view.id.to_string())?;
    let loops = views
        .into_iter()
        .map(|view| shaped(&app, view, Depth::Numbers))
        .collect();
    Ok(Listed(
        Loops {
            loops,
            next: next.clone(),
        },
        next,
    ))
}

/// How much of the last record.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(crate) struct ShowQuery {
    /// With the controller's state.
    #[serde(default)]
    state: bool,
}

/// Shows one loop with its last record.
#[utoipa::path(get, operation_id = "show_loop", path = "/v1/loops/{name}", tag = "loops", params(("name" = String, Path), ShowQuery),
    responses(
        (status = 200, description = "The loop", body = Loop),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn show(
    State(app): State<App>,
    InPath(name): InPath<String>,
    InQuery(query): InQuery<ShowQuery>,
    conditions: Conditions,
) -> Result<Tagged<Loop>, Problem> {
    let view = app.cell.loop_view(&LoopId::new(&name)?)?;
    let tag = Tag::revision(view.spec.revision);
    let depth = if query.state { Depth::State } else { Depth::Record };
    Ok(Tagged::read(&conditions, tag, shaped(&app, view, depth)))
}

/// Creates or changes a loop. Answers when the change is in force on the actuator's side, or refused with nothing changed.
#[utoipa::path(put, operation_id = "apply_loop", path = "/v1/loops/{name}", tag = "loops", params(("name" = String, Path)), request_body = LoopDraft,
    responses(
        (status = 200, description = "In force", body = Apply),
        (status = 201, description = "Created", body = Apply),
        (status = 409, description = "Refused with what the cell has now", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "Cannot be right", body = Problem, content_type = "application/problem+json"),
        (status = "default", description = "Anything else", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn apply(
    State(app): State<App>,
    InPath(name): InPath<String>,
    conditions: Conditions,
    Json(draft): Json<LoopDraft>,
) -> Result<Tagged<Apply>, Problem> {
    LoopId::new(&name)?;
    if draft.name != name {
        let said: String = draft.name.chars().take(80).collect();
        return Err(Problem::new(
            Kind::Invalid,
            format!("the address names the loop {name:?}, the body {said:?}"),
            "use the same name in both",
        ));
    }
    let end = finish(app.cell.apply(draft.into(), conditions.expect()?)).await?;
    let status = if end.created {
        StatusCode::CREATED
    } else {
        StatusCode::OK
    };
    Ok(Tagged::changed(status, Tag::revision(end.revision), Apply::from(end)))
}

/// Ends a loop. Its outputs stay as they are.
#[utoipa::path(delete, operation_id = "remove_loop", path = "/v1/loops/{name}", tag = "loops", params(("name" = String, Path)),
    responses(
        (status = 204, description = "Ended"),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn remove(
    State(app): State<App>,
    InPath(name): InPath<String>,
    conditions: Conditions,
) -> Result<StatusCode, Problem> {
    finish(app.cell.delete(LoopId::new(&name)?, conditions.expect()?)).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// Sends a command and waits for the record that holds its outcome.
async fn command(
    app: &App,
    id: LoopId,
    key: Option<CommandId>,
    body: CommandBody,
) -> Result<JsonAnswer<Command>, Problem> {
    let end = finish(app.cell.command(id, key, body)).await?;
    match &end.applied.outcome {
        Outcome::Done => Ok(JsonAnswer(Command::from(&end))),
        Outcome::Refused(reason) => Err(Problem::new(Kind::Refused, reason.clone(), "")),
    }
}

/// Sets the setpoint.
#[utoipa::path(post, operation_id = "set_setpoint", path = "/v1/loops/{name}/setpoint", tag = "commands", request_body = SetpointRequest,
    params(("name" = String, Path), ("Idempotency-Key" = Option<String>, Header, description = "UUID; asking twice with it acts once")),
    responses(
        (status = 200, description = "Part of a committed record", body = Command),
        (status = 409, description = "The loop refused it", body = Problem, content_type = "application/problem+json"),
        (status = "default", description = "Anything else", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn setpoint(
    State(app): State<App>,
    InPath(name): InPath<String>,
    IdempotencyKey(key): IdempotencyKey,
    Json(request): Json<SetpointRequest>,
) -> Result<JsonAnswer<Command>, Problem> {
    command(&app, LoopId::new(&name)?, key, CommandBody::Setpoint(request.setpoint)).await
}

/// Puts the loop in manual or automatic, without a bump.
#[utoipa::path(post, operation_id = "set_mode", path = "/v1/loops/{name}/mode", tag = "commands", request_body = ModeRequest,
    params(("name" = String, Path), ("Idempotency-Key" = Option<String>, Header, description = "UUID; asking twice with it acts once")),
    responses(
        (status = 200, description = "Part of a committed record", body = Command),
        (status = 409, description = "The loop refused it", body = Problem, content_type = "application/problem+json"),
        (status = "default", description = "Anything else", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn mode(
    State(app): State<App>,
    InPath(name): InPath<String>,
    IdempotencyKey(key): IdempotencyKey,
    Json(request): Json<ModeRequest>,
) -> Result<JsonAnswer<Command>, Problem> {
    command(&app, LoopId::new(&name)?, key, CommandBody::Mode(request.mode.into())).await
}

/// Sets outputs in manual; an output that is not named keeps what it holds.
#[utoipa::path(post, operation_id = "set_output", path = "/v1/loops/{name}/output", tag = "commands", request_body = OutputRequest,
    params(("name" = String, Path), ("Idempotency-Key" = Option<String>, Header, description = "UUID; asking twice with it acts once")),
    responses(
        (status = 200, description = "Part of a committed record", body = Command),
        (status = 409, description = "The loop refused it, for example in automatic", body = Problem, content_type = "application/problem+json"),
        (status = "default", description = "Anything else", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn output(
    State(app): State<App>,
    InPath(name): InPath<String>,
    IdempotencyKey(key): IdempotencyKey,
    Json(request): Json<OutputRequest>,
) -> Result<JsonAnswer<Command>, Problem> {
    let view = app.cell.loop_view(&LoopId::new(&name)?)?;
    let descriptor = app.cell.resolve(&view.spec.digest.to_string())?.descriptor;
    let ports: Vec<&str> = descriptor
        .ports
        .iter()
        .filter(|port| port.direction == Direction::Output)
        .map(|port| port.name.as_str())
        .collect();
    let held = view
        .last
        .as_ref()
        .map(|record| record.outputs.as_slice())
        .unwrap_or_default();
    let values = output_values(&ports, held, &request.outputs)?;
    command(&app, view.id, key, CommandBody::Output(values)).await
}

/// One value per output port: what is asked for, else what is held.
fn output_values(ports: &[&str], held: &[f64], asked: &BTreeMap<String, f64>) -> Result<Vec<f64>, Problem> {
    let list = || ports.join(", ");
    if asked.is_empty() {
        return Err(Problem::new(
            Kind::Invalid,
            "no output is named",
            format!("name one or more of {}", list()),
        ));
    }
    if let Some(unknown) = asked.keys().find(|name| !ports.contains(&name.as_str())) {
        let unknown: String = unknown.chars().take(80).collect();
        return Err(Problem::new(
            Kind::Invalid,
            format!("there is no output port {unknown:?}"),
            format!("use {}", list()),
        ));
    }
    ports
        .iter()
        .enumerate()
        .map(|(i, port)| {
            asked.get(*port).or_else(|| held.get(i)).copied().ok_or_else(|| {
                let detail = format!("the loop has not run yet, so what {port:?} holds is not known");
                Problem::new(Kind::Refused, detail, "give a value for every output")
            })
        })
        .collect()
}

/// The end of a change, with the tag of the revision that it brought.
fn in_force(end: bumpless_deploy::ApplyEnd) -> Tagged<Apply> {
    Tagged::changed(StatusCode::OK, Tag::revision(end.revision), Apply::from(end))
}

/// Sets parameters or the strategy of a running loop.
#[utoipa::path(post, operation_id = "set_parameters", path = "/v1/loops/{name}/set", tag = "loops", params(("name" = String, Path)), request_body = SetRequest,
    responses(
        (status = 200, description = "In force", body = Apply),
        (status = "default", description = "What went wrong; nothing changed", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn set(
    State(app): State<App>,
    InPath(name): InPath<String>,
    conditions: Conditions,
    Json(request): Json<SetRequest>,
) -> Result<Tagged<Apply>, Problem> {
    let change = Change {
        parameters: request.parameters,
        strategy: request.strategy.map(Into::into),
    };
    let end = finish(app.cell.set(LoopId::new(&name)?, change, conditions.expect()?)).await?;
    Ok(in_force(end))
}

/// Goes on with another component, without a bump.
#[utoipa::path(post, operation_id = "swap_component", path = "/v1/loops/{name}/swap", tag = "loops", params(("name" = String, Path)), request_body = SwapRequest,
    responses(
        (status = 200, description = "In force", body = Apply),
        (status = 409, description = "Refused, for example because the output would bump", body = Problem, content_type = "application/problem+json"),
        (status = "default", description = "Anything else; nothing changed", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn swap(
    State(app): State<App>,
    InPath(name): InPath<String>,
    conditions: Conditions,
    Json(request): Json<SwapRequest>,
) -> Result<Tagged<Apply>, Problem> {
    let end = finish(
        app.cell
            .swap(LoopId::new(&name)?, request.component, conditions.expect()?),
    )
    .await?;
    Ok(in_force(end))
}

/// Goes back to an earlier revision.
#[utoipa::path(post, operation_id = "roll_back_loop", path = "/v1/loops/{name}/rollback", tag = "loops", params(("name" = String, Path)), request_body = RollbackRequest,
    responses(
        (status = 200, description = "In force", body = Apply),
        (status = "default", description = "What went wrong; nothing changed", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn rollback(
    State(app): State<App>,
    InPath(name): InPath<String>,
    conditions: Conditions,
    Json(request): Json<RollbackRequest>,
) -> Result<Tagged<Apply>, Problem> {
    let end = finish(
        app.cell
            .rollback(LoopId::new(&name)?, request.revision, conditions.expect()?),
    )
    .await?;
    Ok(in_force(end))
}

/// Gives the ownership to another host, between two cycles.
#[utoipa::path(post, operation_id = "move_loop", path = "/v1/loops/{name}/move", tag = "loops", params(("name" = String, Path)), request_body = MoveRequest,
    responses(
        (status = 204, description = "The next cycle is that host's"),
        (status = "default", description = "What went wrong; nothing changed", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn move_owner(
    State(app): State<App>,
    InPath(name): InPath<String>,
    Json(request): Json<MoveRequest>,
) -> Result<StatusCode, Problem> {
    finish(app.cell.move_owner(LoopId::new(&name)?, HostId::new(&request.host)?)).await?;
    Ok(StatusCode::NO_CONTENT)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

    use super::*;

    #[test]
    fn outputs_by_name_become_one_value_per_port() {
        let asked = |rows: &[(&str, f64)]| {
            rows.iter()
                .map(|(n, v)| ((*n).to_owned(), *v))
                .collect::<BTreeMap<_, _>>()
        };
        let ports = ["valve", "pump"];
        assert_eq!(
            output_values(&ports, &[1.0, 2.0], &asked(&[("pump", 9.0)])),
            Ok(vec![1.0, 9.0])
        );
        assert_eq!(
            output_values(&ports, &[], &asked(&[("pump", 9.0), ("valve", 8.0)])),
            Ok(vec![8.0, 9.0])
        );
        for (held, rows, part) in [
            (&[1.0, 2.0][..], &[][..], "no output is named"),
            (&[1.0, 2.0], &[("heater", 1.0)], "no output port \"heater\""),
            (&[], &[("pump", 1.0)], "what \"valve\" holds is not known"),
        ] {
            let problem = output_values(&ports, held, &asked(rows)).expect_err(part);
            assert!(problem.detail.contains(part), "{problem:?}");
        }
    }
}
