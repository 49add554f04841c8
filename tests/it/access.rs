//! People and hosts: accounts over several hosts, TLS and its rotation, what is refused at the start, and attacks on the wire.
//!
//! `docs/threat-model.md` lists attacks with the test that tries each.

use std::{
    fs,
    io::{Read as _, Write as _},
    net::TcpStream,
    os::unix::fs::PermissionsExt as _,
    path::{Path, PathBuf},
    process::{Command, Output, Stdio},
    time::{Duration, Instant},
};

use bumpless_tests::{Binary, HostOptions, HostProcess, WAIT_MAX};
use serde_json::Value;

const PASSWORD: &str = "correct horse battery";

/// A folder, the hosts in it, and the command line that asks them.
struct Site {
    folder: tempfile::TempDir,
    binary: Binary,
}

impl Site {
    fn new() -> Self {
        Self {
            folder: tempfile::tempdir().unwrap(),
            binary: Binary::find().unwrap(),
        }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Starts a host with these tables; `extra` are keys of `[cell]`.
    fn host(&self, name: &str, connect: &[String], listen: &[&str], extra: &str, tables: &str) -> HostProcess {
        let options = HostOptions {
            name: name.to_owned(),
            cell: "test-access".to_owned(),
            connect: connect.to_vec(),
            listen: listen.iter().map(|&text| text.to_owned()).collect(),
            cell_extra: extra.to_owned(),
            tables: tables.to_owned(),
            ..HostOptions::default()
        };
        HostProcess::start(options, &self.path(name)).unwrap()
    }

    fn run(&self, words: &[&str], stdin: &str) -> Output {
        let mut child = self
            .binary
            .command()
            .args(words)
            .current_dir(self.folder.path())
            .env_remove("BUMPLESS_TOKEN")
            .env_remove("BUMPLESS_TOKEN_FILE")
            .env_remove("BUMPLESS_CA")
            .env_remove("BUMPLESS_API")
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        child.stdin.take().unwrap().write_all(stdin.as_bytes()).unwrap();
        child.wait_with_output().unwrap()
    }

    /// What a command says that must succeed.
    #[track_caller]
    fn good(&self, words: &[&str], stdin: &str) -> String {
        let output = self.run(words, stdin);
        assert!(
            output.status.success(),
            "{words:?}: {}",
            String::from_utf8_lossy(&output.stderr)
        );
        String::from_utf8(output.stdout).unwrap()
    }

    /// What a command says that must fail with this exit code.
    #[track_caller]
    fn bad(&self, words: &[&str], code: i32) -> String {
        let output = self.run(words, "");
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(code), "{words:?}: {said}");
        said
    }

    /// Authority and certificates of hosts, in this folder.
    fn certificates(&self, hosts: &[&str]) {
        self.good(&["ca", "init", "--cell", "test-access"], "");
        for host in hosts {
            self.good(&["ca", "issue", host, "--cell", "test-access"], "");
        }
    }

    /// All that hosts wrote to their logs.
    fn logs(&self, hosts: &[&HostProcess]) -> String {
        hosts
            .iter()
            .map(|host| fs::read_to_string(host.stderr_path()).unwrap())
            .collect()
    }

    /// Makes `root` the administrator; his token is in the file `root.token`.
    fn first(&self, host: &HostProcess, more: &[&str]) {
        let token = self.path(&host.name).join("data/first-token");
        let token = token.display().to_string();
        let mut words = vec![
            "user",
            "first",
            "root",
            "--first-token",
            &token,
            "-o",
            "root.token",
            "--api",
            &host.api,
        ];
        words.extend(more);
        self.good(&words, PASSWORD);
    }
}

/// Waits until `good` is.
#[track_caller]
fn until(what: &str, mut good: impl FnMut() -> bool) {
    let start = Instant::now();
    while !good() {
        assert!(start.elapsed() < WAIT_MAX, "{what} did not come");
        std::thread::sleep(Duration::from_millis(50));
    }
}

