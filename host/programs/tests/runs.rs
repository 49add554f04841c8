//! Programs that really run: Rust and Lua, in the sandbox, on the programs' threads.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

use std::{
    collections::BTreeMap,
    path::PathBuf,
    sync::{
        Arc, LazyLock,
        atomic::{AtomicU64, Ordering},
    },
    time::{Duration, Instant},
};

use bumpless_core::{
    Digest, Fault, Grant, HostId, Message, PointId, ProgramId, ProgramSpec, Reading,
    program::{Status, Wanted},
};
use bumpless_engine::{Answer, Config, Engine, Later, PreparedProgram, Question, Reply, Script, Sight, wrap};
use bumpless_programs::{Error, Exchange, Order, Reach, RunView, Runner};
use parking_lot::Mutex;

static COMPONENTS: LazyLock<PathBuf> = LazyLock::new(|| xtask::components::build().unwrap());
static ENGINE: LazyLock<Engine> = LazyLock::new(|| Engine::new(Config::default()).unwrap());
// Kept, so that it is compiled once.
static LUA: LazyLock<Arc<PreparedProgram>> = LazyLock::new(|| scripted("programs/lua3c.wasm", b"return"));

fn scripted(file: &str, text: &[u8]) -> Arc<PreparedProgram> {
    let bytes = std::fs::read(COMPONENTS.join(file)).unwrap();
    let script = Script {
        name: "test".to_owned(),
        version: "1.0.0".to_owned(),
        text: text.to_vec(),
    };
    ENGINE.programs().open(&wrap(&bytes, &script).unwrap()).unwrap().0
}

fn guest(words: &str) -> Arc<PreparedProgram> {
    scripted("guests/free-runs.wasm", words.as_bytes())
}

fn lua(text: &str) -> Arc<PreparedProgram> {
    LazyLock::force(&LUA);
    scripted("programs/lua3c.wasm", text.as_bytes())
}

/// A home in memory.
#[derive(Default)]
struct Home {
    values: Mutex<Vec<f64>>,
    written: Mutex<Vec<f64>>,
    saved: Mutex<Vec<Vec<u8>>>,
    exchange: Exchange,
}

impl Reach for Home {
    fn read(&self, slot: usize) -> Answer<'_, Sight> {
        let value = self.values.lock().get(slot).copied().unwrap_or(0.0);
        Answer::Now(Sight {
            reading: Reading::good(value, 1),
            age_ns: 0,
        })
    }

    fn write(&self, slot: usize, value: f64) -> Answer<'_, Result<(), String>> {
        if let Some(held) = self.values.lock().get_mut(slot) {
            *held = value;
        }
        self.written.lock().push(value);
        Answer::Now(Ok(()))
    }

    fn publish(&self, message: Message) -> Result<(), String> {
        self.exchange.say(&message);
        Ok(())
    }

    fn step(&self, question: Question) -> Later<'_, Result<Reply, Fault>> {
        let outputs = vec![("out".to_owned(), question.setpoint)];
        Box::pin(std::future::ready(Ok(Reply { state: vec![], outputs })))
    }

    fn save(&self, data: Vec<u8>) -> Later<'_, Result<(), String>> {
        self.saved.lock().push(data);
        Box::pin(std::future::ready(Ok(())))
    }
}

fn spec(name: &str, grants: &[(&str, bool)]) -> ProgramSpec {
    let grant = |(name, write): &(&str, bool)| {
        let grant = Grant {
            point: PointId::new(format!("p.{name}")).unwrap(),
            write: *write,
            raw: None,
            range: (0.0, 100.0),
            unit: String::new(),
        };
        ((*name).to_owned(), grant)
    };
    ProgramSpec {
        id: ProgramId::new(name).unwrap(),
        revision: 1,
        digest: Digest::of(b"x"),
        home: HostId::new("here").unwrap(),
        grants: grants.iter().map(grant).collect::<BTreeMap<_, _>>(),
        publishes: vec!["*".into()],
        listens: vec!["*".into()],
        components: vec!["pid".into()],
        share_percent: 100,
        memory_bytes: 8 << 20,
        prefer: vec![],
        wanted: Wanted::Running,
    }
}

struct Bench {
    runner: Runner,
    home: Arc<Home>,
    terms: AtomicU64,
}

impl Bench {
    fn new(values: &[f64]) -> Self {
        let runner = Runner::start().unwrap();
        let home = Home {
            values: Mutex::new(values.to_vec()),
            exchange: runner.exchange().clone(),
            ..Home::default()
        };
        Self {
            runner,
            home: Arc::new(home),
            terms: AtomicU64::new(1),
        }
    }

