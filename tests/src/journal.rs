//! The actuators' own log, as the simulated bus keeps it: what was really written, by whom, in which order.
//!
//! `at_ns,point,value,loop,term,seq` per write; `#refused,…,reason` per write that was not taken. A host that starts anew
//! begins a new file; the harness keeps the old ones as `writes.0.csv`, `writes.1.csv`…, and they are read as one log.
//! The last line of a file may be cut, because hosts get killed here.

use std::{
    collections::BTreeMap,
    fmt, fs,
    path::{Path, PathBuf},
};

use crate::Error;

/// The log's name in its folder.
pub(crate) const FILE: &str = "writes.csv";

/// What a stopping host writes in order has no ownership; its lines carry this loop name.
const ON_STOP: &str = "on-stop";

/// Who writes where a person wrote a point that no loop writes.
const BY_HAND: &str = "by-hand";

/// One write.
#[derive(Debug, Clone, PartialEq)]
pub struct Write {
    /// When, in ns since 1970 by the I/O host's steady clock.
    pub at_ns: u64,
    /// The point.
    pub point: String,
    /// The value, in the point's unit.
    pub value: f64,
    /// The loop that wrote.
    pub loop_name: String,
    /// Its ownership.
    pub term: u64,
    /// Its cycle.
    pub seq: u64,
}

/// Something that must not be: two writes to a point where the later one does not come after the earlier one.
#[derive(Debug, Clone, PartialEq)]
pub struct Violation {
    /// What it is.
    pub kind: &'static str,
    /// The earlier write.
    pub before: Write,
    /// The later write.
    pub after: Write,
}

impl fmt::Display for Violation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { kind, before, after } = self;
        write!(
            f,
            "{kind} at {}: loop {}, ({}, {}) then ({}, {})",
            after.point, after.loop_name, before.term, before.seq, after.term, after.seq
        )
    }
}

/// A pause between two writes to a point.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Gap {
    /// When it began: time of the write before, in ns.
    pub from_ns: u64,
    /// When it ended: time of the write after, in ns.
    pub to_ns: u64,
    /// Cycles without a write between the two.
    pub cycles_missing: u64,
}

impl Gap {
    /// Its length, in ns.
    #[must_use]
    pub const fn ns(&self) -> u64 {
        self.to_ns.saturating_sub(self.from_ns)
    }
}

/// The log.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Journal {
    /// Writes that were taken, in the order in which they were.
    pub writes: Vec<Write>,
    /// Writes that were refused, with the reason.
    pub refused: Vec<(Write, String)>,
    /// Lines that the host itself could not keep.
    pub dropped: u64,
    /// Where each life of the host begins: the number of its first write.
    lives: Vec<usize>,
}

impl Journal {
    /// Reads the log of a folder: the kept files, then the current one. An absent log is an empty one.
    ///
    /// # Errors
    /// [`Error::File`], or [`Error::Journal`] for a line that is none.
    pub fn read(folder: &Path) -> Result<Self, Error> {
        let mut journal = Self::default();
        let kept = (0..).map(|n| kept(folder, n)).take_while(|path| path.is_file());
        for path in kept.chain([folder.join(FILE)]).filter(|path| path.is_file()) {
            let text = fs::read_to_string(&path).map_err(|source| Error::File {
                path: path.clone(),
                action: "read",
                source,
            })?;
            journal.lives.push(journal.writes.len());
            journal.take(&path, &text)?;
        }
        Ok(journal)
    }

    fn take(&mut self, path: &Path, text: &str) -> Result<(), Error> {
        // What stands after the last newline is a line that the host was killed in, or is writing now.
        let whole = text.rfind('\n').map_or("", |end| text.get(..end).unwrap_or_default());
        for (n, line) in whole.lines().enumerate() {
            let bad = || Error::Journal {
                path: path.to_owned(),
                line: n + 1,
                text: line.to_owned(),
            };
            if n == 0 {
                if line != "at_ns,point,value,loop,term,seq" {
                    return Err(bad());
                }
            } else if let Some(dropped) = line.strip_prefix("#dropped,") {
                self.dropped += dropped.parse::<u64>().map_err(|_| bad())?;
            } else if let Some(refused) = line.strip_prefix("#refused,") {
                self.refused.push(write(refused).ok_or_else(bad)?);
            } else {
                let (write, rest) = write(line).ok_or_else(bad)?;
                if !rest.is_empty() {
                    return Err(bad());
                }
                self.writes.push(write);
            }
        }
        Ok(())
    }

    /// The log of one point alone.
    #[must_use]
    pub fn only(&self, point: &str) -> Self {
        let life_of = |n: usize| self.lives.partition_point(|&first| first <= n);
        let (mut only, mut life) = (Self::default(), 0);
        for (n, write) in self.writes.iter().enumerate().filter(|(_, write)| write.point == point) {
            if life_of(n) != life {
                life = life_of(n);
                only.lives.push(only.writes.len());
            }
            only.writes.push(write.clone());
        }
        only
    }

