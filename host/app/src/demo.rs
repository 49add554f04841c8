//! `demo`: a whole cell on this machine. A plant host with the simulated pilot plant, three controller hosts, the stock
//! controllers in the library, one loop that holds the vessel's pressure, and some tanks with a level loop each.
//!
//! ```text
//! folder, ports ─► plant ready ─► a, b, c ready, each behind a relay ─► upload ─► loop in force ─► addresses ─► watching the children
//!                                                                   ├ a child dies: said, started again with --restart
//!                                                                   └ Ctrl-C or --for: controllers, then the plant
//! ```
//! The hosts are processes like any others: kill one and see. Never: touches anything outside of its folder.

mod children;
mod faults;
mod relay;

use std::{
    fs,
    path::{Path, PathBuf},
    sync::{atomic::Ordering, mpsc},
    time::{Duration, Instant},
};

use bumpless_api::types::{Apply, Fault, FaultKind, Loop, LoopDraft};

use crate::{cli::DemoArgs, client::Client, commands, error::Error, show, stop};
use children::{Cell, Plan};
use faults::Faults;

/// First port of the APIs; the plant's. Where one is taken, any free one serves.
const FIRST_PORT: u16 = 8480;
/// The hosts, the plant first.
const HOSTS: [&str; 4] = ["plant", "a", "b", "c"];
/// The stock controllers.
const COMPONENTS: [&str; 3] = ["pidplus", "pid", "on-off"];
/// Longest wait for the cell to be whole: a shared machine may have other work.
const WHOLE_TIME_MAX: Duration = Duration::from_secs(30);
/// Faults that wait to be done; more are dropped.
const FAULTS_MAX: usize = 16;
/// How often the children are looked at.
const LOOK_EVERY: Duration = Duration::from_millis(100);

/// The demonstration's loop: PIDPlus holds the pressure of vessel R01 by the speed of pump P1.
const LOOP_FILE: &str = include_str!("demo/pressure.toml");

/// Runs the demonstration until Ctrl-C or until its time is over.
pub(crate) fn run(args: &DemoArgs) -> Result<(), Error> {
    let stop = stop::on_signals()?;
    let components = components(args.components.as_deref())?;
    let dir = folder(args.dir.as_deref())?;
    let until = args.for_s.map(|seconds| Instant::now() + Duration::from_secs(seconds));
    let stopping = || stop.load(Ordering::Relaxed) || until.is_some_and(|until| Instant::now() >= until);

    let (wish, wishes) = mpsc::sync_channel::<Fault>(FAULTS_MAX);
    let plan = Plan::new(&dir, &HOSTS, FIRST_PORT, args.tanks, wish)?;
    show::note(&format!("starting hosts {} in {}", HOSTS.join(", "), dir.display()));
    let mut cell = Cell::start(plan, &stop)?;
    let client = Client::new(cell.api(HOSTS[0]).unwrap_or_default())?;
    wait_until_whole(&client, &stop)?;
    for name in COMPONENTS {
        let file = components.join(format!("{name}.wasm"));
        let (component, _) = commands::components::send(&client, &file, "note=stock%20controller", false)?;
        show::note(&format!("uploaded {}@{}", component.name, component.version));
    }
    let file = dir.join("pressure.toml");
    fs::write(&file, LOOP_FILE).map_err(|source| Error::File {
        path: file.clone(),
        action: "written",
        source,
    })?;
    let draft = commands::loops::read(&file)?;
    let end: Apply = client.put("/v1/loops/pressure", &draft)?.decode()?;
    show::note(&format!("loop {} runs, revision {}", end.loop_name, end.revision));
    for n in 0..args.tanks {
        let draft = tank(n)?;
        let _: Apply = client.put(&format!("/v1/loops/{}", draft.name), &draft)?.decode()?;
    }
    if args.tanks > 0 {
        show::note(&format!("{} level loops run", args.tanks));
    }
    tell(&cell, &dir)?;

    let mut faults = Faults::default();
    while !stopping() {
        while let Ok(fault) = wishes.try_recv() {
            match faults.act(&fault, &cell) {
                Ok(done) => show::line(&done)?,
                Err(error) => show::note(&error.report()),
            }
            if fault.fault == FaultKind::Start {
                told(cell.revive(Some(&fault.host), &stop))?;
            }
        }
        for line in faults.look(&cell) {
            show::line(&line)?;
        }
        for death in cell.deaths() {
            show::line(&format!(
                "{death}{}",
                if args.restart { "; it is started again" } else { "" }
            ))?;
        }
        if args.restart {
            told(cell.revive(None, &stop))?;
        }
        std::thread::sleep(LOOK_EVERY);
    }
    // The plant may be the host that was killed; then there is nothing to tell.
    if let Ok(found) = client
        .get("/v1/loops/pressure")
        .and_then(|answer| answer.decode::<Loop>())
        && let Some(tally) = found.tally
    {
        show::line(&format!(
            "pressure: {} cycles taken, {} lost, {} takeovers; stopping",
            tally.taken, tally.lost, tally.takeovers
        ))?;
    }
    cell.stop();
    Ok(())
}

