//! The OpenAPI document, made from the routes and types, so that it cannot say anything else than the code.

use utoipa::OpenApi;

use crate::{
    error::Problem,
    routes::{alarms, bundle, components, demo, field, history, hosts, live, loops, pages, rollouts, trend},
    types,
};

#[derive(OpenApi)]
#[openapi(
    info(
        title = "Bumpless",
        description = "The API of a cell: upload control components, bind them to loops, swap them while they run, \
                       command, watch. Every host answers for the whole cell. Errors are problem+json (RFC 9457)."
    ),
    paths(
        components::list, components::upload, components::show, components::bytes, components::relabel, components::remove, components::call,
        bundle::export, bundle::import,
        loops::list, loops::show, loops::apply, loops::remove, loops::set, loops::swap, loops::rollback, loops::move_owner,
        loops::setpoint, loops::mode, loops::output,
        history::cycles, history::replay, history::backtest,
        history::start_shadow, history::shadows, history::show_shadow, history::stop_shadow,
        rollouts::start, rollouts::list, rollouts::show, rollouts::stop,
        alarms::list, alarms::past, alarms::act, alarms::define, alarms::remove,
        hosts::list, hosts::drain, hosts::undrain, hosts::points, live::feed, trend::trend, trend::list_notices, demo::show, demo::fault,
        field::point, field::write, field::force, field::unforce, field::buses,
        field::start, field::jobs, field::job, field::cancel,
        pages::healthz, pages::readyz, pages::metrics, pages::openapi,
    ),
    components(schemas(Problem, types::Record, types::Hosts, types::LiveRows, types::Standing, types::FieldNews)),
    tags(
        (name = "components", description = "The library of control components"),
        (name = "loops", description = "Controllers bound to points"),
        (name = "commands", description = "What an operator asks of a running loop; answered when a committed record holds it"),
        (name = "history", description = "Looking back: recorded cycles, replays, and candidates tried on them or beside a running loop"),
        (name = "rollouts", description = "One component for many loops: one loop first, then the rest by rule"),
        (name = "alarms", description = "What stands, what happened, and what people do about it, by ANSI/ISA-18.2"),
        (name = "cell", description = "Hosts, points and the live feed"),
        (name = "field", description = "Points by hand, forces, buses, and jobs: what takes long is acknowledged at once and told of later"),
        (name = "operation", description = "For supervisors and monitoring"),
    )
)]
struct Document;

/// The document as pretty JSON with a final newline: what `docs/openapi.json` holds.
#[must_use]
pub fn openapi_json() -> String {
    // The document is strings and numbers, so it always serialises; the test below would see an empty one.
    let mut text = Document::openapi().to_pretty_json().unwrap_or_default();
    text.push('\n');
    text
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

    use super::*;

    #[test]
    fn the_checked_in_document_is_the_code() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/openapi.json");
        let now = openapi_json();
        if std::env::var_os("UPDATE_EXPECT").is_some() {
            std::fs::write(path, &now).expect("docs/openapi.json can be written");
        }
        let kept = std::fs::read_to_string(path).unwrap_or_default();
        assert!(
            kept == now,
            "docs/openapi.json is not what the code says: run `cargo xtask openapi`, or this test with UPDATE_EXPECT=1"
        );
    }

    #[test]
    fn every_operation_has_a_name_of_its_own() {
        let document: serde_json::Value = serde_json::from_str(&openapi_json()).expect("it is JSON");
        let paths = document["paths"].as_object().expect("paths");
        let ids: Vec<&str> = paths
            .values()
            .flat_map(|path| path.as_object().expect("operations").values())
            .map(|operation| operation["operationId"].as_str().expect("an id"))
            .collect();
        let different: std::collections::HashSet<&&str> = ids.iter().collect();
        assert_eq!(
            different.len(),
            ids.len(),
            "generated clients name their functions after these: {ids:?}"
        );
    }

    #[test]
    fn every_route_is_in_the_document() {
        let document: serde_json::Value = serde_json::from_str(&openapi_json()).expect("it is JSON");
        let listed = document["paths"].as_object().expect("paths").len();
        let routes = include_str!("routes.rs").matches(".route(").count();
        // The page for people at "/" is no part of the API.
        assert_eq!(listed, routes - 1);
    }
}
