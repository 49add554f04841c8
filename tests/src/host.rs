//! One process of the `bumpless` binary: started, watched, killed, paused, and started again where it was.
//!
//! ```text
//!   start ──► running ──pause──► paused
//!               │ ▲ ◄──resume──────┘
//!   kill9, terminate, its own end
//!               ▼ │ restart: same folder, same addresses
//!             ended
//! ```
//! A small watchdog process beside each host kills it when this process is gone, however it went.
//! Never: leaves a process behind.

use std::{
    fs::{self, File},
    io::{BufRead as _, BufReader},
    path::{Path, PathBuf},
    process::{Child, ExitStatus, Stdio},
    sync::mpsc::{Receiver, RecvTimeoutError, sync_channel},
    time::Duration,
};

use rustix::process::{Pid, Signal, kill_process};
use serde::Deserialize;

use crate::{Api, Binary, Error, Watchdog, chaos::dates, journal, wait_until};

/// Longest time until a host is ready: it opens its store, finds the others and compiles what it must hold.
const READY_MAX: Duration = Duration::from_secs(30);

/// Longest time until a host that was asked to stop has stopped.
const STOP_MAX: Duration = Duration::from_secs(20);

/// Lines of error output that a message shows.
const TAIL_LINES: usize = 40;

/// What is written into a host's configuration.
#[derive(Debug, Clone, Default)]
pub struct HostOptions {
    /// The host's name.
    pub name: String,
    /// The cell's name.
    pub cell: String,
    /// Locators of hosts to connect to.
    pub connect: Vec<String>,
    /// Where it listens for hosts; a free port of the loopback interface where empty.
    pub listen: Vec<String>,
    /// Keys of the `[cell]` table besides, as TOML lines.
    pub cell_extra: String,
    /// Whole tables besides: `[[bus]]`, `[loops]` and so on, as TOML. `{folder}` stands for the host's folder.
    pub tables: String,
    /// Words before the command, for example `["taskset", "--cpu-list", "0"]`.
    pub launcher: Vec<String>,
    /// Environment variables besides.
    pub environment: Vec<(String, String)>,
    /// Where its API listens, as `address:port`; a free port of the loopback interface where empty.
    pub api_listen: String,
    /// Keys before the tables, as TOML lines.
    pub head: String,
}

/// What a host says on its first line.
#[derive(Debug, Clone, Deserialize)]
struct Ready {
    api: String,
    cell: Vec<String>,
}

/// A process of the binary.
#[derive(Debug)]
pub struct HostProcess {
    /// The host's name.
    pub name: String,
    /// Address of its API: `http://127.0.0.1:PORT`. The same after a restart.
    pub api: String,
    /// Its locators: `tcp/127.0.0.1:PORT`. The same after a restart.
    pub cell: Vec<String>,
    options: HostOptions,
    binary: Binary,
    folder: PathBuf,
    running: Option<Running>,
}

#[derive(Debug)]
struct Running {
    child: Child,
    watchdog: Watchdog,
    ready: Receiver<String>,
}

impl HostProcess {
    /// Starts a host in a folder of its own and waits until it is ready.
    ///
    /// # Errors
    /// [`Error::NotReady`] with the end of its error output, [`Error::NoBinary`], [`Error::File`].
    pub fn start(options: HostOptions, folder: &Path) -> Result<Self, Error> {
        let mut host = Self::spawn(options, folder)?;
        host.wait_ready()?;
        Ok(host)
    }

    /// The name of its cell.
    #[must_use]
    pub fn cell_name(&self) -> &str {
        &self.options.cell
    }

    /// Starts a host without waiting; [`HostProcess::wait_ready`] must follow.
    ///
    /// # Errors
    /// As [`HostProcess::start`].
    pub fn spawn(options: HostOptions, folder: &Path) -> Result<Self, Error> {
        fs::create_dir_all(folder).map_err(|source| Error::File {
            path: folder.to_owned(),
            action: "written",
            source,
        })?;
        let mut host = Self {
            name: options.name.clone(),
            api: String::new(),
            cell: Vec::new(),
            binary: Binary::find()?,
            options,
            folder: folder.to_owned(),
            running: None,
        };
        host.launch()?;
        Ok(host)
    }

