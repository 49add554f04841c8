//! A cell on this machine: one host with the simulated plant, and controller hosts `a`, `b`, `c`…

use std::{collections::BTreeMap, net::SocketAddr, path::Path, sync::Arc, time::Duration};

use serde_json::{Value, json};
use tempfile::TempDir;

use crate::{Api, Disk, Error, HostOptions, HostProcess, Journal, Net, Relay, chaos::dates, slots::Slot, wait_until};

/// Name of the host with the plant.
pub const PLANT: &str = "plant";

/// Longest time until all hosts of a new cell see each other.
const JOIN_MAX: Duration = Duration::from_secs(30);

/// The simulated pilot plant with a journal.
const PILOT_PLANT: &str = "[[bus]]\nid = \"plant\"\ndriver = \"sim\"\nseed = 7\njournal = \"{folder}/writes.csv\"\n";

/// What a cell is made of.
#[derive(Debug, Clone)]
pub struct CellOptions {
    /// Controller hosts, at most 26: `a`, `b`, `c`…
    pub controllers: usize,
    /// The `[[bus]]` tables of the plant host, as TOML; `{folder}` stands for its folder. For [`Cell::journal`] the
    /// simulated bus must have `journal = "{folder}/writes.csv"`.
    pub bus: String,
    /// Tables besides of the plant host, as TOML.
    pub plant_tables: String,
    /// Tables besides of each controller host, as TOML.
    pub controller_tables: String,
    /// Tables besides of single controller hosts, as TOML, by host name.
    pub host_tables: Vec<(String, String)>,
    /// Keys besides of every host's `[cell]` table, as TOML lines.
    pub cell_extra: String,
    /// Words before the command of a host, by host name.
    pub launchers: Vec<(String, Vec<String>)>,
    /// Keys before the tables of a host's configuration, as TOML lines, by host name.
    pub heads: Vec<(String, String)>,
    /// Namespaces to run in, the plant in the first; on the loopback interface where there are none.
    pub net: Option<Arc<Net>>,
    /// Hosts whose data lies on a small disk of their own, with its bytes.
    pub disks: Vec<(String, u64)>,
    /// Dates that can be stepped while hosts run, where there is a means for it; see [`Cell::dates`].
    pub dates: bool,
    /// The controller host whose link with the plant passes a relay.
    pub relayed: Option<String>,
}

impl Default for CellOptions {
    /// Three controllers and the pilot plant with a journal.
    fn default() -> Self {
        Self {
            controllers: 3,
            bus: PILOT_PLANT.to_owned(),
            plant_tables: String::new(),
            controller_tables: String::new(),
            host_tables: Vec::new(),
            cell_extra: String::new(),
            launchers: Vec::new(),
            heads: Vec::new(),
            net: None,
            disks: Vec::new(),
            dates: false,
            relayed: None,
        }
    }
}

impl CellOptions {
    /// Three controllers and a row of first-order loops with a journal: points `plant.0.pv`, `plant.0.out`…
    #[must_use]
    pub fn first_order(fopdt: &str) -> Self {
        Self {
            bus: format!(
                "[[bus]]\nid = \"plant\"\ndriver = \"sim\"\nseed = 7\njournal = \"{{folder}}/writes.csv\"\nfopdt = {fopdt}\n"
            ),
            ..Self::default()
        }
    }

    /// With another number of controllers.
    #[must_use]
    pub const fn controllers(mut self, controllers: usize) -> Self {
        self.controllers = controllers;
        self
    }
}

/// A running cell. Its hosts end with it.
#[derive(Debug)]
pub struct Cell {
    /// The host with the plant.
    pub plant: HostProcess,
    /// The controller hosts.
    pub controllers: Vec<HostProcess>,
    /// The cell's name.
    pub name: String,
    /// The link between the plant and [`CellOptions::relayed`].
    pub relay: Option<Relay>,
    /// Small disks, by host.
    pub disks: BTreeMap<String, Disk>,
    options: CellOptions,
    // After the hosts, so that it is removed when nobody writes into it any more.
    folder: TempDir,
    // Last of all: the next cell starts when this one is gone.
    _slot: Slot,
}

