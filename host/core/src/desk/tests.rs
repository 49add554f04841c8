//! The desk against hosts that die, pause, answer late and twice: what was taken is one chain, and no command is lost.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

use std::collections::BTreeMap;

use proptest::prelude::*;

use super::*;
use crate::{
    Digest, LoopId, Mode, Policy, Strategy as Choice,
    record::{CommandBody, CommandId, Outcome, test_record},
};

const PERIOD_NS: u64 = 100;

fn host(n: usize) -> HostId {
    HostId::new(format!("h{n}")).unwrap()
}

pub(super) fn spec() -> LoopSpec {
    LoopSpec {
        id: LoopId::new("l").unwrap(),
        revision: 1,
        digest: Digest::of(b"a"),
        period_ns: PERIOD_NS,
        ports: BTreeMap::new(),
        parameters: BTreeMap::new(),
        setpoint: 1.0,
        setpoint_range: (0.0, 10.0),
        mode: Mode::Automatic,
        strategy: Choice::Local,
        replicas: 3,
        limits: BTreeMap::new(),
        listens: vec![],
        fallback: None,
        fallback_parameters: BTreeMap::new(),
        prefer: vec![],
        policy: Policy::default(),
    }
}

fn desk() -> Desk {
    let mut desk = Desk::new(host(9), Arc::new(spec()), None, 0, 0);
    assert_eq!(desk.set_members(0, vec![host(0), host(1), host(2)]), None);
    desk
}

/// What an owner that works sends back.
fn commit(sample: &Sample) -> Record {
    let mut record = test_record();
    record.term = sample.term;
    record.seq = sample.seq;
    record.after = sample.last;
    record.owner = sample.owner.clone();
    record.at_ns = sample.at_ns;
    record.applied = sample
        .commands
        .iter()
        .map(|c| Applied {
            id: c.id,
            outcome: Outcome::Done,
        })
        .collect();
    record
}

fn sent(dispatch: Option<Dispatch>) -> Sample {
    match dispatch {
        Some(Dispatch::Send(sample)) => *sample,
        other => panic!("a sample was expected, not {other:?}"),
    }
}

fn next(desk: &mut Desk) -> Sample {
    let at = desk.deadline_at_ns();
    sent(desk.deadline(at, vec![], None).map(|(_, dispatch)| dispatch))
}

#[test]
fn a_silent_owner_is_replaced_within_the_period_and_fenced() {
    let mut desk = desk();
    let first = next(&mut desk);
    assert_eq!((first.owner.clone(), first.seq, first.last), (host(0), 1, (0, 0)));
    desk.check(&commit(&first)).unwrap();
    desk.take(first.at_ns + 1, commit(&first));
    let second = next(&mut desk);
    assert_eq!(
        desk.overdue(second.at_ns + 34),
        None,
        "a third of the period is the owner's"
    );
    let again = sent(desk.overdue(second.at_ns + 35));
    assert_eq!(
        (again.owner.clone(), again.seq, again.at_ns),
        (host(1), second.seq, second.at_ns)
    );
    assert!(again.term > second.term);
    assert_eq!(
        again.resume.as_ref().map(|r| r.position()),
        Some(second.last),
        "the new owner gets the last record"
    );
    assert_eq!(
        desk.check(&commit(&second)),
        Err(Refusal::OldTerm),
        "the silent owner comes back too late"
    );
    desk.check(&commit(&again)).unwrap();
    desk.take(again.at_ns + 60, commit(&again));
    assert_eq!(next(&mut desk).owner, host(1), "the ownership stays where it works");
    assert_eq!(
        desk.tally(),
        Tally {
            taken: 2,
            lost: 0,
            skipped: 0,
            takeovers: 1,
            refused: 1
        }
    );
}

/// Makes host 0 the owner of a cycle at this time and lets it be silent; host 1 takes over. Gives when it was struck.
fn silent(desk: &mut Desk, at_ns: u64) -> u64 {
    desk.set_members(at_ns, vec![host(0)]);
    let at_ns = at_ns.max(desk.deadline_at_ns());
    let first = sent(desk.deadline(at_ns, vec![], None).map(|d| d.1));
    assert_eq!(first.owner, host(0), "where no other is left it is asked all the same");
    desk.set_members(at_ns, vec![host(0), host(1)]);
    let struck_ns = desk.due_at_ns();
    let again = sent(desk.overdue(struck_ns));
    assert_eq!(again.owner, host(1));
    desk.check(&commit(&again)).unwrap();
    desk.take(struck_ns, commit(&again));
    struck_ns
}

