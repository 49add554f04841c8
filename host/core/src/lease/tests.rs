//! Whatever hosts sleep through and whenever their writes land: the device never obeys an old master after a new one.

use proptest::prelude::*;

use super::*;

const TIMES: LeaseTimes = LeaseTimes {
    lease_ns: 1_000,
    in_flight_ns: 200,
    claim_ns: 100,
};

/// What a host has under way: a request whose answer has not been looked at.
#[derive(Debug, Clone, Copy)]
struct Under {
    step: LeaseStep,
    sent_ns: u64,
    lands_ns: u64,
    answered_ns: u64,
    /// What a read saw.
    saw: Option<Token>,
    lost: bool,
}

struct Host {
    lease: Lease,
    under: Option<Under>,
    /// It does nothing until then, as if it were stopped.
    asleep_until_ns: u64,
}

/// A write of data on its way to the device.
#[derive(Debug, Clone, Copy)]
struct Data {
    lands_ns: u64,
    epoch: u32,
}

#[derive(Debug, Clone, Copy)]
struct Luck {
    out_ns: u64,
    back_ns: u64,
    sleep_ns: u64,
    lost: u8,
}

fn luck() -> impl Strategy<Value = Luck> {
    let sleep = prop_oneof![30 => Just(0_u64), 1 => 0..4_000_u64];
    (0..200_u64, 0..300_u64, sleep, 0..12_u8).prop_map(|(out_ns, back_ns, sleep_ns, lost)| Luck {
        out_ns,
        back_ns,
        sleep_ns,
        lost,
    })
}

/// Runs hosts over one device. Gives the epochs of data writes in the order in which the device obeyed them.
fn run(hosts: u8, lucks: &[Luck], times: LeaseTimes) -> Vec<u32> {
    let mut device = Token {
        epoch: 0,
        rank: 0,
        beat: 0,
    };
    let mut all: Vec<Host> = (1..=hosts)
        .map(|rank| Host {
            lease: Lease::new(rank, times, 0),
            under: None,
            asleep_until_ns: 0,
        })
        .collect();
    let (mut lucks, mut flying, mut obeyed) = (lucks.iter().cycle(), Vec::<Data>::new(), Vec::new());
    for now_ns in (0..30_000_u64).step_by(5) {
        // What lands, lands in its order; requests of the lease and data alike.
        flying.sort_by_key(|data| data.lands_ns);
        while flying.first().is_some_and(|data| data.lands_ns <= now_ns) {
            obeyed.push(flying.remove(0).epoch);
        }
        for host in &mut all {
            if let Some(under) = &mut host.under
                && under.lands_ns <= now_ns
                && under.saw.is_none()
            {
                if let LeaseStep::Write(token, _) = under.step {
                    device = token;
                }
                under.saw = Some(device);
            }
        }
        for host in &mut all {
            if now_ns < host.asleep_until_ns {
                continue;
            }
            let luck = *lucks.next().expect("a cycle");
            if luck.sleep_ns > 0 {
                host.asleep_until_ns = now_ns + luck.sleep_ns;
                continue;
            }
            match host.under {
                Some(under) if now_ns >= under.answered_ns => {
                    host.under = None;
                    match (under.step, under.saw) {
                        (_, None) => host.lease.failed(now_ns),
                        _ if under.lost => host.lease.failed(now_ns),
                        (LeaseStep::Read, Some(token)) => host.lease.read(under.sent_ns, now_ns, token),
                        (LeaseStep::Write(token, _), _) => host.lease.written(under.sent_ns, now_ns, token),
                    }
                }
                Some(_) => {}
                None if now_ns >= host.lease.due_ns() => {
                    let step = host.lease.step(now_ns);
                    let sendable = match step {
                        LeaseStep::Read => true,
                        LeaseStep::Write(_, until_ns) => now_ns < until_ns,
                    };
                    if sendable {
                        host.under = Some(Under {
                            step,
                            sent_ns: now_ns,
                            lands_ns: now_ns + luck.out_ns.min(times.in_flight_ns - 5),
                            answered_ns: now_ns + luck.out_ns + luck.back_ns,
                            saw: None,
                            lost: luck.lost == 0,
                        });
                    } else {
                        host.lease.failed(now_ns);
                    }
                }
                None => {}
            }
            if let Some(epoch) = host.lease.epoch(now_ns) {
                flying.push(Data {
                    lands_ns: now_ns + luck.out_ns.min(times.in_flight_ns - 5),
                    epoch,
                });
            }
        }
    }
    obeyed
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]
    #[test]
    fn masters_follow_each_other_and_never_overlap(lucks in prop::collection::vec(luck(), 50..400), hosts in 2..4_u8) {
        let obeyed = run(hosts, &lucks, TIMES);
        prop_assert!(obeyed.is_sorted(), "an old master's write after a new one's: {obeyed:?}");
    }
}

