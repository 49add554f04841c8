//! Calls of guests that behave: what goes in and what comes out.

use bumpless_core::{AlarmChange, Fault, LogLevel, LogLine, Message, Mode, NoData, Priority, Reading};
use bumpless_engine::Origin;

use crate::guest::{Guest, PATIENCE_NS, frame, instance, prepare, state};

#[test]
fn a_step_reads_writes_and_returns_its_state() {
    let mut law = instance(&Guest::good());
    let first = law.start(&[1.0], &[40.0], PATIENCE_NS).unwrap();
    assert_eq!(first, state(40.0));
    let effects = law.step(&frame(2.5), &first, PATIENCE_NS).unwrap();
    assert_eq!(effects.state, state(42.5));
    assert_eq!(effects.writes, [(1, 42.5)]);
    assert!(effects.messages.is_empty() && effects.alarms.is_empty() && effects.log.is_empty());
    assert!(law.last_step_ns() > 0);
}

#[test]
fn a_state_is_taken_over() {
    let mut law = instance(&Guest::good());
    let from = Origin {
        name: "sum".into(),
        version: "1.0.0".into(),
        state_layout: 7,
    };
    assert_eq!(
        law.migrate(&from, &state(3.0), &[1.0], &[0.0], PATIENCE_NS).unwrap(),
        state(3.0)
    );
}

#[test]
fn a_guests_own_faults_come_out_in_its_words_and_leave_it_alive() {
    let expected: [fn(String) -> Fault; 4] = [Fault::BadParameter, Fault::BadState, Fault::BadInput, Fault::Failed];
    for (case, fault) in expected.into_iter().enumerate() {
        let declines = Guest {
            migrate: format!("(call $fault (i32.const {case}))"),
            ..Guest::good()
        };
        let mut law = instance(&declines);
        let from = Origin {
            name: "other".into(),
            version: "1.0.0".into(),
            state_layout: 1,
        };
        assert_eq!(
            law.migrate(&from, &[], &[], &[], PATIENCE_NS).unwrap_err(),
            fault("sum".to_owned())
        );
        assert!(law.step(&frame(1.0), &state(0.0), PATIENCE_NS).is_ok());
    }
}

#[test]
fn the_cycle_and_the_timer_tell_the_frames_numbers() {
    // state = sequence, time, dt, now, since, connected, count, mode, setpoint
    let law = Guest::step(
        "(i64.store (i32.const 512) (local.get $seq))
         (i64.store (i32.const 520) (local.get $time))
         (i64.store (i32.const 528) (local.get $dt))
         (i64.store (i32.const 536) (call $now))
         (i64.store (i32.const 544) (call $since))
         (i64.store (i32.const 552) (local.get $connected))
         (i64.store (i32.const 560) (i64.extend_i32_u (call $count)))
         (i64.store (i32.const 568) (i64.extend_i32_u (local.get $mode)))
         (f64.store (i32.const 576) (local.get $setpoint))
         (call $ok (i32.const 512) (i32.const 72))",
    );
    let mut frame = frame(0.0);
    frame.readings[0] = Reading::unconnected();
    let bytes = instance(&law).step(&frame, &[], PATIENCE_NS).unwrap().state;
    let numbers: Vec<u64> = bytes
        .chunks(8)
        .map(|c| u64::from_le_bytes(c.try_into().unwrap()))
        .collect();
    assert_eq!(numbers, [7, 5000, 100, 5000, 100, 0b10, 2, 1, 3.0_f64.to_bits()]);
    frame.cycle.mode = Mode::Manual;
    frame.readings.truncate(1);
    let bytes = instance(&law).step(&frame, &[], PATIENCE_NS).unwrap().state;
    assert_eq!(bytes[40], 0, "a port without a reading is not connected");
    assert_eq!(bytes[56], 0, "manual");
}

#[test]
fn readings_carry_quality_age_and_freshness() {
    // The record of a reading is 32 bytes: value, quality, age, fresh.
    let law = Guest::step("(call $read (i32.const 0) (i32.const 512)) (call $ok (i32.const 512) (i32.const 25))");
    let mut law = instance(&law);
    let mut read = |reading| {
        let mut frame = frame(0.0);
        frame.readings[0] = reading;
        let s = law.step(&frame, &[], PATIENCE_NS).unwrap().state;
        let age = u64::from_le_bytes(s[16..24].try_into().unwrap());
        (f64::from_le_bytes(s[..8].try_into().unwrap()), s[8], age, s[24])
    };
    assert_eq!(read(Reading::good(1.5, 4000)), (1.5, 0, 1000, 1));
    assert_eq!(read(Reading::missing(NoData::CommsLost, 9.5, 3000)), (9.5, 2, 2000, 0));
    assert_eq!(
        read(Reading {
            fresh: false,
            ..Reading::good(1.0, 6000)
        }),
        (1.0, 0, 0, 0)
    );
    assert_eq!(read(Reading::good(f64::INFINITY, 5000)), (0.0, 2, 0, 1));
}

