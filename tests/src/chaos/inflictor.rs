//! Does to a cell what the schedule says, undoes it, and waits until all is well again.
//!
//! ```text
//! fault ──► inflicted ──lasts──► undone ──► every host sees every other, every loop runs ──► a window: what, from, to
//! ```
//! Never: judges. Where a means is missing (no namespaces, no small disk), its kinds are said to be impossible.

use std::{collections::HashMap, time::Duration};

use serde_json::{Value, json};

use crate::{
    Api, Cell, Error, HostProcess, PLANT,
    chaos::{
        dates,
        operator::unix_ns,
        relay::Way,
        schedule::{Fault, Kind},
    },
    host_number, pause, wait_until,
};

/// Longest time until a cell is well after a fault: a lease, a restart, and a busy machine.
const RECOVERY_MAX: Duration = Duration::from_secs(60);
/// Longest time without a record in which a loop is said to run.
const SILENCE_MS_MAX: u64 = 1_500;
/// Longest wait for an answer while a cell recovers.
const ANSWER_MAX: Duration = Duration::from_secs(5);
/// Delays of a slow link, in ms, least and greatest.
const DELAY_MS: (u64, u64) = (2, 60);
/// Bytes a second that a narrow link carries, least and greatest: some hundredths of what a host of twenty loops is sent.
const NARROW_BYTES_PER_S: (u64, u64) = (10_000, 100_000);
/// Hours that the date of a host without points is stepped by, at most.
const HOURS_MAX: u64 = 23;
/// Days that a date is moved by, at most.
const DAYS_MAX: u64 = 300;

/// A fault that was inflicted.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Window {
    /// What.
    pub kind: Kind,
    /// When it began, in ns since 1970.
    pub from_ns: u64,
    /// When all was well again.
    pub to_ns: u64,
    /// For people: which hosts, for how long.
    pub words: String,
}

/// A cell that gets hurt.
#[derive(Debug)]
pub struct Inflictor {
    /// The cell.
    pub cell: Cell,
}

