//! The host's configuration file: TOML, every key known, every error with the file, the key and the cure.
//!
//! ```toml
//! host = "a"                       # this host's name, unique in the cell
//! data = "data"                    # components, last records, keys; beside this file
//! labels = ["east"]                # words that loops may prefer it by, besides its name
//! realtime = "auto"                # or "required", "off": the cycle's threads go before other work
//!
//! [cell]
//! name = "demo"
//! listen = ["tcp/127.0.0.1:0"]     # where other hosts reach this one
//! connect = []                     # one that is up is enough
//!
//! [api]
//! listen = "127.0.0.1:8480"         # elsewhere only with [security] and [api.tls]
//! names = []                       # names by which people reach it besides addresses, such as "plant.example"
//!
//! [api.tls]                        # PEM files, read again when they change; `bumpless ca` makes some
//! certificate = "plant.pem"
//! key = "plant.key"
//!
//! [cell.tls]                       # every link with TLS on both sides, between these hosts alone
//! ca = "ca.pem"
//! certificate = "plant.pem"
//! key = "plant.key"
//! members = ["plant", "a", "b"]
//!
//! [security]                       # everybody has an account or a token; without this table nobody is asked
//! doors = false                    # may programs on the bus that are no hosts start jobs?
//!
//! [history]                        # of the loops at home or held here
//! enabled = true
//! bytes_max_mib = 512              # for single cycles; then the oldest go
//! cycles_days_max = 30             # single cycles older than this go
//! thinned_mib_max = 1024           # for history of 1 s, 10 s, 1 min, 15 min; then the oldest of the finest go
//! seconds_days_max = 30            # pieces of 1 s and of 10 s
//! minutes_days_max = 400           # of 1 min
//! quarters_days_max = 3700         # of 15 min
//! points = ["plant.tt101"]         # kept too, whether a loop uses them or not
//!
//! [otlp]                           # metrics and traces for a collector; nothing is sent without this table
//! endpoint = "http://127.0.0.1:4318"
//! metrics = true
//! traces = true
//! every_s = 15                     # between two sendings of metrics
//! headers = {}                     # such as a collector's key
//!
//! [lab]                            # for the operator's page
//! reports = "lab-out"              # folder of reports; beside this file
//!
//! [audit]                          # who changed what
//! bytes_max_mib = 256              # then the oldest entries go, and an entry says so
//!
//! [trust]                          # whose components the cell takes: see docs/signing.md
//! roots = []                       # root keys of which one must sign the first document; any may, where none is named
//!
//! [alarms]                         # of the host itself
//! clock_offset_max_ms = 1000
//! disk_free_min_mib = 512
//!
//! [[webhook]]                      # who is told of alarms of loops at home here
//! name = "pager"
//! url = "http://192.0.2.7:8080/alarms"
//! priority = "medium"              # and what is more urgent
//!
//! [testing]                        # a test device; only in a cell whose name begins with "test"
//! flip_bits_every = 100            # every so-manieth step of this host comes out with a bit turned over
//!
//! [[bus]]                          # points, if this host serves any
//! id = "plant"
//! driver = "sim"
//!
//! [[modbus_server]]                # points and loops of the cell, for SCADA
//! listen = "127.0.0.1:1502"
//! [[modbus_server.map]]
//! table = "input"
//! address = 0
//! point = "plant.pit129"
//! type = "f32"
//! ```
//! Relative paths count from the folder of the file. Never: opens anything but the file.

use std::{
    net::{Ipv4Addr, SocketAddr},
    path::{Path, PathBuf},
    time::Duration,
};

use bumpless_core::{CellName, HostId, PointId};
use bumpless_deploy::{HostAlarms, webhook::WebhookConfig};
use bumpless_io::BusConfig;
use bumpless_scada::ModbusServerConfig;
use serde::{Deserialize, Serialize};

mod history;
mod itself;
mod lab;
mod security;
mod testing;
mod trust;

use crate::{error::Error, realtime::Realtime};
use history::HistoryTable;
use lab::LabTable;
use security::{ApiTls, CellTls, Openness, SecurityTable};
use testing::TestingTable;
use trust::TrustTable;

/// Bytes of a configuration file: thousands of points fit; a mistaken path to a large file does not.
const FILE_BYTES_MAX: u64 = 16 * 1024 * 1024;

