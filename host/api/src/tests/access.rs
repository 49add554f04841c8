//! Who may do what, over HTTP: every route of the document against every role, and what a guard turns away.

use std::{collections::HashMap, time::Duration};

use axum::http::{HeaderValue, Method};
use bumpless_access::{Need, Reach, Role, Scope};

use super::{guests::name, *};
use crate::{
    access::Access,
    needs::{self, Who},
};

/// A host that asks who one is, with an account and a token of each role, and `a-only`, an engineer of the loop `a`.
fn secured() -> (Bench, HashMap<&'static str, String>) {
    let bench = Bench::new();
    let tokens = bench.cell.guests(|guests| {
        guests.secured = true;
        for role in Role::ALL {
            guests.add(role.name(), role, Scope::All);
        }
        guests.add("a-only", Role::Engineer, Scope::Loops(vec!["a".to_owned()]));
        ["viewer", "operator", "engineer", "admin", "a-only"]
            .map(|who| (who, guests.token(who)))
            .into()
    });
    (bench, tokens)
}

fn with_token(mut request: Request<Body>, token: &str) -> Request<Body> {
    let value = HeaderValue::try_from(format!("Bearer {token}")).expect("plain");
    request.headers_mut().insert(header::AUTHORIZATION, value);
    request
}

/// Makes a host that asks of the bench, and the request one of its administrator's, for the examples of the document.
pub(super) fn in_session(bench: &Bench, request: &mut Request<Body>) {
    let signed = bench.cell.guests(|guests| {
        (guests.secured, guests.first) = (true, true);
        guests.add("root", Role::Admin, Scope::All);
        guests.add("eve", Role::Engineer, Scope::Loops(vec!["tank-*".to_owned()]));
        guests.token("eve");
        guests.enter("root", "password of root").expect("an account")
    });
    let headers = request.headers_mut();
    let cookie = format!("bumpless={}", signed.cookie.text());
    headers.insert(header::COOKIE, HeaderValue::try_from(cookie).expect("plain"));
    headers.insert(
        "x-csrf-token",
        HeaderValue::try_from(signed.session.csrf).expect("plain"),
    );
}

/// Every operation of the document: method, pattern, an address of it.
fn operations() -> Vec<(Method, String, String)> {
    let document: Value = serde_json::from_str(crate::openapi_json()).expect("it is JSON");
    let paths = document["paths"].as_object().expect("paths");
    let mut all = Vec::new();
    for (path, methods) in paths {
        for method in methods.as_object().expect("operations").keys() {
            let filled: Vec<&str> = path
                .split('/')
                .map(|part| if part.starts_with('{') { "b" } else { part })
                .collect();
            let method = Method::from_bytes(method.to_uppercase().as_bytes()).expect("a method");
            all.push((method, path.clone(), filled.join("/")));
        }
    }
    assert!(all.len() > 70, "{}", all.len());
    all
}

#[tokio::test]
async fn every_route_of_the_document_refuses_who_has_no_role_a_lower_one_or_other_loops() {
    let (bench, tokens) = secured();
    for (method, pattern, path) in operations() {
        let who = needs::of(&method, &pattern).unwrap_or_else(|| panic!("{method} {pattern} has no row in `needs`"));
        let ask = |token: Option<&str>| {
            let request = Request::builder().method(&method).uri(&path);
            let request = request.header(header::CONTENT_TYPE, "application/json");
            let request = request.body(Body::from("{}")).expect("a request");
            let request = match token {
                Some(token) => with_token(request, token),
                None => request,
            };
            bench.ask(request)
        };
        let before = bench.cell.asked.load(Ordering::Relaxed);
        let Who::Needs(need) = who else {
            assert!(
                path.starts_with("/v1/access/") || ["/livez", "/readyz"].contains(&path.as_str()),
                "{path}"
            );
            assert_ne!(ask(None).await.status(), StatusCode::FORBIDDEN, "{method} {path}");
            continue;
        };
        let refused = ask(None).await;
        assert_eq!(refused.status(), StatusCode::UNAUTHORIZED, "{method} {path}");
        assert!(refused.headers().contains_key(header::WWW_AUTHENTICATE));
        for role in Role::ALL.into_iter().filter(|role| *role < need.role) {
            let status = ask(Some(&tokens[role.name()])).await.status();
            assert_eq!(status, StatusCode::FORBIDDEN, "{method} {path} as {role}");
        }
        if need.reach != Reach::Any && need.role <= Role::Engineer {
            let status = ask(Some(&tokens["a-only"])).await.status();
            assert_eq!(status, StatusCode::FORBIDDEN, "{method} {path} for another loop");
        }
        assert_eq!(
            bench.cell.asked.load(Ordering::Relaxed),
            before,
            "{method} {path}: nothing reached the cell"
        );
        // Who has the role comes as far as the route, whatever that says.
        if path != "/v1/live" {
            let status = ask(Some(&tokens[need.role.name()])).await.status();
            let in_the_way = [StatusCode::UNAUTHORIZED, StatusCode::FORBIDDEN];
            let own = ["/v1/access/password", "/v1/access/tokens"].contains(&pattern.as_str());
            assert!(
                own || !in_the_way.contains(&status),
                "{method} {path} as {}: {status}",
                need.role
            );
        }
    }
    let noted = bench.cell.guests(|guests| guests.refused.clone());
    assert!(
        noted
            .iter()
            .any(|(by, what, why)| by == "viewer" && what.contains("/v1/loops/b") && why.contains("needs")),
        "{noted:?}"
    );
}

