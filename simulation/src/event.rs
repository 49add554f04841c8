//! What happens next: events in the order of their times, and the messages among them.
//!
//! Never: two events in an order that depends on anything but the plan.

use std::{
    cmp::{Ordering, Reverse},
    collections::BinaryHeap,
    sync::Arc,
};

use bumpless_core::{
    Record,
    protocol::{Answer, Sample, StepAnswer, StepRequest},
};

/// What goes from host to host.
#[derive(Debug, Clone)]
pub(crate) enum Message {
    Sample(Box<Sample>),
    Answer(Box<Answer>),
    Record(Arc<Record>),
    Step(Box<StepRequest>),
    StepAnswer(Box<StepAnswer>),
}

/// One thing that happens.
#[derive(Debug)]
pub(crate) enum Event {
    /// A message is there.
    Arrive { to: u32, message: Message },
    /// A time of a home; `life` is the home's, for one that died waits for nothing.
    Home { number: u32, life: u32, at_ns: u64 },
    /// A time of a seat.
    Seat { host: u32, number: u32, at_ns: u64 },
    /// A replica's step is done.
    Stepped {
        host: u32,
        life: u32,
        to: u32,
        answer: Box<StepAnswer>,
    },
    /// A host brings its last records to the disk; once, or as every second.
    Sync { host: u32, life: u32, once: bool },
    /// Somebody asks something of a loop.
    Ask { number: u32 },
    /// A home hears that one of a loop's hosts is there, or gone.
    Believe { number: u32, rank: u8, there: bool },
    /// A host has made a loop ready.
    Ready { number: u32, rank: u8, life: u32 },
    /// A fault begins.
    Strike { fault: usize },
    /// A fault ends.
    End { fault: usize },
    /// A host that started again has heard what others know of its loops.
    Reopen { host: u32, life: u32 },
}

struct Entry {
    at_ns: u64,
    order: u64,
    event: Event,
}

impl PartialEq for Entry {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}
impl Eq for Entry {}
impl PartialOrd for Entry {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}
impl Ord for Entry {
    fn cmp(&self, other: &Self) -> Ordering {
        (self.at_ns, self.order).cmp(&(other.at_ns, other.order))
    }
}

/// Events to come. Those of one time happen in the order in which they were put in.
#[derive(Default)]
pub(crate) struct Queue {
    heap: BinaryHeap<Reverse<Entry>>,
    order: u64,
}

impl Queue {
    pub(crate) fn put(&mut self, at_ns: u64, event: Event) {
        self.order += 1;
        self.heap.push(Reverse(Entry {
            at_ns,
            order: self.order,
            event,
        }));
    }

    /// The next event, where it comes before `end_ns`.
    pub(crate) fn next(&mut self, end_ns: u64) -> Option<(u64, Event)> {
        if self.heap.peek()?.0.at_ns >= end_ns {
            return None;
        }
        self.heap.pop().map(|Reverse(entry)| (entry.at_ns, entry.event))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn events_come_by_time_and_then_in_their_order() {
        let mut queue = Queue::default();
        for (at_ns, number) in [(5, 0), (3, 1), (5, 2), (3, 3)] {
            queue.put(at_ns, Event::Ask { number });
        }
        let mut seen = Vec::new();
        while let Some((at_ns, Event::Ask { number })) = queue.next(10) {
            seen.push((at_ns, number));
        }
        assert_eq!(seen, [(3, 1), (3, 3), (5, 0), (5, 2)]);
        queue.put(10, Event::Ask { number: 0 });
        assert!(queue.next(10).is_none());
    }
}
