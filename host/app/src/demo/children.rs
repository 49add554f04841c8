//! The demonstration's hosts as child processes.
//!
//! ```text
//! planned ─► started ─► ready ─► dead (said once) ─► started again
//!                └ no ready line in time, or ended: an error with the end of its log
//! ```
//! A child holds on to its standard input: when this process ends, however it ends, the children drain and stop.
//! Never: restarts a child by itself.

use std::{
    collections::BTreeMap,
    fs::{self, File},
    io::{BufRead as _, BufReader},
    net::{Ipv4Addr, SocketAddr, TcpListener},
    os::unix::process::{CommandExt as _, ExitStatusExt as _},
    path::{Path, PathBuf},
    process::{self, ExitStatus, Stdio},
    sync::{
        atomic::{AtomicBool, Ordering},
        mpsc,
    },
    time::{Duration, Instant},
};

use bumpless_api::types::Fault;
use rustix::process::{Pid, Signal, kill_process};

use super::relay::Relay;
use crate::{error::Error, host::Ready, show};

/// Longest wait for a host to get ready.
const READY_TIME_MAX: Duration = Duration::from_secs(30);
/// Time that a host gets to drain and stop before it is killed.
const STOP_TIME_MAX: Duration = Duration::from_secs(10);
/// How often a waiting parent looks.
const LOOK_EVERY: Duration = Duration::from_millis(50);
/// Lines of a log that an error shows.
const LOG_LINES: usize = 8;

/// What is to be started.
pub(super) struct Plan {
    dir: PathBuf,
    program: PathBuf,
    /// Name and API port; 0 for any.
    hosts: Vec<(String, u16)>,
    /// Tanks beside the plant.
    tanks: u32,
    /// Where the children pass on the faults that they are asked for.
    faults: mpsc::SyncSender<Fault>,
}

impl Plan {
    /// The first host serves the plant. Ports count up from `first_port` where they are free.
    pub(super) fn new(
        dir: &Path,
        names: &[&str],
        first_port: u16,
        tanks: u32,
        faults: mpsc::SyncSender<Fault>,
    ) -> Result<Self, Error> {
        let program = std::env::current_exe().map_err(|source| Error::File {
            path: "this program".into(),
            action: "found",
            source,
        })?;
        let ports = (first_port..).map(|port| {
            let free = TcpListener::bind((Ipv4Addr::LOCALHOST, port)).is_ok();
            if free { port } else { 0 }
        });
        let hosts = names.iter().map(|name| (*name).to_owned()).zip(ports).collect();
        Ok(Self {
            dir: dir.to_owned(),
            program,
            hosts,
            tanks,
            faults,
        })
    }

    /// Writes a host's configuration and starts it.
    fn spawn(&self, index: usize, connect: &[String]) -> Result<Starting, Error> {
        let Some((name, port)) = self.hosts.get(index) else {
            return Err(Error::Demo(format!("there is no host {index}")));
        };
        let dir = self.dir.join(name);
        fs::create_dir_all(&dir).map_err(|source| Error::File {
            path: dir.clone(),
            action: "made",
            source,
        })?;
        let config = dir.join("host.toml");
        fs::write(
            &config,
            host_file(name, *port, connect, (index == 0).then_some(self.tanks)),
        )
        .map_err(|source| Error::File {
            path: config.clone(),
            action: "written",
            source,
        })?;
        let log = dir.join("log");
        let errors = File::options().create(true).append(true).open(&log);
        let errors = errors.map_err(|source| Error::File {
            path: log.clone(),
            action: "written",
            source,
        })?;
        let mut process = process::Command::new(&self.program)
            .args(["host", "--until-stdin-closes", "--faults-on-stdout", "--config"])
            .arg(&config)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(errors)
            // Its own group: Ctrl-C is for the parent, who stops the children in order.
            .process_group(0)
            .spawn()
            .map_err(|source| Error::File {
                path: self.program.clone(),
                action: "started",
                source,
            })?;
        let (sender, ready) = mpsc::channel();
        let faults = self.faults.clone();
        if let Some(stdout) = process.stdout.take() {
            // Ends with the child's standard output.
            let read = move || {
                for line in BufReader::new(stdout).lines().map_while(Result::ok) {
                    if let Ok(line) = serde_json::from_str::<Ready>(&line) {
                        // Nobody waits any more where the child was given up.
                        let _ = sender.send(line);
                    } else if let Ok(fault) = serde_json::from_str::<Fault>(&line) {
                        // Too many at once are dropped; whoever asks sees that nothing happened.
                        let _ = faults.try_send(fault);
                    }
                }
            };
            std::thread::Builder::new()
                .name(format!("stdout-{name}"))
                .spawn(read)
                .map_err(|error| Error::start("the thread of a child", error))?;
        }
        Ok(Starting {
            name: name.clone(),
            log,
            process,
            ready,
        })
    }
}