    fn launch(&mut self) -> Result<(), Error> {
        journal::keep(&self.folder)?;
        let config = self.config_path();
        fs::write(&config, self.config()).map_err(|source| Error::File {
            path: config.clone(),
            action: "written",
            source,
        })?;
        let stderr_path = self.stderr_path();
        let stderr = File::options()
            .create(true)
            .append(true)
            .open(&stderr_path)
            .map_err(|source| Error::File {
                path: stderr_path,
                action: "written",
                source,
            })?;
        let mut command = match self.options.launcher.split_first() {
            Some((program, rest)) => {
                let mut command = std::process::Command::new(program);
                command.args(rest).arg(self.binary.path());
                command
            }
            None => self.binary.command(),
        };
        command
            .args(["host", "--config"])
            .arg(&config)
            .current_dir(&self.folder)
            .env_remove("BUMPLESS_API")
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(stderr);
        if std::env::var_os("BUMPLESS_LOG").is_none() {
            command.env("BUMPLESS_LOG", "info");
        }
        command.envs(self.options.environment.iter().map(|(name, value)| (name, value)));
        let program = self.binary.path().display().to_string();
        let mut child = command.spawn().map_err(|source| Error::Program { program, source })?;
        let watchdog = match Watchdog::over(&child) {
            Ok(watchdog) => watchdog,
            Err(error) => {
                // The child has nothing yet that could be lost.
                let _gone = child.kill().and_then(|()| child.wait());
                return Err(error);
            }
        };
        let (sender, ready) = sync_channel(1);
        if let Some(stdout) = child.stdout.take() {
            std::thread::spawn(move || {
                for line in BufReader::new(stdout).lines().map_while(Result::ok) {
                    // Only the first line is waited for; the pipe is kept empty after it.
                    let _full = sender.try_send(line);
                }
            });
        }
        self.running = Some(Running { child, watchdog, ready });
        Ok(())
    }

    /// Waits until the host says that it is ready.
    ///
    /// # Errors
    /// [`Error::NotReady`].
    pub fn wait_ready(&mut self) -> Result<(), Error> {
        let line = match &self.running {
            Some(running) => running.ready.recv_timeout(READY_MAX),
            None => Err(RecvTimeoutError::Disconnected),
        };
        let why = match line {
            Ok(line) => match serde_json::from_str::<Ready>(&line) {
                Ok(ready) => {
                    self.api = ready.api;
                    self.cell = ready.cell;
                    return Ok(());
                }
                Err(error) => format!("its first line is not what it should be ({error}): {line}"),
            },
            Err(RecvTimeoutError::Timeout) => format!("it was not ready in {READY_MAX:?}"),
            Err(RecvTimeoutError::Disconnected) => "it ended before it was ready".to_owned(),
        };
        let error = Error::NotReady {
            host: self.name.clone(),
            why,
            stderr: self.stderr_tail(),
        };
        self.end();
        Err(error)
    }

    /// The configuration file's text.
    fn config(&self) -> String {
        let o = &self.options;
        let quoted = |list: &[String]| {
            let items: Vec<String> = list.iter().map(|text| format!("{text:?}")).collect();
            format!("[{}]", items.join(", "))
        };
        // After a restart: the same addresses, so that the others find it where it was.
        let listen = [&self.cell, &o.listen]
            .into_iter()
            .find(|list| !list.is_empty())
            .map_or_else(|| quoted(&["tcp/127.0.0.1:0".to_owned()]), |list| quoted(list));
        let api = match (
            self.api.split_once("://").map(|(_, address)| address),
            o.api_listen.as_str(),
        ) {
            (Some(before), _) => before,
            (None, "") => "127.0.0.1:0",
            (None, wanted) => wanted,
        };
        let folder = self.folder.display().to_string();
        format!(
            "host = {:?}\ndata = {:?}\n{}\n\n[cell]\nname = {:?}\nlisten = {listen}\nconnect = {}\n{}\n\n[api]\nlisten = {api:?}\n\n{}\n",
            o.name,
            self.data().display().to_string(),
            o.head,
            o.cell,
            quoted(&o.connect),
            o.cell_extra,
            o.tables.replace("{folder}", &folder),
        ) + own_network(&o.listen)
    }

    /// Locators to connect to from the next start on.
    pub fn set_connect(&mut self, connect: Vec<String>) {
        self.options.connect = connect;
    }

    /// Keys before the tables of its configuration, from the next start on.
    pub fn set_head(&mut self, head: String) {
        self.options.head = head;
    }

    /// Sets its date so many seconds off while it runs; only where its cell has [`crate::CellOptions::dates`].
    ///
    /// # Errors
    /// [`Error::File`].
    pub fn step_date(&self, by_s: i64) -> Result<(), Error> {
        dates::step(&self.folder, by_s)
    }

    /// Its client.
    #[must_use]
    pub fn api(&self) -> Api {
        Api::new(self.api.clone())
    }

    /// Its folder: configuration, data, error output, journal.
    #[must_use]
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Where it keeps what must outlast it.
    #[must_use]
    pub fn data(&self) -> PathBuf {
        self.folder.join("data")
    }

    /// Its configuration file.
    #[must_use]
    pub fn config_path(&self) -> PathBuf {
        self.folder.join("host.toml")
    }

