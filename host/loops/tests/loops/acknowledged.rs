//! When somebody is told that a command is done: not before its record outlives its home.

use std::sync::{Arc, atomic::Ordering};

use bumpless_core::{Command, CommandBody, CommandId, Record};
use bumpless_loops::CommandReply;
use crossbeam_channel::{Receiver, TryRecvError};

use crate::bench::{Bench, PATIENCE, loop_id};

/// Asks for a setpoint, and gives where its end will be told.
fn ask(bench: &Bench, number: u128, setpoint: f64) -> Receiver<CommandReply> {
    let (sender, reply) = crossbeam_channel::bounded(1);
    let command = Command {
        id: CommandId(number),
        body: CommandBody::Setpoint(setpoint),
    };
    let done = Box::new(move |reply| drop(sender.send(reply)));
    bench.at(&bench.home).command(&loop_id(), command, done).unwrap();
    reply
}

#[track_caller]
fn told(reply: &Receiver<CommandReply>) -> Arc<Record> {
    match reply.recv_timeout(PATIENCE).unwrap() {
        CommandReply::Applied { record, .. } => record,
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_home_alone_tells_of_it_when_its_disk_has_it() {
    let mut bench = Bench::new(&["plant"], |_| {});
    bench.next();
    let reply = ask(&bench, 1, 55.0);
    let (record, alone) = bench.outcomes.recv_timeout(PATIENCE).unwrap();
    assert!(alone, "no other host could keep it");
    bench.until("it is in force", |r| r.setpoint == 55.0);
    // The loop goes on meanwhile; nobody is told.
    for _ in 0..10 {
        bench.next();
    }
    assert!(matches!(reply.try_recv(), Err(TryRecvError::Empty)));
    // Asked again with the same id, it is the same wait.
    let again = ask(&bench, 1, 55.0);
    bench.at(&bench.home).kept(&loop_id(), record.position()).unwrap();
    assert_eq!(told(&reply).position(), record.position());
    assert_eq!(told(&again).position(), record.position());
    // From now on it is known to be done.
    let later = ask(&bench, 1, 55.0);
    assert_eq!(told(&later).setpoint, 55.0);
}

#[test]
fn with_other_members_one_of_them_must_have_it() {
    let mut bench = Bench::new(&["a", "b"], |_| {});
    bench.next();
    let reply = ask(&bench, 1, 55.0);
    assert_eq!(told(&reply).setpoint, 55.0);
    let (_, alone) = bench.outcomes.recv_timeout(PATIENCE).unwrap();
    assert!(!alone);
    // Records reach nobody: the owner goes on with what it made, but does not know that it was taken.
    bench.board.records_lost.store(true, Ordering::Relaxed);
    let reply = ask(&bench, 2, 60.0);
    bench.until("it is in force", |r| r.setpoint == 60.0);
    for _ in 0..10 {
        bench.next();
    }
    assert!(matches!(reply.try_recv(), Err(TryRecvError::Empty)));
    // Any later record has the outcome too.
    bench.board.records_lost.store(false, Ordering::Relaxed);
    assert_eq!(told(&reply).setpoint, 60.0);
}