#[test]
fn accounts_are_the_cells_and_what_is_revoked_is_revoked_everywhere() {
    let site = Site::new();
    let one = site.host("one", &[], &[], "", "[security]\n");
    let two = site.host("two", &one.cell, &[], "", "[security]\n");
    assert!(
        site.bad(&["hosts", "--api", &one.api], 3)
            .contains("wants to know who asks")
    );
    let first = site.path("one").join("data/first-token");
    assert_eq!(fs::metadata(&first).unwrap().permissions().mode() & 0o777, 0o600);
    let first_text = fs::read_to_string(&first).unwrap();
    site.first(&one, &[]);
    assert!(!first.exists(), "its token is of no use any more");
    until("the other host's first token goes", || {
        !site.path("two").join("data/first-token").exists()
    });

    // Made at one host, used at the other.
    let at = |api: &str, token: &str, words: &[&str]| {
        let mut all = words.to_vec();
        all.extend(["--api", api, "--token-file", token]);
        all.into_iter().map(str::to_owned).collect::<Vec<_>>()
    };
    let run = |words: Vec<String>, stdin: &str| site.run(&words.iter().map(String::as_str).collect::<Vec<_>>(), stdin);
    let good =
        |words: Vec<String>, stdin: &str| site.good(&words.iter().map(String::as_str).collect::<Vec<_>>(), stdin);
    good(
        at(&one.api, "root.token", &["user", "add", "ann", "--role", "viewer"]),
        PASSWORD,
    );
    good(
        at(
            &one.api,
            "root.token",
            &["token", "new", "ann", "-o", "ann.token", "--days", "2"],
        ),
        "",
    );
    let whoami = at(&two.api, "ann.token", &["whoami"]);
    until("ann's token at the other host", || {
        String::from_utf8_lossy(&run(whoami.clone(), "").stdout).contains("ann: viewer")
    });
    assert!(run(at(&two.api, "ann.token", &["hosts"]), "").status.success());
    let refused = run(at(&two.api, "ann.token", &["hosts", "drain", "one"]), "");
    assert_eq!(refused.status.code(), Some(3));
    assert!(String::from_utf8_lossy(&refused.stderr).contains("ann is viewer, and this needs engineer"));
    // With a password at the other host.
    until("ann can sign in at the other host", || {
        run(at(&two.api, "login.token", &["login", "ann"]), PASSWORD)
            .status
            .success()
    });
    assert!(
        !run(at(&two.api, "x.token", &["login", "ann"]), "a wrong password")
            .status
            .success()
    );

    let trail: Value =
        serde_json::from_str(&good(at(&one.api, "root.token", &["audit", "list", "--json"]), "")).unwrap();
    let text = trail.to_string();
    for part in ["user.add", "token.issue", "session.begin", "access.refuse"] {
        assert!(text.contains(part), "{part} is missing in the trail: {text}");
    }
    let by = |what: &str| {
        trail["entries"]
            .as_array()
            .unwrap()
            .iter()
            .find(|entry| entry["what"] == what)
            .unwrap()["by"]
            .clone()
    };
    assert_eq!((by("user.add"), by("access.refuse")), ("root".into(), "ann".into()));

    let tokens: Value =
        serde_json::from_str(&good(at(&two.api, "root.token", &["token", "list", "--json"]), "")).unwrap();
    let mut ids = tokens["tokens"]
        .as_array()
        .unwrap()
        .iter()
        .filter(|token| token["user"] == "ann");
    let id = ids.find(|token| token["note"] == "").unwrap()["id"]
        .as_str()
        .unwrap()
        .to_owned();
    good(at(&two.api, "root.token", &["token", "revoke", &id]), "");
    for api in [&two.api, &one.api] {
        until("the token is revoked", || {
            run(at(api, "ann.token", &["hosts"]), "").status.code() == Some(3)
        });
    }
    good(at(&one.api, "root.token", &["user", "remove", "ann"]), "");
    until("the account is gone", || {
        run(at(&two.api, "login.token", &["hosts"]), "").status.code() == Some(3)
    });
    let lonely = run(
        at(&one.api, "root.token", &["user", "set", "root", "--disabled", "true"]),
        "",
    );
    assert!(String::from_utf8_lossy(&lonely.stderr).contains("last administrator"));

    // Nothing that was secret lies anywhere but where it belongs.
    let told = site.logs(&[&one, &two]) + &text + &tokens.to_string();
    for file in ["ann.token", "root.token", "login.token"] {
        let path = site.path(file);
        assert_eq!(
            fs::metadata(&path).unwrap().permissions().mode() & 0o777,
            0o600,
            "{file}"
        );
        let token = fs::read_to_string(path).unwrap();
        let secret = token.trim().rsplit('_').next().unwrap().to_owned();
        assert!(secret.len() == 64 && !told.contains(&secret), "{file}");
    }
    assert!(!told.contains(PASSWORD) && !told.contains(first_text.trim()) && !told.contains("argon2id"));
}

