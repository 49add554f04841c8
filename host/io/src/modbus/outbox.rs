//! Writes on their way to a device: one place per point, the latest value wins.
//!
//! ```text
//! idle ──put──► waiting ──take──► in flight ──sent──► idle, with the value as known
//!                  ▲                  │ failed, and nothing newer: back
//!                  └──────────────────┘ older than the expiry: given up
//! ```
//!
//! Bounded by the number of points. Never: blocks longer than the copy of a value; talks to the device.

use parking_lot::Mutex;
use tokio::sync::Notify;

use super::{PlannedPoint, value::Words};

/// A value on its way.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Wish {
    /// The point's number on its bus.
    pub(crate) point: usize,
    /// Its registers.
    pub(crate) words: Words,
    /// When the loop wrote it.
    pub(crate) at_ns: u64,
}

#[derive(Debug, Clone, Copy, Default)]
struct Slot {
    waiting: Option<(Words, u64)>,
    /// What the device is known to hold because it was written, and when; unknown while a write is in flight.
    known: Option<(Words, u64)>,
}

#[derive(Debug)]
struct Inside {
    slots: Vec<Slot>,
    /// Numbers of the points that wait, each once.
    waiting: Vec<usize>,
}

#[derive(Debug)]
pub(crate) struct Outbox {
    inside: Mutex<Inside>,
    /// Wakes the task.
    pub(crate) notify: Notify,
    repeat_ns: u64,
    expiry_ns: u64,
}

impl Outbox {
    /// Places for `points` points. `repeat_ns` 0: an unchanged value is never written again.
    pub(crate) fn new(points: usize, repeat_ns: u64, expiry_ns: u64) -> Self {
        Self {
            inside: Mutex::new(Inside {
                slots: vec![Slot::default(); points],
                waiting: Vec::with_capacity(points),
            }),
            notify: Notify::new(),
            repeat_ns,
            expiry_ns,
        }
    }

    /// Puts the latest value of a point; one that the device is known to hold is not sent again.
    pub(crate) fn put(&self, wish: Wish) {
        let mut guard = self.inside.lock();
        let Inside { slots, waiting } = &mut *guard;
        let Some(slot) = slots.get_mut(wish.point) else { return };
        let known = slot.known.is_some_and(|(words, at_ns)| {
            words == wish.words && (self.repeat_ns == 0 || wish.at_ns.saturating_sub(at_ns) < self.repeat_ns)
        });
        if known && slot.waiting.is_none() {
            return;
        }
        if slot.waiting.replace((wish.words, wish.at_ns)).is_none() {
            waiting.push(wish.point);
        }
        drop(guard);
        self.notify.notify_one();
    }

    /// Takes all that waits and is not too old; also says how many were given up for their age.
    pub(crate) fn take(&self, now_ns: u64) -> (Vec<Wish>, u64) {
        let mut guard = self.inside.lock();
        let Inside { slots, waiting } = &mut *guard;
        let (mut wishes, mut expired) = (Vec::new(), 0);
        for point in waiting.drain(..) {
            let Some(slot) = slots.get_mut(point) else { continue };
            let Some((words, at_ns)) = slot.waiting.take() else {
                continue;
            };
            // Until the device confirms, nobody knows what it holds.
            slot.known = None;
            if now_ns.saturating_sub(at_ns) > self.expiry_ns {
                expired += 1;
            } else {
                wishes.push(Wish { point, words, at_ns });
            }
        }
        (wishes, expired)
    }

    /// The device confirmed.
    pub(crate) fn sent(&self, wish: &Wish, now_ns: u64) {
        if let Some(slot) = self.inside.lock().slots.get_mut(wish.point) {
            slot.known = Some((wish.words, now_ns));
        }
    }

    /// The device was read. Where it holds something else than was written (it started again, obeyed an old request late,
    /// or somebody turned a knob), the next write of the loop is sent even if its value is the same.
    pub(crate) fn seen(&self, point: usize, words: &[u16]) {
        if let Some(slot) = self.inside.lock().slots.get_mut(point)
            && slot.known.is_some_and(|(known, _)| known.as_slice() != words)
        {
            slot.known = None;
        }
    }

    /// The write did not arrive: it waits again, unless a newer one does.
    pub(crate) fn put_back(&self, wish: &Wish) {
        let mut guard = self.inside.lock();
        let Inside { slots, waiting } = &mut *guard;
        if let Some(slot) = slots.get_mut(wish.point)
            && slot.waiting.is_none()
        {
            slot.waiting = Some((wish.words, wish.at_ns));
            waiting.push(wish.point);
        }
    }

