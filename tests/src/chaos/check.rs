//! Were acknowledged commands kept? Pure: what was ordered and what the records say, in, and breaches out.
//!
//! Every order carries a setpoint of its own, so a record tells which order it follows. An order that was acknowledged must
//! rule every record from the one that its acknowledgement names on, until a later order rules. What got no answer may have
//! been done or not, and late; it is allowed whenever it shows.

use std::{collections::BTreeMap, fmt};

use crate::chaos::operator::{Order, Outcome};

/// How far a setpoint may be from its order's: it travels as a decimal text.
const SAME: f64 = 1e-7;

/// One record, as far as it matters here.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Seen {
    /// Number of its loop among those that are watched.
    pub loop_number: usize,
    /// Ownership and cycle.
    pub position: (u64, u64),
    /// When its inputs were frozen, in ns since 1970, on this machine's date.
    pub at_ns: u64,
    /// The setpoint in force.
    pub setpoint: f64,
    /// What was measured; not a number where that was bad.
    pub measurement: f64,
    /// A replica was silent, and the next was asked.
    pub hedged: bool,
    /// The first record of an ownership.
    pub took_over: bool,
}

/// An acknowledged order that a later record does not follow.
#[derive(Debug, Clone, PartialEq)]
pub struct Breach {
    /// The order.
    pub order: Order,
    /// The record.
    pub record: Seen,
}

impl fmt::Display for Breach {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { order, record } = self;
        write!(
            f,
            "setpoint {} of {} was acknowledged with {:?}, and record {:?} has {}",
            order.setpoint, order.loop_name, order.outcome, record.position, record.setpoint
        )
    }
}

/// Breaches, at most one per order. `orders` are in the order of their sending, each sent when the one before had its answer
/// or none; `names` gives the loops' names by number; `forgiven` says which orders need not be kept.
#[must_use]
pub fn kept_commands(
    orders: &[Order],
    records: &[Seen],
    names: &[String],
    forgiven: &dyn Fn(&Order) -> bool,
) -> Vec<Breach> {
    let mut of_loop: BTreeMap<usize, Vec<Seen>> = BTreeMap::new();
    for record in records {
        of_loop.entry(record.loop_number).or_default().push(*record);
    }
    let mut breaches = Vec::new();
    for (number, mut records) in of_loop {
        records.sort_by_key(|record| record.position);
        let name = names.get(number).map(String::as_str).unwrap_or_default();
        let orders: Vec<&Order> = orders.iter().filter(|order| order.loop_name == name).collect();
        let mut told = None;
        for record in records {
            let acknowledged = |order: &&Order| match order.outcome {
                Outcome::Done(position) => position <= record.position,
                Outcome::Unknown => false,
            };
            // The latest that must rule.
            let Some(rules) = orders.iter().rposition(acknowledged) else {
                continue;
            };
            let ruled_by = |order: &&Order| (order.setpoint - record.setpoint).abs() < SAME;
            let follows = orders.iter().rposition(ruled_by);
            let good = match follows {
                Some(place) if place >= rules => true,
                // Without an answer, and late.
                Some(place) => orders.get(place).is_some_and(|order| order.outcome == Outcome::Unknown),
                None => false,
            };
            if let Some(order) = orders.get(rules).filter(|_| !good && told != Some(rules))
                && !forgiven(order)
            {
                told = Some(rules);
                breaches.push(Breach {
                    order: (*order).clone(),
                    record,
                });
            }
        }
    }
    breaches
}

#[cfg(test)]
mod tests {
    use super::*;

    fn order(setpoint: f64, outcome: Outcome) -> Order {
        Order {
            loop_name: "l".to_owned(),
            setpoint,
            sent_ns: 0,
            answered_ns: 0,
            outcome,
            tries: 1,
        }
    }

    fn record(position: (u64, u64), setpoint: f64) -> Seen {
        Seen {
            loop_number: 0,
            position,
            at_ns: 0,
            setpoint,
            measurement: 0.0,
            hedged: false,
            took_over: false,
        }
    }

    #[test]
    fn what_was_acknowledged_rules_until_the_next() {
        let orders = [
            order(1.0, Outcome::Done((1, 10))),
            order(2.0, Outcome::Unknown),
            order(3.0, Outcome::Done((2, 30))),
        ];
        let names = ["l".to_owned()];
        for (position, setpoint, good) in [
            ((1, 9), 0.5, true),
            ((1, 10), 1.0, true),
            ((1, 11), 0.5, false),
            ((2, 11), 2.0, true),
            ((2, 20), 3.0, true),
            ((2, 30), 3.0, true),
            ((2, 31), 1.0, false),
            ((3, 30), 2.0, true),
            ((18, 25), 1.0, false),
            ((18, 25), 7.0, false),
        ] {
            let found = kept_commands(&orders, &[record(position, setpoint)], &names, &|_| false);
            assert_eq!(found.is_empty(), good, "{position:?} with {setpoint}: {found:?}");
        }
        let lost = [record((2, 31), 1.0), record((2, 32), 1.0)];
        assert_eq!(kept_commands(&orders, &lost, &names, &|_| false).len(), 1, "told once");
        assert!(kept_commands(&orders, &lost, &names, &|_| true).is_empty(), "forgiven");
    }
}