    fn run(&self, spec: ProgramSpec, prepared: Arc<PreparedProgram>, checkpoint: Option<Vec<u8>>) -> ProgramId {
        let id = spec.id.clone();
        let order = Order {
            spec,
            term: self.terms.fetch_add(1, Ordering::Relaxed),
            prepared,
            checkpoint,
            reach: Arc::clone(&self.home) as Arc<dyn Reach>,
            paused: false,
        };
        self.runner.run(order).unwrap();
        id
    }

    fn view(&self, id: &ProgramId) -> RunView {
        self.runner.view(id).unwrap()
    }

    /// Waits for something that must come.
    #[track_caller]
    fn until(&self, id: &ProgramId, what: impl Fn(&RunView) -> bool) -> RunView {
        let patience = Instant::now() + Duration::from_secs(60);
        loop {
            let view = self.view(id);
            if what(&view) {
                return view;
            }
            assert!(Instant::now() < patience, "{view:?}");
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    fn lines(&self, id: &ProgramId) -> Vec<String> {
        self.runner
            .lines(id, 0, 1_000)
            .into_iter()
            .map(|line| line.text)
            .collect()
    }
}

#[test]
fn a_program_that_spins_is_paused_resumed_and_stopped() {
    let bench = Bench::new(&[]);
    for prepared in [guest("spin"), lua("while true do end")] {
        let id = bench.run(spec("spins", &[]), prepared, None);
        bench.until(&id, |view| view.used_ns > 20_000_000);
        let term = bench.view(&id).term;
        bench.runner.pause(&id, term, true).unwrap();
        assert_eq!(bench.view(&id).status, Status::Paused);
        // It stands still: once it has come to its wait, it uses nothing.
        let mut before = bench.view(&id).used_ns;
        loop {
            std::thread::sleep(Duration::from_millis(20));
            let now = bench.view(&id).used_ns;
            if now == before {
                break;
            }
            before = now;
        }
        bench.runner.pause(&id, term, false).unwrap();
        bench.until(&id, |view| {
            view.status == Status::Running && view.used_ns > before + 5_000_000
        });
        bench.runner.stop(&id, u64::MAX);
        assert_eq!(bench.view(&id).status, Status::Stopped);
        bench.runner.forget(&id, u64::MAX);
    }
}

#[test]
fn a_run_that_has_ended_begins_again_only_under_another_term() {
    let bench = Bench::new(&[]);
    let id = bench.run(spec("once", &[]), guest("nonsense"), None);
    let ended = bench.until(&id, |view| view.status == Status::Fault);
    let order = |term| Order {
        spec: spec("once", &[]),
        term,
        prepared: guest("spin"),
        checkpoint: None,
        reach: Arc::clone(&bench.home) as Arc<dyn Reach>,
        paused: true,
    };
    assert!(matches!(bench.runner.run(order(ended.term)), Err(Error::Runs(..))));
    assert_eq!(bench.view(&id).status, Status::Fault);
    bench.runner.run(order(ended.term + 5)).unwrap();
    assert_eq!(bench.view(&id).status, Status::Paused, "it begins paused");
    // Words about earlier terms do not concern it.
    bench.runner.stop(&id, ended.term);
    bench.runner.forget(&id, ended.term + 4);
    assert!(bench.runner.pause(&id, ended.term, false).is_err());
    assert_eq!(bench.view(&id).status, Status::Paused);
    bench.runner.stop(&id, ended.term + 5);
    assert_eq!(bench.view(&id).status, Status::Stopped);
}

#[test]
fn a_program_keeps_to_its_share_and_its_memory() {
    let bench = Bench::new(&[]);
    let mut quarter = spec("quarter", &[]);
    quarter.share_percent = 25;
    let id = bench.run(quarter, guest("spin"), None);
    let view = bench.until(&id, |view| view.up_ms > 1_000);
    // At least the pauses were kept; a busy machine gives less.
    assert!(view.used_ns < 400_000_000, "{view:?}");
    bench.runner.stop(&id, u64::MAX);
    for (words, part) in [
        ("grow", "of memory; at most 8388608 are given"),
        ("trap", "trapped"),
        ("nonsense", "the script says \"nonsense\""),
    ] {
        let id = bench.run(spec("wrong", &[]), guest(words), None);
        let view = bench.until(&id, |view| view.status == Status::Fault);
        assert!(view.reason.contains(part), "{words}: {}", view.reason);
    }
}

#[test]
fn a_run_goes_on_from_the_last_checkpoint() {
    let bench = Bench::new(&[0.0]);
    let counts = guest("count 1");
    let id = bench.run(spec("counts", &[("out", true)]), Arc::clone(&counts), None);
    bench.until(&id, |_| bench.home.saved.lock().len() >= 5);
    bench.runner.stop(&id, u64::MAX);
    let saved = bench.home.saved.lock().last().cloned().unwrap();
    let count = u64::from_le_bytes(saved.clone().try_into().unwrap());
    bench.runner.forget(&id, u64::MAX);
    bench.home.written.lock().clear();
    bench.run(spec("counts", &[("out", true)]), counts, Some(saved));
    bench.until(&id, |_| !bench.home.written.lock().is_empty());
    // The stopped run may have counted once more before it was gone.
    let first = bench.home.written.lock().first().copied().unwrap() as u64;
    assert!((count + 1..=count + 2).contains(&first), "{count} {first}");
}

#[test]
fn scripts_end_or_fault_with_their_lines() {
    let bench = Bench::new(&[]);
    let id = bench.run(
        spec("ends", &[]),
        lua("for i = 1, 3 do print('line ' .. i) o3c.dms(1) end"),
        None,
    );
    bench.until(&id, |view| view.status == Status::Stopped);
    assert_eq!(bench.lines(&id), ["line 1", "line 2", "line 3"]);
    for (text, part) in [
        ("x = 1\nfor", "script:2:"),
        (
            "\n\nlocal t = nil + 1",
            "script:3: attempt to perform arithmetic on a nil value",
        ),
        (
            "local t = {} while true do t[#t + 1] = ('x'):rep(1e5) .. #t end",
            "memory",
        ),
        ("local function f() return 1 + f() end f()", "stack overflow"),
        ("string.rep('x', -1):bad()", "attempt to call"),
        ("local s = string.rep('a', 1e9)", "memory"),
    ] {
        let id = bench.run(spec("faults", &[]), lua(text), None);
        let view = bench.until(&id, |view| view.status == Status::Fault);
        assert!(view.reason.contains(part), "{text}: {}", view.reason);
    }
}

#[test]
fn two_scripts_talk_and_pins_are_points() {
    let bench = Bench::new(&[42.0, 0.0]);
    let sender = bench.run(
        spec("sender", &[("ain-0", false)]),
        lua("while true do n3c.tx(10, h3c.aIn(0)) o3c.dms(2) end"),
        None,
    );
    let text = "n3c.listen(10) while true do local r, id, v = n3c.rx() if r and id == 10 then h3c.aOut(2, v / 2) end o3c.dus(200) end";
    let taker = bench.run(spec("taker", &[("aaa", false), ("aout-2", true)]), lua(text), None);
    bench.until(&taker, |_| bench.home.written.lock().contains(&21.0));
    for id in [sender, taker] {
        assert_eq!(bench.view(&id).status, Status::Running);
        bench.runner.stop(&id, u64::MAX);
    }
    let echo = bench.run(spec("echo", &[]), guest("echo"), None);
    let hears = bench.run(
        spec("hears", &[]),
        lua("n3c.listen(1) while true do local r, _, d = n3c.rx() if r then print(d) return end o3c.dms(1) end"),
        None,
    );
    bench.until(&hears, |_| {
        let data = b"over".to_vec();
        bench.home.exchange.say(&Message {
            topic: "n3c.1".into(),
            data,
        });
        bench.view(&hears).status == Status::Stopped
    });
    assert_eq!(bench.lines(&hears), ["over"]);
    bench.runner.stop(&echo, u64::MAX);
    let asks = bench.run(spec("asks", &[]), guest("ask"), None);
    bench.until(&asks, |view| view.status == Status::Stopped);
    assert_eq!(bench.lines(&asks), ["out = 50"]);
}

#[test]
fn what_is_not_granted_is_refused_in_words() {
    let bench = Bench::new(&[1.0]);
    let mut narrow = spec("narrow", &[("aout-0", false)]);
    narrow.publishes.clear();
    narrow.listens.clear();
    let text = "print(h3c.aOut(0, 1)) print(n3c.tx(1, 2)) n3c.listen(1)";
    let id = bench.run(narrow, lua(text), None);
    let view = bench.until(&id, |view| view.status == Status::Fault);
    assert!(
        view.reason.contains("not granted to listen to \"n3c.1\""),
        "{}",
        view.reason
    );
    assert_eq!(
        bench.lines(&id),
        [
            "false\tthe program may only read this point",
            "false\tthe program is not granted to publish on \"n3c.1\""
        ]
    );
}
