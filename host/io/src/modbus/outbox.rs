//! Writes on their way to a device: one place per point, the latest value wins.
//!
//! ```text
//! idle ──put──► waiting ──take──► in flight ──sent──► idle, with the value as known
//!                  ▲                  │ failed, and nothing newer: back
//!                  └──────────────────┘ older than the expiry: given up
//! ```
//!
//! Each point belongs to a lane, which is one connection's; a lane takes only its own. Bounded by the number of points. Never: blocks longer than the copy of a value; talks to the device.

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
    /// Numbers of the points that wait, each once, by lane.
    waiting: Vec<Vec<usize>>,
}

#[derive(Debug)]
pub(crate) struct Outbox {
    inside: Mutex<Inside>,
    /// The lane of each point.
    lanes: Vec<u8>,
    /// Wakes the task of each lane.
    notify: Vec<Notify>,
    repeat_ns: u64,
    expiry_ns: u64,
}

impl Outbox {
    /// A place for each point, with its lane. `repeat_ns` 0: an unchanged value is never written again.
    pub(crate) fn new(lanes: Vec<u8>, repeat_ns: u64, expiry_ns: u64) -> Self {
        let count = lanes.iter().max().map_or(1, |lane| usize::from(*lane) + 1);
        // Room for all, so that a cycle's thread never allocates here.
        let room = |lane: usize| Vec::with_capacity(lanes.iter().filter(|l| usize::from(**l) == lane).count());
        Self {
            inside: Mutex::new(Inside {
                slots: vec![Slot::default(); lanes.len()],
                waiting: (0..count).map(room).collect(),
            }),
            notify: (0..count).map(|_| Notify::new()).collect(),
            lanes,
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
        let lane = self.lane(wish.point);
        if slot.waiting.replace((wish.words, wish.at_ns)).is_none()
            && let Some(waiting) = waiting.get_mut(lane)
        {
            waiting.push(wish.point);
        }
        drop(guard);
        if let Some(notify) = self.notify.get(lane) {
            notify.notify_one();
        }
    }

    fn lane(&self, point: usize) -> usize {
        self.lanes.get(point).copied().map_or(0, usize::from)
    }

    /// Waits until something is put for the lane.
    pub(crate) async fn notified(&self, lane: usize) {
        match self.notify.get(lane) {
            Some(notify) => notify.notified().await,
            None => std::future::pending().await,
        }
    }

    /// Takes all of a lane that waits and is not too old; also says how many were given up for their age.
    pub(crate) fn take(&self, lane: usize, now_ns: u64) -> (Vec<Wish>, u64) {
        let mut guard = self.inside.lock();
        let Inside { slots, waiting } = &mut *guard;
        let (mut wishes, mut expired) = (Vec::new(), 0);
        for point in waiting.get_mut(lane).into_iter().flat_map(|waiting| waiting.drain(..)) {
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
            if let Some(waiting) = waiting.get_mut(self.lane(wish.point)) {
                waiting.push(wish.point);
            }
        }
    }

    /// A new connection, perhaps a device that started again: nothing is known of what it holds.
    pub(crate) fn forget(&self, lane: usize) {
        let mut inside = self.inside.lock();
        for (slot, own) in inside.slots.iter_mut().zip(&self.lanes) {
            if usize::from(*own) == lane {
                slot.known = None;
            }
        }
    }

    /// Does anything of the lane wait?
    pub(crate) fn is_waiting(&self, lane: usize) -> bool {
        self.inside
            .lock()
            .waiting
            .get(lane)
            .is_some_and(|waiting| !waiting.is_empty())
    }
}

/// The registers of a value of a point; of a field of bits, its number.
pub(crate) fn encoded(point: &PlannedPoint, value: f64) -> Words {
    let words = point
        .value_type
        .encode(point.scaling.raw(value), point.word_order, point.byte_order);
    match (point.bits, words.as_slice()) {
        // Held at the field's end, so that what is read back compares equal.
        (Some(bits), [number]) => Words::one(bits.of(bits.put(*number))),
        _ => words,
    }
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
        let outbox = Outbox::new(vec![0, 0], 0, 1000);
        outbox.put(wish(0, 1.0, 1));
        outbox.put(wish(0, 2.0, 2));
        outbox.put(wish(1, 9.0, 2));
        assert_eq!(outbox.take(0, 10), (vec![wish(0, 2.0, 2), wish(1, 9.0, 2)], 0));
        assert!(!outbox.is_waiting(0));
        outbox.sent(&wish(0, 2.0, 2), 10);
        outbox.put(wish(0, 2.0, 11));
        assert!(!outbox.is_waiting(0), "the device holds it");
        outbox.put(wish(0, 3.0, 12));
        // Back to the old value before the new one left: the new wish must not survive.
        outbox.put(wish(0, 2.0, 13));
        assert_eq!(outbox.take(0, 14).0, [wish(0, 2.0, 13)]);
    }