#[test]
fn a_restart_forgets_no_account_and_opens_nothing() {
    let site = Site::new();
    let mut one = site.host("one", &[], &[], "", "[security]\n");
    site.first(&one, &[]);
    one.kill9();
    one.restart().unwrap();
    assert!(!site.path("one").join("data/first-token").exists());
    assert!(
        site.good(&["whoami", "--api", &one.api, "--token-file", "root.token"], "")
            .contains("root: admin")
    );
    site.bad(&["hosts", "--api", &one.api], 3);
}

#[test]
fn the_api_speaks_tls_and_takes_another_certificate_while_it_runs() {
    let site = Site::new();
    site.certificates(&["one"]);
    let tables = "[security]\n[api.tls]\ncertificate = \"{folder}/../one.pem\"\nkey = \"{folder}/../one.key\"\n";
    let one = site.host("one", &[], &[], "", tables);
    assert!(one.api.starts_with("https://"), "{}", one.api);
    site.first(&one, &["--ca", "ca.pem"]);
    let hosts = |ca: &[&str]| {
        let mut words = vec!["hosts", "--api", &one.api, "--token-file", "root.token"];
        words.extend(ca);
        site.run(&words, "").status.code()
    };
    assert_eq!(hosts(&["--ca", "ca.pem"]), Some(0));
    assert_eq!(hosts(&[]), Some(4), "no public authority signed it");
    let plain = one.api.replace("https://", "http://");
    let output = site.run(&["whoami", "--api", &plain], "");
    assert!(!output.status.success(), "plain HTTP is not answered");

    // Another authority's certificate takes its place; the host is not touched.
    fs::create_dir(site.path("new")).unwrap();
    site.good(&["ca", "init", "--cell", "test-access", "--dir", "new"], "");
    site.good(
        &[
            "ca",
            "issue",
            "one",
            "--cell",
            "test-access",
            "--dir",
            "new",
            "--out",
            ".",
        ],
        "",
    );
    until("the new certificate", || hosts(&["--ca", "new/ca.pem"]) == Some(0));
    assert_eq!(
        hosts(&["--ca", "ca.pem"]),
        Some(4),
        "the old authority is not believed any more"
    );
    // What is none is not taken; the host goes on with what it has.
    fs::write(site.path("one.pem"), "nonsense").unwrap();
    until("the log says so", || {
        site.logs(&[&one]).contains("certificate stays as it was")
    });
    assert_eq!(hosts(&["--ca", "new/ca.pem"]), Some(0));
    let refused = site.run(&["ca", "init", "--cell", "test-access"], "");
    assert!(String::from_utf8_lossy(&refused.stderr).contains("holds an authority already"));
}

#[test]
fn what_strangers_could_reach_does_not_start() {
    let site = Site::new();
    let check = |text: &str| {
        fs::write(site.path("host.toml"), format!("host = \"a\"\n{text}")).unwrap();
        site.bad(&["host", "--config", "host.toml", "--check"], 1)
    };
    for (text, part) in [
        (
            "[cell]\nname = \"mill\"\n[api]\nlisten = \"0.0.0.0:0\"\n",
            "it needs [security] and [api.tls]",
        ),
        (
            "[cell]\nname = \"mill\"\n[security]\n[api]\nlisten = \"[::]:0\"\n",
            "it needs [api.tls]",
        ),
        ("[cell]\nname = \"mill\"\nlisten = [\"tcp/0.0.0.0:0\"]\n", "without TLS"),
        ("[cell]\nname = \"mill\"\nscouting = true\n", "strangers could join"),
        (
            "[cell]\nname = \"mill\"\n[testing]\nopen_network = true\n",
            "may be a real one",
        ),
    ] {
        let said = check(text);
        assert!(said.contains(part), "{text}: {said}");
    }
    // Files that are none are found before anything listens.
    let text = "[cell]\nname = \"mill\"\n[security]\n[api]\nlisten = \"127.0.0.1:0\"\n[api.tls]\ncertificate = \"x\"\nkey = \"y\"\n";
    fs::write(site.path("host.toml"), format!("host = \"a\"\n{text}")).unwrap();
    let said = site.bad(&["host", "--config", "host.toml"], 1);
    assert!(
        said.contains("the API's TLS could not be started") && said.contains("bumpless ca issue"),
        "{said}"
    );
}