#[test]
fn ports_are_found_by_name() {
    // "in" is the first port's name, in the descriptor at 1024+48.
    let law = Guest::step(
        "(call $find (i32.load (i32.const 1104)) (i32.load (i32.const 1108)) (i32.const 512))
         (call $find (i32.const 0) (i32.const 0) (i32.const 520))
         (call $ok (i32.const 512) (i32.const 16))",
    );
    let found = instance(&law).step(&frame(0.0), &[], PATIENCE_NS).unwrap().state;
    assert_eq!((found[0], found[4]), (1, 1), "\"out\" is port 1");
    assert_eq!(found[8], 0, "no port is called nothing");
}

#[test]
fn messages_alarms_and_lines_travel_with_the_effects() {
    // The name of the component serves as topic, alarm name and text; the message received is sent back.
    let name = "(i32.load (i32.const 1024)) (i32.load (i32.const 1028))";
    let law = Guest::step(&format!(
        "(call $receive (i32.const 256))
         (call $publish {name} (i32.load (i32.const 268)) (i32.load (i32.const 272)))
         (call $receive (i32.const 256))
         (if (i32.load8_u (i32.const 256)) (then unreachable))
         (call $raise {name} (i32.const 2) {name})
         (call $clear {name})
         (call $log (i32.const 1) {name})
         (call $ok (local.get $state) (local.get $state_len))"
    ));
    let mut frame = frame(0.0);
    frame.messages.push(Message {
        topic: "level".into(),
        data: vec![1, 2, 3],
    });
    let mut law = instance(&law);
    for _ in 0..2 {
        let effects = law.step(&frame, &[], PATIENCE_NS).unwrap();
        assert_eq!(
            effects.messages,
            [Message {
                topic: "sum".into(),
                data: vec![1, 2, 3]
            }]
        );
        let raised = AlarmChange {
            name: "sum".into(),
            raised: Some((Priority::High, "sum".into())),
        };
        assert_eq!(
            effects.alarms,
            [
                raised,
                AlarmChange {
                    name: "sum".into(),
                    raised: None
                }
            ]
        );
        assert_eq!(
            effects.log,
            [LogLine {
                level: LogLevel::Info,
                text: "sum".into()
            }]
        );
    }
}

#[test]
fn the_last_write_of_a_step_counts_and_none_is_kept_for_the_next() {
    let law = Guest::step(
        "(if (f64.ne (local.get $setpoint) (f64.const 0))
           (then (call $write (i32.const 1) (f64.const 1)) (call $write (i32.const 1) (f64.const 2))))
         (call $ok (local.get $state) (local.get $state_len))",
    );
    let mut law = instance(&law);
    assert_eq!(law.step(&frame(0.0), &[], PATIENCE_NS).unwrap().writes, [(1, 2.0)]);
    let mut quiet = frame(0.0);
    quiet.cycle.setpoint = 0.0;
    assert_eq!(law.step(&quiet, &[], PATIENCE_NS).unwrap().writes, []);
}

#[test]
fn a_fresh_and_a_used_instance_give_the_same_bytes() {
    let prepared = prepare(&Guest::good());
    let mut used = prepared.instantiate().unwrap();
    for i in 0..100 {
        used.step(&frame(f64::from(i)), &state(0.1), PATIENCE_NS).unwrap();
    }
    let mut fresh = prepared.instantiate().unwrap();
    for input in [0.1, -3.0, 1e300, f64::MIN_POSITIVE] {
        let (a, b) = (
            used.step(&frame(input), &state(0.2), PATIENCE_NS),
            fresh.step(&frame(input), &state(0.2), PATIENCE_NS),
        );
        assert_eq!(a.unwrap(), b.unwrap());
    }
}

#[test]
fn nan_has_one_bit_pattern_on_every_host() {
    // 0/0 and a NaN with a payload through an addition: both come out as the canonical NaN.
    let law = Guest::step(
        "(f64.store (i32.const 512) (f64.div (f64.const 0) (local.get $setpoint)))
         (f64.store (i32.const 520) (f64.add (f64.const nan:0x4000000000001) (local.get $setpoint)))
         (call $ok (i32.const 512) (i32.const 16))",
    );
    let mut frame = frame(0.0);
    frame.cycle.setpoint = 0.0;
    let canonical = 0x7ff8_0000_0000_0000_u64.to_le_bytes();
    assert_eq!(
        instance(&law).step(&frame, &[], PATIENCE_NS).unwrap().state,
        [canonical, canonical].concat()
    );
}
