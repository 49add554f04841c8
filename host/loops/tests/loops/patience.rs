//! A component that overruns in each cycle is tried ever less often, its loop stays in its policy, and a person gets it tried at once.

use bumpless_core::{CommandBody, Event, Outcome, Record};

use crate::bench::Bench;

/// What the record says of its fault.
fn fault(record: &Record) -> String {
    let faults = record.events.iter().filter_map(|event| match event {
        Event::Faulted { fault, .. } => Some(fault.as_str()),
        _ => None,
    });
    faults.collect::<Vec<_>>().join("; ")
}

/// The cycle in which it is tried again, where it rests in this one.
fn next_try(record: &Record) -> Option<u64> {
    let text = fault(record);
    let (_, number) = text.split_once("it is not tried again before cycle ")?;
    Some(number.parse().unwrap())
}

fn rests(record: &Record) -> bool {
    next_try(record).is_some()
}

#[test]
fn a_step_that_spins_in_each_cycle_is_tried_ever_less_often() {
    let mut bench = Bench::new(&["a", "b"], |_| {});
    bench.settled();
    let mut spec = bench.spec("guests/spins", 2, &[("after", 3.0)]);
    spec.policy.probation_cycles = 0;
    assert_eq!(bench.revise(&spec).0, Outcome::Done);
    let first = bench.until("its first fault", |r| r.faults_in_row == 1);
    assert!(
        fault(&first).contains("ran past its limit") && !rests(&first),
        "{first:?}"
    );
    // Two in a row may be the machine's doing; then it rests, and its loop is in its policy all the while. A cycle in which it is
    // tried may end too late for its record, so the pauses are read from what is said of the next try.
    let mut tries: Vec<u64> = Vec::new();
    while tries.len() < 5 {
        let record = bench.next();
        assert!(
            record.faults_in_row > 1 && record.events.contains(&Event::PolicyHeld),
            "{record:?}"
        );
        assert!(fault(&record).contains("ran past its limit"), "{record:?}");
        assert_eq!(record.outputs, first.outputs);
        if let Some(next) = next_try(&record).filter(|next| tries.last() != Some(next)) {
            tries.push(next);
        }
    }
    for (times, pair) in tries.windows(2).enumerate() {
        assert!(pair[1] - pair[0] > 4 << times, "{tries:?}");
    }
    // Whatever a person does may have mended it.
    let resting = bench.next();
    assert!(rests(&resting), "{resting:?}");
    let (outcome, asked) = bench.command(CommandBody::Setpoint(41.0));
    assert_eq!((outcome, asked.setpoint), (Outcome::Done, 41.0));
    assert!(
        fault(&asked).contains("ran past its limit") && !rests(&asked),
        "tried at once: {asked:?}"
    );
    // And another revision begins anew.
    let (outcome, record) = bench.revise(&bench.spec("pid", 3, &[("k", 2.0), ("ti", 0.5)]));
    assert_eq!((outcome, record.revision), (Outcome::Done, 3));
    assert_eq!(
        bench
            .until("good cycles", |r| r.revision == 3 && r.faults_in_row == 0)
            .outputs
            .len(),
        1
    );
}