#[test]
fn a_cell_with_tls_on_its_bus_works_as_any_and_a_host_that_is_no_member_is_alone() {
    let site = Site::new();
    site.certificates(&["one", "two", "eve"]);
    let tls = |name: &str, members: &str| {
        format!(
            "[cell.tls]\nca = \"{{folder}}/../ca.pem\"\ncertificate = \"{{folder}}/../{name}.pem\"\nkey = \"{{folder}}/../{name}.key\"\nmembers = {members}\n"
        )
    };
    let listen = &["tls/127.0.0.1:0"];
    let members = "[\"one\", \"two\"]";
    let one = site.host("one", &[], listen, "", &tls("one", members));
    let two = site.host("two", &one.cell, listen, "", &tls("two", members));
    let names = |host: &HostProcess| {
        let list: Value = serde_json::from_str(&site.good(&["hosts", "--json", "--api", &host.api], "")).unwrap();
        let hosts = list["hosts"]
            .as_array()
            .unwrap()
            .iter()
            .filter(|host| host["alive"] == true);
        hosts
            .map(|host| host["name"].as_str().unwrap().to_owned())
            .collect::<Vec<_>>()
    };
    until("the two see each other", || {
        names(&one) == ["one", "two"] && names(&two) == ["one", "two"]
    });
    // A library is copied by requests, records and notices by publication: an upload shows that they pass.
    let pid = bumpless_tests::components().unwrap().join("pid.wasm");
    site.good(&["upload", &pid.display().to_string(), "--api", &one.api], "");
    until("the component at the other host", || {
        site.good(&["components", "--json", "--api", &two.api], "")
            .contains("\"pid\"")
    });
    // Eve has a certificate of the authority and the right configuration, but nobody calls her a member.
    let eve = site.host("eve", &one.cell, listen, "", &tls("eve", "[\"one\", \"two\", \"eve\"]"));
    // As a stranger without any: he may knock for as long as he likes.
    let bare = site.host(
        "bare",
        &[one.cell[0].replace("tls/", "tcp/")],
        &["tcp/127.0.0.1:0"],
        "",
        "",
    );
    std::thread::sleep(Duration::from_secs(3));
    assert_eq!(
        (names(&one), names(&two)),
        (vec!["one".into(), "two".into()], vec!["one".into(), "two".into()])
    );
    assert_eq!(
        (names(&eve), names(&bare)),
        (vec!["eve".to_owned()], vec!["bare".to_owned()])
    );
    assert!(
        !site
            .good(&["components", "--json", "--api", &eve.api], "")
            .contains("\"pid\""),
        "she read the library"
    );
}

/// Sends bytes, and reads what comes until the end or for a while.
fn raw(address: &str, bytes: &[u8]) -> String {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(5))).unwrap();
    // A host that has read enough may close while the rest is on its way.
    let _cut = stream.write_all(bytes);
    let mut answer = Vec::new();
    let mut piece = [0; 4_096];
    while let Ok(count) = stream.read(&mut piece) {
        answer.extend_from_slice(&piece[..count]);
        if count == 0 || answer.len() > 100_000 {
            break;
        }
    }
    String::from_utf8_lossy(&answer).into_owned()
}