impl Cell {
    /// Starts all hosts and waits until each sees all the others.
    ///
    /// # Errors
    /// Where a host does not start, or they do not find each other in 30 s.
    pub fn start(options: CellOptions) -> Result<Self, Error> {
        let slot = Slot::take()?;
        let folder = tempfile::Builder::new()
            .prefix("bumpless-")
            .tempdir()
            .map_err(|source| Error::File {
                path: std::env::temp_dir(),
                action: "written",
                source,
            })?;
        let name = format!("test-{:016x}", random());
        let mut disks = BTreeMap::new();
        for (host, bytes) in &options.disks {
            let data = folder.path().join(host).join("data");
            disks.insert(host.clone(), Disk::mount(&data, *bytes)?);
        }
        let plant_options = HostOptions {
            tables: format!("{}\n{}", options.bus, options.plant_tables),
            ..host_options(&options, &name, PLANT, folder.path())?
        };
        let plant = HostProcess::start(plant_options, &folder.path().join(PLANT))?;
        let relay = options
            .relayed
            .as_ref()
            .map(|_| relay_to(&plant, options.net.as_deref()));
        let mut cell = Self {
            plant,
            controllers: Vec::new(),
            name,
            relay: relay.transpose()?,
            disks,
            options,
            folder,
            _slot: slot,
        };
        if let (Some(net), Some(number)) = (&cell.options.net, cell.options.relayed.as_deref().map(host_number)) {
            // Only the relay leads from one to the other.
            net.cut(0, number)?;
            net.cut(number, 0)?;
        }
        for n in 0..cell.options.controllers {
            let host = cell.spawn_controller(&controller_name(n))?;
            cell.controllers.push(host);
        }
        for host in &mut cell.controllers {
            host.wait_ready()?;
        }
        cell.wait_joined()?;
        Ok(cell)
    }

    fn spawn_controller(&self, name: &str) -> Result<HostProcess, Error> {
        let own = self.options.host_tables.iter().find(|(host, _)| host == name);
        let own = own.map(|(_, tables)| tables.as_str()).unwrap_or_default();
        let options = HostOptions {
            connect: self.locators(name),
            tables: format!("{}\n{own}", self.options.controller_tables),
            ..host_options(&self.options, &self.name, name, self.folder.path())?
        };
        HostProcess::spawn(options, &self.folder.path().join(name))
    }

    /// Starts one more controller host and waits until all hosts see it.
    ///
    /// # Errors
    /// As [`Cell::start`].
    pub fn add_controller(&mut self, name: &str) -> Result<(), Error> {
        let mut host = self.spawn_controller(name)?;
        host.wait_ready()?;
        self.controllers.push(host);
        self.wait_joined()
    }

    /// Where the hosts other than `but` listen, as that host may know them: of a relayed pair one knows the relay, and the
    /// other nothing.
    fn locators(&self, but: &str) -> Vec<String> {
        let relayed = self.options.relayed.as_deref();
        let mut known = Vec::new();
        for host in self.hosts().filter(|host| host.name != but) {
            match &self.relay {
                Some(relay) if relayed == Some(but) && host.name == PLANT => {
                    known.push(format!("tcp/{}", relay.address));
                }
                Some(_) if but == PLANT && relayed == Some(host.name.as_str()) => {}
                _ => known.extend(host.cell.iter().cloned()),
            }
        }
        known
    }

    /// Can the hosts' dates be stepped? They were asked for, and libfaketime is here.
    #[must_use]
    pub fn dates(&self) -> bool {
        self.options.dates && dates::library().is_some()
    }

    /// The namespaces that the hosts run in.
    #[must_use]
    pub const fn net(&self) -> Option<&Arc<Net>> {
        self.options.net.as_ref()
    }

    /// The controller host behind the relay.
    #[must_use]
    pub fn relayed(&self) -> Option<&str> {
        self.options.relayed.as_deref()
    }

    /// All hosts, the plant first.
    pub fn hosts(&self) -> impl Iterator<Item = &HostProcess> {
        std::iter::once(&self.plant).chain(&self.controllers)
    }

    /// All hosts, the plant first.
    pub fn hosts_mut(&mut self) -> impl Iterator<Item = &mut HostProcess> {
        std::iter::once(&mut self.plant).chain(&mut self.controllers)
    }

    /// A host by name.
    ///
    /// # Errors
    /// [`Error::NoHost`].
    pub fn host(&mut self, name: &str) -> Result<&mut HostProcess, Error> {
        let missing = || Error::NoHost(format!("the cell has no host {name:?}"));
        self.hosts_mut().find(|host| host.name == name).ok_or_else(missing)
    }

    /// Starts a host again where it was, knowing all others.
    ///
    /// # Errors
    /// As [`HostProcess::restart`].
    pub fn restart(&mut self, name: &str) -> Result<(), Error> {
        let connect = self.locators(name);
        let host = self.host(name)?;
        host.set_connect(connect);
        host.restart()
    }

    /// Waits until every host that runs sees every other one that runs.
    ///
    /// # Errors
    /// [`Error::Waited`] with who sees whom.
    pub fn wait_joined(&mut self) -> Result<(), Error> {
        let running: Vec<(String, Api)> = self
            .hosts_mut()
            .filter_map(|host| host.is_running().then(|| (host.name.clone(), host.api())))
            .collect();
        let mut names: Vec<&str> = running.iter().map(|(name, _)| name.as_str()).collect();
        names.sort_unstable();
        wait_until("all hosts to see each other", JOIN_MAX, || {
            for (name, api) in &running {
                let hosts = api.hosts().map_err(|error| error.to_string())?;
                let mut seen: Vec<&str> = hosts
                    .iter()
                    .filter(|host| host["alive"] == true)
                    .filter_map(|host| host["name"].as_str())
                    .collect();
                seen.sort_unstable();
                if seen != names {
                    return Err(format!("{name} sees {seen:?}, not {names:?}"));
                }
            }
            Ok(())
        })
    }

