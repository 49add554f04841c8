//! A worker's inbox: a bounded queue whose reader sleeps until something comes or a time is up.
//!
//! ```text
//! try_send ──► queue ──► recv_timeout: takes, or sleeps on the condition until a send or the time
//! ```
//! Never: spins or yields while it is empty. A reader that yields stays runnable: with some workers per host and some hosts
//! per machine, the run queue then is full of threads that have nothing to do, each of which the scheduler puts behind the
//! others, so that deadlines are met late and a third of the processor time goes into switches.

use std::{
    collections::VecDeque,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
    time::{Duration, Instant},
};

use parking_lot::{Condvar, Mutex};

/// Waiting events that are looked at: a host that was held up for seconds has thousands, and looking through all of them for
/// each would hold it up again.
const LOOKED_AT_MAX: usize = 256;

/// What readers and writers share.
struct Shared<T> {
    /// None when the reader is gone: then nothing may wait here, for somebody may wait for its end.
    queue: Mutex<Option<VecDeque<T>>>,
    filled: Condvar,
    max: usize,
    senders: AtomicUsize,
}

/// Why nothing was sent: the inbox is full, or its reader is gone.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Full;

/// Why nothing was received.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Nothing {
    /// The time is up.
    Timeout,
    /// Nobody can send any more.
    Disconnected,
}

/// The writing end; clones are the same end.
pub(crate) struct Sender<T>(Arc<Shared<T>>);

/// The reading end.
pub(crate) struct Receiver<T>(Arc<Shared<T>>);

/// An inbox of at most `max` events.
pub(crate) fn bounded<T>(max: usize) -> (Sender<T>, Receiver<T>) {
    let shared = Arc::new(Shared {
        queue: Mutex::new(Some(VecDeque::new())),
        filled: Condvar::new(),
        max,
        senders: AtomicUsize::new(1),
    });
    (Sender(Arc::clone(&shared)), Receiver(shared))
}

impl<T> Sender<T> {
    /// Puts an event at the end; never waits for room.
    ///
    /// # Errors
    /// [`Full`]; the event is dropped.
    pub(crate) fn try_send(&self, event: T) -> Result<(), Full> {
        {
            let mut queue = self.0.queue.lock();
            let queue = queue.as_mut().filter(|queue| queue.len() < self.0.max).ok_or(Full)?;
            queue.push_back(event);
        }
        self.0.filled.notify_one();
        Ok(())
    }

    /// Puts an event before all others, whether there is room or not: for the one that ends the reader.
    pub(crate) fn send_first(&self, event: T) {
        if let Some(queue) = self.0.queue.lock().as_mut() {
            queue.push_front(event);
        }
        self.0.filled.notify_one();
    }
}

impl<T> Clone for Sender<T> {
    fn clone(&self) -> Self {
        self.0.senders.fetch_add(1, Ordering::Relaxed);
        Self(Arc::clone(&self.0))
    }
}

impl<T> Drop for Sender<T> {
    fn drop(&mut self) {
        if self.0.senders.fetch_sub(1, Ordering::AcqRel) == 1 {
            // Under the lock, so that a reader that is about to sleep has not looked yet or sleeps already.
            drop(self.0.queue.lock());
            self.0.filled.notify_all();
        }
    }
}

impl<T> Receiver<T> {
    /// The next event, where there is one.
    pub(crate) fn try_recv(&self) -> Option<T> {
        self.0.queue.lock().as_mut().and_then(VecDeque::pop_front)
    }

    /// Does one of the events that came last, and still wait, answer to this? Only the last [`LOOKED_AT_MAX`] are asked.
    pub(crate) fn holds(&self, is: impl Fn(&T) -> bool) -> bool {
        let queue = self.0.queue.lock();
        queue
            .as_ref()
            .is_some_and(|queue| queue.iter().rev().take(LOOKED_AT_MAX).any(is))
    }

    /// The next event, waiting for it at most `longest`.
    ///
    /// # Errors
    /// [`Nothing`] says why there is none.
    pub(crate) fn recv_timeout(&self, longest: Duration) -> Result<T, Nothing> {
        let until = Instant::now() + longest;
        let mut queue = self.0.queue.lock();
        loop {
            if let Some(event) = queue.as_mut().and_then(VecDeque::pop_front) {
                return Ok(event);
            }
            if self.0.senders.load(Ordering::Acquire) == 0 {
                return Err(Nothing::Disconnected);
            }
            if self.0.filled.wait_until(&mut queue, until).timed_out() {
                return queue.as_mut().and_then(VecDeque::pop_front).ok_or(Nothing::Timeout);
            }
        }
    }
}

impl<T> Drop for Receiver<T> {
    fn drop(&mut self) {
        // What waited is dropped outside the lock: it may hold senders.
        let waited = self.0.queue.lock().take();
        drop(waited);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    #[test]
    fn events_come_in_order_and_a_full_inbox_refuses() {
        let (sender, receiver) = bounded(2);
        assert_eq!(sender.try_send(1), Ok(()));
        assert_eq!(sender.try_send(2), Ok(()));
        assert_eq!(sender.try_send(3), Err(Full));
        sender.send_first(0);
        let all: Vec<_> = (0..4).map(|_| receiver.recv_timeout(Duration::ZERO)).collect();
        assert_eq!(all, [Ok(0), Ok(1), Ok(2), Err(Nothing::Timeout)]);
        sender.try_send(4).unwrap();
        assert!(receiver.holds(|event| *event == 4) && !receiver.holds(|event| *event == 3));
        drop(receiver);
        assert_eq!(sender.try_send(5), Err(Full), "nobody reads any more");
    }

    #[test]
    fn a_sleeping_reader_is_woken_by_an_event_and_by_the_last_senders_end() {
        let (sender, receiver) = bounded(8);
        let reader = std::thread::spawn(move || {
            let patience = Duration::from_secs(60);
            let mut seen = Vec::new();
            loop {
                match receiver.recv_timeout(patience) {
                    Ok(event) => seen.push(event),
                    Err(why) => return (seen, why),
                }
            }
        });
        let other = sender.clone();
        for event in 0..8 {
            other.try_send(event).unwrap();
        }
        drop(other);
        drop(sender);
        assert_eq!(reader.join().unwrap(), ((0..8).collect(), Nothing::Disconnected));
    }
}
