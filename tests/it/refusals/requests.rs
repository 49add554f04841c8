//! Requests that are none: each gets a problem in words, and the host stays well.

use bumpless_tests::Api;

const JSON: (&str, &str) = ("content-type", "application/json");

/// Method, address, headers and body; the status of the answer, and a part of its words.
type Row<'a> = (&'a str, &'a str, &'a [(&'a str, &'a str)], &'a [u8], u16, &'a str);

pub(super) fn refused(api: &Api) {
    let setpoint = "/v1/loops/loop-0/setpoint";
    let long = vec![b' '; 300 * 1024];
    let good: &[u8] = b"{\"setpoint\": 40}";
    let table: [Row<'_>; 17] = [
        ("GET", "/v1/nothing", &[], b"", 404, "no address of this API"),
        (
            "GET",
            "/v1/loops/loop-0/nothing",
            &[],
            b"",
            404,
            "no address of this API",
        ),
        ("PATCH", "/v1/loops/loop-0", &[], b"", 405, "PATCH means nothing here"),
        ("DELETE", "/v1/hosts", &[], b"", 405, "DELETE means nothing here"),
        ("POST", setpoint, &[JSON], b"{\"setpoint\": ", 400, "EOF"),
        ("POST", setpoint, &[JSON], b"\xff\xfe", 400, "column"),
        (
            "POST",
            setpoint,
            &[JSON],
            b"{\"setpoint\": 1e999}",
            400,
            "number out of range",
        ),
        (
            "POST",
            setpoint,
            &[JSON],
            b"{\"setpoint\": 40, \"speed\": 1}",
            422,
            "unknown field `speed`",
        ),
        ("POST", setpoint, &[], good, 415, "Content-Type: application/json"),
        (
            "POST",
            setpoint,
            &[("content-type", "text/plain")],
            good,
            415,
            "text/plain",
        ),
        (
            "POST",
            setpoint,
            &[JSON, ("idempotency-key", "no key!")],
            good,
            400,
            "Idempotency-Key",
        ),
        ("POST", setpoint, &[JSON], &long, 413, "longer than"),
        ("POST", "/v1/components", &[JSON], b"{}", 415, "application/wasm"),
        ("GET", "/v1/loops?limit=0", &[], b"", 422, "limit = 0"),
        ("GET", "/v1/loops?speed=1", &[], b"", 400, "speed"),
        ("GET", "/v1/live?loops=,,", &[], b"", 422, "loops names 0 loops"),
        ("GET", "/v1/loops/%ff", &[], b"", 400, "address"),
    ];
    for (method, path, headers, body, status, part) in table {
        let answer = api.send(method, path, headers, body).unwrap();
        let case = format!("{method} {path}: {} {}", answer.status, answer.text());
        assert_eq!(answer.status, status, "{case}");
        let kind = answer.headers.get("content-type").map(String::as_str);
        assert_eq!(kind, Some("application/problem+json"), "{case}");
        let problem = answer.json();
        let words = format!("{} {}", problem["detail"], problem["cure"]);
        assert!(words.contains(part), "{part:?} is missing in {case}");
        assert_eq!(problem["status"], status, "{case}");
    }
    let health = api.get("/healthz").unwrap();
    assert_eq!(health["alive"], true);
    assert_eq!(api.get("/readyz").unwrap()["ready"], true);
}
