//! Is the plant believable? Balances, steady states, dead times, interlock, determinism.

#![allow(clippy::panic, reason = "tests")]

use super::*;

fn quiet() -> Plant {
    Plant::new(
        PlantSettings {
            noise: 0.0,
            ..PlantSettings::default()
        },
        0,
    )
}

fn run(plant: &mut Plant, seconds: f64) {
    for _ in 0..(seconds * 1000.0) as u64 {
        plant.step();
    }
}

#[test]
fn at_rest_nothing_moves_but_the_draining_tank() {
    let mut plant = quiet();
    plant.set_command(Command::Hv123, 0.0);
    let before = [Instrument::Lit125, Instrument::Tit127].map(|i| plant.true_value(i));
    run(&mut plant, 60.0);
    let after = [Instrument::Lit125, Instrument::Tit127].map(|i| plant.true_value(i));
    assert_eq!(before, after);
    assert!(plant.true_value(Instrument::Pit118).abs() < 1e-9);
    assert!(plant.true_value(Instrument::Fit116).abs() < 1e-9);
}

#[test]
fn line_pressure_and_flow_rise_with_the_pump_and_fall_with_the_valve() {
    let mut last = (-1.0, -1.0);
    for volts in [4.0, 6.0, 8.0, 10.0] {
        let mut plant = quiet();
        plant.set_command(Command::P2, volts);
        run(&mut plant, 15.0);
        let now = (
            plant.true_value(Instrument::Pit118),
            plant.true_value(Instrument::Fit116),
        );
        assert!(
            now.0 > last.0 + 0.1 && now.1 > last.1 + 0.1,
            "{volts} V: {now:?} after {last:?}"
        );
        last = now;
    }
    // At full speed the pump works between no flow and no head.
    assert!(
        (1.0..2.2).contains(&last.0) && (1.0..4.24).contains(&last.1),
        "{last:?}"
    );

    let mut throttled = quiet();
    throttled.set_command(Command::P2, 10.0);
    throttled.set_command(Command::Lv122, 4.0);
    run(&mut throttled, 20.0);
    assert!(throttled.true_value(Instrument::Pit118) > last.0 + 0.1);
    assert!(throttled.true_value(Instrument::Fit116) < last.1 - 0.3);

    // Dead-headed: the pressure is the pump's shut-off head.
    throttled.set_command(Command::Lv122, 0.0);
    run(&mut throttled, 20.0);
    let dead_head = throttled.true_value(Instrument::Pit118);
    assert!((dead_head - PUMP_SHUT_OFF_BAR).abs() < 0.01, "{dead_head}");
    assert!(throttled.true_value(Instrument::Fit116) < 0.01);
}

#[test]
fn the_steady_flow_solves_the_pressure_balance() {
    let mut plant = quiet();
    plant.set_command(Command::P2, 8.0);
    run(&mut plant, 30.0);
    let flow = plant.flow2;
    let kv = LV122_KV_L_S * RANGEABILITY.powf(plant.valve - 1.0);
    let losses = (PUMP_FRICTION + FRICTION_BEFORE + FRICTION_AFTER + 1.0 / (kv * kv)) * flow * flow;
    let head = PUMP_SHUT_OFF_BAR * plant.p2.speed * plant.p2.speed;
    assert!((head - TQ01_HEAD_BAR - losses).abs() < 1e-6, "{head} against {losses}");
}

#[test]
fn the_vessel_fills_holds_and_empties() {
    let mut plant = quiet();
    plant.set_command(Command::P1, 9.0);
    run(&mut plant, 120.0);
    let full = plant.true_value(Instrument::Pit129);
    assert!((1.0..1.9).contains(&full), "{full}");
    // Shut on both sides the vessel keeps its pressure: the check valve holds.
    plant.set_command(Command::Hv131, 0.0);
    run(&mut plant, 30.0);
    plant.set_command(Command::P1, 0.0);
    run(&mut plant, 5.0);
    let held = plant.true_value(Instrument::Pit129);
    run(&mut plant, 60.0);
    assert!((plant.true_value(Instrument::Pit129) - held).abs() < 1e-6);
    plant.set_command(Command::Hv131, 100.0);
    run(&mut plant, 300.0);
    assert!(plant.true_value(Instrument::Pit129) < 0.02);
}

#[test]
fn water_is_neither_made_nor_lost() {
    let mut plant = quiet();
    let before = plant.water_l();
    for (seconds, command, value) in [
        (40.0, Command::P1, 10.0),
        (60.0, Command::P2, 10.0),
        (60.0, Command::Hv123, 0.0),
        (60.0, Command::Lv122, 10.0),
        (60.0, Command::Hv131, 100.0),
        (60.0, Command::Hv123, 100.0),
        (60.0, Command::P1, 0.0),
    ] {
        plant.set_command(command, value);
        run(&mut plant, seconds);
        assert!(
            (plant.water_l() - before).abs() < 1e-6,
            "{command:?} {value}: {} L",
            plant.water_l()
        );
        assert!(plant.tq01 <= TQ01_L + 0.01 && plant.r01 < R01_L && plant.tq02 >= 0.0);
    }
}