#[tokio::test]
async fn a_loop_is_changed_by_whose_scope_it_is_in() {
    let (bench, tokens) = secured();
    let setpoint = |of: &str| {
        with_token(
            send("POST", &format!("/v1/loops/{of}/setpoint"), &json!({"setpoint": 1.0})),
            &tokens["a-only"],
        )
    };
    assert_ne!(bench.json(setpoint("a")).await.0, StatusCode::FORBIDDEN);
    // The name is read as the handler reads it.
    assert_ne!(bench.json(setpoint("%61")).await.0, StatusCode::FORBIDDEN);
    for other in ["b", "aa", "a%2Fb", "A"] {
        assert_eq!(bench.json(setpoint(other)).await.0, StatusCode::FORBIDDEN, "{other}");
    }
    let look = with_token(get("/v1/loops/l"), &tokens["a-only"]);
    assert_eq!(bench.json(look).await.0, StatusCode::OK, "looking is not bound");
}

#[tokio::test]
async fn the_trail_gets_the_proved_name_and_no_other() {
    let (bench, tokens) = secured();
    let body = json!({ "act": "acknowledge", "by": "somebody else" });
    let mut request = with_token(send("POST", "/v1/loops/l/alarms/high", &body), &tokens["operator"]);
    request
        .headers_mut()
        .insert("x-by", HeaderValue::from_static("a third"));
    assert_eq!(bench.json(request).await.0, StatusCode::OK);
    let acts = bench.cell.alarm_acts.lock().unwrap().clone();
    assert_eq!(acts.last().map(|(_, _, by)| by.as_str()), Some("operator"));
}

#[tokio::test]
async fn a_session_is_begun_used_and_ended() {
    let (bench, _) = secured();
    let enter = |password: &str| {
        send(
            "POST",
            "/v1/access/sign-in",
            &json!({"name": "operator", "password": password}),
        )
    };
    assert_eq!(bench.json(enter("wrong")).await.0, StatusCode::UNAUTHORIZED);
    let response = bench.ask(enter("password of operator")).await;
    assert_eq!(response.status(), StatusCode::OK);
    let cookie = response.headers()[header::SET_COOKIE].to_str().unwrap().to_owned();
    assert!(
        cookie.contains("HttpOnly") && cookie.contains("SameSite=Strict"),
        "{cookie}"
    );
    let cookie = cookie.split(';').next().unwrap().to_owned();
    let me: Value = serde_json::from_slice(&axum::body::to_bytes(response.into_body(), 10_000).await.unwrap()).unwrap();
    assert_eq!((&me["name"], &me["role"]), (&json!("operator"), &json!("operator")));
    let in_session = |mut request: Request<Body>, csrf: Option<&str>| {
        request
            .headers_mut()
            .insert(header::COOKIE, HeaderValue::try_from(&cookie).unwrap());
        if let Some(csrf) = csrf {
            request
                .headers_mut()
                .insert("x-csrf-token", HeaderValue::try_from(csrf).unwrap());
        }
        request
    };
    let csrf = me["csrf"].as_str().unwrap();
    assert_eq!(bench.json(in_session(get("/v1/loops"), None)).await.0, StatusCode::OK);
    let setpoint = || send("POST", "/v1/loops/l/setpoint", &json!({"setpoint": 1.0}));
    // Another site's page would send the cookie at most, and knows no second secret.
    for bad in [None, Some(""), Some("0".repeat(64).as_str())] {
        assert_eq!(
            bench.json(in_session(setpoint(), bad)).await.0,
            StatusCode::FORBIDDEN,
            "{bad:?}"
        );
    }
    assert_eq!(bench.json(in_session(setpoint(), Some(csrf))).await.0, StatusCode::OK);
    let mut foreign = in_session(setpoint(), Some(csrf));
    foreign
        .headers_mut()
        .insert("sec-fetch-site", HeaderValue::from_static("cross-site"));
    assert_eq!(bench.json(foreign).await.0, StatusCode::FORBIDDEN);
    let out = in_session(send("POST", "/v1/access/sign-out", &json!({})), Some(csrf));
    assert_eq!(bench.json(out).await.0, StatusCode::NO_CONTENT);
    assert_eq!(
        bench.json(in_session(get("/v1/loops"), None)).await.0,
        StatusCode::UNAUTHORIZED
    );
}

