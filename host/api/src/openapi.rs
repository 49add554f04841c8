//! The OpenAPI document, made from the routes and types, so that it cannot say anything else than the code.

mod complete;

use std::sync::LazyLock;

use utoipa::OpenApi;

use crate::{
    error::Problem,
    routes::{
        access, alarms, audit, bundle, components, demo, field, health, history, hosts, lab, live, load, loops, pages,
        past, programs, rollouts, signing, trend,
    },
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
        access::me, access::sign_in, access::first, access::sign_out, access::password, access::users, access::add_user,
        access::change_user, access::remove_user, access::make_token, access::tokens, access::make_own_token, access::revoke_token,
        components::list, components::upload, components::show, components::bytes, components::relabel, components::remove, components::call,
        bundle::export, bundle::import, signing::show, signing::put, signing::of_component, signing::sign,
        loops::list, loops::show, loops::apply, loops::remove, loops::set, loops::swap, loops::rollback, loops::move_owner,
        loops::setpoint, loops::mode, loops::output,
        history::cycles, past::of_loop, past::of_point, history::replay, history::backtest,
        history::start_shadow, history::shadows, history::show_shadow, history::stop_shadow,
        programs::create, programs::list, programs::show, programs::order, programs::remove, programs::log, programs::checkpoint,
        programs::script,
        rollouts::start, rollouts::list, rollouts::show, rollouts::stop,
        alarms::list, alarms::past, alarms::show, alarms::act, alarms::define, alarms::remove,
        load::metrics, load::webhooks, audit::list, audit::verify, audit::export,
        hosts::list, health::of_host, hosts::drain, hosts::undrain, hosts::points, live::feed, trend::trend, trend::list_notices, demo::show, demo::fault, lab::list, lab::show,
        field::point, field::write, field::force, field::unforce, field::buses,
        field::start, field::jobs, field::job, field::cancel,
        health::livez, health::readyz, pages::metrics, pages::openapi,
    ),
    components(schemas(Problem, types::Record, types::Hosts, types::LiveRows, types::Standing, types::FieldNews, types::LiveField, live::Form, audit::AuditFormat)),
    tags(
        (name = "components", description = "The library of control components"),
        (name = "loops", description = "Controllers bound to points"),
        (name = "commands", description = "What an operator asks of a running loop; answered when a committed record holds it"),
        (name = "history", description = "Looking back: recorded cycles, years of thinned history, replays, and candidates tried on them or beside a running loop"),
        (name = "programs", description = "Free-running programs and scripts: started, paused, resumed and stopped at any instruction"),
        (name = "rollouts", description = "One component for many loops: one loop first, then the rest by rule"),
        (name = "alarms", description = "What stands, what happened, and what people do about it, by ANSI/ISA-18.2"),
        (name = "audit", description = "Who changed what: a chain of entries on each host, listed, verified, exported"),
        (name = "cell", description = "Hosts, points and the live feed"),
        (name = "field", description = "Points by hand, forces, buses, and jobs: what takes long is acknowledged at once and told of later"),
        (name = "lab", description = "Reports of experiments, where the host has a folder of them"),
        (name = "access", description = "Who one is, accounts with roles, tokens for programs"),
        (name = "operation", description = "For supervisors and monitoring"),
    )
)]
struct Document;