impl Inflictor {
    /// Can this kind be inflicted on this cell? If not, what is missing.
    ///
    /// # Errors
    /// What is missing, in words.
    pub fn possible(&self, kind: Kind) -> Result<(), &'static str> {
        match kind {
            Kind::Cut | Kind::CutOneWay if self.cell.net().is_none() && self.cell.relay.is_none() => {
                Err("no network namespaces and no relay")
            }
            Kind::Delay | Kind::Loss | Kind::Narrow if self.cell.relay.is_none() => Err("no relay"),
            Kind::ClockStep if !self.cell.dates() => Err("no libfaketime (Debian: faketime)"),
            Kind::DiskFull if self.cell.disks.is_empty() => Err("no small disk"),
            _ => Ok(()),
        }
    }

    /// Inflicts a fault and waits until the cell is well again.
    ///
    /// # Errors
    /// [`Error::Waited`] where it is not within a minute; what a host or a means says.
    pub fn inflict(&mut self, fault: &Fault) -> Result<Window, Error> {
        let from_ns = unix_ns();
        let words = self.act(fault)?;
        self.wait_well()?;
        Ok(Window {
            kind: fault.kind,
            from_ns,
            to_ns: unix_ns(),
            words,
        })
    }

    fn controller(&self, number: u64) -> String {
        let controllers = &self.cell.controllers;
        let place = usize::try_from(number % controllers.len().max(1) as u64).unwrap_or(0);
        controllers.get(place).map(|host| host.name.clone()).unwrap_or_default()
    }

    fn act(&mut self, fault: &Fault) -> Result<String, Error> {
        let lasts = Duration::from_millis(fault.lasts_ms);
        let victim = self.controller(fault.victim);
        match fault.kind {
            Kind::Kill => {
                self.cell.host(&victim)?.kill9();
                pause(lasts);
                self.cell.restart(&victim)?;
                Ok(format!("{victim}, away for {lasts:?} and its start"))
            }
            Kind::Pause => {
                self.cell.host(&victim)?.pause()?;
                pause(lasts);
                self.cell.host(&victim)?.resume()?;
                Ok(format!("{victim}, for {lasts:?}"))
            }
            Kind::Cut | Kind::CutOneWay => self.cut(fault, lasts),
            Kind::Delay => {
                let (low, high) = DELAY_MS;
                let delay = Duration::from_millis(low + fault.choice % (high - low));
                self.slow(delay);
                pause(lasts);
                self.slow(Duration::ZERO);
                Ok(format!(
                    "{delay:?} each way between {PLANT} and {}, for {lasts:?}",
                    self.relayed()
                ))
            }
            Kind::Loss => Ok(self.lose(fault, lasts)),
            Kind::Narrow => {
                let bytes_per_s = self.narrow(fault.choice);
                pause(lasts);
                self.widen();
                Ok(format!(
                    "{bytes_per_s} bytes/s each way between {PLANT} and {}, for {lasts:?}",
                    self.relayed()
                ))
            }
            Kind::ClockStep => {
                let there = self.step_dates(fault.choice)?;
                pause(lasts);
                let back = self.step_dates(fault.choice.rotate_right(17))?;
                // Until the means has seen it.
                pause(Duration::from_millis(1_500));
                Ok(format!("{there}; {lasts:?} later {back}"))
            }
            Kind::DiskFull => {
                let names: Vec<String> = self.cell.disks.keys().cloned().collect();
                let place = usize::try_from(fault.choice % names.len().max(1) as u64).unwrap_or(0);
                let host = names.get(place).cloned().unwrap_or_default();
                if let Some(disk) = self.cell.disks.get(&host) {
                    disk.fill()?;
                    pause(lasts);
                    disk.free()?;
                }
                if !self.cell.host(&host)?.is_running() {
                    return Err(Error::NoHost(format!("host {host} ended because its disk was full")));
                }
                Ok(format!("of {host}, for {lasts:?}"))
            }
            Kind::Date => {
                let days = move_date(self.cell.host(&victim)?, fault.choice);
                self.cell.host(&victim)?.terminate()?;
                pause(lasts);
                self.cell.restart(&victim)?;
                Ok(format!("{victim} comes back with its date {days} days off"))
            }
            Kind::Drain => {
                let api = self.cell.api()?;
                let end = api.post(&format!("/v1/hosts/{victim}/drain"), &json!({}))?;
                pause(lasts);
                api.post(&format!("/v1/hosts/{victim}/undrain"), &json!({}))?;
                Ok(format!(
                    "{victim}, empty for {lasts:?}; it owned {} when told so",
                    end["loops_owned"]
                ))
            }
            Kind::Stop => {
                self.cell.host(&victim)?.terminate()?;
                pause(lasts);
                self.cell.restart(&victim)?;
                Ok(format!("{victim}, away for {lasts:?} and its start"))
            }
            Kind::HomeKill => {
                let days = move_date(&mut self.cell.plant, fault.choice);
                self.cell.plant.kill9();
                pause(lasts);
                self.cell.restart(PLANT)?;
                Ok(format!("away for {lasts:?} and its start; its date is {days} days off"))
            }
            Kind::HomePause => {
                self.cell.plant.pause()?;
                pause(lasts);
                self.cell.plant.resume()?;
                Ok(format!("for {lasts:?}"))
            }
            Kind::Together => self.together(fault, lasts),
            Kind::AllDead => {
                for host in self.cell.hosts_mut() {
                    host.kill9();
                }
                pause(lasts);
                let names: Vec<String> = self.cell.hosts().map(|host| host.name.clone()).collect();
                for name in &names {
                    self.cell.restart(name)?;
                }
                Ok(format!("for {lasts:?} and their starts"))
            }
        }
    }

    /// Several at once, each on a host of its own; then all of them are undone, the network first and the home last.
    fn together(&mut self, fault: &Fault, lasts: Duration) -> Result<String, Error> {
        let possible: Vec<Part> = Part::ALL
            .into_iter()
            .filter(|part| match part {
                Part::Cut => self.cell.net().is_some(),
                Part::Slow | Part::Narrow => self.cell.relay.is_some(),
                Part::Disk => self.cell.disks.keys().any(|host| host != PLANT),
                Part::Dates => self.cell.dates(),
                Part::Home | Part::Kill | Part::Pause => true,
            })
            .collect();
        let (killed, frozen) = (self.controller(fault.victim), self.controller(fault.victim + 1));
        let apart = self.controller(fault.victim + 2);
        let others: Vec<String> = self.cell.hosts().map(|host| host.name.clone()).collect();
        let chosen = parts(fault.choice, &possible);
        let mut words = Vec::new();
        for part in &chosen {
            words.push(match part {
                Part::Home => {
                    self.cell.plant.kill9();
                    format!("{PLANT} killed")
                }
                Part::Kill => {
                    self.cell.host(&killed)?.kill9();
                    format!("{killed} killed")
                }
                Part::Pause => {
                    self.cell.host(&frozen)?.pause()?;
                    format!("{frozen} stopped")
                }
                Part::Cut => {
                    for other in others.iter().filter(|other| **other != apart) {
                        self.block(&apart, other, true)?;
                        self.block(other, &apart, true)?;
                    }
                    format!("{apart} cut off")
                }
                Part::Slow => {
                    self.slow(Duration::from_millis(DELAY_MS.1));
                    format!("{} far away", self.relayed())
                }
                Part::Narrow => {
                    let bytes_per_s = self.narrow(fault.choice);
                    format!("{bytes_per_s} bytes/s for {}", self.relayed())
                }
                Part::Disk => {
                    // Not the home's: what is told while its disk is full rests on others, who may be the ones that are killed.
                    let full = self.cell.disks.iter().find(|(host, _)| *host != PLANT);
                    if let Some((_, disk)) = full {
                        disk.fill()?;
                    }
                    format!("disk of {} full", full.map_or("nobody", |(host, _)| host.as_str()))
                }
                Part::Dates => self.step_dates(fault.choice)?,
            });
        }
        pause(lasts);
        for part in chosen.iter().rev() {
            match part {
                Part::Home => self.cell.restart(PLANT)?,
                Part::Kill => self.cell.restart(&killed)?,
                Part::Pause => self.cell.host(&frozen)?.resume()?,
                Part::Cut => {
                    for other in others.iter().filter(|other| **other != apart) {
                        self.block(&apart, other, false)?;
                        self.block(other, &apart, false)?;
                    }
                }
                Part::Slow => self.slow(Duration::ZERO),
                Part::Narrow => self.widen(),
                Part::Disk => {
                    if let Some((_, disk)) = self.cell.disks.iter().find(|(host, _)| *host != PLANT) {
                        disk.free()?;
                    }
                }
                // Dates stay as they are: nobody may care.
                Part::Dates => {}
            }
        }
        Ok(format!("{}, for {lasts:?}", words.join(", ")))
    }

    fn narrow(&self, choice: u64) -> u64 {
        let (low, high) = NARROW_BYTES_PER_S;
        let bytes_per_s = low + choice % (high - low);
        if let Some(relay) = &self.cell.relay {
            relay.narrow(Way::Away, Some(bytes_per_s));
            relay.narrow(Way::Back, Some(bytes_per_s));
        }
        bytes_per_s
    }

    fn widen(&self) {
        if let Some(relay) = &self.cell.relay {
            relay.narrow(Way::Away, None);
            relay.narrow(Way::Back, None);
        }
    }

    /// Steps the dates of some hosts, one at least: the home's by whole days, so that its log can be read, the others' by hours.
    fn step_dates(&self, choice: u64) -> Result<String, Error> {
        let mut words = Vec::new();
        let count = self.cell.hosts().count();
        for (n, host) in self.cell.hosts().enumerate() {
            if choice >> n & 1 == 0 && choice % count as u64 != n as u64 {
                continue;
            }
            let draw = choice.rotate_right(u32::try_from(7 * (n + 1)).unwrap_or(0));
            let (unit, unit_s, most) = if host.name == PLANT {
                ("days", 86_400, DAYS_MAX)
            } else {
                ("hours", 3_600, HOURS_MAX)
            };
            let by = i64::try_from(draw % (2 * most + 1)).unwrap_or(0) - i64::try_from(most).unwrap_or(0);
            dates::step(host.folder(), by * unit_s)?;
            words.push(format!("{} {by:+} {unit}", host.name));
        }
        Ok(format!("dates: {}", words.join(", ")))
    }

    fn relayed(&self) -> &str {
        self.cell.relayed().unwrap_or("nobody")
    }

    fn slow(&self, delay: Duration) {
        if let Some(relay) = &self.cell.relay {
            relay.delay(Way::Away, delay);
            relay.delay(Way::Back, delay);
        }
    }

    /// Stalls as TCP has them where packets are lost: a fifth of a second until it is sent again, twice that the second time.
    fn lose(&self, fault: &Fault, lasts: Duration) -> String {
        let Some(relay) = &self.cell.relay else {
            return String::new();
        };
        let started = std::time::Instant::now();
        let (mut stalls, mut draw) = (0_u64, fault.choice);
        while started.elapsed() < lasts {
            draw = draw
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            let way = if draw >> 63 == 0 { Way::Away } else { Way::Back };
            relay.stall(way, true);
            pause(Duration::from_millis(if draw >> 60 & 1 == 0 { 200 } else { 400 }));
            relay.stall(way, false);
            stalls += 1;
            if stalls == 3 {
                relay.reset();
            }
            pause(Duration::from_millis(20 + (draw >> 40) % 280));
        }
        format!(
            "{stalls} stalls and {} break between {PLANT} and {}",
            u64::from(stalls >= 3),
            self.relayed()
        )
    }

    fn cut(&self, fault: &Fault, lasts: Duration) -> Result<String, Error> {
        let one_way = fault.kind == Kind::CutOneWay;
        let (victim, others) = match self.cell.net() {
            None => (self.relayed().to_owned(), vec![PLANT.to_owned()]),
            Some(_) => {
                let victim = self.controller(fault.victim);
                let others = match fault.choice % 3 {
                    0 => vec![PLANT.to_owned()],
                    1 => vec![self.controller(fault.victim + 1)],
                    _ => self.cell.hosts().map(|host| host.name.clone()).collect(),
                };
                (victim, others)
            }
        };
        let outwards = (fault.choice / 3).is_multiple_of(2);
        let mut pairs = Vec::new();
        for other in others.iter().filter(|other| **other != victim) {
            if !one_way || outwards {
                pairs.push((victim.clone(), other.clone()));
            }
            if !one_way || !outwards {
                pairs.push((other.clone(), victim.clone()));
            }
        }
        for (from, to) in &pairs {
            self.block(from, to, true)?;
        }
        pause(lasts);
        for (from, to) in &pairs {
            self.block(from, to, false)?;
        }
        let word = match (one_way, outwards) {
            (false, _) => "and",
            (true, true) => "to",
            (true, false) => "from",
        };
        let others: Vec<&str> = others
            .iter()
            .map(String::as_str)
            .filter(|other| *other != victim)
            .collect();
        Ok(format!("{victim} {word} {}, for {lasts:?}", others.join(", ")))
    }

    /// Blocks what goes from one host to another, or lets it pass again. Of the relayed pair the relay does it.
    fn block(&self, from: &str, to: &str, blocked: bool) -> Result<(), Error> {
        let relayed = self.cell.relayed().unwrap_or_default();
        match (&self.cell.relay, self.cell.net()) {
            (Some(relay), _) if from == relayed && to == PLANT => {
                relay.stall(Way::Away, blocked);
                Ok(())
            }
            (Some(relay), _) if from == PLANT && to == relayed => {
                relay.stall(Way::Back, blocked);
                Ok(())
            }
            (_, Some(net)) if blocked => net.cut(host_number(from), host_number(to)),
            (_, Some(net)) => net.heal(host_number(from), host_number(to)),
            _ => Ok(()),
        }
    }

    /// Waits until every host sees every other one, and every loop has an owner and a new record.
    ///
    /// # Errors
    /// [`Error::Waited`] with what is missing.
    pub fn wait_well(&mut self) -> Result<(), Error> {
        let addresses: Vec<(String, String)> = self
            .cell
            .hosts()
            .map(|host| (host.name.clone(), host.api.clone()))
            .collect();
        let all = addresses.len();
        let hosts_see = |(name, address): &(String, String)| -> Result<(), String> {
            let api = Api::within(address.clone(), ANSWER_MAX);
            let hosts = api.hosts().map_err(|error| format!("{name}: {error}"))?;
            let alive = hosts.iter().filter(|host| host["alive"] == true).count();
            if alive == all {
                Ok(())
            } else {
                Err(format!("{name} sees {alive} hosts of {all}"))
            }
        };
        wait_until("all hosts to see each other after a fault", RECOVERY_MAX, || {
            addresses.iter().try_for_each(hosts_see)
        })?;
        // A home that starts shows the record of its disk before it opens: only one that comes after it is of this life.
        let api = Api::within(self.cell.plant.api.clone(), ANSWER_MAX);
        let mut seen: HashMap<String, Value> = HashMap::new();
        wait_until("all loops to run after a fault", RECOVERY_MAX, || {
            let loops = api.get("/v1/loops").map_err(|error| error.to_string())?;
            let rows = loops["loops"].as_array().map(Vec::as_slice).unwrap_or_default();
            for row in rows {
                let first = seen
                    .entry(row["name"].as_str().unwrap_or_default().to_owned())
                    .or_insert_with(|| position(row));
                if !runs(row) || *first == position(row) {
                    return Err(format!(
                        "{}: owner {}, members {}, at {}, last record {} ms ago, {}",
                        row["name"], row["owner"], row["members"], row["seq"], row["last_age_ms"], row["failures"]
                    ));
                }
            }
            Ok(())
        })
    }
}