    /// Its error output: the log.
    #[must_use]
    pub fn stderr_path(&self) -> PathBuf {
        self.folder.join("stderr.log")
    }

    /// Its process id; none where it does not run.
    #[must_use]
    pub fn pid(&self) -> Option<u32> {
        self.running.as_ref().map(|running| running.child.id())
    }

    /// Does it run? A paused host does.
    pub fn is_running(&mut self) -> bool {
        let ended = match &mut self.running {
            Some(running) => matches!(running.child.try_wait(), Ok(Some(_)) | Err(_)),
            None => return false,
        };
        if ended {
            self.end();
        }
        !ended
    }

    /// The end of its error output.
    #[must_use]
    pub fn stderr_tail(&self) -> String {
        let text = self.stderr();
        let lines: Vec<&str> = text.lines().collect();
        let from = lines.len().saturating_sub(TAIL_LINES);
        lines.get(from..).unwrap_or_default().join("\n")
    }

    /// All of its error output, over all starts.
    #[must_use]
    pub fn stderr(&self) -> String {
        fs::read(self.stderr_path())
            .map(|bytes| String::from_utf8_lossy(&bytes).into_owned())
            .unwrap_or_default()
    }

    fn signal(&self, signal: Signal) -> Result<(), Error> {
        let pid = self
            .pid()
            .and_then(|pid| i32::try_from(pid).ok())
            .and_then(Pid::from_raw);
        let sent = pid.map_or(Err(rustix::io::Errno::SRCH), |pid| kill_process(pid, signal));
        sent.map_err(|error| self.process(format!("{signal:?} cannot be sent: {error}")))
    }

    fn process(&self, why: String) -> Error {
        Error::Process {
            host: self.name.clone(),
            why,
            stderr: self.stderr_tail(),
        }
    }

    /// Kills it without warning and waits until it is gone.
    pub fn kill9(&mut self) {
        self.end();
    }

    /// Freezes it (SIGSTOP).
    ///
    /// # Errors
    /// [`Error::Process`] where it does not run.
    pub fn pause(&mut self) -> Result<(), Error> {
        self.signal(Signal::STOP)
    }

    /// Lets it go on (SIGCONT).
    ///
    /// # Errors
    /// [`Error::Process`] where it does not run.
    pub fn resume(&mut self) -> Result<(), Error> {
        self.signal(Signal::CONT)
    }

    /// Asks it to stop (SIGTERM) and waits until it has.
    ///
    /// # Errors
    /// [`Error::Process`] where it does not run, does not stop in 20 s, or ends with another status than 0.
    pub fn terminate(&mut self) -> Result<(), Error> {
        self.signal(Signal::TERM)?;
        let status = self.wait(STOP_MAX)?;
        if status.success() {
            Ok(())
        } else {
            Err(self.process(format!("it was asked to stop and ended with {status}")))
        }
    }

    /// Waits until it ends by itself.
    ///
    /// # Errors
    /// [`Error::Process`] where it does not in that time; it is killed then.
    pub fn wait(&mut self, longest: Duration) -> Result<ExitStatus, Error> {
        let ended = wait_until("the end of the process", longest, || match &mut self.running {
            Some(running) => running.child.try_wait().ok().flatten().ok_or("it runs"),
            None => Err("it was not started"),
        });
        let failed = ended.as_ref().err().map(|error| self.process(error.to_string()));
        self.end();
        match (ended, failed) {
            (_, Some(error)) => Err(error),
            (ended, None) => ended,
        }
    }

    /// Starts it again with the same configuration, data and addresses; kills it first where it runs.
    ///
    /// # Errors
    /// As [`HostProcess::start`].
    pub fn restart(&mut self) -> Result<(), Error> {
        self.end();
        self.launch()?;
        self.wait_ready()
    }

    fn end(&mut self) {
        if let Some(mut running) = self.running.take() {
            // The watchdog first, so that it never kills a stranger with the same number.
            drop(running.watchdog);
            let _gone = running.child.kill().and_then(|()| running.child.wait());
        }
    }
}

impl Drop for HostProcess {
    #[allow(clippy::print_stderr, reason = "a test that fails shows what its hosts said")]
    fn drop(&mut self) {
        self.end();
        if std::thread::panicking() {
            eprintln!("--- the end of host {}'s error output", self.name);
            eprintln!("{}", self.stderr_tail());
        }
    }
}

/// A host in a network of the test's own says so, or it would not start without TLS.
fn own_network(listen: &[String]) -> &'static str {
    let elsewhere = |place: &String| place.starts_with("tcp/") && !place.starts_with("tcp/127.");
    if listen.iter().any(elsewhere) {
        "\n[testing]\nopen_network = true\n"
    } else {
        ""
    }
}
