//! What operations have in common, put into the document in one place: errors, keys, conditions, links and examples.
//!
//! A route says what is its own: its parameters, its body, its good answers, and the errors that need words of their own. The rest
//! follows from what the middlewares and extractors do for every route, so a new route is documented whole by itself.
//! Never: says anything of a single route that the route could say; the lists of names below are those with entity tags.

use std::sync::LazyLock;

use axum::http::StatusCode;
use serde_json::{Map, Value, json};

/// Requests and answers, by operation. The tests ask the API for the answers, so they are what it gives.
const EXAMPLES: &str = include_str!("examples.json");

/// Operations whose answer has an entity tag.
const TAGGED: [&str; 5] = [
    "show_loop",
    "show_component",
    "download_component",
    "show_alarm",
    "read_openapi",
];

/// Changes that may be made to depend on an entity tag, and whether their answer has the new one.
const CONDITIONAL: [(&str, bool); 9] = [
    ("apply_loop", true),
    ("set_parameters", true),
    ("swap_component", true),
    ("roll_back_loop", true),
    ("remove_loop", false),
    ("relabel_component", true),
    ("remove_component", false),
    ("define_alarm", true),
    ("remove_alarm", false),
];

/// Operations that are served without a place and a time limit, for they must answer when there is none.
const UNLIMITED: [&str; 2] = ["is_alive", "is_ready"];

/// Operations for which nobody needs to sign in.
const OPEN: [&str; 3] = ["is_alive", "is_ready", "who_am_i"];

/// The examples, by operation.
pub(super) static ALL_EXAMPLES: LazyLock<Map<String, Value>> =
    LazyLock::new(|| serde_json::from_str(EXAMPLES).unwrap_or_default());

/// Status, name and words of the errors that operations share.
const ERRORS: [(u16, &str, &str); 14] = [
    (
        400,
        "BadRequest",
        "The address, a header or the text of the body cannot be read",
    ),
    (401, "SignIn", "This host wants to know who asks"),
    (
        403,
        "Forbidden",
        "The role or the loops of the asker do not reach so far, or a page of another site asks",
    ),
    (429, "TooOften", "Too many in a short time; wait"),
    (404, "NotFound", "The cell has nothing of that name"),
    (
        409,
        "Refused",
        "Not with what the cell has or does now; or a request with this key is under way",
    ),
    (
        412,
        "Precondition",
        "It is not what If-Match or If-None-Match counts on; nothing was done",
    ),
    (413, "TooLarge", "The body is too large"),
    (
        415,
        "ContentType",
        "The body has another content type than this operation takes",
    ),
    (
        422,
        "Invalid",
        "What was given cannot be right, or the key belongs to another request; says why",
    ),
    (500, "Internal", "The host or its disk failed"),
    (
        503,
        "Busy",
        "A limit is reached, or a host that must answer is away; try again",
    ),
    (504, "Timeout", "No answer in time; what was asked may still happen"),
    (304, "NotModified", "The asker has it as it is now"),
];

/// The document, complete, its keys in order.
pub(super) fn complete(mut document: Value) -> Value {
    if let Some(paths) = document["paths"].as_object_mut() {
        for (path, methods) in paths {
            for (method, operation) in methods.as_object_mut().into_iter().flatten() {
                of_operation(path, method, operation);
            }
        }
    }
    let mut lists = Vec::new();
    if let Some(schemas) = document["components"]["schemas"].as_object() {
        let is_list = |schema: &Value| schema["properties"].get("next").is_some();
        lists = schemas
            .iter()
            .filter(|(_, schema)| is_list(schema))
            .map(|(name, _)| name.clone())
            .collect();
    }
    if let Some(paths) = document["paths"].as_object_mut() {
        for operation in paths.values_mut().filter_map(|methods| methods.get_mut("get")) {
            let good = &mut operation["responses"]["200"];
            let of = good["content"]["application/json"]["schema"]["$ref"]
                .as_str()
                .unwrap_or_default();
            if lists.iter().any(|list| of.ends_with(&format!("/{list}"))) {
                good["headers"]["Link"] = json!({
                    "description": "The address of the next part, where there is one: `<…>; rel=\"next\"` (RFC 8288)",
                    "schema": { "type": "string" },
                });
            }
        }
    }
    for (status, name, words) in ERRORS {
        document["components"]["responses"][name] = error(status, words);
    }
    in_order(document)
}