/// Everything that a host is told, checked as far as text can be.
#[derive(Debug, Clone)]
pub struct Config {
    /// Where it was read, for messages.
    pub path: PathBuf,
    /// This host's name.
    pub host: HostId,
    /// Folder of everything that outlives the process.
    pub data: PathBuf,
    /// Words that it goes by besides its name, for what loops prefer.
    pub labels: Vec<String>,
    /// How far its date is off, in s; for drills.
    pub clock_offset_s: i64,
    /// May the cycle's threads go before other work of the machine?
    pub realtime: Realtime,
    /// The bus between hosts.
    pub cell: bumpless_cell::Config,
    /// Where the API listens.
    pub api_listen: SocketAddr,
    /// Names by which people reach the API besides addresses.
    pub api_names: Vec<String>,
    /// Certificate and key of the API; none on loopback, where plain HTTP will do.
    pub api_tls: Option<bumpless_api::TlsFiles>,
    /// Must everybody who asks the API say who he is?
    pub secured: bool,
    /// May programs on the bus that are no hosts start jobs?
    pub doors: bool,
    /// Does it serve points? There are buses, then.
    pub io: bool,
    /// Does it run controllers?
    pub control: bool,
    /// Buses with their points.
    pub buses: bumpless_io::Config,
    /// The sandbox; folder and key of the compiled code are for the composition to fill in.
    pub engine: bumpless_engine::Config,
    /// The threads of the loops.
    pub loops: bumpless_loops::Config,
    /// Bytes on disk for recorded cycles; none to record none.
    pub history_bytes_max: Option<u64>,
    /// Where metrics and traces are sent; none to send none.
    pub otlp: Option<bumpless_telemetry::Config>,
    /// Folder of the lab's reports, for the operator's page.
    pub lab_reports: Option<PathBuf>,
    /// Bytes on disk for the audit trail.
    pub audit_bytes_max: u64,
    /// From when on the host's own clock and disk are alarms.
    pub host_alarms: HostAlarms,
    /// Who is told of alarms.
    pub webhooks: Vec<WebhookConfig>,
    /// Root keys of which one must sign the first document of trust.
    pub trust_roots: Vec<bumpless_trust::PublicKey>,
    /// How long they are kept, in ns.
    pub cycles_keep_ns: u64,
    /// Bounds of the thinned history; none to keep none.
    pub history: Option<bumpless_store::Bounds>,
    /// Points of which history is kept, whether a loop uses them or not.
    pub history_points: Vec<PointId>,
    /// Points and loops of the cell as Modbus registers.
    pub modbus_servers: Vec<ModbusServerConfig>,
}

/// The file.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct File {
    host: HostId,
    #[serde(default = "data_default")]
    data: PathBuf,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    labels: Vec<String>,
    /// For drills: the host believes that its date is so far off. Nothing but what people read may change by it.
    #[serde(default)]
    clock_offset_s: i64,
    #[serde(default)]
    realtime: Realtime,
    cell: CellTable,
    #[serde(default)]
    api: ApiTable,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    security: Option<SecurityTable>,
    #[serde(default)]
    roles: RolesTable,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    bus: Vec<BusConfig>,
    #[serde(default)]
    engine: EngineTable,
    #[serde(default)]
    loops: LoopsTable,
    #[serde(default)]
    history: HistoryTable,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    otlp: Option<bumpless_telemetry::Config>,
    #[serde(default)]
    lab: LabTable,
    #[serde(default)]
    audit: AuditTable,
    #[serde(default)]
    alarms: HostAlarms,
    #[serde(default)]
    trust: TrustTable,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    webhook: Vec<WebhookConfig>,
    #[serde(default, skip_serializing_if = "TestingTable::is_empty")]
    testing: TestingTable,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    modbus_server: Vec<ModbusServerConfig>,
}

fn data_default() -> PathBuf {
    PathBuf::from("data")
}

/// How the host joins its cell; what is left out is as `bumpless_cell::Config` has it.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct CellTable {
    name: CellName,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    listen: Option<Vec<String>>,
    #[serde(default)]
    connect: Vec<String>,
    #[serde(default)]
    scouting: bool,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    lease_ms: Option<u64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    tls: Option<CellTls>,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct ApiTable {
    listen: SocketAddr,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    names: Vec<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    tls: Option<ApiTls>,
}

impl Default for ApiTable {
    fn default() -> Self {
        // Loopback: without [security] whoever reaches the API may operate the cell.
        Self {
            listen: SocketAddr::from((Ipv4Addr::LOCALHOST, 8480)),
            names: Vec::new(),
            tls: None,
        }
    }
}

/// What is left out follows from the buses: a host with points serves them, one without runs controllers.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct RolesTable {
    #[serde(skip_serializing_if = "Option::is_none")]
    io: Option<bool>,
    #[serde(skip_serializing_if = "Option::is_none")]
    control: Option<bool>,
}

/// Bounds of the sandbox; what is left out is as `bumpless_engine::Limits` has it.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct EngineTable {
    #[serde(skip_serializing_if = "Option::is_none")]
    instances_max: Option<u32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    memory_mib_max: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    cached_max: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    compile: Option<CompileWord>,
    #[serde(skip_serializing_if = "Option::is_none")]
    compile_memory_mib_max: Option<u64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    compile_s_max: Option<u64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum CompileWord {
    Child,
    InProcess,
}

