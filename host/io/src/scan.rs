//! Looks what a Modbus TCP device has: which units answer, and which addresses of each table can be read.
//!
//! ```text
//! for each unit: one read ─► silence: not there
//!                         └► an answer, an exception too: there ─► each table: blocks, halved where the device refuses them
//! ```
//!
//! Polite: a connection of its own, one request at a time, a pause between two, and a bound on all of them. Only reads.
//! Never: takes a late answer for the next one's, for answers carry the number of their request.

use std::time::Duration;

use serde::{Deserialize, Serialize};
use tokio::{net::TcpStream, time::timeout};

use crate::{
    Error,
    limits::{SCAN_REQUESTS_MAX, SCAN_UNITS_MAX, TIMEOUT_MS_RANGE},
    modbus::{
        Exception, Framing, Request, Table,
        connection::{Connection, Failure},
    },
};

/// What to look at.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ScanPlan {
    /// The units, each 0 to 255.
    pub units: Vec<u8>,
    /// The address spaces.
    pub tables: Vec<Table>,
    /// First address, from 0.
    pub first: u16,
    /// Last address.
    pub last: u16,
    /// Longest wait for an answer, in ms.
    pub timeout_ms: u64,
    /// Pause between two requests, in ms.
    pub pause_ms: u64,
}

impl Default for ScanPlan {
    /// Units 1 to 10, all tables, the first 100 addresses.
    fn default() -> Self {
        Self {
            units: (1..=10).collect(),
            tables: vec![Table::Coil, Table::Discrete, Table::Holding, Table::Input],
            first: 0,
            last: 99,
            timeout_ms: 300,
            pause_ms: 10,
        }
    }
}

impl ScanPlan {
    /// Checks the bounds.
    ///
    /// # Errors
    /// [`Error::Config`].
    pub fn check(&self) -> Result<(), Error> {
        let wrong = |problem: String| Err(Error::config("the scan", problem));
        if self.units.is_empty() || self.units.len() > SCAN_UNITS_MAX {
            return wrong(format!(
                "{} units: 1 to {SCAN_UNITS_MAX} are possible",
                self.units.len()
            ));
        }
        if self.tables.is_empty() || self.tables.len() > 4 {
            return wrong("name 1 to 4 of coil, discrete, holding, input".to_owned());
        }
        if self.first > self.last {
            return wrong(format!("first = {} lies behind last = {}", self.first, self.last));
        }
        let (least, most) = TIMEOUT_MS_RANGE;
        if !(least..=most).contains(&self.timeout_ms) {
            return wrong(format!(
                "timeout_ms = {}: {least} to {most} are possible",
                self.timeout_ms
            ));
        }
        if self.pause_ms > 10_000 {
            return wrong(format!("pause_ms = {}: at most 10000", self.pause_ms));
        }
        Ok(())
    }
}

/// A stretch of addresses that can be read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Stretch {
    /// The unit.
    pub unit_id: u8,
    /// The address space.
    pub table: Table,
    /// First address.
    pub start: u16,
    /// How many.
    pub count: u32,
}

/// What a scan found.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Scan {
    /// Units that answered.
    pub units: Vec<u8>,
    /// What can be read of them, in order.
    pub stretches: Vec<Stretch>,
    /// Requests that it took.
    pub requests: u32,
    /// Why it ended before the end; none where it did not.
    pub stopped: Option<String>,
}

/// One device under the magnifier.
struct Scanner<'a> {
    address: &'a str,
    plan: &'a ScanPlan,
    connection: Option<Connection>,
    scan: Scan,
}

/// What a read came to.
enum Seen {
    Readable,
    Refused,
    Silent,
}

/// Looks at the device at `address` (`host:port`). Takes as long as its requests; whoever waits bounds that by dropping it.
///
/// # Errors
/// [`Error::Config`] for a plan that cannot be; [`Error::Unreachable`] where there is nobody at the address. A scan that
/// cannot be finished says so in what it found.
pub async fn scan(address: &str, plan: &ScanPlan) -> Result<Scan, Error> {
    plan.check()?;
    let mut scanner = Scanner {
        address,
        plan,
        connection: None,
        scan: Scan::default(),
    };
    scanner.connect().await?;
    for &unit_id in &plan.units {
        let Some(&table) = plan.tables.first() else { break };
        match scanner.look(unit_id, table, plan.first, 1).await? {
            Some(Seen::Silent) => continue,
            Some(Seen::Readable | Seen::Refused) => scanner.scan.units.push(unit_id),
            None => break,
        }
        for &table in &plan.tables {
            scanner.table(unit_id, table).await?;
        }
    }
    Ok(scanner.scan)
}

