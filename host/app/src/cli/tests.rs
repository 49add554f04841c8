//! What is typed is understood, or refused in words that name the word.
//!
//! Never: runs a command.

use super::*;

#[test]
fn the_command_line_holds_together() {
    Cli::command().debug_assert();
}

#[test]
fn what_is_typed_is_understood() {
    let parse = |text: &str| Cli::try_parse_from(text.split(' '));
    for good in [
        "bumpless host --config host.toml --data /tmp/x --check",
        "bumpless new st level",
        "bumpless new rust level --sdk ../guest-sdk",
        "bumpless build level.st -o level.wasm",
        "bumpless check level",
        "bumpless dev level --loop pressure",
        "bumpless host --config host.toml --dry-run",
        "bumpless upload pid.wasm --note x --json",
        "bumpless upload pid.wasm --label stage=pilot --label line=3 --force --wait",
        "bumpless upload pid.wasm --dry-run",
        "bumpless components",
        "bumpless components --label stage=pilot --name pid --text pump",
        "bumpless components list --label stage",
        "bumpless components label pid stage=pilot line-",
        "bumpless components note pid@1.0.0 for_the_pilot",
        "bumpless components export pid on-off@1.0.0 -o laws.tar",
        "bumpless components import laws.tar --force",
        "bumpless --json components show pid@1.0.0",
        "bumpless components download pid -o x.wasm",
        "bumpless keys new ann -o ann.key --passphrase-file secret",
        "bumpless keys list",
        "bumpless keys trust ann.key --role author --role approver --expires-days 365 --root root.key",
        "bumpless keys revoke ann --reason stolen --root root.key",
        "bumpless keys policy required --needs author,approver --root root.key",
        "bumpless sign pid.wasm --key ann.key --role author --expires-days 90 --send",
        "bumpless verify pid.wasm",
        "bumpless loop apply loop.toml",
        "bumpless loop set pressure setpoint=1.5 k=2 strategy=p2c --api http://127.0.0.1:1",
        "bumpless loop setpoint t -5",
        "bumpless loop mode pressure automatic",
        "bumpless loop mode pressure auto",
        "bumpless loop output pressure -4.5",
        "bumpless loop output pressure valve=4 pump=5",
        "bumpless loop rollback pressure --to 3",
        "bumpless loop cycles pressure",
        "bumpless loop replay pressure --last 10m",
        "bumpless history pressure",
        "bumpless history pressure --from -7d --to -1d --buckets 100 --json",
        "bumpless history plant.tt101 --point --from 2026-11-22T08:00:00Z --step 1s --format parquet -o x.parquet",
        "bumpless rollout start pid@1.1.0 pressure level --cycles 100 --factor 1.5 --at-once 2 --on-failure back --wait",
        "bumpless rollout start pid --all-of pid@1.0.0 -p k=2 -p action=direct --json",
        "bumpless rollout list",
        "bumpless program apply level.toml",
        "bumpless program start level --json",
        "bumpless program pause level",
        "bumpless program resume level",
        "bumpless program stop level",
        "bumpless program list",
        "bumpless program show level",
        "bumpless program log level --lines 5",
        "bumpless program checkpoint level -o x",
        "bumpless program delete level",
        "bumpless components script level -o level.lua",
        "bumpless rollout show plant.3",
        "bumpless rollout stop plant.3",
        "bumpless alarm",
        "bumpless alarm list --all --loop pressure",
        "bumpless alarm history --limit 20",
        "bumpless alarm ack pressure high --note seen --by ann",
        "bumpless alarm shelve pressure high --for 30m --reason cleaning",
        "bumpless alarm out pressure high --reason repair",
        "bumpless alarm define alarms.toml",
        "bumpless alarm remove pressure high",
        "bumpless alarm watch --loop pressure --count 3",
        "bumpless audit",
        "bumpless audit list --from -1h --loop pressure --by ann --what loop --limit 5 --after plant:7",
        "bumpless audit verify",
        "bumpless audit verify audit.jsonl --holds plant:7:0123456789abcdef0123456789abcdef0123456789abcdef0123456789abcdef",
        "bumpless audit export --format csv --host plant --to 2026-03-01T06:00:00Z -o audit.csv",
        "bumpless loop backtest pressure pidplus -p k=2 -p action=direct --last 5000 --plot x.svg",
        "bumpless loop shadow pressure pidplus --cycles 200 --wait",
        "bumpless loop shadows pressure 3 --stop",
        "bumpless lab run a.toml b.toml --out x --jobs 2 --seeds 5 --fresh",
        "bumpless lab compare a.toml pid pidplus:k=2,ti=3",
        "bumpless lab sweep a.toml loop.flow.period_ms=500,1000 --json",
        "bumpless lab report a.toml",
        "bumpless lab record pressure --last 10m -o window.json",
        "bumpless lab fit window.json",
        "bumpless lab promote a.toml pressure --by itae --cycles 100 --wait",
        "bumpless call pid --input pv=1 --input ff=-2 --strategy latency",
        "bumpless io scan 192.0.2.7:502 --units 1-3,9 --table holding --table coil --last 999",
        "bumpless io scan --bus line --host plant",
        "bumpless io read oven.pv oven.out --json",
        "bumpless io write oven.out -4.5 --by ann",
        "bumpless io watch oven.pv --every-ms 100 --looks 3",
        "bumpless io force oven.pv 80 --for 10m --why test",
        "bumpless io unforce oven.pv",
        "bumpless io map --config host.toml --bus line",
        "bumpless io export --config host.toml --bus line -o points.csv",
        "bumpless io import points.csv --config host.toml --bus line --write",
        "bumpless io job start line set-range --wait --key k",
        "bumpless io job start line write-block --table holding --address 7 --values 1,2,3",
        "bumpless io job show plant.1000001",
        "bumpless backup -o cell.tar --json",
        "bumpless restore cell.tar --check",
        "bumpless restore cell.tar --manual",
        "bumpless io job list",
        "bumpless io job cancel plant.1000001",
        "bumpless watch pressure --plain --cycles 5",
        "bumpless hosts --json",
        "bumpless hosts drain a --keep",
        "bumpless hosts undrain a --wait 30",
        "bumpless demo --for 5 --restart",
        "bumpless user first ann --first-token data/first-token -o token",
        "bumpless user add bob --role operator --loop tank-* --loop pressure --note shift_2",
        "bumpless user set bob --disabled true",
        "bumpless token new bob --days 30 -o bob.token --role viewer",
        "bumpless token revoke 0123456789abcdef",
        "bumpless login ann --token-file t --ca ca.pem",
        "bumpless whoami",
        "bumpless ca init --cell mill --dir keys",
        "bumpless ca issue plant --cell mill --address 10.0.0.5 --address plant.example",
        "bumpless completions bash",
        "bumpless compile-child in out",
    ] {
        assert!(parse(good).is_ok(), "{good}: {:?}", parse(good).err());
    }
    for (bad, part) in [
        ("bumpless host", "--config"),
        (
            "bumpless new cobol level",
            "[possible values: rust, st, c, js, ts, python]",
        ),
        ("bumpless dev level", "--loop <LOOP>"),
        ("bumpless upload pid.wasm --dry-run --force", "cannot be used with"),
        ("bumpless components label pid", "<KEY=VALUE|KEY->"),
        ("bumpless components label pid stage", "KEY- to remove it"),
        ("bumpless components export pid", "--output"),
        ("bumpless keys trust ann.key --root root.key", "--role"),
        ("bumpless sign pid.wasm --key k --passphrase x", "unexpected argument"),
        ("bumpless loop set pressure", "KEY=VALUE"),
        ("bumpless loop set pressure setpoint", "write it as KEY=VALUE"),
        ("bumpless loop shadows pressure --stop", "<ID>"),
        ("bumpless loop mode pressure fast", "[possible values: manual, auto]"),
        ("bumpless call pid --input pv=x", "\"x\" is no number"),
        ("bumpless call pid --strategy best", "use round-robin, random, cpu"),
        ("bumpless rollout start pid", "<LOOP>..."),
        (
            "bumpless rollout start pid l --on-failure forth",
            "[possible values: stop, back]",
        ),
        ("bumpless alarm shelve pressure high --for 30m", "--reason"),
        (
            "bumpless alarm shelve pressure high --for soon --reason x",
            "write it as 30s, 10m or 2h",
        ),
        ("bumpless audit verify x --holds plant:7", "HOST:NUMBER:HASH"),
        ("bumpless audit export --format xml", "[possible values: jsonl, csv]"),
        ("bumpless io force oven.pv 80 --why test", "--for"),
        ("bumpless io force oven.pv 80 --for 25h --why test", "1s to 24h"),
        ("bumpless io scan", "<ADDRESS>"),
        ("bumpless io scan h:502 --units 9-1", "lies behind the last"),
        (
            "bumpless user add bob --role boss",
            "[possible values: viewer, operator, engineer, admin]",
        ),
        ("bumpless user add bob --role viewer --password x", "--no-password"),
        ("bumpless ca issue a --cell m --days 0", "1..=3650"),
        ("bumpless lop", "'loop'"),
    ] {
        let error = parse(bad).expect_err(bad);
        assert_eq!(error.exit_code(), 2, "{bad}");
        assert!(error.to_string().contains(part), "{bad}: {error}");
    }
}

#[test]
fn the_api_comes_from_the_command_line_or_its_default() {
    let cli = Cli::try_parse_from(["bumpless", "hosts", "--api", "http://10.0.0.1:80"]).expect("good");
    assert_eq!((cli.to.api.as_str(), cli.to.json), ("http://10.0.0.1:80", false));
}

#[test]
fn help_lists_the_commands_in_the_order_of_their_use() {
    let help = Cli::command().render_help().to_string();
    let places: Vec<usize> = [
        "host ",
        "demo ",
        "upload ",
        "components ",
        "loop ",
        "rollout ",
        "alarm ",
        "call ",
        "hosts ",
        "watch ",
    ]
    .iter()
    .map(|word| {
        help.find(&format!("\n  {word}"))
            .unwrap_or_else(|| panic!("{word} is not in the help:\n{help}"))
    })
    .collect();
    assert!(places.is_sorted(), "{help}");
    assert!(!help.contains("compile-child"), "{help}");
}