    /// A new connection, perhaps a device that started again: nothing is known of what it holds.
    pub(crate) fn forget(&self) {
        self.inside.lock().slots.iter_mut().for_each(|slot| slot.known = None);
    }

    /// Does anything wait?
    pub(crate) fn is_waiting(&self) -> bool {
        !self.inside.lock().waiting.is_empty()
    }
}

/// The registers of a value of a point.
pub(crate) fn encoded(point: &PlannedPoint, value: f64) -> Words {
    point
        .value_type
        .encode(point.scaling.raw(value), point.word_order, point.byte_order)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::modbus::{ByteOrder, ValueType, WordOrder};

    fn wish(point: usize, value: f64, at_ns: u64) -> Wish {
        let words = ValueType::U16.encode(value, WordOrder::HighFirst, ByteOrder::Big);
        Wish { point, words, at_ns }
    }

    #[test]
    fn the_latest_value_wins_and_known_ones_stay_home() {
        let outbox = Outbox::new(2, 0, 1000);
        outbox.put(wish(0, 1.0, 1));
        outbox.put(wish(0, 2.0, 2));
        outbox.put(wish(1, 9.0, 2));
        assert_eq!(outbox.take(10), (vec![wish(0, 2.0, 2), wish(1, 9.0, 2)], 0));
        assert!(!outbox.is_waiting());
        outbox.sent(&wish(0, 2.0, 2), 10);
        outbox.put(wish(0, 2.0, 11));
        assert!(!outbox.is_waiting(), "the device holds it");
        outbox.put(wish(0, 3.0, 12));
        // Back to the old value before the new one left: the new wish must not survive.
        outbox.put(wish(0, 2.0, 13));
        assert_eq!(outbox.take(14).0, [wish(0, 2.0, 13)]);
    }

    #[test]
    fn a_value_in_flight_is_unknown() {
        let outbox = Outbox::new(1, 0, 1000);
        outbox.put(wish(0, 1.0, 1));
        outbox.take(1);
        outbox.sent(&wish(0, 1.0, 1), 2);
        outbox.put(wish(0, 2.0, 3));
        let (flying, _) = outbox.take(3);
        // While 2 flies, the loop wants 1 again, which the device held before: it must be sent.
        outbox.put(wish(0, 1.0, 4));
        outbox.sent(&flying[0], 5);
        assert_eq!(outbox.take(6).0, [wish(0, 1.0, 4)]);
    }

    #[test]
    fn failures_wait_again_newer_ones_first_and_old_ones_expire() {
        let outbox = Outbox::new(1, 0, 1000);
        outbox.put(wish(0, 1.0, 1));
        let (taken, _) = outbox.take(2);
        outbox.put_back(&taken[0]);
        assert_eq!(outbox.take(3).0, taken);
        outbox.put(wish(0, 2.0, 4));
        outbox.put_back(&taken[0]);
        assert_eq!(outbox.take(5).0, [wish(0, 2.0, 4)]);
        outbox.put(wish(0, 3.0, 10));
        assert_eq!(outbox.take(1011), (vec![], 1));
        assert!(!outbox.is_waiting());
    }

    #[test]
    fn repeats_and_new_connections_send_again() {
        let outbox = Outbox::new(1, 100, 1000);
        outbox.put(wish(0, 1.0, 1));
        outbox.sent(&outbox.take(1).0[0], 1);
        outbox.put(wish(0, 1.0, 50));
        assert!(!outbox.is_waiting());
        outbox.put(wish(0, 1.0, 101));
        assert!(outbox.is_waiting());
        outbox.sent(&outbox.take(101).0[0], 101);
        outbox.seen(0, &[1]);
        outbox.put(wish(0, 1.0, 102));
        assert!(!outbox.is_waiting());
        outbox.seen(0, &[4]);
        outbox.put(wish(0, 1.0, 102));
        assert_eq!(outbox.take(102).0, [wish(0, 1.0, 102)]);
        outbox.sent(&wish(0, 1.0, 102), 102);
        outbox.forget();
        outbox.put(wish(0, 1.0, 102));
        assert!(outbox.is_waiting());
        outbox.put(wish(7, 1.0, 102));
    }
}