/// The same search finds the overlap where a time is too short: it can see what it looks for.
#[test]
fn an_impatient_watcher_is_caught() {
    let hasty = LeaseTimes {
        claim_ns: 100,
        lease_ns: 1_000,
        in_flight_ns: 200,
    };
    // A lease that the master believes to be longer than the watchers do.
    let mut master = Lease::new(
        1,
        LeaseTimes {
            lease_ns: 4_000,
            ..hasty
        },
        0,
    );
    let mut watcher = Lease::new(2, hasty, 0);
    let nobody = Token {
        epoch: 0,
        rank: 0,
        beat: 0,
    };
    let mut device = nobody;
    let settle = |lease: &mut Lease, device: &mut Token, from: u64, to: u64| {
        for now in (from..to).step_by(10) {
            if now >= lease.due_ns() {
                match lease.step(now) {
                    LeaseStep::Read => lease.read(now, now, *device),
                    LeaseStep::Write(token, until) if now < until => {
                        *device = token;
                        lease.written(now, now, token);
                    }
                    LeaseStep::Write(..) => lease.failed(now),
                }
            }
        }
    };
    settle(&mut master, &mut device, 0, 8_000);
    assert!(master.may_write(8_000));
    settle(&mut watcher, &mut device, 8_000, 10_500);
    assert!(
        watcher.may_write(10_500) && master.may_write(10_500),
        "both: the times of the two must agree"
    );
}

fn drive(lease: &mut Lease, device: &mut Token, from: u64, to: u64) {
    for now in from..to {
        if now >= lease.due_ns() {
            match lease.step(now) {
                LeaseStep::Read => lease.read(now, now, *device),
                LeaseStep::Write(token, until) if now < until => {
                    *device = token;
                    lease.written(now, now, token);
                }
                LeaseStep::Write(..) => lease.failed(now),
            }
        }
    }
}

#[test]
fn a_lone_host_becomes_master_stays_it_and_a_pause_ends_it() {
    let (mut lease, mut device) = (
        Lease::new(1, TIMES, 0),
        Token {
            epoch: 7,
            rank: 3,
            beat: 9,
        },
    );
    drive(&mut lease, &mut device, 0, TIMES.patience_ns());
    assert!(
        !lease.may_write(TIMES.patience_ns()),
        "nobody writes before its patience is over"
    );
    drive(&mut lease, &mut device, TIMES.patience_ns(), 5_000);
    assert_eq!((lease.epoch(5_000), device.rank), (Some(8), 1));
    assert!(
        lease.may_write(5_000) && !lease.may_write(6_100),
        "it was paused: the lease is over before it looks"
    );
    drive(&mut lease, &mut device, 6_100, 9_000);
    assert_eq!(lease.epoch(9_000), Some(9), "a new mastership has a new epoch");
}

#[test]
fn one_that_is_given_up_goes_over_soon() {
    let (mut a, mut device) = (
        Lease::new(1, TIMES, 0),
        Token {
            epoch: 0,
            rank: 0,
            beat: 0,
        },
    );
    drive(&mut a, &mut device, 0, 4_000);
    let mut b = Lease::new(2, TIMES, 3_000);
    drive(&mut b, &mut device, 3_000, 4_000);
    a.give_up(4_000);
    assert!(!a.may_write(4_000) && a.is_giving_up());
    drive(&mut a, &mut device, 4_000, 4_001);
    assert!(!a.is_giving_up());
    let soon = 4_001 + TIMES.beat_ns() + TIMES.in_flight_ns + 2 * TIMES.settle_ns() + 10;
    drive(&mut b, &mut device, 4_001, soon);
    assert!(b.may_write(soon) && soon < 4_000 + TIMES.patience_ns());
}

#[test]
fn tokens_are_registers_and_back() {
    for token in [
        Token {
            epoch: 0,
            rank: 0,
            beat: 0,
        },
        Token {
            epoch: 0x0001_0002,
            rank: 15,
            beat: 0x0fff,
        },
        Token {
            epoch: u32::MAX,
            rank: 1,
            beat: 1,
        },
    ] {
        assert_eq!(Token::of(token.words()), token);
    }
    assert!(TIMES.fit() && !LeaseTimes { lease_ns: 400, ..TIMES }.fit());
}