#[test]
fn the_level_answers_to_pump_and_hand_valve() {
    let mut plant = quiet();
    plant.set_command(Command::P2, 8.0);
    run(&mut plant, 600.0);
    let level = plant.true_value(Instrument::Lit125);
    assert!((40.0..95.0).contains(&level), "{level}");
    // More outflow: the level settles lower.
    plant.set_command(Command::Hv123, 70.0);
    run(&mut plant, 600.0);
    assert!(plant.true_value(Instrument::Lit125) < level - 10.0);
}

#[test]
fn dead_times_are_visible() {
    let mut plant = quiet();
    plant.set_command(Command::P2, 10.0);
    run(&mut plant, 0.149);
    assert!(plant.true_value(Instrument::Pit118).abs() < 1e-12);
    run(&mut plant, 1.0);
    assert!(plant.true_value(Instrument::Pit118) > 0.05);

    let mut plant = quiet();
    plant.set_command(Command::Heater, 10.0);
    run(&mut plant, 1.9);
    assert!((plant.true_value(Instrument::Tit127) - ROOM_C).abs() < 1e-9);
    run(&mut plant, 60.0);
    assert!(plant.true_value(Instrument::Tit127) > ROOM_C + 0.3);

    let mut plant = quiet();
    plant.set_command(Command::Lv122, 0.0);
    run(&mut plant, 0.399);
    assert!((plant.valve - 0.8).abs() < 1e-12);
    run(&mut plant, 4.0);
    // Half the stroke in four seconds: the motor has one speed.
    assert!((plant.valve - 0.3).abs() < 0.01, "{}", plant.valve);
}

#[test]
fn the_low_level_switch_stops_the_pumps_until_water_is_back() {
    let mut plant = quiet();
    plant.set_command(Command::Hv123, 0.0);
    plant.set_command(Command::P1, 10.0);
    plant.set_command(Command::P2, 10.0);
    plant.set_command(Command::Hv114, 100.0);
    for _ in 0..300 {
        if !plant.tripped() {
            run(&mut plant, 1.0);
        }
    }
    assert!(plant.tripped());
    plant.set_command(Command::Hv114, 0.0);
    run(&mut plant, 3.0);
    assert!(plant.tripped());
    assert!(plant.true_value(Instrument::Pit118) < 0.01, "both pumps stand");
    let (tq01, r01) = (plant.tq01, plant.r01);
    run(&mut plant, 5.0);
    assert!(plant.tq01 <= tq01 && plant.r01 < r01);
    plant.set_command(Command::Refill, 1.0);
    run(&mut plant, 60.0);
    assert!(!plant.tripped());
    assert!(
        plant.true_value(Instrument::Pit118) > 0.5,
        "they run again by themselves"
    );
}

#[test]
fn same_seed_and_commands_give_the_same_bits() {
    let trace = |seed| {
        let mut plant = Plant::new(PlantSettings::default(), seed);
        let mut bits = Vec::new();
        for n in 0..20_000_u32 {
            if n % 500 == 0 {
                plant.set_command(Command::P2, f64::from(n % 11));
                plant.set_command(Command::P1, f64::from(n % 7));
            }
            plant.step();
            bits.push(plant.current_ma(Instrument::Pit118).to_bits() ^ plant.current_ma(Instrument::Pit129).to_bits());
        }
        bits
    };
    assert_eq!(trace(5), trace(5));
    assert_ne!(trace(5), trace(6));
}

#[test]
fn instruments_are_noisy_stepped_and_can_break() {
    let mut plant = Plant::new(PlantSettings::default(), 1);
    plant.set_command(Command::P2, 7.0);
    run(&mut plant, 20.0);
    let mut seen = Vec::new();
    for _ in 0..2000 {
        plant.step();
        seen.push(plant.current_ma(Instrument::Pit118));
    }
    let mean = seen.iter().sum::<f64>() / seen.len() as f64;
    let deviation = (seen.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / seen.len() as f64).sqrt();
    assert!(
        (0.015..0.035).contains(&deviation),
        "0.15 % of 16 mA are 0.024: {deviation}"
    );
    let step = 22.0 / 4095.0;
    assert!(seen.iter().all(|ma| ((ma / step) - (ma / step).round()).abs() < 1e-6));
    let expected = current_ma(plant.true_value(Instrument::Pit118) / 2.5);
    assert!((mean - expected).abs() < 0.05, "{mean} against {expected}");

    plant.set_broken(Instrument::Pit118, true);
    assert!(plant.current_ma(Instrument::Pit118).abs() < 1e-12);
    plant.set_broken(Instrument::Pit118, false);
    assert!(plant.current_ma(Instrument::Pit118) > 4.0);
    // No flow reads exactly nothing: the low-flow cut-off swallows the noise.
    let rest = Plant::new(PlantSettings::default(), 1);
    assert!((rest.current_ma(Instrument::Fit116) - 4.0).abs() < 22.0 / 4095.0);
}

#[test]
fn heat_stays_within_reason() {
    let mut plant = quiet();
    plant.set_command(Command::Heater, 10.0);
    plant.set_command(Command::P2, 9.0);
    run(&mut plant, 1200.0);
    let warm = plant.true_value(Instrument::Tit127);
    // 3 kW for 20 min into 60 L: 14 K less the losses.
    assert!((ROOM_C + 9.0..ROOM_C + 15.0).contains(&warm), "{warm}");
    assert!(plant.tq01_c > ROOM_C + 5.0, "the water goes round");
}