/// Would a host that has no strikes be preferred to host 0 at this time?
fn passed_over(desk: &Desk, at_ns: u64) -> bool {
    let mut desk = desk.clone();
    desk.set_members(at_ns, vec![host(0), host(2)]);
    let sample = sent(desk.deadline(at_ns, vec![], None).map(|d| d.1));
    sample.owner == host(2)
}

#[test]
fn who_is_silent_again_and_again_is_passed_over_twice_as_long_and_a_minute_at_most() {
    let mut desk = desk();
    let (mut at_ns, mut times_s) = (0, Vec::new());
    for _ in 0..9 {
        let struck_ns = silent(&mut desk, at_ns);
        let for_ns = [1, 2, 4, 8, 16, 32, 60]
            .map(|s| s * 1_000_000_000)
            .into_iter()
            .find(|ns| !passed_over(&desk, struck_ns + ns))
            .unwrap();
        assert!(passed_over(&desk, struck_ns + for_ns - 1), "to the last nanosecond");
        times_s.push(for_ns / 1_000_000_000);
        at_ns = struck_ns + for_ns;
    }
    assert_eq!(times_s, [1, 2, 4, 8, 16, 32, 60, 60, 60]);

    // One cycle that it ran, and all is forgiven.
    let mut forgiven = desk.clone();
    forgiven.set_members(at_ns, vec![host(0)]);
    let good = sent(forgiven.deadline(at_ns, vec![], None).map(|d| d.1));
    forgiven.check(&commit(&good)).unwrap();
    forgiven.take(at_ns + 1, commit(&good));
    let struck_ns = silent(&mut forgiven, at_ns + PERIOD_NS);
    assert!(!passed_over(&forgiven, struck_ns + 1_000_000_000), "a second again");

    // So it is after a minute in which nobody had to ask it.
    let later_ns = at_ns + SUSPECT_NS_MAX;
    let mut remembered = desk.clone();
    let struck_ns = silent(&mut remembered, later_ns - 1);
    assert!(
        passed_over(&remembered, struck_ns + SUSPECT_NS_MAX - 1),
        "not yet forgotten"
    );
    let struck_ns = silent(&mut desk, later_ns);
    assert!(!passed_over(&desk, struck_ns + 1_000_000_000), "forgotten");
}

#[test]
fn a_dead_owner_is_replaced_at_once_and_between_cycles() {
    let mut desk = desk();
    let first = next(&mut desk);
    let again = sent(desk.set_members(first.at_ns + 3, vec![host(1), host(2)]));
    assert_eq!((again.owner.clone(), again.seq), (host(1), first.seq));
    desk.check(&commit(&again)).unwrap();
    desk.take(again.at_ns + 5, commit(&again));
    assert_eq!(desk.set_members(again.at_ns + 7, vec![host(2)]), None, "nothing waits");
    assert_eq!(desk.check(&commit(&again)), Err(Refusal::OldTerm));
    let later = next(&mut desk);
    assert_eq!(later.owner, host(2));
    assert!(later.resume.is_some());
    assert_eq!(desk.tally().lost, 0);
}

#[test]
fn with_nobody_left_the_cycle_is_lost_and_the_next_host_is_taken() {
    let mut desk = desk();
    let first = next(&mut desk);
    assert_eq!(desk.set_members(first.at_ns + 1, vec![]), Some(Dispatch::Nobody));
    let at = desk.deadline_at_ns();
    assert_eq!(desk.deadline(at, vec![], None).unwrap().1, Dispatch::Nobody);
    assert_eq!(desk.tally().lost, 2);
    desk.set_members(at + 1, vec![host(2)]);
    assert_eq!(next(&mut desk).owner, host(2));
}

#[test]
fn a_planned_move_loses_nothing() {
    let mut desk = desk();
    let first = next(&mut desk);
    desk.move_to(host(2));
    desk.check(&commit(&first)).unwrap();
    desk.take(first.at_ns + 1, commit(&first));
    let second = next(&mut desk);
    assert_eq!(second.owner, host(2));
    assert_eq!(second.resume.as_ref().map(|r| r.position()), Some(second.last));
    assert_eq!(desk.tally().lost, 0);
}

#[test]
fn a_planned_move_goes_to_a_host_that_was_silent_before() {
    let mut desk = desk();
    let first = next(&mut desk);
    let again = sent(desk.overdue(first.at_ns + 50));
    desk.check(&commit(&again)).unwrap();
    desk.take(again.at_ns + 60, commit(&again));
    desk.move_to(first.owner.clone());
    assert_eq!(next(&mut desk).owner, first.owner);
}