/// Says who is back, or why not.
fn told(revived: Vec<Result<String, Error>>) -> Result<(), Error> {
    for back in revived {
        match back {
            Ok(name) => show::line(&format!("host {name} is back"))?,
            Err(error) => show::note(&error.report()),
        }
    }
    Ok(())
}

/// The level loop of a tank. Lambda tuning with lambda = 2 s: k = 6 / (0.9 · (2 + 0.4)) = 2.8 and ti = 6 s.
fn tank(n: u32) -> Result<LoopDraft, Error> {
    let text = format!(
        "name = \"tank-{number}\"\ncomponent = \"pid\"\nperiod_ms = 200\nsetpoint = {setpoint}\nreplicas = 3\n\
         [ports]\npv = \"tanks.{n}.pv\"\nout = \"tanks.{n}.out\"\n\
         [parameters]\nk = 2.8\nti = 6.0\nout-low = 0.0\nout-high = 100.0\n",
        number = n + 1,
        setpoint = 30 + (n * 17) % 50,
    );
    toml::from_str(&text).map_err(|error| Error::Demo(format!("the loop of tank {}: {error}", n + 1)))
}

/// The folder of everything; a new one where none is named.
fn folder(named: Option<&Path>) -> Result<PathBuf, Error> {
    let dir = match named {
        Some(dir) => dir.to_owned(),
        None => std::env::temp_dir().join(format!("bumpless-demo-{}", std::process::id())),
    };
    fs::create_dir_all(&dir).map_err(|source| Error::File {
        path: dir.clone(),
        action: "made",
        source,
    })?;
    // The children's paths must not depend on where they are started.
    fs::canonicalize(&dir).map_err(|source| Error::File {
        path: dir,
        action: "read",
        source,
    })
}

/// The folder with the stock controllers: as named, else beside the program, else in the work tree it was built in.
fn components(named: Option<&Path>) -> Result<PathBuf, Error> {
    let whole = |dir: &Path| COMPONENTS.iter().all(|name| dir.join(format!("{name}.wasm")).is_file());
    let mut places = Vec::new();
    if let Some(named) = named {
        places.push(named.to_owned());
    } else {
        let program = std::env::current_exe().ok();
        let beside = program.iter().flat_map(|program| program.ancestors().skip(1).take(2));
        places.extend(beside.map(|dir| dir.join("components")));
        places.push(PathBuf::from("target/components"));
    }
    places.iter().find(|dir| whole(dir)).cloned().ok_or_else(|| {
        let list: Vec<String> = places.iter().map(|dir| dir.display().to_string()).collect();
        Error::Demo(format!(
            "{} are not all in {}; build them with `cargo xtask components`, or name their folder with --components",
            COMPONENTS.map(|name| format!("{name}.wasm")).join(", "),
            list.join(" or ")
        ))
    })
}

