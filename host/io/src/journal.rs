//! The actuators' own log: one CSV line per write, by a thread of its own, so that a slow disk never delays a cycle.
//!
//! ```text
//! at_ns,point,value,loop,term,seq
//! 1790000000000000000,plant.p2,4.25,pressure,1,17
//! #refused,1790000000100000000,plant.p2,11,pressure,1,18,point plant.p2: 11 V is outside 0 to 10; nothing was written
//! #forced,1790000000200000000,plant.p2,5,pressure,1,19,asked 4.25
//! #dropped,0
//! ```
//!
//! `#forced` is a commit whose value a force replaced: the actuator got the first number, the loop asked for the last.
//!
//! Lines reach the file within `JOURNAL_FLUSH_MS`. The queue is bounded; when it is full the line is dropped and counted,
//! and the last line of a file that was closed in order says how many were.

use std::{
    fs::File,
    io::{self, BufWriter, Write},
    path::Path,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering::Relaxed},
    },
    thread::JoinHandle,
    time::{Duration, Instant},
};

use bumpless_core::{LoopId, PointId};
use crossbeam_channel::{Receiver, RecvTimeoutError, Sender, TrySendError, bounded};
use parking_lot::Mutex;

use crate::{
    Error,
    limits::{JOURNAL_FLUSH_MS, JOURNAL_LINES_WAITING_MAX},
};

/// One write.
#[derive(Debug)]
pub struct Line {
    /// When, in ns of the I/O host's clock.
    pub at_ns: u64,
    /// Which point.
    pub point: PointId,
    /// The value in the point's unit.
    pub value: f64,
    /// The loop that wrote.
    pub loop_id: LoopId,
    /// Its ownership.
    pub term: u64,
    /// Its cycle.
    pub seq: u64,
    /// What became of it.
    pub end: LineEnd,
}

/// What became of a write.
#[derive(Debug, Clone, PartialEq)]
pub enum LineEnd {
    /// The actuator got the value.
    Taken,
    /// The actuator got the value, for a person forces it; this is what the loop asked for.
    Forced(f64),
    /// Nothing was written, and why.
    Refused(String),
}

impl Line {
    fn write(&self, out: &mut impl Write) -> io::Result<()> {
        let Self {
            at_ns,
            point,
            value,
            loop_id,
            term,
            seq,
            end,
        } = self;
        match end {
            LineEnd::Taken => writeln!(out, "{at_ns},{point},{value},{loop_id},{term},{seq}"),
            LineEnd::Forced(asked) => {
                writeln!(
                    out,
                    "#forced,{at_ns},{point},{value},{loop_id},{term},{seq},asked {asked}"
                )
            }
            LineEnd::Refused(reason) => {
                // A reason is one field to the end of the line.
                let reason = reason.replace(['\n', '\r'], " ");
                writeln!(out, "#refused,{at_ns},{point},{value},{loop_id},{term},{seq},{reason}")
            }
        }
    }
}

/// A journal at work.
#[derive(Debug)]
pub struct Journal {
    /// None after `close`: that ends the thread.
    sender: Mutex<Option<Sender<Line>>>,
    dropped: Arc<AtomicU64>,
    thread: Mutex<Option<JoinHandle<()>>>,
}

impl Journal {
    /// Makes the file, replacing an old one, and starts the thread.
    pub fn open(bus: &str, path: &Path) -> Result<Self, Error> {
        let failed = |source| Error::Journal {
            bus: bus.to_owned(),
            path: path.to_owned(),
            source,
        };
        let mut file = BufWriter::new(File::create(path).map_err(failed)?);
        file.write_all(b"at_ns,point,value,loop,term,seq\n")
            .and_then(|()| file.flush())
            .map_err(failed)?;
        let (sender, receiver) = bounded(JOURNAL_LINES_WAITING_MAX);
        let dropped = Arc::new(AtomicU64::new(0));
        let (count, bus) = (dropped.clone(), bus.to_owned());
        let thread = std::thread::Builder::new()
            .name("io-journal".to_owned())
            .spawn(move || {
                if let Err(error) = keep(&receiver, &mut file, &count) {
                    tracing::error!(bus, %error, "the journal cannot be written any more");
                    // What still comes is lost, and counted.
                    count.fetch_add(receiver.iter().count() as u64, Relaxed);
                }
            })
            .map_err(failed)?;
        Ok(Self {
            sender: Mutex::new(Some(sender)),
            dropped,
            thread: Mutex::new(Some(thread)),
        })
    }