/// A host's configuration; one with a number of tanks has the plant.
fn host_file(name: &str, port: u16, connect: &[String], tanks: Option<u32>) -> String {
    let connect: Vec<String> = connect.iter().map(|at| format!("{at:?}")).collect();
    let mut text = format!(
        "# A host of the demonstration; the next start replaces this file.\nhost = \"{name}\"\n\n\
         [cell]\nname = \"demo\"\nlisten = [\"tcp/127.0.0.1:0\"]\nconnect = [{}]\n\n\
         [api]\nlisten = \"127.0.0.1:{port}\"\n\n[lab]\nreports = \"../reports\"\n",
        connect.join(", ")
    );
    if tanks.is_some() {
        text.push_str("\n[[bus]]\nid = \"plant\"\ndriver = \"sim\"\nseed = 1\non_stop = \"safe\"\n");
    }
    if let Some(count @ 1..) = tanks {
        text.push_str(&format!(
            "\n[[bus]]\nid = \"tanks\"\ndriver = \"sim\"\nseed = 2\non_stop = \"safe\"\n\
             fopdt = {{ count = {count}, gain = 0.9, tau_s = 6.0, dead_time_s = 0.4, noise = 0.15 }}\n"
        ));
    }
    text
}

/// A host that is not ready yet.
struct Starting {
    name: String,
    log: PathBuf,
    process: process::Child,
    ready: mpsc::Receiver<Ready>,
}

impl Starting {
    /// Waits for its word; ends it where none comes.
    fn wait(mut self, stop: &AtomicBool) -> Result<Child, Error> {
        let until = Instant::now() + READY_TIME_MAX;
        let why = loop {
            if let Ok(ready) = self.ready.recv_timeout(LOOK_EVERY) {
                return Ok(Child {
                    name: self.name,
                    log: self.log,
                    process: self.process,
                    ready,
                    dead: false,
                });
            }
            if let Ok(Some(status)) = self.process.try_wait() {
                break in_words(status);
            }
            if stop.load(Ordering::Relaxed) {
                break "was told to stop".to_owned();
            }
            if Instant::now() >= until {
                break format!("was not ready within {} s", READY_TIME_MAX.as_secs());
            }
        };
        end(&mut self.process, Duration::ZERO);
        Err(Error::Demo(format!("host {} {why}{}", self.name, log_end(&self.log))))
    }
}

/// A host that is, or was, ready.
pub(super) struct Child {
    /// Its name.
    pub(super) name: String,
    /// Where its log lines go.
    pub(super) log: PathBuf,
    process: process::Child,
    ready: Ready,
    dead: bool,
}

impl Child {
    /// Address of its API.
    pub(super) fn api(&self) -> &str {
        &self.ready.api
    }

    /// Its process id.
    pub(super) fn id(&self) -> u32 {
        self.process.id()
    }
}

/// The children that make up the cell. Dropping it stops them.
pub(super) struct Cell {
    plan: Plan,
    children: Vec<Child>,
    /// The way from each controller to the plant, by the controller's name.
    relays: BTreeMap<String, Relay>,
}

impl Cell {
    /// Starts the first host, then the others side by side, each behind a relay to the first, and waits until all are ready.
    pub(super) fn start(plan: Plan, stop: &AtomicBool) -> Result<Self, Error> {
        let first = plan.spawn(0, &[])?.wait(stop)?;
        let at = address(&first.ready)?;
        let mut cell = Self {
            plan,
            children: vec![first],
            relays: BTreeMap::new(),
        };
        for (name, _) in cell.plan.hosts.iter().skip(1) {
            cell.relays.insert(name.clone(), Relay::start(at)?);
        }
        let starting: Vec<Result<Starting, Error>> = (1..cell.plan.hosts.len())
            .map(|index| cell.plan.spawn(index, &cell.known_to(index)))
            .collect();
        for started in starting {
            cell.children.push(started?.wait(stop)?);
        }
        Ok(cell)
    }

    /// All children, in the order of the plan.
    pub(super) fn children(&self) -> impl Iterator<Item = &Child> {
        self.children.iter()
    }

    /// Address of a host's API.
    pub(super) fn api(&self, name: &str) -> Option<&str> {
        self.children.iter().find(|child| child.name == name).map(Child::api)
    }

    /// The way of a controller to the plant.
    pub(super) fn relay(&self, name: &str) -> Option<&Relay> {
        self.relays.get(name)
    }

    /// Where a host finds others when it starts: a controller knows the plant, by its relay, and learns of the rest from there.
    /// The plant knows nobody, for they come to it; else it would go to them past the relays.
    fn known_to(&self, index: usize) -> Vec<String> {
        let name = self.plan.hosts.get(index).map(|(name, _)| name);
        name.and_then(|name| self.relays.get(name))
            .map(Relay::locator)
            .into_iter()
            .collect()
    }

    /// Sends a signal to a host that lives; false where there is none of that name.
    pub(super) fn signal(&self, name: &str, signal: Signal) -> bool {
        let child = self.children.iter().find(|child| child.name == name && !child.dead);
        child
            .and_then(|child| Pid::from_raw(i32::try_from(child.id()).ok()?))
            .is_some_and(|pid| kill_process(pid, signal).is_ok())
    }