    #[test]
    fn a_value_in_flight_is_unknown() {
        let outbox = Outbox::new(vec![0], 0, 1000);
        outbox.put(wish(0, 1.0, 1));
        outbox.take(0, 1);
        outbox.sent(&wish(0, 1.0, 1), 2);
        outbox.put(wish(0, 2.0, 3));
        let (flying, _) = outbox.take(0, 3);
        // While 2 flies, the loop wants 1 again, which the device held before: it must be sent.
        outbox.put(wish(0, 1.0, 4));
        outbox.sent(&flying[0], 5);
        assert_eq!(outbox.take(0, 6).0, [wish(0, 1.0, 4)]);
    }

    #[test]
    fn failures_wait_again_newer_ones_first_and_old_ones_expire() {
        let outbox = Outbox::new(vec![0], 0, 1000);
        outbox.put(wish(0, 1.0, 1));
        let (taken, _) = outbox.take(0, 2);
        outbox.put_back(&taken[0]);
        assert_eq!(outbox.take(0, 3).0, taken);
        outbox.put(wish(0, 2.0, 4));
        outbox.put_back(&taken[0]);
        assert_eq!(outbox.take(0, 5).0, [wish(0, 2.0, 4)]);
        outbox.put(wish(0, 3.0, 10));
        assert_eq!(outbox.take(0, 1011), (vec![], 1));
        assert!(!outbox.is_waiting(0));
    }

    #[test]
    fn repeats_and_new_connections_send_again() {
        let outbox = Outbox::new(vec![0], 100, 1000);
        outbox.put(wish(0, 1.0, 1));
        outbox.sent(&outbox.take(0, 1).0[0], 1);
        outbox.put(wish(0, 1.0, 50));
        assert!(!outbox.is_waiting(0));
        outbox.put(wish(0, 1.0, 101));
        assert!(outbox.is_waiting(0));
        outbox.sent(&outbox.take(0, 101).0[0], 101);
        outbox.seen(0, &[1]);
        outbox.put(wish(0, 1.0, 102));
        assert!(!outbox.is_waiting(0));
        outbox.seen(0, &[4]);
        outbox.put(wish(0, 1.0, 102));
        assert_eq!(outbox.take(0, 102).0, [wish(0, 1.0, 102)]);
        outbox.sent(&wish(0, 1.0, 102), 102);
        outbox.forget(0);
        outbox.put(wish(0, 1.0, 102));
        assert!(outbox.is_waiting(0));
        outbox.put(wish(7, 1.0, 102));
    }

    #[test]
    fn a_lane_takes_its_own_points_only() {
        let outbox = Outbox::new(vec![0, 1, 0], 0, 1000);
        for point in 0..3 {
            outbox.put(wish(point, 1.0, 1));
        }
        assert_eq!(outbox.take(1, 2).0, [wish(1, 1.0, 1)]);
        assert!(outbox.is_waiting(0) && !outbox.is_waiting(1) && !outbox.is_waiting(7));
        outbox.put_back(&wish(1, 1.0, 1));
        assert_eq!(outbox.take(0, 2).0, [wish(0, 1.0, 1), wish(2, 1.0, 1)]);
        assert_eq!(outbox.take(1, 2).0, [wish(1, 1.0, 1)]);
        for point in 0..2 {
            outbox.sent(&wish(point, 1.0, 1), 3);
        }
        // A new connection of one lane says nothing about the devices of the other.
        outbox.forget(1);
        outbox.put(wish(0, 1.0, 4));
        outbox.put(wish(1, 1.0, 4));
        assert!(!outbox.is_waiting(0) && outbox.is_waiting(1));
    }
}