#[tokio::test]
async fn a_guesser_is_slowed_down_and_the_others_are_not() {
    let (bench, tokens) = secured();
    let guess = || with_token(get("/v1/loops"), &format!("bpl_{}_{}", "0".repeat(16), "0".repeat(64)));
    let mut tries = 0;
    let slowed = loop {
        let response = bench.ask(guess()).await;
        if response.status() == StatusCode::TOO_MANY_REQUESTS {
            break response;
        }
        assert_eq!(response.status(), StatusCode::UNAUTHORIZED);
        tries += 1;
        assert!(tries < 100);
    };
    assert!(slowed.headers().contains_key(header::RETRY_AFTER));
    let enter = send(
        "POST",
        "/v1/access/sign-in",
        &json!({"name": "operator", "password": "password of operator"}),
    );
    assert_eq!(
        bench.json(enter).await.0,
        StatusCode::TOO_MANY_REQUESTS,
        "from the same address"
    );
    let good = with_token(get("/v1/loops"), &tokens["viewer"]);
    assert_eq!(bench.json(good).await.0, StatusCode::OK);
}

#[tokio::test]
async fn a_credential_is_used_at_a_pace() {
    let (bench, tokens) = secured();
    let mut good = 0;
    loop {
        let status = bench
            .ask(with_token(get("/v1/access/me"), &tokens["viewer"]))
            .await
            .status();
        if status == StatusCode::TOO_MANY_REQUESTS {
            break;
        }
        good += 1;
        assert!(good < 20_000);
    }
    let other = with_token(get("/v1/loops"), &tokens["operator"]);
    assert_eq!(bench.json(other).await.0, StatusCode::OK);
}

#[tokio::test]
async fn a_feed_ends_with_its_credential() {
    let (bench, tokens) = secured();
    let response = bench.ask(with_token(get("/v1/live"), &tokens["viewer"])).await;
    assert_eq!(response.status(), StatusCode::OK);
    let mut pieces = response.into_body().into_data_stream();
    assert!(pieces.next().await.is_some(), "it tells of the hosts at once");
    let id = bench
        .cell
        .tokens()
        .into_iter()
        .find(|token| token.account == name("viewer"))
        .unwrap()
        .id;
    bench.cell.guests(|guests| guests.register.revoke(&id)).unwrap();
    let ended = async { while pieces.next().await.is_some() {} };
    assert!(tokio::time::timeout(Duration::from_secs(20), ended).await.is_ok());
}

#[tokio::test]
async fn the_first_administrator_needs_the_token_and_is_the_first_only_once() {
    let bench = Bench::new();
    bench
        .cell
        .guests(|guests| (guests.secured, guests.first) = (true, true));
    let (_, me) = bench.json(get("/v1/access/me")).await;
    assert_eq!(
        (&me["secured"], &me["first"], &me["role"]),
        (&json!(true), &json!(true), &json!(null))
    );
    let first = |token: &str| {
        send(
            "POST",
            "/v1/access/first",
            &json!({"token": token, "name": "root", "password": "long enough"}),
        )
    };
    assert_eq!(bench.json(first("guess")).await.0, StatusCode::UNAUTHORIZED);
    let (status, me) = bench.json(first("first")).await;
    assert_eq!((status, &me["role"]), (StatusCode::OK, &json!("admin")));
    assert_eq!(bench.json(first("first")).await.0, StatusCode::UNAUTHORIZED);
}

