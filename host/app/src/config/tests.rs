//! Configurations that are taken, and those that are refused in words.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

use super::*;

const LEAST: &str = "host = \"a\"\n[cell]\nname = \"demo\"\n";

fn parse(text: &str) -> Result<Config, Error> {
    Config::parse(text, Path::new("/etc/bumpless/host.toml"))
}

#[test]
fn the_least_file_is_a_control_host_on_loopback() {
    let config = parse(LEAST).expect("a good file");
    assert_eq!((config.io, config.control), (false, true));
    assert_eq!(config.api_listen.to_string(), "127.0.0.1:8480");
    assert_eq!(config.data, Path::new("/etc/bumpless/data"));
    assert_eq!(config.cell.listen, ["tcp/127.0.0.1:0"]);
    assert_eq!(config.cell.lease_ms, 10_000);
    assert_eq!(
        config.engine.limits.memory_bytes_max,
        bumpless_engine::Limits::default().memory_bytes_max
    );
    assert_eq!(
        config.engine.limits.compile_memory_bytes_max,
        bumpless_engine::Limits::default().compile_memory_bytes_max
    );
    assert!(matches!(config.engine.compile, bumpless_engine::Compile::Child { .. }));
    assert_eq!(config.history_bytes_max, Some(512 * 1024 * 1024));
    assert_eq!(config.lab_reports, None);
}

#[test]
fn a_full_file_is_taken_as_it_stands() {
    let text = r#"
        host = "plant"
        data = "/var/lib/bumpless"
        [otlp]
        endpoint = "http://127.0.0.1:4318"
        headers = { api-key = "k" }
        [cell]
        name = "demo"
        listen = ["tls/10.0.0.1:7447"]
        connect = ["tls/10.0.0.2:7447"]
        scouting = true
        lease_ms = 300
        [cell.tls]
        ca = "ca.pem"
        certificate = "plant.pem"
        key = "/keys/plant.key"
        members = ["plant", "a"]
        [api]
        listen = "10.0.0.1:443"
        names = ["plant.example"]
        [api.tls]
        certificate = "plant.pem"
        key = "plant.key"
        [security]
        [roles]
        control = true
        [[bus]]
        id = "plant"
        driver = "sim"
        journal = "writes.csv"
        [engine]
        instances_max = 5
        compile = "in-process"
        [loops]
        workers = 3
        [history]
        enabled = false
        [lab]
        reports = "lab-out"
    "#;
    let config = parse(text).expect("a good file");
    assert_eq!((config.io, config.control), (true, true));
    assert_eq!(config.data, Path::new("/var/lib/bumpless"));
    assert_eq!((config.cell.lease_ms, config.cell.scouting), (300, true));
    assert!(config.secured && !config.doors && config.api_names == ["plant.example"]);
    let tls = config.cell.tls.expect("certificates");
    assert_eq!(
        (tls.ca.as_path(), tls.key.as_path()),
        (Path::new("/etc/bumpless/ca.pem"), Path::new("/keys/plant.key"))
    );
    assert!(
        config
            .api_tls
            .is_some_and(|files| files.certificate == Path::new("/etc/bumpless/plant.pem"))
    );
    assert_eq!((config.loops.workers, config.history_bytes_max), (3, None));
    let otlp = config.otlp.expect("a collector");
    assert!(otlp.metrics && otlp.traces && otlp.every_s == 15);
    assert!(matches!(config.engine.compile, bumpless_engine::Compile::InProcess));
    let BusConfig::Sim(sim) = &config.buses.buses[0] else {
        panic!("a simulated bus")
    };
    assert_eq!(sim.journal.as_deref(), Some(Path::new("/etc/bumpless/writes.csv")));
    assert_eq!(config.lab_reports.as_deref(), Some(Path::new("/etc/bumpless/lab-out")));
}