/// What may be part of a fault of several, in the order in which it begins: deaths first, so that what is acknowledged before
/// them was acknowledged in peace.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Part {
    Home,
    Kill,
    Dates,
    Disk,
    Pause,
    Cut,
    Slow,
    Narrow,
}

impl Part {
    const ALL: [Self; 8] = [
        Self::Home,
        Self::Kill,
        Self::Dates,
        Self::Disk,
        Self::Pause,
        Self::Cut,
        Self::Slow,
        Self::Narrow,
    ];
}

/// Those that the bits of a free choice name, three at least, in their order.
fn parts(choice: u64, possible: &[Part]) -> Vec<Part> {
    let named = |n: usize| choice >> n & 1 == 1;
    let missing = 3_usize.saturating_sub((0..possible.len()).filter(|n| named(*n)).count());
    let mut more: Vec<usize> = (0..possible.len()).filter(|n| !named(*n)).collect();
    let turn = usize::try_from(choice >> 32).unwrap_or(0) % more.len().max(1);
    more.rotate_left(turn);
    more.truncate(missing);
    let chosen = possible
        .iter()
        .enumerate()
        .filter(|(n, _)| named(*n) || more.contains(n));
    chosen.map(|(_, part)| *part).collect()
}

/// Has the loop an owner, all its members, and a record of now?
fn runs(row: &Value) -> bool {
    let members = row["members"].as_array().map_or(0, Vec::len) as u64;
    let wanted = row["spec"]["replicas"].as_u64().unwrap_or(1);
    row["owner"].is_string()
        && members >= wanted
        && row["last_age_ms"].as_u64().is_some_and(|age| age <= SILENCE_MS_MAX)
}

/// Which record of the loop was the last.
fn position(row: &Value) -> Value {
    json!([row["term"], row["seq"]])
}

/// Moves a host's date by whole days from its next start on; gives the days.
fn move_date(host: &mut HostProcess, choice: u64) -> i64 {
    let days = i64::try_from(choice % (2 * DAYS_MAX + 1)).unwrap_or(0) - i64::try_from(DAYS_MAX).unwrap_or(0);
    host.set_head(format!("clock_offset_s = {}\n", days * 86_400));
    days
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn at_least_three_happen_at_once_and_every_one_some_time() {
        let mut seen = Vec::new();
        for choice in 0..256_u64 {
            let chosen = parts(choice | choice << 32, &Part::ALL);
            assert!(chosen.len() >= 3, "{choice:b}: {chosen:?}");
            let place = |part: &Part| Part::ALL.iter().position(|p| p == part);
            assert!(chosen.is_sorted_by_key(place), "{chosen:?}");
            seen.extend(chosen);
        }
        assert!(Part::ALL.iter().all(|part| seen.contains(part)));
        assert_eq!(parts(0, &[Part::Kill, Part::Pause]).len(), 2, "as many as there are");
    }
}