    /// Brings the times of hosts whose date was moved by whole days back to those of `near_ns` and the day after it.
    pub fn undo_dates(&mut self, near_ns: u64) {
        for write in self
            .writes
            .iter_mut()
            .chain(self.refused.iter_mut().map(|(write, _)| write))
        {
            write.at_ns = same_day(write.at_ns, near_ns);
        }
    }

    /// Writes to a point, in order, without those of a stopping host.
    pub fn of<'a>(&'a self, point: &'a str) -> impl Iterator<Item = &'a Write> + Clone {
        self.writes
            .iter()
            .filter(move |w| w.point == point && w.loop_name != ON_STOP)
    }

    /// Every break of the promise of one writer. For each point and loop, within one life of the host: terms never go back,
    /// each write has a higher cycle number than the one before it, and times never go back. From one life to the next the
    /// term grows; cycle numbers may begin a little earlier, at the last record that reached a disk or another host.
    #[must_use]
    pub fn check_one_writer(&self) -> Vec<Violation> {
        let mut last: BTreeMap<(&str, &str), (usize, &Write)> = BTreeMap::new();
        let mut violations = Vec::new();
        for (n, after) in self.writes.iter().enumerate() {
            // Neither is of a cycle: many may follow each other.
            if after.loop_name == ON_STOP || after.loop_name == BY_HAND {
                continue;
            }
            let life = self.lives.partition_point(|&first| first <= n);
            let Some((life_before, before)) = last.insert((&after.point, &after.loop_name), (life, after)) else {
                continue;
            };
            let kind = if life != life_before {
                (after.term <= before.term).then_some("a write of an ownership of before the restart")
            } else if after.seq == before.seq {
                Some("two writes of one cycle")
            } else if after.term < before.term {
                Some("a write of an old ownership")
            } else if after.seq < before.seq {
                Some("a write of an old cycle")
            } else if after.at_ns < before.at_ns {
                Some("a write back in time")
            } else {
                None
            };
            violations.extend(kind.map(|kind| Violation {
                kind,
                before: before.clone(),
                after: after.clone(),
            }));
        }
        violations
    }

    /// The pauses between writes to a point that are longer than `longer_than_ns`, in order.
    #[must_use]
    pub fn gaps(&self, point: &str, longer_than_ns: u64) -> Vec<Gap> {
        self.of(point)
            .zip(self.of(point).skip(1))
            .map(|(before, after)| Gap {
                from_ns: before.at_ns,
                to_ns: after.at_ns,
                cycles_missing: after.seq.saturating_sub(before.seq).saturating_sub(1),
            })
            .filter(|gap| gap.ns() > longer_than_ns)
            .collect()
    }

    /// The longest pause between two writes to a point, in ns; 0 where there are fewer than two.
    #[must_use]
    pub fn longest_gap_ns(&self, point: &str) -> u64 {
        self.gaps(point, 0).iter().map(Gap::ns).max().unwrap_or(0)
    }

    /// Cycle numbers of a loop without a write, between its first and its last.
    #[must_use]
    pub fn cycles_missing(&self, point: &str) -> u64 {
        self.gaps(point, 0).iter().map(|gap| gap.cycles_missing).sum()
    }

    /// Writes to a point at or after `from_ns` and before `to_ns`.
    #[must_use]
    pub fn between<'a>(&'a self, point: &'a str, from_ns: u64, to_ns: u64) -> Vec<&'a Write> {
        self.of(point).filter(|w| (from_ns..to_ns).contains(&w.at_ns)).collect()
    }
}

/// The time that differs by whole days and lies within half a day of `near_ns`.
pub(crate) fn same_day(at_ns: u64, near_ns: u64) -> u64 {
    const DAY_NS: u64 = 86_400_000_000_000;
    // Half a day before to half a day after: what was written before `near_ns` stays before it.
    let (day_ns, half_ns) = (i128::from(DAY_NS), i128::from(DAY_NS / 2));
    let away_ns = (i128::from(at_ns) - i128::from(near_ns) + half_ns).rem_euclid(day_ns) - half_ns;
    u64::try_from(i128::from(near_ns) + away_ns).unwrap_or(near_ns)
}

/// One line's write and what stands after it.
fn write(line: &str) -> Option<(Write, String)> {
    let mut fields = line.splitn(7, ',');
    let write = Write {
        at_ns: fields.next()?.parse().ok()?,
        point: fields.next()?.to_owned(),
        value: fields.next()?.parse().ok()?,
        loop_name: fields.next()?.to_owned(),
        term: fields.next()?.parse().ok()?,
        seq: fields.next()?.parse().ok()?,
    };
    Some((write, fields.next().unwrap_or_default().to_owned()))
}