#[test]
fn bad_files_say_where_and_what_helps() {
    let bus = "[[bus]]\nid = \"plant\"\ndriver = \"sim\"\n";
    let table: [(String, &[&str]); 33] = [
        (
            format!("{LEAST}[testing]\nflip_bits_every = 5"),
            &["key testing", "cell demo may be a real one", "begins with \"test\""],
        ),
        (
            "host = \"a\"\n[cell]\nname = \"test-1\"\n[testing]\nflip_bits_every = 0".into(),
            &["key testing.flip_bits_every", "it is 0"],
        ),
        (
            "host = \"a\"\nlabels = [\"East\"]\n[cell]\nname = \"demo\"".into(),
            &["key labels", "\"East\" is no label", "lower-case"],
        ),
        (
            "host = \"a\"\nclock_offset_s = -99999999\n[cell]\nname = \"demo\"".into(),
            &["key clock_offset_s", "a year, either way"],
        ),
        (String::new(), &["host.toml", "missing field `host`"]),
        (
            "host = \"A\"\n[cell]\nname = \"demo\"".into(),
            &["line 1, key host", "'A'", "lower-case"],
        ),
        (
            "host = \"a\"\ncell = \"demo\"".into(),
            &["line 2, key cell", "CellTable"],
        ),
        (
            format!("{LEAST}lease = 5"),
            &["line 4, key lease", "unknown field `lease`", "`lease_ms`"],
        ),
        (
            format!("{LEAST}lease_ms = 5"),
            &["key cell", "lease_ms", "between 100 and 60000"],
        ),
        (
            format!("{LEAST}listen = [\"quic/x:1\"]"),
            &["key cell", "use tcp, unixsock-stream or tls"],
        ),
        (
            format!("{LEAST}[api]\nlisten = \"localhost\""),
            &["line 5, key listen", "invalid socket address"],
        ),
        (
            format!("{LEAST}[roles]\nio = true"),
            &["key roles.io", "add one, or set io = false"],
        ),
        (
            format!("{LEAST}[roles]\ncontrol = false"),
            &["key roles", "set io or control"],
        ),
        (
            format!("{LEAST}{bus}[roles]\nio = false"),
            &["key roles.io", "remove them"],
        ),
        (
            format!("{LEAST}{bus}{bus}"),
            &["key bus.id", "two buses are named plant"],
        ),
        (
            format!("{LEAST}[[bus]]\nid = \"x\"\ndriver = \"opc\""),
            &["unknown variant `opc`", "modbus-tcp"],
        ),
        (
            format!("{LEAST}[engine]\ninstances_max = 0"),
            &["key engine.instances_max", "it is 0; use 1 to 100000"],
        ),
        (
            format!("{LEAST}[engine]\ncompile = \"jit\""),
            &["line 5, key compile", "`child` or `in-process`"],
        ),
        (
            format!("{LEAST}[loops]\nworkers = 65"),
            &["key loops.workers", "1 to 64"],
        ),
        (
            format!("{LEAST}[loop]\nworkers = 2"),
            &["line 4", "unknown field `loop`", "`loops`"],
        ),
        (
            format!("{LEAST}[history]\nbytes_max_mib = 15"),
            &["key history.bytes_max_mib", "it is 15; use 16 to 65536"],
        ),
        (
            format!("{LEAST}[history]\nbytes = 15"),
            &["line 5, key bytes", "unknown field `bytes`", "`bytes_max_mib`"],
        ),
        (
            format!("{LEAST}[otlp]\nendpoint = \"collector:4318\""),
            &["key otlp", "http://HOST:PORT"],
        ),
        (
            format!("{LEAST}[api]\nlisten = \"0.0.0.0:8480\""),
            &["key api.listen", "needs [security] and [api.tls]"],
        ),
        (
            format!("{LEAST}[security]\n[api]\nlisten = \"10.0.0.1:8480\""),
            &["key api.listen", "needs [api.tls]"],
        ),
        (
            format!("{LEAST}[api]\nlisten = \"[::]:8480\"\n[api.tls]\ncertificate = \"a\"\nkey = \"b\""),
            &["key api.listen", "needs [security];"],
        ),
        (
            format!(
                "{LEAST}[security]\nusers = false\n[api]\nlisten = \"[::]:8480\"\n[api.tls]\ncertificate = \"a\"\nkey = \"b\""
            ),
            &["key api.listen", "needs [security];"],
        ),
        (
            format!("{LEAST}listen = [\"tcp/0.0.0.0:7447\"]"),
            &["key cell.listen", "without TLS", "[cell.tls]"],
        ),
        (
            format!("{LEAST}connect = [\"tcp/plant.example:7447\"]"),
            &["key cell.connect", "without TLS"],
        ),
        (
            format!("{LEAST}scouting = true"),
            &["key cell.scouting", "strangers could join"],
        ),
        (
            format!("{LEAST}[cell.tls]\nca = \"a\"\ncertificate = \"b\"\nkey = \"c\"\nmembers = [\"b\"]"),
            &["key cell", "this one too"],
        ),
        (
            format!("{LEAST}[testing]\nopen_network = true"),
            &["key testing", "lie open on purpose", "cell demo may be a real one"],
        ),
        (format!("{LEAST}[[["), &["line 4"]),
    ];
    for (text, parts) in table {
        let error = parse(&text).expect_err(&text).to_string();
        for part in parts {
            assert!(error.contains(part), "{text:?}: {part:?} is missing in: {error}");
        }
    }
    let missing = Config::read(Path::new("/nowhere/host.toml"), None).expect_err("no such file");
    assert!(missing.to_string().contains("/nowhere/host.toml"), "{missing}");
}