    /// Who died since the last look, in words.
    pub(super) fn deaths(&mut self) -> Vec<String> {
        let mut deaths = Vec::new();
        for child in self.children.iter_mut().filter(|child| !child.dead) {
            if let Ok(Some(status)) = child.process.try_wait() {
                child.dead = true;
                deaths.push(format!(
                    "host {} {}; its log: {}",
                    child.name,
                    in_words(status),
                    child.log.display()
                ));
            }
        }
        deaths
    }

    /// Starts the dead again, or one of them, joined to all others.
    pub(super) fn revive(&mut self, only: Option<&str>, stop: &AtomicBool) -> Vec<Result<String, Error>> {
        let mut ends = Vec::new();
        for index in 0..self.children.len() {
            let child = &self.children[index];
            if !child.dead || only.is_some_and(|name| name != child.name) {
                continue;
            }
            let back = self
                .plan
                .spawn(index, &self.known_to(index))
                .and_then(|starting| starting.wait(stop))
                .and_then(|child| Ok((address(&child.ready)?, child)));
            ends.push(back.map(|(at, child)| {
                if index == 0 {
                    // The plant is elsewhere now; the controllers come to it again by themselves.
                    self.relays.values().for_each(|relay| relay.lead_to(at));
                }
                let name = child.name.clone();
                self.children[index] = child;
                name
            }));
        }
        ends
    }

    /// Stops the controllers, then the plant: each drains first.
    pub(super) fn stop(&mut self) {
        let (plant, controllers) = match self.children.split_first_mut() {
            Some((plant, controllers)) => (plant, controllers),
            None => return,
        };
        // One that is paused hears nothing.
        for child in controllers.iter().chain([&*plant]).filter(|child| !child.dead) {
            if let Some(pid) = i32::try_from(child.id()).ok().and_then(Pid::from_raw) {
                // It may have ended by itself; then there is nothing to continue.
                let _ = kill_process(pid, Signal::CONT);
            }
        }
        // All are told before one is waited for.
        for child in controllers.iter_mut() {
            drop(child.process.stdin.take());
        }
        for child in controllers.iter_mut() {
            end(&mut child.process, STOP_TIME_MAX);
        }
        drop(plant.process.stdin.take());
        end(&mut plant.process, STOP_TIME_MAX);
        self.children.clear();
    }
}

impl Drop for Cell {
    fn drop(&mut self) {
        self.stop();
    }
}

/// Where a host listens for others.
fn address(ready: &Ready) -> Result<SocketAddr, Error> {
    let locator = ready.cell.first().map(String::as_str).unwrap_or_default();
    let text = locator.strip_prefix("tcp/").unwrap_or(locator);
    text.parse().map_err(|_| {
        Error::Demo(format!(
            "host {} listens at {locator:?}, which is no address",
            ready.host
        ))
    })
}

/// Closes a process's standard input, waits, and kills it where that did not help.
fn end(process: &mut process::Child, patience: Duration) {
    drop(process.stdin.take());
    let until = Instant::now() + patience;
    while Instant::now() < until {
        match process.try_wait() {
            Ok(None) => std::thread::sleep(LOOK_EVERY),
            // Ended, or not ours to wait for.
            _ => return,
        }
    }
    if matches!(process.try_wait(), Ok(None)) {
        show::note(&format!("process {} did not stop in time and is killed", process.id()));
        // It may have ended in between; that is as good.
        let _ = process.kill();
    }
    let _ = process.wait();
}

fn in_words(status: ExitStatus) -> String {
    match (status.code(), status.signal()) {
        (Some(code), _) => format!("ended with code {code}"),
        (None, Some(signal)) => format!("was killed by signal {signal}"),
        (None, None) => "ended".to_owned(),
    }
}

/// The last lines of a log.
fn log_end(log: &Path) -> String {
    let text = fs::read_to_string(log).unwrap_or_default();
    let lines: Vec<&str> = text.lines().collect();
    let skip = lines.len().saturating_sub(LOG_LINES);
    lines[skip..]
        .iter()
        .fold(format!("; the end of {}:", log.display()), |text, line| {
            text + "\n    " + line
        })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Config;

    #[test]
    fn the_hosts_files_are_good_ones() {
        let at = ["tcp/127.0.0.1:1".to_owned(), "tcp/127.0.0.1:2".to_owned()];
        let plant = Config::parse(&host_file("plant", 0, &[], Some(3)), Path::new("host.toml")).expect("a good file");
        assert_eq!((plant.io, plant.control), (true, false));
        let a = Config::parse(&host_file("a", 8481, &at, None), Path::new("host.toml")).expect("a good file");
        assert_eq!((a.io, a.control), (false, true));
        assert_eq!(a.cell.connect, at);
        assert_eq!(a.api_listen.port(), 8481);
        assert_eq!(a.lab_reports.as_deref(), Some(Path::new("../reports")));
    }

    #[test]
    fn ends_are_told_in_words() {
        assert_eq!(in_words(ExitStatus::from_raw(9)), "was killed by signal 9");
        assert_eq!(in_words(ExitStatus::from_raw(256)), "ended with code 1");
    }
}