#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct LoopsTable {
    #[serde(skip_serializing_if = "Option::is_none")]
    workers: Option<usize>,
}

/// The audit trail.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct AuditTable {
    bytes_max_mib: u64,
}

impl Default for AuditTable {
    fn default() -> Self {
        // Half a million entries: years of a plant where people act a few times an hour.
        Self { bytes_max_mib: 256 }
    }
}

impl AuditTable {
    fn checked(&self, wrong: &dyn Fn(&str, String) -> Error) -> Result<u64, Error> {
        let range = bumpless_store::AUDIT_BYTES_MAX;
        let (low, high) = (range.start() >> 20, range.end() >> 20);
        let mib = in_range(wrong, "audit.bytes_max_mib", Some(self.bytes_max_mib), 0, low, high)?;
        Ok(mib << 20)
    }
}

impl Config {
    /// Reads and checks a file. `data` replaces the file's folder for data; it counts from the working directory.
    ///
    /// # Errors
    /// The file cannot be read, or what is wrong in it.
    pub fn read(path: &Path, data: Option<&Path>) -> Result<Self, Error> {
        let file_error = |source| Error::File {
            path: path.to_owned(),
            action: "read",
            source,
        };
        let size = std::fs::metadata(path).map_err(file_error)?.len();
        if size > FILE_BYTES_MAX {
            return Err(Error::Config {
                path: path.to_owned(),
                place: "the file".to_owned(),
                reason: format!("it has {size} bytes; a configuration has at most {FILE_BYTES_MAX}"),
            });
        }
        let text = std::fs::read_to_string(path).map_err(file_error)?;
        let mut config = Self::parse(&text, path)?;
        if let Some(data) = data {
            data.clone_into(&mut config.data);
        }
        Ok(config)
    }

    /// Checks a text as if it stood in the file at `path`.
    ///
    /// # Errors
    /// What is wrong in it.
    pub fn parse(text: &str, path: &Path) -> Result<Self, Error> {
        let file: File = toml::from_str(text).map_err(|error| Error::Config {
            path: path.to_owned(),
            place: place(text, error.span()),
            reason: error.message().to_owned(),
        })?;
        let folder = path.parent().unwrap_or(Path::new(""));
        file.checked(path, folder)
    }
}

impl File {
    fn checked(self, path: &Path, folder: &Path) -> Result<Config, Error> {
        let wrong = |place: &str, reason: String| Error::Config {
            path: path.to_owned(),
            place: format!("key {place}"),
            reason,
        };
        let mut loops = self.loops.checked(&wrong)?;
        loops.flip_bits_every = self.testing.checked(&self.cell.name, &wrong)?;
        let mut cell = bumpless_cell::Config::new(self.cell.name, self.host.clone());
        cell.connect = self.cell.connect;
        cell.scouting = self.cell.scouting;
        if let Some(tls) = self.cell.tls {
            cell.tls = Some(tls.config(folder));
            cell.listen = vec!["tls/127.0.0.1:0".to_owned()];
        }
        if let Some(listen) = self.cell.listen {
            cell.listen = listen;
        }
        if let Some(lease_ms) = self.cell.lease_ms {
            cell.lease_ms = lease_ms;
        }
        cell.check().map_err(|error| wrong("cell", error.to_string()))?;
        let asks = self.security;
        let open = Openness {
            api: self.api.listen,
            names: &self.api.names,
            users: asks.is_some_and(|table| table.users),
            api_tls: self.api.tls.is_some(),
            cell: &cell,
            testing: self.testing.open_network,
        };
        security::check(&open, &wrong)?;
        let secured = open.users;

        itself::check(&self.labels, self.clock_offset_s, &wrong)?;
        if let Some(otlp) = &self.otlp {
            otlp.check().map_err(|reason| wrong("otlp", reason))?;
        }
        let mut ids = std::collections::HashSet::new();
        if let Some(twice) = self.bus.iter().find(|bus| !ids.insert(bus.id())) {
            return Err(wrong(
                "bus.id",
                format!("two buses are named {}; give each its own name", twice.id()),
            ));
        }
        let mut buses = bumpless_io::Config { buses: self.bus };
        for bus in &mut buses.buses {
            match bus {
                BusConfig::Sim(sim) => sim.journal = sim.journal.take().map(|journal| folder.join(journal)),
                BusConfig::ModbusTcp(modbus) | BusConfig::ModbusRtu(modbus) => modbus.resolve(folder),
            }
        }
        let mut modbus_servers = self.modbus_server;
        for server in &mut modbus_servers {
            server.resolve(folder);
            server
                .check()
                .map_err(|error| wrong("modbus_server", error.to_string()))?;
        }
        let has_buses = !buses.buses.is_empty();
        let io = self.roles.io.unwrap_or(has_buses);
        if io && !has_buses {
            return Err(wrong(
                "roles.io",
                "a host that serves I/O needs a [[bus]]; add one, or set io = false".into(),
            ));
        }
        if !io && has_buses {
            return Err(wrong(
                "roles.io",
                "io = false, but there are buses; remove them, or the key".into(),
            ));
        }
        let kept = self.history.checked(io, &wrong)?;
        let control = self.roles.control.unwrap_or(!has_buses);
        if !io && !control {
            return Err(wrong(
                "roles",
                "a host without any role does nothing; set io or control to true".into(),
            ));
        }
        Ok(Config {
            path: path.to_owned(),
            host: self.host,
            data: folder.join(self.data),
            labels: self.labels,
            clock_offset_s: self.clock_offset_s,
            realtime: self.realtime,
            cell,
            api_listen: self.api.listen,
            api_tls: self.api.tls.map(|tls| tls.files(folder)),
            api_names: self.api.names,
            secured,
            doors: asks.is_none_or(|table| table.doors),
            io,
            control,
            buses,
            engine: self.engine.checked(&wrong)?,
            loops,
            otlp: self.otlp,
            lab_reports: self.lab.reports(folder),
            audit_bytes_max: self.audit.checked(&wrong)?,
            trust_roots: self.trust.roots(&wrong)?,
            host_alarms: itself::alarms(self.alarms, &wrong)?,
            webhooks: itself::webhooks(self.webhook, folder, &wrong)?,
            history_bytes_max: kept.cycles_bytes_max,
            cycles_keep_ns: kept.cycles_keep_ns,
            history: kept.thinned,
            history_points: kept.points,
            modbus_servers,
        })
    }
}

