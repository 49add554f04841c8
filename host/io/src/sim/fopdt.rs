//! A first-order process with dead time, solved exactly between the changes of its input.
//!
//! Never: steps. However long nobody looks, the next look costs the changes in between and no more, so that one host can
//! carry tens of thousands of loops.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

use crate::{
    limits::{DEAD_TIME_S_MAX, FOPDT_CHANGES_MAX, FOPDT_COUNT_MAX},
    sim::noise,
};

/// `tau · dy/dt + y = gain · u(t − dead time) + load`, all in % of span.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FopdtSettings {
    /// How many loops, each on its own.
    pub count: u32,
    /// % of measurement per % of output.
    pub gain: f64,
    /// Time constant, in s.
    pub tau_s: f64,
    /// Dead time between output and process, in s.
    pub dead_time_s: f64,
    /// Standard deviation of the measurement's noise, in %.
    pub noise: f64,
}

impl Default for FopdtSettings {
    fn default() -> Self {
        Self {
            count: 1,
            gain: 1.0,
            tau_s: 1.0,
            dead_time_s: 0.1,
            noise: 0.0,
        }
    }
}

impl FopdtSettings {
    /// Checks the numbers.
    ///
    /// # Errors
    /// In words, where one makes no sense.
    pub fn check(&self) -> Result<(), String> {
        let wrong = |problem: String| Err(problem);
        if !(1..=FOPDT_COUNT_MAX).contains(&self.count) {
            return wrong(format!("fopdt.count must be 1 to {FOPDT_COUNT_MAX}"));
        }
        if !(self.gain.is_finite() && self.gain != 0.0) {
            return wrong("fopdt.gain must be a number other than 0".to_owned());
        }
        if !(self.tau_s.is_finite() && self.tau_s > 0.0) {
            return wrong("fopdt.tau_s must be greater than 0 seconds".to_owned());
        }
        if !(0.0..=DEAD_TIME_S_MAX).contains(&self.dead_time_s) {
            return wrong(format!("fopdt.dead_time_s must be 0 to {DEAD_TIME_S_MAX} seconds"));
        }
        if !(self.noise.is_finite() && self.noise >= 0.0) {
            return wrong("fopdt.noise must be 0 or more".to_owned());
        }
        Ok(())
    }
}

#[derive(Debug, Clone, Copy)]
enum Change {
    Output(f64),
    Load(f64),
}

/// One loop. Times are those of the caller, in ns; a time before the last change counts as that change's.
#[derive(Debug, Clone)]
pub struct Fopdt {
    gain: f64,
    tau_ns: f64,
    dead_ns: u64,
    noise: f64,
    seed: u64,
    source: u64,
    /// What the actuator was told last.
    output: f64,
    /// What was last set as load.
    load: f64,
    /// What reaches the process.
    acting_output: f64,
    acting_load: f64,
    /// The measurement at the last change that reached the process, and when that was.
    value: f64,
    value_at_ns: u64,
    /// Changes on their way: when each reaches the process. In order of time.
    waiting: VecDeque<(u64, Change)>,
}

impl Fopdt {
    /// At rest with everything at 0. `source` tells the loops of one seed apart.
    #[must_use]
    pub fn new(settings: &FopdtSettings, seed: u64, source: u64, start_ns: u64) -> Self {
        Self {
            gain: settings.gain,
            tau_ns: settings.tau_s * 1e9,
            dead_ns: (settings.dead_time_s * 1e9) as u64,
            noise: settings.noise,
            seed,
            source,
            output: 0.0,
            load: 0.0,
            acting_output: 0.0,
            acting_load: 0.0,
            value: 0.0,
            value_at_ns: start_ns,
            waiting: VecDeque::with_capacity(16),
        }
    }

    /// The measurement at `now_ns`, with its noise (one value per ms).
    pub fn measured(&mut self, now_ns: u64) -> f64 {
        self.settle(now_ns);
        let value = self.value_at(now_ns);
        if self.noise == 0.0 {
            value
        } else {
            value + self.noise * noise::normal(self.seed, self.source, now_ns / 1_000_000)
        }
    }

    /// Sets the actuator; the process feels it after the dead time.
    pub fn set_output(&mut self, output: f64, now_ns: u64) {
        self.output = output;
        self.push(now_ns.saturating_add(self.dead_ns), Change::Output(output));
    }

    /// Sets the load, in % at the measurement's end; the process feels it at once.
    pub fn set_load(&mut self, load: f64, now_ns: u64) {
        self.load = load;
        self.push(now_ns, Change::Load(load));
    }

    /// What the actuator holds.
    #[must_use]
    pub const fn output(&self) -> f64 {
        self.output
    }

    /// The load that was set.
    #[must_use]
    pub const fn load(&self) -> f64 {
        self.load
    }