#[tokio::test]
async fn a_host_that_asks_nobody_is_as_it_was_and_makes_no_accounts() {
    let bench = Bench::new();
    let (_, me) = bench.json(get("/v1/access/me")).await;
    assert_eq!(
        (&me["secured"], &me["role"], &me["loops"]),
        (&json!(false), &json!("admin"), &json!(["*"]))
    );
    assert_eq!(
        bench
            .json(send("POST", "/v1/loops/l/setpoint", &json!({"setpoint": 1.0})))
            .await
            .0,
        StatusCode::OK
    );
    for (method, path, body) in [
        ("POST", "/v1/access/users", json!({"name": "eve", "role": "admin"})),
        ("POST", "/v1/access/users/eve/tokens", json!({})),
        ("POST", "/v1/access/sign-in", json!({"name": "eve", "password": "x"})),
        ("DELETE", "/v1/access/users/eve", json!({})),
    ] {
        assert_eq!(
            bench.json(send(method, path, &body)).await.0,
            StatusCode::CONFLICT,
            "{method} {path}"
        );
    }
    let mut rebound = get("/v1/loops");
    rebound
        .headers_mut()
        .insert(header::HOST, HeaderValue::from_static("evil.example:8480"));
    assert_eq!(bench.json(rebound).await.0, StatusCode::FORBIDDEN);
}

#[tokio::test]
async fn what_is_not_in_the_table_is_refused_and_what_is_no_route_is_no_secret() {
    let (bench, tokens) = secured();
    assert_eq!(bench.json(get("/v1/nothing")).await.0, StatusCode::NOT_FOUND);
    let put = with_token(send("PUT", "/v1/loops", &json!({})), &tokens["admin"]);
    assert!([StatusCode::FORBIDDEN, StatusCode::METHOD_NOT_ALLOWED].contains(&bench.json(put).await.0));
    assert_eq!(
        needs::of(&Method::HEAD, "/v1/loops"),
        needs::of(&Method::GET, "/v1/loops")
    );
    let need = Need {
        role: Role::Viewer,
        reach: Reach::Any,
    };
    assert_eq!(needs::of(&Method::GET, "/v1/loops"), Some(Who::Needs(need)));
}

#[tokio::test]
async fn every_answer_is_hardened() {
    let bench = Bench::new();
    for path in ["/v1/loops", "/v1/nothing", "/livez", "/"] {
        let response = bench.ask(get(path)).await;
        for name in [
            "content-security-policy",
            "x-content-type-options",
            "referrer-policy",
            "cross-origin-resource-policy",
        ] {
            assert!(response.headers().contains_key(name), "{path}: {name}");
        }
        assert!(
            !response.headers().contains_key(header::STRICT_TRANSPORT_SECURITY),
            "plain"
        );
    }
}

#[tokio::test(start_paused = true)]
async fn a_head_that_drips_is_cut_off() {
    use tokio::{
        io::{AsyncReadExt as _, AsyncWriteExt as _},
        net::{TcpListener, TcpStream},
        time::{Instant, sleep},
    };
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let address = listener.local_addr().expect("an address");
    tokio::spawn(async move {
        crate::server::serve_cell(
            listener,
            Arc::new(Fake::new()),
            &Options::default(),
            std::future::pending(),
        )
        .await
    });
    let mut stream = TcpStream::connect(address).await.expect("the kernel takes it");
    stream
        .write_all(b"GET /v1/loops HTTP/1.1\r\nx: ")
        .await
        .expect("room for some bytes");
    let began = Instant::now();
    let mut answer = [0; 1_024];
    loop {
        tokio::select! {
            end = stream.read(&mut answer) => {
                let text = String::from_utf8_lossy(&answer[..end.unwrap_or(0)]).into_owned();
                assert!(text.is_empty() || text.starts_with("HTTP/1.1 408"), "{text}");
                break;
            }
            // A byte a second would keep a connection open for ever that only counts silence.
            () = sleep(Duration::from_secs(1)) => drop(stream.write_all(b"y").await),
        }
        assert!(began.elapsed() < crate::limits::HEAD_TIME_MAX * 3, "it is still open");
    }
    assert!(began.elapsed() >= crate::limits::HEAD_TIME_MAX, "{:?}", began.elapsed());
}