impl EngineTable {
    fn checked(&self, wrong: &dyn Fn(&str, String) -> Error) -> Result<bumpless_engine::Config, Error> {
        let mut config = bumpless_engine::Config::default();
        let limits = &mut config.limits;
        config.instances_max = in_range(
            wrong,
            "engine.instances_max",
            self.instances_max,
            config.instances_max,
            1,
            100_000,
        )?;
        let memory_mib = in_range(wrong, "engine.memory_mib_max", self.memory_mib_max, 16, 1, 1024)?;
        limits.memory_bytes_max = memory_mib * 1024 * 1024;
        limits.cached_max = in_range(
            wrong,
            "engine.cached_max",
            self.cached_max,
            limits.cached_max,
            1,
            100_000,
        )?;
        let child_mib = in_range(
            wrong,
            "engine.compile_memory_mib_max",
            self.compile_memory_mib_max,
            2048,
            256,
            65_536,
        )?;
        limits.compile_memory_bytes_max = child_mib * 1024 * 1024;
        limits.compile_time_max =
            Duration::from_secs(in_range(wrong, "engine.compile_s_max", self.compile_s_max, 60, 1, 180)?);
        config.compile = match self.compile.unwrap_or(CompileWord::Child) {
            CompileWord::InProcess => bumpless_engine::Compile::InProcess,
            CompileWord::Child => bumpless_engine::Compile::Child {
                program: std::env::current_exe()
                    .map_err(|error| wrong("engine.compile", format!("this program cannot find itself: {error}")))?,
                args: vec!["compile-child".into()],
            },
        };
        Ok(config)
    }
}

impl LoopsTable {
    fn checked(&self, wrong: &dyn Fn(&str, String) -> Error) -> Result<bumpless_loops::Config, Error> {
        let default = bumpless_loops::Config::default();
        Ok(bumpless_loops::Config {
            workers: in_range(wrong, "loops.workers", self.workers, default.workers, 1, 64)?,
            ..default
        })
    }
}

/// The value given, or the default; refused outside `low` to `high`.
fn in_range<T: PartialOrd + Copy + std::fmt::Display>(
    wrong: &dyn Fn(&str, String) -> Error,
    key: &str,
    given: Option<T>,
    default: T,
    low: T,
    high: T,
) -> Result<T, Error> {
    match given {
        Some(value) if value < low || value > high => Err(wrong(key, format!("it is {value}; use {low} to {high}"))),
        Some(value) => Ok(value),
        None => Ok(default),
    }
}

/// Line and key at a span of the text: `line 4, key lease`.
pub(crate) fn place(text: &str, span: Option<std::ops::Range<usize>>) -> String {
    let Some(before) = span.and_then(|span| text.get(..span.start)) else {
        return "the file".to_owned();
    };
    let number = before.matches('\n').count() + 1;
    let line = text.lines().nth(number - 1).unwrap_or_default();
    match line.split_once('=') {
        Some((key, _)) => format!("line {number}, key {}", key.trim()),
        None => format!("line {number}, {:?}", line.trim().chars().take(60).collect::<String>()),
    }
}

#[cfg(test)]
mod tests;