    /// Takes a line; never waits for the disk.
    pub fn note(&self, line: Line) {
        let sent = self.sender.lock().as_ref().map(|sender| sender.try_send(line));
        if matches!(sent, Some(Err(TrySendError::Full(_) | TrySendError::Disconnected(_)))) {
            self.dropped.fetch_add(1, Relaxed);
        }
    }

    /// Lines lost so far.
    #[must_use]
    pub fn dropped(&self) -> u64 {
        self.dropped.load(Relaxed)
    }

    /// Writes what is waiting and ends; a second call does nothing.
    pub fn close(&self) {
        self.sender.lock().take();
        if let Some(thread) = self.thread.lock().take()
            && thread.join().is_err()
        {
            tracing::error!("the journal's thread failed");
        }
    }
}

impl Drop for Journal {
    fn drop(&mut self) {
        self.close();
    }
}

/// The thread: writes lines until the journal is closed.
fn keep(lines: &Receiver<Line>, out: &mut impl Write, dropped: &AtomicU64) -> io::Result<()> {
    let longest = Duration::from_millis(JOURNAL_FLUSH_MS);
    // When the oldest line since the last flush came; none where all is on its way to the disk.
    let mut unflushed: Option<Instant> = None;
    loop {
        let wait = unflushed.map_or(longest, |since| longest.saturating_sub(since.elapsed()));
        match lines.recv_timeout(wait) {
            Ok(line) => {
                line.write(out)?;
                unflushed.get_or_insert_with(Instant::now);
            }
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => break,
        }
        if unflushed.is_some_and(|since| since.elapsed() >= longest) {
            out.flush()?;
            unflushed = None;
        }
    }
    writeln!(out, "#dropped,{}", dropped.load(Relaxed))?;
    out.flush()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use super::*;

    fn line(seq: u64, end: LineEnd) -> Line {
        Line {
            at_ns: 1000 + seq,
            point: PointId::new("plant.p2").unwrap(),
            value: 4.25,
            loop_id: LoopId::new("pressure").unwrap(),
            term: 3,
            seq,
            end,
        }
    }

    #[test]
    fn keeps_every_line_in_order_and_ends_with_the_count() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("writes.csv");
        let journal = Journal::open("plant", &path).unwrap();
        for seq in 0..10_000 {
            journal.note(line(seq, LineEnd::Taken));
        }
        journal.note(line(10_000, LineEnd::Refused("no,\nreally".to_owned())));
        journal.note(line(10_001, LineEnd::Forced(5.5)));
        journal.close();
        journal.close();
        journal.note(line(1, LineEnd::Taken));
        let text = std::fs::read_to_string(&path).unwrap();
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines.len(), 10_004);
        assert_eq!(lines[0], "at_ns,point,value,loop,term,seq");
        assert_eq!(lines[1], "1000,plant.p2,4.25,pressure,3,0");
        assert_eq!(lines[10_000], "10999,plant.p2,4.25,pressure,3,9999");
        assert_eq!(
            lines[10_001],
            "#refused,11000,plant.p2,4.25,pressure,3,10000,no, really"
        );
        assert_eq!(lines[10_002], "#forced,11001,plant.p2,4.25,pressure,3,10001,asked 5.5");
        assert_eq!(lines[10_003], "#dropped,0");
        assert_eq!(journal.dropped(), 0);
    }

    #[test]
    fn a_folder_that_does_not_exist_is_named() {
        let error = Journal::open("plant", Path::new("/no/such/folder/writes.csv")).unwrap_err();
        assert!(error.to_string().contains("/no/such/folder/writes.csv"), "{error}");
    }

    #[test]
    fn a_dead_disk_is_counted_not_waited_for() {
        struct Dead;
        impl Write for Dead {
            fn write(&mut self, _: &[u8]) -> io::Result<usize> {
                Err(io::Error::other("dead"))
            }
            fn flush(&mut self) -> io::Result<()> {
                Ok(())
            }
        }
        let (sender, receiver) = bounded(4);
        sender.send(line(0, LineEnd::Taken)).unwrap();
        assert!(keep(&receiver, &mut Dead, &AtomicU64::new(0)).is_err());
    }
}
