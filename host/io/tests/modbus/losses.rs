//! How soon a loss shows, and how little one wrong address takes with it.

use bumpless_core::{NoData, Quality};

use crate::{
    Bench, WIDE,
    peer::{Manner, Peer},
    point,
};

#[test]
fn a_loss_shows_with_the_first_time_out_whatever_tries_follow() {
    let bench = Bench::start("retries = 3", &point("a", "input", 0, WIDE));
    bench.peer.set_words(0, &[7]);
    bench.until("a", Ok(7.0));
    bench.peer.behave(Manner::Silent);
    let before = bench.peer.device.lock().unwrap().asked;
    bench.until("a", Err(NoData::CommsLost));
    let asked = bench.peer.device.lock().unwrap().asked - before;
    // Four in all; the loss is there before the last of them has been sent.
    assert!(asked < 4, "{asked} requests before the loss showed");
    bench.peer.behave(Manner::Good);
    bench.until("a", Ok(7.0));
    let status = bench.status();
    assert!(status.retries >= 1 && status.connections == 1, "{status:?}");
}

#[test]
fn one_wrong_address_takes_no_neighbour_with_it() {
    let points: String = (0..40).map(|n| point(&format!("p{n}"), "holding", n, WIDE)).collect();
    let peer = Peer::start();
    peer.set_words(0, &(100..140).collect::<Vec<_>>());
    peer.behave(Manner::Without(23));
    let bench = Bench::start_with(peer, "", &points);
    let wrong = bench.until("p23", Err(NoData::DeviceError(2)));
    assert_eq!(wrong.quality, Quality::Bad);
    for n in (0..40).filter(|n| *n != 23) {
        bench.until(&format!("p{n}"), Ok(f64::from(100 + n)));
    }
    let said = bench.status().last_error.unwrap();
    assert_eq!(
        said,
        "unit 1, holding registers 23 to 23: exception 2, illegal data address"
    );
    // The device has it now; nobody tells us, and we find it.
    bench.peer.behave(Manner::Good);
    bench.until("p23", Ok(123.0));
}