#[test]
fn commands_ride_until_a_record_holds_them_and_a_full_queue_refuses() {
    let mut desk = desk();
    let command = |n: u128| Command {
        id: CommandId(n),
        body: CommandBody::Setpoint(2.0),
    };
    for n in 0..COMMANDS_WAITING_MAX as u128 {
        assert_eq!(desk.command(command(n)), Queued::Waits);
    }
    assert_eq!(desk.command(command(0)), Queued::Waits, "asking twice does it once");
    assert_eq!(desk.command(command(999)), Queued::Full);
    assert!(desk.withdraw(CommandId(1)));
    let first = next(&mut desk);
    assert_eq!(first.commands.len(), COMMANDS_WAITING_MAX - 1);
    assert!(!desk.withdraw(CommandId(0)), "it rides already");
    let again = sent(desk.overdue(first.at_ns + 50));
    assert_eq!(again.commands, first.commands, "the next owner gets them too");
    desk.check(&commit(&again)).unwrap();
    let taken = desk.take(again.at_ns + 60, commit(&again));
    assert_eq!(desk.command(command(0)), Queued::Waits, "only this home has it yet");
    assert_eq!(desk.kept(taken.position()).len(), COMMANDS_WAITING_MAX - 1);
    assert_eq!(
        desk.command(command(0)),
        Queued::Ended(Applied {
            id: CommandId(0),
            outcome: Outcome::Done
        })
    );
    assert!(next(&mut desk).commands.is_empty());
}

#[test]
fn an_outcome_is_told_when_its_record_outlives_the_home() {
    let mut desk = desk();
    let ask = |desk: &mut Desk, n: u128| {
        let body = CommandBody::Setpoint(2.0);
        desk.command(Command { id: CommandId(n), body })
    };
    let take = |desk: &mut Desk| {
        let sample = next(desk);
        desk.take(sample.at_ns + 1, commit(&sample))
    };
    assert_eq!(desk.unkept(), None);
    ask(&mut desk, 1);
    let first = take(&mut desk);
    ask(&mut desk, 2);
    let second = take(&mut desk);
    let third = take(&mut desk);
    assert_eq!(desk.unkept(), Some(second.position()), "the third holds nothing new");
    let (term, seq) = third.position();
    assert!(desk.kept((term, seq + 1)).is_empty(), "never taken");
    assert!(desk.kept((0, 0)).is_empty());
    let ids = |told: Vec<(Applied, Arc<Record>)>| told.into_iter().map(|(a, r)| (a.id.0, r.seq)).collect::<Vec<_>>();
    assert_eq!(ids(desk.kept(first.position())), [(1, first.seq)]);
    assert_eq!(
        ids(desk.kept(third.position())),
        [(2, second.seq)],
        "a later record holds it too"
    );
    assert!(desk.kept(third.position()).is_empty(), "told once");
    // Outcomes that may not be told yet take places of commands: what waits is bounded.
    for n in 10..10 + COMMANDS_WAITING_MAX as u128 {
        assert_eq!(ask(&mut desk, n), Queued::Waits);
    }
    take(&mut desk);
    assert_eq!(ask(&mut desk, 99), Queued::Full);
}

#[test]
fn after_a_restart_terms_and_cycles_go_on_beyond_what_was_known() {
    let mut last = test_record();
    (last.term, last.seq) = (7, 500);
    let mut desk = Desk::new(host(9), Arc::new(spec()), Some(Arc::new(last)), 1_000, 0);
    desk.set_members(1_000, vec![host(1)]);
    let sample = next(&mut desk);
    assert_eq!((sample.seq, sample.last), (501, (7, 500)));
    assert!(sample.term > 7 + TERMS_SKIPPED_AT_RESTART);
    assert!(sample.resume.is_some());
}

#[test]
fn fresh_is_what_arrived_since_the_last_record() {
    let mut desk = desk();
    let read = |at_ns| vec![Reading::good(1.0, at_ns)];
    let at = desk.deadline_at_ns();
    let first = sent(desk.deadline(at, read(90), None).map(|d| d.1));
    assert!(first.readings[0].fresh);
    let mut record = commit(&first);
    record.readings = first.readings.clone();
    desk.take(at + 1, record);
    let at = desk.deadline_at_ns();
    assert!(!sent(desk.deadline(at, read(90), None).map(|d| d.1)).readings[0].fresh);
    let at = desk.deadline_at_ns();
    assert!(sent(desk.deadline(at, read(91), None).map(|d| d.1)).readings[0].fresh);
}