    /// The API of a host that runs: the plant's, where it does.
    ///
    /// # Errors
    /// [`Error::NoHost`] where none runs.
    pub fn api(&mut self) -> Result<Api, Error> {
        self.hosts_mut()
            .find_map(|host| host.is_running().then(|| host.api()))
            .ok_or_else(|| Error::NoHost("no host of the cell runs".to_owned()))
    }

    /// The API of a host.
    ///
    /// # Errors
    /// [`Error::NoHost`].
    pub fn api_of(&mut self, name: &str) -> Result<Api, Error> {
        self.host(name).map(|host| host.api())
    }

    /// The actuators' own log, as it is on disk now.
    ///
    /// # Errors
    /// As [`Journal::read`].
    pub fn journal(&self) -> Result<Journal, Error> {
        Journal::read(self.plant.folder())
    }

    /// The cell's folder.
    #[must_use]
    pub fn folder(&self) -> &Path {
        self.folder.path()
    }
}

/// What all hosts have in common.
fn host_options(options: &CellOptions, cell: &str, name: &str, folder: &Path) -> Result<HostOptions, Error> {
    let number = host_number(name);
    let head = options.heads.iter().find(|(host, _)| host == name);
    let mut common = HostOptions {
        name: name.to_owned(),
        cell: cell.to_owned(),
        cell_extra: options.cell_extra.clone(),
        launcher: launcher(options, name),
        head: head.map(|(_, keys)| keys.clone()).unwrap_or_default(),
        ..HostOptions::default()
    };
    if let Some(library) = dates::library().filter(|_| options.dates) {
        common.environment = dates::prepare(&library, &folder.join(name))?;
    }
    if let Some(net) = &options.net {
        let address = net.address(number);
        common.listen = vec![format!("tcp/{address}:0")];
        common.api_listen = format!("{address}:0");
        common.launcher = net.launcher(number).into_iter().chain(common.launcher).collect();
    }
    Ok(common)
}

/// Place of a host in a net: the plant first, then the controllers by their letters.
#[must_use]
pub fn host_number(name: &str) -> usize {
    let letter = ('a'..='z').position(|letter| name.len() == 1 && name.starts_with(letter));
    letter.map_or(0, |place| place + 1)
}

fn relay_to(plant: &HostProcess, net: Option<&Net>) -> Result<Relay, Error> {
    let locator = plant.cell.first().map(String::as_str).unwrap_or_default();
    let address: Result<SocketAddr, _> = locator.trim_start_matches("tcp/").parse();
    let address =
        address.map_err(|_| Error::NoHost(format!("the plant listens at {locator:?}, which is no address")))?;
    let on = net.map_or(std::net::Ipv4Addr::LOCALHOST, Net::own_address);
    Relay::start(on.into(), address)
}

fn launcher(options: &CellOptions, name: &str) -> Vec<String> {
    let found = options.launchers.iter().find(|(host, _)| host == name);
    found.map(|(_, words)| words.clone()).unwrap_or_default()
}

fn controller_name(n: usize) -> String {
    ('a'..='z')
        .nth(n)
        .map_or_else(|| format!("c{n}"), |letter| letter.to_string())
}

/// A number that no other test has.
fn random() -> u64 {
    // The system's generator does not fail on a machine that can run tests; the process id is then unique enough.
    getrandom::u64().unwrap_or_else(|_| u64::from(std::process::id()))
}

/// The pressure of the pilot plant's vessel by its pump, as a loop to apply.
#[must_use]
pub fn pressure_loop(component: &str, period_ms: f64) -> Value {
    json!({
        "name": "pressure",
        "component": component,
        "period_ms": period_ms,
        "ports": { "pv": "plant.pit129", "out": "plant.p1" },
        "parameters": { "k": 4.0, "ti": 4.0, "out-low": 0.0, "out-high": 10.0 },
        "setpoint": 0.5,
        "strategy": "round-robin",
    })
}

/// Loop `n` of a bus of first-order loops, named `loop-n`, as a loop to apply. Nearly all integral action: whatever the
/// measurement does, the output moves slowly, so a jump of the output is a fault of the hosts and not of the tuning.
#[must_use]
pub fn first_order_loop(n: usize, component: &str, period_ms: f64) -> Value {
    json!({
        "name": format!("loop-{n}"),
        "component": component,
        "period_ms": period_ms,
        "ports": { "pv": format!("plant.{n}.pv"), "out": format!("plant.{n}.out") },
        "parameters": { "k": 0.1, "ti": 0.2 },
        "setpoint": 40.0,
        "strategy": "round-robin",
    })
}
