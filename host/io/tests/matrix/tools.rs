//! Other people's Modbus: installed by themselves under the target folder, once.
//!
//! | peer | comes from |
//! |---|---|
//! | pymodbus | PyPI, into a virtual environment |
//! | libmodbus, mbpoll | Debian's package `mbpoll`; installed where this runs as root |
//! | modbus-serial | npm, without its native parts |
//!
//! What cannot be had fails the test, for rows that are not there show nothing. Who works without them sets
//! `BUMPLESS_WITHOUT_PEERS`: then they are left out, and that is said on the error output.

use std::{
    fs::{self, File},
    io::{BufRead as _, BufReader, Write as _},
    path::{Path, PathBuf},
    process::{Child, ChildStdin, ChildStdout, Command, Stdio},
    sync::{Arc, Mutex, mpsc},
    time::Duration,
};

use serde_json::Value;

/// A peer's program: what runs it, and where it is installed.
#[derive(Debug, Clone)]
pub(crate) struct Tool {
    pub(crate) name: &'static str,
    program: PathBuf,
    script: PathBuf,
    modules: PathBuf,
}

fn peers() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/matrix/peers")
}

fn home(part: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("modbus-peers").join(part);
    fs::create_dir_all(&folder).expect("a folder under the target folder");
    folder
}

fn run(what: &str, command: &mut Command) -> Result<(), String> {
    let output = command
        .stdin(Stdio::null())
        .output()
        .map_err(|error| format!("{what}: {error}"))?;
    if output.status.success() {
        return Ok(());
    }
    let said = [output.stdout, output.stderr].concat();
    Err(format!("{what}: {}: {}", output.status, String::from_utf8_lossy(&said)))
}

/// Installs once: `wanted` is what is in the stamp afterwards.
fn once(folder: &Path, wanted: &str, install: impl FnOnce() -> Result<(), String>) -> Result<(), String> {
    let stamp = folder.join("installed.txt");
    if fs::read_to_string(&stamp).is_ok_and(|installed| installed == wanted) {
        return Ok(());
    }
    install()?;
    fs::write(&stamp, wanted).map_err(|error| error.to_string())
}

fn python() -> Result<PathBuf, String> {
    let folder = home("python");
    let requirements = peers().join("requirements.txt");
    let wanted = fs::read_to_string(&requirements).map_err(|error| error.to_string())?;
    let python = folder.join("bin/python");
    once(&folder, &wanted, || {
        let advice = |error: String| format!("{error}\ninstall python3 with venv and pip (Debian: python3-venv)");
        run(
            "python3 -m venv",
            Command::new("python3").args(["-m", "venv"]).arg(&folder),
        )
        .map_err(advice)?;
        let pip = [
            "-m",
            "pip",
            "install",
            "--quiet",
            "--disable-pip-version-check",
            "--requirement",
        ];
        run("pip install", Command::new(&python).args(pip).arg(&requirements))
    })?;
    Ok(python)
}

fn pymodbus() -> Result<Tool, String> {
    Ok(Tool {
        name: "pymodbus",
        program: python()?,
        script: peers().join("pymodbus_peer.py"),
        modules: PathBuf::new(),
    })
}

fn has_mbpoll() -> bool {
    // It says so with a failure where it is asked for nothing.
    Command::new("mbpoll").arg("-V").stdin(Stdio::null()).output().is_ok()
}

fn libmodbus() -> Result<Tool, String> {
    if !has_mbpoll() {
        let is_root = Command::new("id")
            .arg("-u")
            .output()
            .is_ok_and(|output| output.stdout.trim_ascii() == b"0");
        if !is_root {
            return Err("mbpoll and libmodbus are not installed; as root: apt-get install mbpoll".to_owned());
        }
        let mut apt = Command::new("apt-get");
        apt.env("DEBIAN_FRONTEND", "noninteractive");
        if run("apt-get install", apt.args(["install", "--yes", "mbpoll"])).is_err() {
            run("apt-get update", Command::new("apt-get").arg("update"))?;
            run("apt-get install", &mut apt)?;
        }
    }
    Ok(Tool {
        name: "libmodbus",
        program: "python3".into(),
        script: peers().join("libmodbus_peer.py"),
        modules: PathBuf::new(),
    })
}

fn modbus_serial() -> Result<Tool, String> {
    let folder = home("node");
    let package = peers().join("package.json");
    let wanted = fs::read_to_string(&package).map_err(|error| error.to_string())?;
    once(&folder, &wanted, || {
        fs::copy(&package, folder.join("package.json")).map_err(|error| error.to_string())?;
        let npm = [
            "install",
            "--omit=optional",
            "--ignore-scripts",
            "--no-audit",
            "--no-fund",
            "--no-package-lock",
        ];
        run("npm install", Command::new("npm").args(npm).current_dir(&folder))
            .map_err(|error| format!("{error}\ninstall Node.js with npm (Debian: nodejs npm)"))
    })?;
    Ok(Tool {
        name: "modbus-serial",
        program: "node".into(),
        script: peers().join("modbus_serial_peer.js"),
        modules: folder.join("node_modules"),
    })
}

