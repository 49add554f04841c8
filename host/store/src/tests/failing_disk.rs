//! A disk that refuses writes for a while: the error names the place and the cure, nothing that was kept is lost, and the
//! store works again without a restart.

use std::{
    io,
    ops::Bound,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
};

use redb::{BackendError, StorageBackend, backends::FileBackend};
use tempfile::tempdir;

use super::samples::{intent, loop_id, record, spec};
use crate::{Error, RecordWriter, Store};

/// The file, behind a switch.
#[derive(Debug)]
struct Disk {
    file: FileBackend,
    full: Arc<AtomicBool>,
}

impl Disk {
    fn room(&self) -> io::Result<()> {
        if self.full.load(Ordering::SeqCst) {
            Err(io::ErrorKind::StorageFull.into())
        } else {
            Ok(())
        }
    }
}

impl StorageBackend for Disk {
    fn len(&self) -> io::Result<u64> {
        self.file.len()
    }
    fn read(&self, offset: u64, out: &mut [u8]) -> io::Result<()> {
        self.file.read(offset, out)
    }
    fn set_len(&self, len: u64) -> io::Result<()> {
        self.room()?;
        self.file.set_len(len)
    }
    fn sync_data(&self) -> io::Result<()> {
        self.room()?;
        self.file.sync_data()
    }
    fn write(&self, offset: u64, data: &[u8]) -> io::Result<()> {
        self.room()?;
        self.file.write(offset, data)
    }
    fn close(&self) -> io::Result<()> {
        self.file.close()
    }
    fn try_lock_range(&self, start: Bound<u64>, end: Bound<u64>) -> Result<bool, BackendError> {
        self.file.try_lock_range(start, end)
    }
    fn try_lock_shared_range(&self, start: Bound<u64>, end: Bound<u64>) -> Result<bool, BackendError> {
        self.file.try_lock_shared_range(start, end)
    }
    fn lock_range(&self, start: Bound<u64>, end: Bound<u64>) -> Result<(), BackendError> {
        self.file.lock_range(start, end)
    }
    fn lock_shared_range(&self, start: Bound<u64>, end: Bound<u64>) -> Result<(), BackendError> {
        self.file.lock_shared_range(start, end)
    }
    fn unlock_range(&self, start: Bound<u64>, end: Bound<u64>) -> Result<(), BackendError> {
        self.file.unlock_range(start, end)
    }
    fn query_lock_range(&self, start: Bound<u64>, end: Bound<u64>) -> Result<bool, BackendError> {
        self.file.query_lock_range(start, end)
    }
}

fn opener(full: &Arc<AtomicBool>) -> crate::database::Opener {
    let full = Arc::clone(full);
    Box::new(move |builder: &redb::Builder, file| {
        builder.create_with_backend(Disk {
            file: FileBackend::new(file)?,
            full: Arc::clone(&full),
        })
    })
}

#[test]
fn cycles_wait_for_the_disk_and_come_after_it() {
    let dir = tempdir().unwrap();
    let full = Arc::new(AtomicBool::new(false));
    let store = Store::open(dir.path()).unwrap();
    let log = crate::CycleLog::open_with(&store, (1 << 24, u64::MAX), || opener(&full)).unwrap();
    let id = loop_id("level-1");
    let seqs = |log: &crate::CycleLog| {
        let mut cursor = log.read(&id, crate::Window::Last(100), false).unwrap();
        let mut found = Vec::new();
        while let Some(piece) = cursor.next_piece().unwrap() {
            found.extend(piece.iter().map(|r| r.seq));
        }
        found
    };
    log.offer(record("level-1", 1, 1));
    log.flush().unwrap();
    full.store(true, Ordering::SeqCst);
    log.offer(record("level-1", 1, 2));
    let error = log.flush().unwrap_err().to_string();
    assert!(
        error.contains("cycles.redb: the disk is full, so free some space"),
        "{error}"
    );
    log.offer(record("level-1", 1, 3));
    assert!(log.flush().is_err());
    full.store(false, Ordering::SeqCst);
    assert_eq!(seqs(&log), [1, 2, 3], "what waits is read too");
    log.flush().unwrap();
    assert_eq!((log.counts().written, log.counts().dropped), (3, 0));
    assert!(log.counts().failed_writes >= 2);
    log.close().unwrap();
    assert_eq!(
        seqs(&crate::CycleLog::open(&store, 1 << 24, u64::MAX).unwrap()),
        [1, 2, 3]
    );
}

fn open(dir: &std::path::Path, full: &Arc<AtomicBool>) -> Store {
    let full = Arc::clone(full);
    let opener = move |builder: &redb::Builder, file| {
        builder.create_with_backend(Disk {
            file: FileBackend::new(file)?,
            full: Arc::clone(&full),
        })
    };
    Store::open_with(dir, Box::new(opener)).unwrap()
}

#[test]
fn a_full_disk_is_named_and_the_store_comes_back_when_there_is_room() {
    let dir = tempdir().unwrap();
    let full = Arc::new(AtomicBool::new(false));
    let store = open(dir.path(), &full);
    let mut held = intent("level-1");
    store.put_intent(&held).unwrap();

    full.store(true, Ordering::SeqCst);
    let mut next = held.clone();
    next.propose(spec("level-1", 2.0)).unwrap();
    for _ in 0..3 {
        let error = store.put_intent(&next).unwrap_err();
        assert!(matches!(error, Error::Io { .. }), "{error:?}");
        let text = error.to_string();
        assert!(
            text.contains("host.redb: the disk is full, so free some space"),
            "{text}"
        );
    }

    full.store(false, Ordering::SeqCst);
    assert_eq!(store.intents().unwrap(), [held.clone()]);
    store.put_intent(&next).unwrap();
    held = next;
    drop(store);
    assert_eq!(Store::open(dir.path()).unwrap().intents().unwrap(), [held]);
}

#[test]
fn records_wait_for_the_disk_and_none_is_lost() {
    let dir = tempdir().unwrap();
    let full = Arc::new(AtomicBool::new(false));
    let store = open(dir.path(), &full);
    let writer = RecordWriter::start(store.clone()).unwrap();
    writer.offer(record("level-1", 1, 1));
    writer.flush().unwrap();

    full.store(true, Ordering::SeqCst);
    writer.offer(record("level-1", 1, 2));
    writer.offer(record("flow-1", 1, 8));
    assert!(writer.flush().is_err());
    writer.offer(record("level-1", 1, 3));
    assert!(writer.flush().is_err());
    assert!(writer.counts().failed_writes >= 2);

    full.store(false, Ordering::SeqCst);
    writer.close().unwrap();
    drop(store);
    let store = Store::open(dir.path()).unwrap();
    assert_eq!(
        store.last_record(&loop_id("level-1")).unwrap().unwrap().position(),
        (1, 3)
    );
    assert_eq!(
        store.last_record(&loop_id("flow-1")).unwrap().unwrap().position(),
        (1, 8)
    );
}
