//! Two hosts for one device: one writes, the other takes over when it dies or falls silent, and never do both.

use std::time::Instant;

use bumpless_tests::masters::{LOOP, TwoMasters};

use crate::{number, text};

#[track_caller]
fn no_overlap(rig: &TwoMasters) {
    let overlaps = rig.overlaps();
    assert!(
        overlaps.is_empty(),
        "{} writes beside the master's: {overlaps:#?}",
        overlaps.len()
    );
}

#[test]
fn the_device_goes_over_with_its_loop_and_is_never_written_by_two() {
    let mut rig = TwoMasters::start(150).unwrap();
    let first = rig.writes().last().unwrap().master;
    let other = 1 - first;
    let api = rig.api(other).unwrap();
    api.setpoint(LOOP, 5_010.0).unwrap();
    let (before, epoch) = (api.loop_view(LOOP).unwrap(), rig.epoch());

    // Death.
    let at = Instant::now();
    rig.hosts[first].kill9();
    rig.wait_written_by(other, at).unwrap();
    no_overlap(&rig);
    let after = api
        .wait_for_loop(LOOP, "the new home", |view| {
            text(&view["home"]) == format!("io-{}", other + 1)
        })
        .unwrap();
    assert!(rig.epoch() > epoch);
    assert!(after["term"].as_u64() > before["term"].as_u64(), "{after}");
    assert_eq!(number(&after["setpoint"]), 5_010.0, "an acknowledged command is kept");

    // The dead one comes back: it stands by.
    rig.hosts[first].restart().unwrap();
    api.wait_until("both are there", |api| match api.hosts() {
        Ok(hosts) if hosts.iter().filter(|host| host["alive"] == true).count() == 2 => Ok(()),
        other => Err(other.map_err(|error| error.to_string())),
    })
    .unwrap();

    // Silence: the master is stopped, and goes on when another is master.
    let at = Instant::now();
    rig.hosts[other].pause().unwrap();
    let taken = rig.wait_written_by(first, at).unwrap();
    rig.hosts[other].resume().unwrap();
    let again = rig.api(first).unwrap();
    again
        .wait_for_loop(LOOP, "twenty cycles at the new home", |view| {
            text(&view["home"]) == format!("io-{}", first + 1)
                && rig
                    .writes()
                    .iter()
                    .filter(|write| write.at > taken.at && write.master == first)
                    .count()
                    > 20
        })
        .unwrap();
    no_overlap(&rig);
    again.setpoint(LOOP, 5_020.0).unwrap();
}