#[test]
fn attacks_on_the_wire_are_answered_or_cut_off_and_the_host_goes_on() {
    let site = Site::new();
    let one = site.host("one", &[], &[], "", "[security]\n");
    site.first(&one, &[]);
    let token = fs::read_to_string(site.path("root.token")).unwrap();
    let address = one.api.trim_start_matches("http://").to_owned();
    let head =
        |line: &str, more: &str| format!("{line} HTTP/1.1\r\nhost: {address}\r\nconnection: close\r\n{more}\r\n");
    let bearer = format!("authorization: Bearer {}\r\n", token.trim());
    for (name, request, wanted) in [
        ("no credential", head("GET /v1/loops", ""), "401"),
        (
            "a bad scheme",
            head("GET /v1/loops", "authorization: Basic cm9vdDp4\r\n"),
            "401",
        ),
        (
            "a forged cookie",
            head("GET /v1/loops", "cookie: bumpless=0000\r\n"),
            "401",
        ),
        (
            "path traversal",
            head("GET /assets/..%2f..%2fdata%2ffirst-token", &bearer),
            "404",
        ),
        ("path traversal, dots", head("GET /../../etc/passwd", &bearer), "404"),
        (
            "path traversal, reports",
            head("GET /v1/lab/reports/..%2F..%2Fhost.toml", &bearer),
            "4",
        ),
        ("a double slash around the guard", head("GET //v1/loops", ""), "404"),
        ("a coded path around the guard", head("GET /v1/%6coops", ""), "40"),
        ("another case around the guard", head("GET /V1/loops", ""), "404"),
        ("another method around the guard", head("BREW /v1/loops", ""), "405"),
        (
            "an oversized head",
            head("GET /v1/loops", &format!("x: {}\r\n", "y".repeat(200_000))),
            "431",
        ),
        (
            "an oversized body",
            head(
                "POST /v1/loops/l/setpoint",
                &format!("{bearer}content-type: application/json\r\ncontent-length: 262200\r\n"),
            ) + &" ".repeat(262_200),
            "413",
        ),
        (
            "two lengths",
            head(
                "POST /v1/loops/l/setpoint",
                &format!("{bearer}content-length: 4\r\ncontent-length: 40\r\n"),
            ) + "{}  ",
            "400",
        ),
        (
            "a smuggled request",
            head(
                "POST /v1/loops/l/setpoint",
                &format!("{bearer}content-length: 4\r\ntransfer-encoding: xchunked\r\n"),
            ) + "{}  ",
            "400",
        ),
        (
            "no HTTP at all",
            "\x16\x03\x01\x02\x00\x01\x00".to_owned() + &"\0".repeat(50),
            "400",
        ),
        (
            "a page of another site",
            head(
                "DELETE /v1/access/users/root",
                &format!("{bearer}sec-fetch-site: cross-site\r\n"),
            ),
            "403",
        ),
    ] {
        let answer = raw(&address, request.as_bytes());
        let status = answer.split(' ').nth(1).unwrap_or_default();
        assert!(
            status.starts_with(wanted),
            "{name}: {}",
            answer.chars().take(200).collect::<String>()
        );
        assert!(!answer.contains("root:x:0") && !answer.contains("host = "), "{name}");
    }
    // Connections that say nothing, or a byte now and then, hold up nobody.
    let idle: Vec<TcpStream> = (0..200).map(|_| TcpStream::connect(&address).unwrap()).collect();
    for mut stream in &idle {
        stream.write_all(b"G").unwrap();
    }
    let began = Instant::now();
    site.good(&["hosts", "--api", &one.api, "--token-file", "root.token"], "");
    assert!(began.elapsed() < Duration::from_secs(10));
    drop(idle);
    let guesses = (0..60).map(|_| {
        let answer = raw(
            &address,
            head(
                "GET /v1/loops",
                &format!("authorization: Bearer bpl_{}_{}\r\n", "0".repeat(16), "0".repeat(64)),
            )
            .as_bytes(),
        );
        answer.split(' ').nth(1).unwrap_or_default().to_owned()
    });
    assert!(
        guesses.into_iter().any(|status| status == "429"),
        "a guesser is slowed down"
    );
    site.good(&["hosts", "--api", &one.api, "--token-file", "root.token"], "");
}

#[test]
fn secrets_are_no_arguments_and_no_output() {
    let site = Site::new();
    site.certificates(&["one"]);
    for key in ["ca.key", "one.key"] {
        assert_eq!(
            fs::metadata(site.path(key)).unwrap().permissions().mode() & 0o777,
            0o600,
            "{key}"
        );
    }
    fs::write(site.path("open.token"), "bpl_0000000000000000_x").unwrap();
    fs::set_permissions(site.path("open.token"), fs::Permissions::from_mode(0o644)).unwrap();
    assert!(
        site.bad(&["whoami", "--token-file", "open.token"], 2)
            .contains("chmod 600")
    );
    fs::set_permissions(site.path("open.token"), fs::Permissions::from_mode(0o600)).unwrap();
    let said = site.bad(
        &["whoami", "--token-file", "open.token", "--api", "http://192.0.2.1:1"],
        2,
    );
    assert!(said.contains("would read the token"), "{said}");
    for words in [
        &["user", "add", "--help"][..],
        &["token", "new", "--help"],
        &["login", "--help"],
        &["--help"],
    ] {
        let mut command = Command::new(site.binary.path());
        let output = command
            .args(words)
            .env("BUMPLESS_TOKEN", "bpl_secret")
            .output()
            .unwrap();
        let help = String::from_utf8_lossy(&output.stdout).into_owned();
        assert!(!help.contains("bpl_secret"), "{help}");
        assert!(!help.contains("--password <") && !help.contains("--token <"), "{help}");
    }
    let shown = |path: &Path| fs::read_to_string(path).unwrap();
    assert!(
        shown(&site.path("ca.pem")).contains("BEGIN CERTIFICATE") && !shown(&site.path("ca.pem")).contains("PRIVATE")
    );
}