/// The same value with its keys in order, whichever map the JSON library was built with.
fn in_order(value: Value) -> Value {
    match value {
        Value::Object(map) => {
            let mut rows: Vec<(String, Value)> = map.into_iter().collect();
            rows.sort_by(|a, b| a.0.cmp(&b.0));
            Value::Object(rows.into_iter().map(|(key, value)| (key, in_order(value))).collect())
        }
        Value::Array(rows) => Value::Array(rows.into_iter().map(in_order).collect()),
        plain => plain,
    }
}

/// A shared answer.
fn error(status: u16, words: &str) -> Value {
    if status == StatusCode::NOT_MODIFIED.as_u16() {
        return json!({ "description": words });
    }
    let mut answer = json!({
        "description": words,
        "content": { "application/problem+json": {
            "schema": { "$ref": "#/components/schemas/Problem" },
            "example": {
                "type": format!("urn:bumpless:problem:{}", kind(status)),
                "title": words.split(';').next().unwrap_or(words),
                "status": status,
                "detail": "what happened this time, naming the place",
                "cure": "what helps",
            },
        } },
    });
    if status == StatusCode::SERVICE_UNAVAILABLE.as_u16() {
        answer["headers"]["Retry-After"] = json!({
            "description": "Seconds to wait before asking again",
            "schema": { "type": "integer", "minimum": 0 },
        });
    }
    answer
}

/// The usual kind of problem with a status.
const fn kind(status: u16) -> &'static str {
    match status {
        400 => "bad-request",
        401 => "sign-in",
        403 => "forbidden",
        429 => "too-often",
        404 => "not-found",
        409 => "refused",
        412 => "precondition",
        413 => "too-large",
        415 => "content-type",
        422 => "invalid",
        503 => "busy",
        504 => "timeout",
        _ => "internal",
    }
}

