//! Fewer and fewer hosts, and links that carry too little: the loop goes on as far as it can, and says so.

use std::sync::atomic::Ordering;

use bumpless_core::{Event, HostId};

use crate::bench::{Bench, host, loop_id};

fn tell_all_gone(bench: &Bench, gone: &[HostId]) {
    for name in bench.holders.iter().chain([&bench.home]) {
        for host in gone {
            bench.at(name).host_gone(host);
        }
    }
}

#[test]
fn the_last_replica_is_the_owner_itself_and_the_loop_says_what_it_lost() {
    let mut bench = Bench::new(&["a", "b", "c"], |_| {});
    bench.until("everyone is ready", |r| r.redundancy.whole());
    let owner = bench.next().owner.clone();
    let gone: Vec<HostId> = bench.holders.iter().filter(|h| **h != owner).cloned().collect();
    bench.board.cut.lock().unwrap().extend(gone.iter().cloned());
    tell_all_gone(&bench, &gone);
    let lost = bench.until("the loss is told", |r| {
        r.events.contains(&Event::RedundancyLost { have: 1, want: 3 })
    });
    assert_eq!((&lost.owner, lost.faults_in_row), (&owner, 0));
    for _ in 0..20 {
        let record = bench.next();
        assert_eq!(
            (&record.stepped_by, record.faults_in_row),
            (&owner, 0),
            "the owner steps itself"
        );
        assert_eq!((record.redundancy.have, record.redundancy.want), (1, 3));
        assert!(
            !record.events.iter().any(|e| matches!(e, Event::RedundancyLost { .. })),
            "told once"
        );
    }
    // They come back.
    bench.board.cut.lock().unwrap().clear();
    bench.tell_of_hosts(&[lost.digest]);
    bench.set_members(&bench.holders.clone());
    bench.until("the return is told", |r| {
        r.events.contains(&Event::RedundancyRestored { want: 3 })
    });
}

#[test]
fn with_nobody_left_the_output_holds_the_cycles_are_counted_and_the_next_host_goes_on() {
    let mut bench = Bench::new(&["a", "b"], |_| {});
    bench.settled();
    let before = bench.next();
    bench.set_members(&[]);
    let home = bench.at(&bench.home);
    let view = |what: &str, is: &dyn Fn(&bumpless_loops::HomeView) -> bool| {
        let until = std::time::Instant::now() + crate::bench::PATIENCE;
        loop {
            let view = home.home_view(&loop_id()).unwrap();
            if is(&view) {
                return view;
            }
            assert!(std::time::Instant::now() < until, "{what}: {view:?}");
            std::thread::yield_now();
        }
    };
    let empty = view("nobody owns it", &|v| v.owner.is_none());
    view("cycles are lost", &|v| v.tally.lost >= empty.tally.lost + 5);
    bench.set_members(&[host("b")]);
    let after = bench.until("it goes on", |r| r.seq > before.seq + 5);
    assert_eq!(after.owner, host("b"));
    let prepared = bench.engine.prepared(&after.digest).unwrap();
    let out = prepared
        .descriptor()
        .ports
        .iter()
        .position(|port| port.name == "out")
        .unwrap();
    let held = after.readings.get(out).map(bumpless_core::Reading::value_or_last);
    let last = bench.seen.iter().rev().find(|r| r.term != after.term).unwrap();
    assert!(
        held.is_some_and(|held| (held - last.outputs[0]).abs() < 0.01),
        "the actuator held what was written last: {held:?}, {:?}",
        last.outputs
    );
}

#[test]
fn links_that_lose_every_third_message_cost_cycles_but_never_order() {
    let mut bench = Bench::new(&["a", "b", "c"], |_| {});
    bench.settled();
    let before = bench.next();
    bench.board.lost_every.store(3, Ordering::Relaxed);
    // `next` holds every record to the chain, and every output to its range.
    for _ in 0..150 {
        bench.next();
    }
    let seen = &bench.seen[bench.seen.len() - 150..];
    let hedged = seen
        .iter()
        .any(|r| r.events.iter().any(|e| matches!(e, Event::Hedged { .. })));
    let fewer = seen.iter().any(|r| !r.redundancy.whole());
    assert!(hedged, "silent replicas are told of");
    assert!(fewer, "and that there are fewer of them");
    bench.board.lost_every.store(0, Ordering::Relaxed);
    let calm = bench.until("all is well again", |r| {
        r.redundancy.whole() && r.faults_in_row == 0 && r.term > before.term
    });
    assert_eq!(calm.redundancy.want, 3);
}