/// Every peer that can be had here.
pub(crate) fn all() -> Vec<Tool> {
    // Two test processes must not install at once.
    let lock = File::create(home("").join(".lock")).expect("a lock file");
    lock.lock().expect("the lock");
    let mut tools = Vec::new();
    for tool in [pymodbus(), libmodbus(), modbus_serial()] {
        match tool {
            Ok(tool) => tools.push(tool),
            Err(problem) if std::env::var_os("BUMPLESS_WITHOUT_PEERS").is_some() => {
                eprintln!("LEFT OUT, a peer is missing: {problem}");
            }
            Err(problem) => {
                panic!("a peer is missing: {problem}\nBUMPLESS_WITHOUT_PEERS=1 leaves out what cannot be had")
            }
        }
    }
    tools
}

/// A peer's process; it ends with its owner.
pub(crate) struct Process {
    child: Arc<Mutex<Child>>,
    stdin: Option<ChildStdin>,
    stdout: BufReader<ChildStdout>,
    /// Goes with the process: whoever waits for its lines must not wait for ever.
    _guard: mpsc::Sender<()>,
}

/// Longest life of a peer; reached only when it hangs.
const LIFE_MAX: Duration = Duration::from_secs(120);

impl Process {
    fn start(tool: &Tool, arguments: &[String]) -> Self {
        let mut child = Command::new(&tool.program)
            .arg(&tool.script)
            .args(arguments)
            .env("PEER_MODULES", &tool.modules)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap_or_else(|error| panic!("{}: {error}", tool.name));
        let stdin = child.stdin.take();
        let stdout = BufReader::new(child.stdout.take().expect("a pipe"));
        let child = Arc::new(Mutex::new(child));
        let (guard, gone) = mpsc::channel::<()>();
        let guarded = Arc::clone(&child);
        std::thread::spawn(move || {
            if gone.recv_timeout(LIFE_MAX) == Err(mpsc::RecvTimeoutError::Timeout) {
                let _gone = guarded.lock().expect("a peer").kill();
            }
        });
        Self {
            child,
            stdin,
            stdout,
            _guard: guard,
        }
    }

    /// A client of the server on this port.
    pub(crate) fn client(tool: &Tool, port: u16, unit: u8) -> Self {
        Self::start(tool, &["client".to_owned(), port.to_string(), unit.to_string()])
    }

    /// A client over TLS, with this certificate.
    pub(crate) fn client_over_tls(tool: &Tool, port: u16, unit: u8, own: &str) -> Self {
        let words = ["client", &port.to_string(), &unit.to_string(), &certificates(), own];
        Self::start(tool, &words.map(str::to_owned))
    }

    /// A server, and its port.
    pub(crate) fn server(tool: &Tool) -> (Self, u16) {
        Self::serving(tool, &["server".to_owned()])
    }

    /// A server over TLS, and its port.
    pub(crate) fn server_over_tls(tool: &Tool) -> (Self, u16) {
        Self::serving(tool, &["server".to_owned(), certificates()])
    }

    fn serving(tool: &Tool, words: &[String]) -> (Self, u16) {
        let mut process = Self::start(tool, words);
        let line = process.line();
        let port = line.parse();
        (
            process,
            port.unwrap_or_else(|_| panic!("{} says {line:?} instead of its port", tool.name)),
        )
    }

    fn line(&mut self) -> String {
        let mut line = String::new();
        self.stdout.read_line(&mut line).expect("a line from the peer");
        line.trim().to_owned()
    }

    /// One operation and its answer.
    pub(crate) fn ask(&mut self, operation: &Value) -> Value {
        let stdin = self.stdin.as_mut().expect("a pipe");
        writeln!(stdin, "{operation}")
            .and_then(|()| stdin.flush())
            .expect("the peer listens");
        let line = self.line();
        serde_json::from_str(&line).unwrap_or_else(|_| panic!("{operation}: the peer said {line:?}"))
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let mut child = self.child.lock().expect("a peer");
        let _gone = child.kill().and_then(|()| child.wait());
    }
}

/// The folder of the tests' certificates.
pub(crate) fn certificates() -> String {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/modbus/tls");
    folder.to_string_lossy().into_owned()
}

/// mbpoll's view of some values: table as its number, first address from 0.
pub(crate) fn mbpoll(port: u16, table: &str, start: u16, count: u16, write: &[&str]) -> Result<Vec<i64>, String> {
    mbpoll_unit(port, 1, table, start, count, write)
}

/// As [`mbpoll`], of a unit.
pub(crate) fn mbpoll_unit(
    port: u16,
    unit: u8,
    table: &str,
    start: u16,
    count: u16,
    write: &[&str],
) -> Result<Vec<i64>, String> {
    let mut command = Command::new("mbpoll");
    command.args(["-m", "tcp", "-1", "-0", "-o", "5", "-a", &unit.to_string(), "-t", table]);
    command.args(["-p", &port.to_string(), "-r", &start.to_string()]);
    if write.is_empty() {
        command.args(["-c", &count.to_string()]);
    }
    command.arg("127.0.0.1").args(write);
    let output = command
        .stdin(Stdio::null())
        .output()
        .map_err(|error| error.to_string())?;
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    if !output.status.success() {
        return Err(format!("{said}{}", String::from_utf8_lossy(&output.stderr)));
    }
    let value = |line: &str| {
        line.strip_prefix('[')?
            .split_once("]:")?
            .1
            .split_whitespace()
            .next()?
            .parse()
            .ok()
    };
    Ok(said.lines().filter_map(value).collect())
}