    fn push(&mut self, at_ns: u64, change: Change) {
        self.settle(at_ns.saturating_sub(self.dead_ns));
        let same_kind = |other: &Change| {
            matches!(
                (other, &change),
                (Change::Output(_), Change::Output(_)) | (Change::Load(_), Change::Load(_))
            )
        };
        // Full: the youngest change of the same kind gives way, so the final value is still right.
        if self.waiting.len() >= FOPDT_CHANGES_MAX
            && let Some(last) = self.waiting.iter_mut().rev().find(|(_, c)| same_kind(c))
        {
            last.1 = change;
            return;
        }
        let position = self.waiting.partition_point(|(other_ns, _)| *other_ns <= at_ns);
        self.waiting.insert(position, (at_ns, change));
    }

    /// Lets every change that is due by `now_ns` reach the process.
    fn settle(&mut self, now_ns: u64) {
        while let Some((at_ns, change)) = self.waiting.front().copied() {
            if at_ns > now_ns {
                break;
            }
            self.waiting.pop_front();
            self.value = self.value_at(at_ns);
            self.value_at_ns = self.value_at_ns.max(at_ns);
            match change {
                Change::Output(output) => self.acting_output = output,
                Change::Load(load) => self.acting_load = load,
            }
        }
    }

    /// The exact solution with the present input.
    pub(crate) fn value_at(&self, at_ns: u64) -> f64 {
        let rest = self.gain * self.acting_output + self.acting_load;
        let passed_ns = at_ns.saturating_sub(self.value_at_ns) as f64;
        rest + (self.value - rest) * (-passed_ns / self.tau_ns).exp()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: u64 = 1_000_000_000;

    fn settings() -> FopdtSettings {
        FopdtSettings {
            count: 1,
            gain: 2.0,
            tau_s: 4.0,
            dead_time_s: 1.5,
            noise: 0.0,
        }
    }

    #[test]
    fn a_step_shows_dead_time_gain_and_time_constant() {
        let mut process = Fopdt::new(&settings(), 0, 0, 100 * S);
        process.set_output(10.0, 100 * S);
        assert!(process.measured(101 * S).abs() < 1e-12);
        assert!(process.measured(101 * S + S / 2).abs() < 1e-12);
        // One time constant after the dead time: 1 − 1/e of the way.
        let one_tau = process.measured(105 * S + S / 2);
        assert!((one_tau - 20.0 * (1.0 - (-1.0_f64).exp())).abs() < 1e-9, "{one_tau}");
        assert!((process.measured(300 * S) - 20.0).abs() < 1e-9);
        process.set_load(-5.0, 300 * S);
        assert!((process.measured(400 * S) - 15.0).abs() < 1e-6);
        assert!((process.output() - 10.0).abs() < 1e-12);
    }

    #[test]
    fn looking_changes_nothing() {
        let noisy = FopdtSettings {
            noise: 0.5,
            ..settings()
        };
        let (mut seen, mut unseen) = (Fopdt::new(&noisy, 9, 4, 0), Fopdt::new(&noisy, 9, 4, 0));
        for second in 0..50 {
            let u = f64::from(second % 7);
            seen.set_output(u, u64::from(second as u32) * S);
            unseen.set_output(u, u64::from(second as u32) * S);
            for part in 0..10 {
                seen.measured(u64::from(second as u32) * S + part * S / 10);
            }
        }
        assert_eq!(seen.measured(60 * S).to_bits(), unseen.measured(60 * S).to_bits());
        // Another loop of the same seed has other noise.
        let mut other = Fopdt::new(&noisy, 9, 5, 0);
        assert!((other.measured(0) - Fopdt::new(&noisy, 9, 4, 0).measured(0)).abs() > 1e-9);
    }

    #[test]
    fn changes_on_the_way_are_bounded_and_the_last_one_counts() {
        let mut process = Fopdt::new(
            &FopdtSettings {
                dead_time_s: 600.0,
                ..settings()
            },
            0,
            0,
            0,
        );
        for n in 0..(FOPDT_CHANGES_MAX as u32 * 2) {
            process.set_output(f64::from(n % 50) + 1.0, u64::from(n));
        }
        process.set_output(30.0, 1_000_000);
        assert!(process.waiting.len() <= FOPDT_CHANGES_MAX);
        assert!((process.measured(1_000 * S) - 60.0).abs() < 1e-9);
    }

    #[test]
    fn a_load_overtakes_an_output_on_its_way() {
        let mut process = Fopdt::new(&settings(), 0, 0, 0);
        process.set_output(10.0, 0);
        process.set_load(3.0, S);
        let early = process.measured(S + S / 4);
        assert!(early > 0.1 && early < 3.0, "{early}");
        assert!((process.measured(100 * S) - 23.0).abs() < 1e-6);
    }
}
