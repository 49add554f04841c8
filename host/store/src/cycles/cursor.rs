//! The way back from the log: a loop's records in a window, piece by piece, so that a long window needs little memory.
//!
//! Never: holds the database open between two pieces; a chunk that was thrown away meanwhile is passed over.

use std::{collections::VecDeque, sync::Arc};

use bumpless_core::{LoopId, Record};
use serde::{Deserialize, Serialize};

use super::{Inner, shelf::Head, unpack};
use crate::error::Error;

/// How far a loop's clock may have gone back at a restart of its home, in ns: an hour. Chunks beyond it are not looked at.
const CLOCK_BACK_NS: u64 = 3_600_000_000_000;

/// Which records of a loop. Times are in ns of the home's clock, as in [`Record::at_ns`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Window {
    /// So many, the newest.
    Last(u64),
    /// The newest, back to so many ns before the newest of all.
    Recent(u64),
    /// Those between two times, both included.
    Between(u64, u64),
}

/// Records of one loop, oldest first.
#[derive(Debug)]
pub struct Cursor {
    inner: Arc<Inner>,
    loop_id: LoopId,
    heads: VecDeque<Head>,
    tail: Vec<Arc<Record>>,
    /// Records to leave out at the beginning.
    skip: u64,
    from_ns: u64,
    to_ns: u64,
    /// Give the record before the window first.
    before: bool,
    held: Option<Arc<Record>>,
    begun: bool,
    last: Option<(u64, u64)>,
    unread: u64,
}

impl Cursor {
    pub(super) fn new(
        inner: Arc<Inner>,
        loop_id: LoopId,
        mut tail: Vec<Arc<Record>>,
        window: Window,
        before: bool,
    ) -> Result<Self, Error> {
        let waiting = tail.len() as u64;
        let (mut from_ns, mut to_ns) = (0, u64::MAX);
        let mut wanted = u64::MAX;
        match window {
            Window::Last(count) => wanted = count.saturating_add(u64::from(before)),
            Window::Between(from, to) => (from_ns, to_ns) = (from, to),
            Window::Recent(back_ns) => {
                let newest = match tail.last() {
                    Some(record) => Some(record.at_ns),
                    None => inner
                        .shelf
                        .heads(&loop_id, |_, _| false)?
                        .first()
                        .map(|head| head.last_at_ns),
                };
                from_ns = newest.unwrap_or_default().saturating_sub(back_ns);
            }
        }
        let mut heads = inner.shelf.heads(&loop_id, |oldest, counted| {
            counted.saturating_add(waiting) < wanted && oldest.first_at_ns.saturating_add(CLOCK_BACK_NS) >= from_ns
        })?;
        heads.reverse();
        // What was written since the tail was asked for is in both.
        if let Some(newest) = heads.last() {
            tail.retain(|record| record.position() > newest.last);
        }
        let there = heads.iter().map(|head| head.count).sum::<u64>() + tail.len() as u64;
        let by_count = matches!(window, Window::Last(_));
        let mut cursor = Self {
            skip: if by_count { there.saturating_sub(wanted) } else { 0 },
            before: before && !by_count,
            inner,
            loop_id,
            heads: heads.into(),
            tail,
            from_ns,
            to_ns,
            held: None,
            begun: by_count,
            last: None,
            unread: 0,
        };
        cursor.leave_out_whole_chunks();
        Ok(cursor)
    }

    /// Passes over chunks that lie before the window, but for the last of them: the record before may be in it.
    fn leave_out_whole_chunks(&mut self) {
        while let [first, second, ..] = self.heads.make_contiguous() {
            let by_time = first.last_at_ns < self.from_ns && second.first_at_ns < self.from_ns;
            let by_count = self.skip >= first.count && first.count > 0;
            if by_count {
                self.skip -= first.count;
            } else if !by_time {
                return;
            }
            self.heads.pop_front();
        }
    }

    /// The next piece, never empty; none at the end. A piece has about a chunk's records, at most some thousands.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Database`].
    pub fn next_piece(&mut self) -> Result<Option<Vec<Arc<Record>>>, Error> {
        loop {
            let piece = match self.heads.pop_front() {
                Some(head) if head.first_at_ns > self.to_ns && head.last_at_ns > self.to_ns => continue,
                Some(head) => match unpack(&self.inner, &self.loop_id, &head)? {
                    Some(records) => records,
                    None => {
                        self.unread += 1;
                        self.skip = self.skip.saturating_sub(head.count);
                        continue;
                    }
                },
                None if self.tail.is_empty() => return Ok(None),
                None => std::mem::take(&mut self.tail),
            };
            let piece = self.within(piece);
            if !piece.is_empty() {
                return Ok(Some(piece));
            }
        }
    }

    /// Chunks that were damaged, or thrown away while this was read.
    #[must_use]
    pub const fn unread(&self) -> u64 {
        self.unread
    }

    fn within(&mut self, piece: Vec<Arc<Record>>) -> Vec<Arc<Record>> {
        let mut kept = Vec::with_capacity(piece.len());
        for record in piece {
            if self.skip > 0 {
                self.skip -= 1;
                continue;
            }
            if self.last.is_some_and(|last| record.position() <= last) {
                continue;
            }
            if !(self.from_ns..=self.to_ns).contains(&record.at_ns) {
                if !self.begun {
                    self.held = Some(record);
                }
                continue;
            }
            if !self.begun {
                self.begun = true;
                kept.extend(self.held.take().filter(|_| self.before));
            }
            self.last = Some(record.position());
            kept.push(record);
        }
        kept
    }
}