/// The document as pretty JSON with a final newline: what `docs/openapi.json` holds.
#[must_use]
pub fn openapi_json() -> &'static str {
    static TEXT: LazyLock<String> = LazyLock::new(|| {
        // The document is strings and numbers, so it always serialises; the test below would see an empty one.
        let document = serde_json::to_value(Document::openapi()).unwrap_or_default();
        format!("{:#}\n", complete::complete(document))
    });
    &TEXT
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
            std::fs::write(path, now).expect("docs/openapi.json can be written");
        }
        let kept = std::fs::read_to_string(path).unwrap_or_default();
        assert!(
            kept == now,
            "docs/openapi.json is not what the code says: run `cargo xtask openapi`, or this test with UPDATE_EXPECT=1"
        );
    }

    #[test]
    fn every_operation_has_a_name_of_its_own() {
        let document: serde_json::Value = serde_json::from_str(openapi_json()).expect("it is JSON");
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
        let document: serde_json::Value = serde_json::from_str(openapi_json()).expect("it is JSON");
        let listed = document["paths"].as_object().expect("paths").len();
        let routes = include_str!("routes.rs").matches(".route(").count();
        // The page for people at "/", and the older name of /livez, are no part of the API.
        assert_eq!(listed, routes - 2);
    }

    /// Every operation of the document: method, path, and what is said of it.
    fn operations() -> Vec<(String, String, serde_json::Value)> {
        let document: serde_json::Value = serde_json::from_str(openapi_json()).expect("it is JSON");
        let paths = document["paths"].as_object().expect("paths").clone();
        let of = |(path, methods): (String, serde_json::Value)| {
            let methods = methods.as_object().expect("operations").clone();
            methods
                .into_iter()
                .map(move |(method, operation)| (method, path.clone(), operation))
        };
        paths.into_iter().flat_map(of).collect()
    }

    #[test]
    fn every_operation_names_every_answer_that_it_may_give() {
        for (method, path, operation) in operations() {
            let answers: Vec<&String> = operation["responses"].as_object().expect("answers").keys().collect();
            let place = format!("{method} {path}: {answers:?}");
            let has = |status: &str| answers.iter().any(|one| *one == status);
            assert!(!has("default"), "{place}");
            assert!(has("500"), "{place}");
            if method != "get" {
                let keyed = operation["parameters"].to_string().contains("Idempotency-Key");
                assert!(keyed && has("409") && has("422"), "{place}");
            }
            if path.contains('{') {
                assert!(has("404") && has("400"), "{place}");
            }
            if operation["requestBody"].is_object() {
                assert!(has("413") && has("415"), "{place}");
            }
        }
    }

    #[test]
    fn every_reference_leads_somewhere() {
        fn references(value: &serde_json::Value, found: &mut Vec<String>) {
            match value {
                serde_json::Value::Object(map) => {
                    found.extend(map.get("$ref").and_then(|to| to.as_str()).map(str::to_owned));
                    map.values().for_each(|value| references(value, found));
                }
                serde_json::Value::Array(rows) => rows.iter().for_each(|row| references(row, found)),
                _ => {}
            }
        }
        let document: serde_json::Value = serde_json::from_str(openapi_json()).expect("it is JSON");
        let mut found = Vec::new();
        references(&document, &mut found);
        assert!(found.len() > 100, "{}", found.len());
        let lost = |to: &String| document.pointer(to.trim_start_matches('#')).is_none();
        let lost: Vec<String> = found.into_iter().filter(lost).collect();
        assert!(lost.is_empty(), "{lost:?}");
    }

    #[test]
    fn nothing_is_null_but_examples() {
        fn nulls(place: &str, value: &serde_json::Value, found: &mut Vec<String>) {
            match value {
                serde_json::Value::Null => found.push(place.to_owned()),
                serde_json::Value::Object(map) => {
                    for (key, value) in map
                        .iter()
                        .filter(|(key, _)| !["example", "default", "enum"].contains(&key.as_str()))
                    {
                        nulls(&format!("{place}/{key}"), value, found);
                    }
                }
                serde_json::Value::Array(rows) => rows.iter().for_each(|row| nulls(place, row, found)),
                _ => {}
            }
        }
        let document: serde_json::Value = serde_json::from_str(openapi_json()).expect("it is JSON");
        let mut found = Vec::new();
        nulls("", &document, &mut found);
        assert!(found.is_empty(), "{found:?}");
    }

    /// The shape of an answer: its keys, and of a list the shape of its first row.
    fn shape(value: &serde_json::Value) -> serde_json::Value {
        use serde_json::Value;
        match value {
            Value::Object(map) => map.iter().map(|(key, value)| (key.clone(), shape(value))).collect(),
            Value::Array(rows) => rows.first().map(shape).into_iter().collect(),
            _ => Value::Null,
        }
    }

    #[tokio::test]
    async fn every_operation_has_an_example_that_the_api_gives() {
        use crate::tests::example_answer;
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/src/openapi/examples.json");
        let update = std::env::var_os("UPDATE_EXPECT").is_some();
        let mut examples = complete::ALL_EXAMPLES.clone();
        let mut wrong = Vec::new();
        let hint = "write `path` and `request` into host/api/src/openapi/examples.json, then `cargo xtask openapi` asks for the answer";
        for (method, template, operation) in operations() {
            let id = operation["operationId"].as_str().expect("an id").to_owned();
            let good = operation["responses"].as_object().expect("answers").iter();
            let plain = |content: &serde_json::Value| content.get("application/json").is_some();
            let json_answer = good
                .clone()
                .any(|(status, answer)| status.starts_with('2') && plain(&answer["content"]));
            let no_body = good
                .clone()
                .any(|(status, answer)| status.starts_with('2') && answer.get("content").is_none());
            let binary_request = operation["requestBody"].is_object() && !plain(&operation["requestBody"]["content"]);
            let Some(example) = examples.get_mut(&id) else {
                // Bytes have no example in a text.
                if (json_answer || no_body) && !binary_request {
                    wrong.push(format!("{method} {template}: no example; {hint}"));
                }
                continue;
            };
            if !json_answer && !no_body || id == "read_openapi" {
                continue;
            }
            let asked = example["path"].as_str().unwrap_or_default().to_owned();
            let (status, answer) = example_answer(&method, &asked, example.get("request")).await;
            if !(200..300).contains(&status) {
                wrong.push(format!("{method} {asked}: {status} {answer}"));
            } else if update && asked.starts_with("/v1/access/") && shape(&example["answer"]) == shape(&answer) {
                // Its secrets are drawn anew each time; an example stays.
            } else if update {
                example["status"] = status.into();
                if !answer.is_null() {
                    example["answer"] = answer;
                }
            } else if example["status"] != status || shape(&example["answer"]) != shape(&answer) {
                wrong.push(format!("{method} {asked}: another answer than the example's; {hint}"));
            }
        }
        if update {
            let rows: std::collections::BTreeMap<_, _> = examples.into_iter().collect();
            let text = serde_json::to_string_pretty(&rows).expect("plain data");
            std::fs::write(path, format!("{text}\n")).expect("the examples can be written");
        }
        assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    }
}