impl Scanner<'_> {
    async fn connect(&mut self) -> Result<(), Error> {
        let unreachable = |problem: String| Error::Unreachable {
            address: self.address.to_owned(),
            problem,
        };
        let connected = timeout(
            Duration::from_millis(self.plan.timeout_ms),
            TcpStream::connect(self.address),
        )
        .await;
        let stream = connected
            .map_err(|_| unreachable(format!("no connection within {} ms", self.plan.timeout_ms)))?
            .map_err(|error| unreachable(error.to_string()))?;
        // Where the system refuses, requests leave a little later.
        let _ = stream.set_nodelay(true);
        self.connection = Some(Connection::over_network(stream, Framing::Tcp));
        Ok(())
    }

    /// One read; none where the bound on requests is met.
    async fn look(&mut self, unit_id: u8, table: Table, start: u16, count: u16) -> Result<Option<Seen>, Error> {
        if self.scan.requests >= SCAN_REQUESTS_MAX {
            self.scan.stopped = Some(format!(
                "after {SCAN_REQUESTS_MAX} requests, at unit {unit_id}, {} {start}; scan fewer addresses or units",
                table.name()
            ));
            return Ok(None);
        }
        self.scan.requests += 1;
        tokio::time::sleep(Duration::from_millis(self.plan.pause_ms)).await;
        if self.connection.is_none() {
            self.connect().await?;
        }
        let Some(connection) = &mut self.connection else {
            return Ok(Some(Seen::Silent));
        };
        let request = Request::Read { table, start, count };
        let longest = Duration::from_millis(self.plan.timeout_ms);
        Ok(Some(match connection.call(unit_id, &request, longest).await {
            Ok(_) => Seen::Readable,
            // A gateway says so of a unit that is not there.
            Err(Failure::Exception(Exception::PATH | Exception::TARGET)) => Seen::Silent,
            Err(Failure::Exception(_) | Failure::Malformed(_)) => Seen::Refused,
            Err(Failure::Silent(_) | Failure::Fenced) => Seen::Silent,
            Err(Failure::Lost(_)) => {
                self.connection = None;
                Seen::Silent
            }
        }))
    }

    /// The stretches of one table: blocks as large as a request, halved where they are refused.
    async fn table(&mut self, unit_id: u8, table: Table) -> Result<(), Error> {
        let last = u32::from(self.plan.last);
        let most = u32::from(table.read_max());
        // Stretches still to be looked at, the next one last.
        let mut open = Vec::new();
        let mut start = u32::from(self.plan.first);
        while start <= last {
            open.push((start, most.min(last + 1 - start)));
            start += most;
        }
        open.reverse();
        let mut silences = 0;
        while let Some((start, count)) = open.pop() {
            match self.look(unit_id, table, start as u16, count as u16).await? {
                None => return Ok(()),
                Some(Seen::Readable) => {
                    silences = 0;
                    match self.scan.stretches.last_mut() {
                        Some(s)
                            if (s.unit_id, s.table) == (unit_id, table) && u32::from(s.start) + s.count == start =>
                        {
                            s.count += count;
                        }
                        _ => self.scan.stretches.push(Stretch {
                            unit_id,
                            table,
                            start: start as u16,
                            count,
                        }),
                    }
                }
                Some(Seen::Refused) if count > 1 => {
                    let half = count / 2;
                    open.push((start + half, count - half));
                    open.push((start, half));
                }
                Some(Seen::Refused) => {}
                // A device that falls silent over some request is not asked for ever.
                Some(Seen::Silent) => {
                    silences += 1;
                    if silences >= 3 {
                        self.scan.stopped = Some(format!("unit {unit_id} fell silent at {} {start}", table.name()));
                        return Ok(());
                    }
                }
            }
        }
        Ok(())
    }
}