/// Waits until every host sees every other, so that the loop gets all its replicas at once.
fn wait_until_whole(client: &Client, stop: &std::sync::atomic::AtomicBool) -> Result<(), Error> {
    let until = Instant::now() + WHOLE_TIME_MAX;
    loop {
        let hosts: bumpless_api::types::Hosts = client.get("/v1/hosts")?.decode()?;
        let alive: Vec<&str> = hosts
            .hosts
            .iter()
            .filter(|h| h.alive)
            .map(|h| h.name.as_str())
            .collect();
        if HOSTS.iter().all(|name| alive.contains(name)) {
            return Ok(());
        }
        if Instant::now() >= until || stop.load(Ordering::Relaxed) {
            return Err(Error::Demo(format!(
                "only {} of the hosts {} found each other within {} s; the logs in the folder say more",
                alive.join(", "),
                HOSTS.join(", "),
                WHOLE_TIME_MAX.as_secs()
            )));
        }
        std::thread::sleep(LOOK_EVERY);
    }
}

/// What runs, and what can be tried.
fn tell(cell: &Cell, dir: &Path) -> Result<(), Error> {
    let mut table = show::table(&["host", "api", "pid", "log"]);
    for child in cell.children() {
        table.add_row([
            child.name.clone(),
            child.api().to_owned(),
            child.id().to_string(),
            child.log.display().to_string(),
        ]);
    }
    show::line("")?;
    show::print(&table)?;
    let me = std::env::args().next().unwrap_or_else(|| "bumpless".to_owned());
    let api = cell.api(HOSTS[0]).unwrap_or_default();
    let other = cell.api(HOSTS[1]).unwrap_or_default();
    // The default address needs no words.
    let to = if api == "http://127.0.0.1:8480" {
        String::new()
    } else {
        format!(" --api {api}")
    };
    let killed = cell
        .children()
        .find(|child| child.name == HOSTS[2])
        .map_or(0, children::Child::id);
    let mut table = show::table(&["try", "what it does"]);
    for (command, what) in [
        (
            format!("{me} watch pressure --api {other}"),
            "the loop as it runs, from host a",
        ),
        (
            format!("{me} loop setpoint pressure 1.2{to}"),
            "another setpoint, in bar",
        ),
        (
            format!("{me} loop swap pressure pid{to}"),
            "another controller, without a bump",
        ),
        (format!("{me} loop rollback pressure{to}"), "and back"),
        (
            format!("{me} loop set pressure strategy=latency{to}"),
            "another way to choose the replica",
        ),
        (format!("kill -9 {killed}"), "lose host b: no cycle is lost with it"),
        (
            format!("{me} upload my-controller.wasm{to}"),
            "a controller of your own",
        ),
        (
            format!("{me} hosts{to}; {me} points{to}; {me} loop list{to}"),
            "what there is",
        ),
    ] {
        table.add_row([command, what.to_owned()]);
    }
    show::line("")?;
    show::print(&table)?;
    show::line(&format!(
        "\nin a browser: {api}/    loop file: {}    Ctrl-C stops everything\n",
        dir.join("pressure.toml").display()
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn missing_components_are_named_with_their_cure() {
        let error = components(Some(Path::new("/nowhere")))
            .expect_err("nothing there")
            .to_string();
        assert!(
            error.contains("/nowhere") && error.contains("cargo xtask components"),
            "{error}"
        );
    }

    #[test]
    fn the_loop_file_is_a_good_one() {
        let draft: LoopDraft = toml::from_str(LOOP_FILE).expect("a loop file");
        assert_eq!(draft.name, "pressure");
        for n in [0, 4, 199] {
            let draft = tank(n).expect("a loop file");
            assert!((0.0..100.0).contains(&draft.setpoint), "{draft:?}");
        }
    }
}