fn kept(folder: &Path, n: u32) -> PathBuf {
    folder.join(format!("writes.{n}.csv"))
}

/// Puts the current file aside, so that a new start does not replace it.
pub(crate) fn keep(folder: &Path) -> Result<(), Error> {
    let current = folder.join(FILE);
    if !current.is_file() {
        return Ok(());
    }
    let free = (0..).map(|n| kept(folder, n)).find(|path| !path.exists());
    let to = free.unwrap_or_else(|| folder.join("writes.last.csv"));
    fs::rename(&current, &to).map_err(|source| Error::File {
        path: to,
        action: "written",
        source,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn journal(lines: &[&str]) -> Result<Journal, Error> {
        let mut journal = Journal::default();
        let text = format!("at_ns,point,value,loop,term,seq\n{}", lines.join("\n"));
        journal.take(Path::new("writes.csv"), &text).map(|()| journal)
    }

    #[test]
    fn reads_what_the_bus_writes_and_passes_over_a_cut_line() {
        let lines = [
            "1000,plant.p2,4.25,pressure,1,17",
            "#refused,1100,plant.p2,11,pressure,1,18,11 V is outside 0 to 10, so it is not written",
            "1200,plant.p2,4.5,pressure,2,19",
            "#dropped,3",
            "1300,plant.p2,4.",
        ];
        let journal = journal(&lines).unwrap();
        assert_eq!(journal.writes.len(), 2);
        assert_eq!(journal.writes[1].seq, 19);
        assert_eq!(journal.refused[0].0.value.to_bits(), 11f64.to_bits());
        assert!(journal.refused[0].1.starts_with("11 V is outside 0 to 10, so"));
        assert_eq!(journal.dropped, 3);
        assert_eq!(
            journal.gaps("plant.p2", 100),
            [Gap {
                from_ns: 1000,
                to_ns: 1200,
                cycles_missing: 1
            }]
        );
        assert_eq!(journal.between("plant.p2", 1000, 1200).len(), 1);
    }

    #[test]
    fn every_kind_of_second_writer_is_found() {
        for (line, kind) in [
            ("1100,p,1,l,2,17", Some("two writes of one cycle")),
            ("1100,p,1,l,3,17", Some("two writes of one cycle")),
            ("1100,p,1,l,1,18", Some("a write of an old ownership")),
            ("1100,p,1,l,2,16", Some("a write of an old cycle")),
            ("900,p,1,l,2,18", Some("a write back in time")),
            ("1100,p,1,l,2,18", None),
            ("1100,q,1,l,2,17", None),
            ("1100,p,0,on-stop,0,0", None),
        ] {
            let found = journal(&["1000,p,1,l,2,17", line, ""]).unwrap().check_one_writer();
            assert_eq!(found.first().map(|v| v.kind), kind, "{line}: {found:?}");
        }
    }

    #[test]
    fn a_line_that_is_none_is_named() {
        for line in ["x,p,1,l,2,17", "1,p,1,l,2", "1,p,1,l,2,17,more", "#dropped,many"] {
            let text = journal(&[line, ""]).unwrap_err().to_string();
            assert!(text.contains("line 2") && text.contains(line), "{text}");
        }
    }

    #[test]
    fn dates_that_were_moved_are_moved_back() {
        let day = 86_400_000_000_000_u64;
        let start = 20_000 * day + 5;
        for days in [-300_i64, -1, 0, 1, 17] {
            let moved = (start + 1_000).saturating_add_signed(days * 86_400_000_000_000);
            assert_eq!(same_day(moved, start), start + 1_000, "{days} days");
        }
    }

    #[test]
    fn files_of_several_starts_are_one_log() {
        let folder = tempfile::tempdir().unwrap();
        // A restart may repeat a cycle, with a new term.
        for (term, seq) in [(1, 0), (2, 1), (5, 1), (5, 2)] {
            keep(folder.path()).unwrap();
            let text = format!("at_ns,point,value,loop,term,seq\n{seq},p,1,l,{term},{seq}\n");
            fs::write(folder.path().join(FILE), text).unwrap();
        }
        let journal = Journal::read(folder.path()).unwrap();
        let seqs: Vec<u64> = journal.of("p").map(|w| w.seq).collect();
        assert_eq!(seqs, [0, 1, 1, 2]);
        let found = journal.check_one_writer();
        assert_eq!(found.len(), 1, "{found:?}");
        assert_eq!(found[0].kind, "a write of an ownership of before the restart");
        let only = journal.only("p");
        assert_eq!(only.check_one_writer(), found);
        assert_eq!(journal.only("q").of("p").count(), 0);
    }
}
