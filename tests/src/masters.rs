//! Two hosts that are configured for one device, the device itself, and one loop over them.
//!
//! ```text
//! io-1 ── port 0 ──┐
//!                  ├── FieldDevice: notes who wrote what, and who the lease's registers named then
//! io-2 ── port 1 ──┘
//! ```
//! Never: looks inside a host to say who writes; the device knows.

use std::time::{Duration, Instant};

use serde_json::json;
use tempfile::TempDir;

use crate::{Api, Error, FieldDevice, HostOptions, HostProcess, Obeyed, slots::Slot, wait_until};

/// First of the lease's registers.
const LEASE: u16 = 900;

/// The register of the loop's output.
const OUT: u16 = 10;

/// The loop.
pub const LOOP: &str = "level";

/// Longest wait for a mastership, on a machine that has other work.
pub const HANDOVER_MAX: Duration = Duration::from_secs(60);

/// The rig.
#[derive(Debug)]
pub struct TwoMasters {
    /// The device.
    pub device: FieldDevice,
    /// `io-1` and `io-2`.
    pub hosts: Vec<HostProcess>,
    // After the hosts, so that it is removed when nobody writes into it any more.
    _folder: TempDir,
    _slot: Slot,
}

/// A write of the loop's output that the device obeyed while its registers named another master, or none.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Overlap {
    /// The write.
    pub write: Obeyed,
    /// The rank that the registers named.
    pub named: u16,
}

impl TwoMasters {
    /// Starts device and hosts, and a loop every 50 ms.
    ///
    /// # Errors
    /// Where a host does not start, or the loop does not run.
    pub fn start(timeout_ms: u64) -> Result<Self, Error> {
        let slot = Slot::take()?;
        let folder = tempfile::Builder::new()
            .prefix("bumpless-")
            .tempdir()
            .map_err(|source| Error::File {
                path: std::env::temp_dir(),
                action: "written",
                source,
            })?;
        let device = FieldDevice::start(2, LEASE)?;
        let cell = format!("m-{}", std::process::id());
        let mut hosts: Vec<HostProcess> = Vec::new();
        for master in 0..2_usize {
            let name = format!("io-{}", master + 1);
            let options = HostOptions {
                cell: cell.clone(),
                connect: hosts.iter().flat_map(|host| host.cell.clone()).collect(),
                tables: tables(&device, master, timeout_ms),
                name: name.clone(),
                ..HostOptions::default()
            };
            hosts.push(HostProcess::start(options, &folder.path().join(name))?);
        }
        let rig = Self {
            device,
            hosts,
            _folder: folder,
            _slot: slot,
        };
        let api = rig.api(0)?;
        api.upload_stock(&["pid"])?;
        rig.wait_for("a master", || rig.named().map(drop).ok_or("nobody yet"))?;
        let draft = json!({
            "name": LOOP, "component": "pid", "period_ms": 50.0, "setpoint": 5_000.0, "setpoint_range": [0.0, 10_000.0],
            "ports": {"pv": "line.level", "out": "line.valve"}, "parameters": {"k": 2.0, "ti": 100.0},
        });
        rig.wait_for("the loop", || {
            api.apply(&draft).map(drop).map_err(|error| error.to_string())
        })?;
        rig.wait_for("a write", || rig.writes().last().map(drop).ok_or("none yet"))?;
        Ok(rig)
    }

    /// The API of a host.
    ///
    /// # Errors
    /// Where there is no such host.
    pub fn api(&self, host: usize) -> Result<Api, Error> {
        self.hosts
            .get(host)
            .map(HostProcess::api)
            .ok_or_else(|| Error::NoHost(format!("there is no host number {host}")))
    }

    /// The host that the lease's registers name, from 0; none where they name nobody or a mastership that was given up.
    #[must_use]
    pub fn named(&self) -> Option<usize> {
        let token = self.device.word(LEASE + 2);
        let rank = usize::from(token >> 12);
        (rank > 0 && token & 0x0fff != 0x0fff).then(|| rank - 1)
    }

    /// The number of the mastership in the device's registers.
    #[must_use]
    pub fn epoch(&self) -> u32 {
        u32::from(self.device.word(LEASE)) << 16 | u32::from(self.device.word(LEASE + 1))
    }

    /// The writes of the loop's output, in the order in which they were obeyed.
    #[must_use]
    pub fn writes(&self) -> Vec<Obeyed> {
        let mut all = self.device.obeyed();
        all.retain(|write| write.start == OUT);
        all
    }

    /// Waits until the loop's output is written by this host, and gives the first such write since `since`.
    ///
    /// # Errors
    /// Where it does not come.
    pub fn wait_written_by(&self, host: usize, since: Instant) -> Result<Obeyed, Error> {
        self.wait_for(&format!("writes of io-{}", host + 1), || {
            let writes = self.writes();
            let last = writes.last().map(|write| write.master);
            let found = writes
                .into_iter()
                .find(|write| write.master == host && write.at >= since);
            found.ok_or(last)
        })
        .map_err(|error| self.with_what_the_hosts_say(error))
    }

    /// A wait that was in vain, with the ends of the hosts' logs.
    fn with_what_the_hosts_say(&self, error: Error) -> Error {
        match error {
            Error::Waited { what, seconds, seen } => {
                let logs: Vec<String> = self
                    .hosts
                    .iter()
                    .enumerate()
                    .map(|(number, host)| format!("io-{}:\n{}", number + 1, host.stderr_tail()))
                    .collect();
                let seen = format!("{seen}\n{}", logs.join("\n"));
                Error::Waited { what, seconds, seen }
            }
            other => other,
        }
    }

    fn wait_for<T, S: std::fmt::Debug>(&self, what: &str, ask: impl FnMut() -> Result<T, S>) -> Result<T, Error> {
        wait_until(what, HANDOVER_MAX, ask)
    }

    /// Writes of one host while the registers named the other.
    #[must_use]
    pub fn overlaps(&self) -> Vec<Overlap> {
        let named = |write: &Obeyed| {
            let [_, _, token] = write.watched;
            token >> 12
        };
        self.writes()
            .into_iter()
            .filter(|write| usize::from(named(write)) != write.master + 1)
            .map(|write| Overlap {
                named: named(&write),
                write,
            })
            .collect()
    }
}

fn tables(device: &FieldDevice, master: usize, timeout_ms: u64) -> String {
    format!(
        r#"
[roles]
io = true
control = true

[[bus]]
id = "line"
driver = "modbus-tcp"
address = "{}"
period_ms = 25
timeout_ms = {timeout_ms}
backoff_ms_min = 10
backoff_ms_max = 100

[bus.redundant]
with = "io-{}"
rank = {}
register = {LEASE}

[[bus.point]]
id = "line.level"
table = "input"
address = 0
low = 0.0
high = 10000.0

[[bus.point]]
id = "line.valve"
table = "holding"
address = {OUT}
low = 0.0
high = 60000.0
writable = true
"#,
        device.address(master),
        2 - master,
        master + 1
    )
}