#[derive(Debug, Clone)]
enum Happening {
    /// Time goes on by this part of a period, in percent.
    Wait(u64),
    /// A host answers the oldest sample that it holds.
    Answer(usize),
    /// It answers it twice.
    AnswerTwice(usize),
    /// It loses the oldest sample that it holds.
    Lose(usize),
    /// Its liveliness changes.
    Flip(usize),
    /// An operator sends a command.
    Command,
    /// The home is asked to move the loop.
    Move(usize),
}

fn happenings() -> impl Strategy<Value = Vec<Happening>> {
    prop::collection::vec(
        prop_oneof![
            4 => (1u64..80).prop_map(Happening::Wait),
            4 => (0usize..3).prop_map(Happening::Answer),
            1 => (0usize..3).prop_map(Happening::AnswerTwice),
            1 => (0usize..3).prop_map(Happening::Lose),
            1 => (0usize..3).prop_map(Happening::Flip),
            1 => Just(Happening::Command),
            1 => (0usize..3).prop_map(Happening::Move),
        ],
        1..300,
    )
}

proptest! {
    #[test]
    fn what_is_taken_is_one_chain_and_no_command_is_lost(happenings in happenings()) {
        let mut desk = desk();
        let (mut now, mut alive, mut boxes) = (0, [true; 3], [const { VecDeque::<Sample>::new() }; 3]);
        let (mut chain, mut commands, mut done) = (vec![(0, 0)], 0u128, std::collections::BTreeSet::new());
        let deliver = |dispatch: Option<Dispatch>, boxes: &mut [VecDeque<Sample>; 3]| {
            if let Some(Dispatch::Send(sample)) = dispatch {
                let i = (0..3).find(|&i| host(i) == sample.owner).unwrap();
                boxes[i].push_back(*sample);
            }
        };
        for happening in happenings {
            match happening {
                Happening::Wait(percent) => {
                    now += PERIOD_NS * percent / 100;
                    let overdue = desk.overdue(now);
                    deliver(overdue, &mut boxes);
                    let fired = desk.deadline(now, vec![], None).map(|(_, d)| d);
                    deliver(fired, &mut boxes);
                    prop_assert!(desk.due_at_ns() > now, "nothing that is due is left");
                }
                Happening::Answer(i) | Happening::AnswerTwice(i) => {
                    let twice = matches!(happening, Happening::AnswerTwice(_));
                    if let Some(sample) = boxes[i].pop_front() {
                        for _ in 0..=usize::from(twice) {
                            let record = commit(&sample);
                            if desk.check(&record).is_ok() {
                                let record = desk.take(now, record);
                                let before = *chain.last().unwrap();
                                prop_assert_eq!(record.after, before);
                                prop_assert!(record.position() > before && record.seq > before.1);
                                chain.push(record.position());
                                for applied in &record.applied {
                                    prop_assert!(done.insert(applied.id), "a command takes effect once");
                                }
                            }
                        }
                    }
                }
                Happening::Lose(i) => { boxes[i].pop_front(); }
                Happening::Flip(i) => {
                    alive[i] = !alive[i];
                    let members = (0..3).filter(|&i| alive[i]).map(host).collect();
                    let dispatch = desk.set_members(now, members);
                    deliver(dispatch, &mut boxes);
                }
                Happening::Command => {
                    commands += 1;
                    let queued = desk.command(Command { id: CommandId(commands), body: CommandBody::Setpoint(1.0) });
                    if queued != Queued::Waits { commands -= 1; }
                }
                Happening::Move(i) => desk.move_to(host(i)),
            }
        }
        // Quiet at last: everyone is alive and answers, so every command that was taken in comes to its end.
        let dispatch = desk.set_members(now, (0..3).map(host).collect());
        prop_assert!(dispatch.is_none() || matches!(dispatch, Some(Dispatch::Send(_))));
        for _ in 0..3 {
            now = desk.deadline_at_ns();
            let sample = sent(desk.deadline(now, vec![], None).map(|d| d.1));
            let record = commit(&sample);
            prop_assert!(desk.check(&record).is_ok());
            desk.take(now, record).applied.iter().for_each(|a| { done.insert(a.id); });
        }
        prop_assert_eq!(done.len() as u128, commands);
    }
}