/// Adds a parameter that is a header, unless the route names it itself.
fn header(operation: &mut Value, name: &str, words: &str, example: &str) {
    if !operation["parameters"].is_array() {
        operation["parameters"] = json!([]);
    }
    let Some(parameters) = operation["parameters"].as_array_mut() else {
        return;
    };
    parameters.retain(|parameter| parameter["name"] != name);
    let mut schema = json!({ "type": "string" });
    if name == "Idempotency-Key" {
        schema["pattern"] = json!("^[0-9a-f]{1,32}$|^[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}$");
    } else {
        schema["pattern"] = json!(r#"^(\*|"[!#-~]{1,64}")$"#);
    }
    parameters.push(json!({
        "name": name, "in": "header", "required": false, "description": words, "schema": schema, "example": example,
    }));
}

fn of_operation(path: &str, method: &str, operation: &mut Value) {
    let id = operation["operationId"].as_str().unwrap_or_default().to_owned();
    let changes = method != "get";
    let named = |place: &str| {
        let parameters = operation["parameters"].as_array();
        parameters.is_some_and(|all| all.iter().any(|parameter| parameter["in"] == place))
    };
    let (in_path, in_query, body) = (named("path"), named("query"), operation["requestBody"].is_object());
    let mut statuses = vec![403, 500];
    if !OPEN.contains(&id.as_str()) {
        statuses.extend([401, 429]);
    }
    if !UNLIMITED.contains(&id.as_str()) {
        statuses.extend([503, 504]);
    }
    if in_path || in_query || body {
        statuses.extend([400, 404, 409, 422]);
    }
    if body {
        statuses.extend([413, 415]);
    }
    if changes {
        statuses.extend([400, 409, 413, 422]);
        header(
            operation,
            "Idempotency-Key",
            "A UUID, or 1 to 32 hexadecimal digits. The same request with the same key acts once, and gets the same answer, for an hour",
            "5f0c2d7e-8a3b-4c1d-9e2f-6a7b8c9d0e1f",
        );
    }
    let conditional = CONDITIONAL.iter().find(|(name, _)| *name == id);
    if let Some((_, with_tag)) = conditional {
        statuses.push(412);
        header(
            operation,
            "If-Match",
            "Only if it still has this entity tag, from the ETag of an earlier answer; or `*`: only if it exists",
            "\"r7\"",
        );
        header(operation, "If-None-Match", "`*`: only if it does not exist yet", "*");
        if *with_tag {
            tagged(operation);
        }
    }
    if TAGGED.contains(&id.as_str()) {
        statuses.extend([304, 400]);
        header(
            operation,
            "If-None-Match",
            "An entity tag that the asker has: 304 where it is still so",
            "\"r7\"",
        );
        tagged(operation);
    }
    if let Some(responses) = operation["responses"].as_object_mut() {
        // Every error that there is has its own row.
        responses.remove("default");
        for (status, name, _) in ERRORS {
            if statuses.contains(&status) {
                responses
                    .entry(status.to_string())
                    .or_insert_with(|| json!({ "$ref": format!("#/components/responses/{name}") }));
            }
        }
    }
    examples(path, &id, operation);
}

/// Its good answers have an entity tag.
fn tagged(operation: &mut Value) {
    let Some(responses) = operation["responses"].as_object_mut() else {
        return;
    };
    for answer in ["200", "201"]
        .iter()
        .filter_map(|status| responses.get_mut(*status).map(|_| *status))
        .collect::<Vec<_>>()
    {
        if let Some(answer) = responses.get_mut(answer) {
            answer["headers"]["ETag"] = json!({
                "description": "The entity tag, for If-Match and If-None-Match",
                "schema": { "type": "string" },
            });
        }
    }
}

/// Puts the operation's example where it belongs.
fn examples(path: &str, id: &str, operation: &mut Value) {
    let Some(example) = ALL_EXAMPLES.get(id) else { return };
    let asked = example["path"].as_str().unwrap_or_default();
    let (asked, query) = asked.split_once('?').unwrap_or((asked, ""));
    // Looked up, not indexed: an index would put a null where there is nothing.
    let parameters = operation.get_mut("parameters").and_then(Value::as_array_mut);
    for parameter in parameters.into_iter().flatten() {
        let name = parameter["name"].as_str().unwrap_or_default().to_owned();
        let placed = match parameter["in"].as_str() {
            Some("path") => {
                let parts = path.split('/').zip(asked.split('/'));
                let mut parts = parts.filter(|(template, _)| *template == format!("{{{name}}}"));
                parts.next().map(|(_, value)| value)
            }
            Some("query") => {
                let mut pairs = query.split('&').filter_map(|pair| pair.split_once('='));
                pairs.find(|(key, _)| *key == name).map(|(_, value)| value)
            }
            _ => None,
        };
        if let Some(value) = placed {
            parameter["example"] = match parameter["schema"]["type"].as_str() {
                // A number stands as one.
                Some("integer") => value.parse::<u64>().map_or(json!(value), |value| json!(value)),
                _ => json!(value),
            };
        }
    }
    if let Some(request) = example.get("request") {
        let content = operation.pointer_mut("/requestBody/content");
        for (_, content) in content.and_then(Value::as_object_mut).into_iter().flatten() {
            content["example"] = request.clone();
        }
    }
    if let Some(answer) = example.get("answer") {
        let content = operation.pointer_mut(&format!("/responses/{}/content", example["status"]));
        for (_, content) in content.and_then(Value::as_object_mut).into_iter().flatten() {
            content["example"] = answer.clone();
        }
    }
}
