//! A model in the host's time, on a thread of its own.
//!
//! ```text
//! write ──► wanted (latest per signal) ──┐                    ┌──► shown (one value per signal) ──► read
//!                                        ▼                    │
//!                         every step: set, advance to now, copy out ── halted: points go bad, the thread ends
//! ```
//! Readers and writers take a lock that is held for some copies, never for a step of the model: a component that spins cannot
//! hold up a cycle. After a pause of more than `PLANT_CATCH_UP_MS_MAX` the model stood still for the rest of it.

use std::{
    sync::Arc,
    thread::JoinHandle,
    time::{Duration, Instant},
};

use bumpless_core::{NoData, Reading};
use parking_lot::{Condvar, Mutex};

use super::model::{CATCH_UP_NS_MAX, Model, Signal, SignalRole};

/// What readers see and writers leave.
#[derive(Debug)]
struct Shown {
    values: Vec<f64>,
    /// Host time that the values belong to, in ns.
    at_ns: u64,
    /// Writes that the model has not seen, one place per signal: the latest counts.
    wanted: Vec<Option<f64>>,
    halted: Option<String>,
    stop: bool,
}

/// A model that runs.
#[derive(Debug)]
pub(crate) struct Paced {
    signals: Vec<Signal>,
    shared: Arc<(Mutex<Shown>, Condvar)>,
    thread: Mutex<Option<JoinHandle<()>>>,
}

impl Paced {
    /// Starts the model's thread; it advances every `step`. `start_ns` is host time now.
    pub(crate) fn start(model: Box<dyn Model>, bus: &str, step: Duration, start_ns: u64) -> std::io::Result<Self> {
        let signals = model.signals().to_vec();
        let shown = Shown {
            values: (0..signals.len()).map(|n| model.shown(n)).collect(),
            at_ns: start_ns,
            wanted: vec![None; signals.len()],
            halted: None,
            stop: false,
        };
        let shared = Arc::new((Mutex::new(shown), Condvar::new()));
        let (theirs, name) = (Arc::clone(&shared), bus.to_owned());
        let thread = std::thread::Builder::new()
            .name(format!("plant-{name}"))
            .spawn(move || keep(model, &theirs, &name, step, start_ns))?;
        Ok(Self {
            signals,
            shared,
            thread: Mutex::new(Some(thread)),
        })
    }

    pub(crate) fn signals(&self) -> &[Signal] {
        &self.signals
    }

    pub(crate) fn read(&self, signal: usize, now_ns: u64) -> Reading {
        let shown = self.shared.0.lock();
        let Some((value, role)) = shown.values.get(signal).zip(self.signals.get(signal).map(|s| s.role)) else {
            return Reading::unconnected();
        };
        let at_ns = shown.at_ns.min(now_ns);
        // What was set and is not yet taken is what the actuator holds.
        let set = shown.wanted.get(signal).copied().flatten();
        match (set, shown.halted.is_some(), value.is_finite()) {
            (Some(set), false, _) if role != SignalRole::Measures => Reading::good(set, now_ns),
            (_, true, true) => Reading::missing(NoData::CommsLost, *value, at_ns),
            (_, false, true) if role == SignalRole::Measures => Reading::good(*value, at_ns),
            (_, false, true) => Reading::good(*value, now_ns),
            (_, _, false) => Reading::missing(NoData::OutOfRange, 0.0, at_ns),
        }
    }

    pub(crate) fn set(&self, signal: usize, value: f64) {
        if let Some(slot) = self.shared.0.lock().wanted.get_mut(signal) {
            *slot = Some(value);
        }
    }

    /// Why the model stopped, if it did.
    pub(crate) fn halted(&self) -> Option<String> {
        self.shared.0.lock().halted.clone()
    }

    /// Ends the thread. A step of the model that is under way ends first; the sandbox bounds it.
    pub(crate) fn stop(&self) {
        self.shared.0.lock().stop = true;
        self.shared.1.notify_all();
        if let Some(thread) = self.thread.lock().take() {
            // A model that panicked has nothing more to say.
            let _ = thread.join();
        }
    }
}

impl Drop for Paced {
    fn drop(&mut self) {
        self.stop();
    }
}

/// The thread's work. Absolute deadlines, so that lateness does not add up.
fn keep(mut model: Box<dyn Model>, shared: &(Mutex<Shown>, Condvar), bus: &str, step: Duration, start_ns: u64) {
    let began = Instant::now();
    let (mut next, mut skipped_ns, mut reached_ns) = (began + step, 0, 0);
    let mut values = vec![0.0; model.signals().len()];
    loop {
        let wanted = {
            let mut shown = shared.0.lock();
            while !shown.stop && Instant::now() < next {
                shared.1.wait_until(&mut shown, next);
            }
            if shown.stop {
                return;
            }
            shown.wanted.iter_mut().map(Option::take).collect::<Vec<_>>()
        };
        let passed_ns = u64::try_from(began.elapsed().as_nanos()).unwrap_or(u64::MAX);
        let behind_ns = passed_ns.saturating_sub(skipped_ns).saturating_sub(reached_ns);
        skipped_ns += behind_ns.saturating_sub(CATCH_UP_NS_MAX);
        for (signal, value) in wanted.into_iter().enumerate() {
            if let Some(value) = value {
                model.set(signal, value);
            }
        }
        reached_ns = passed_ns - skipped_ns;
        let moved = model.advance(reached_ns);
        for (signal, value) in values.iter_mut().enumerate() {
            *value = model.shown(signal);
        }
        let mut shown = shared.0.lock();
        shown.values.copy_from_slice(&values);
        shown.at_ns = start_ns.saturating_add(passed_ns);
        if let Err(halted) = moved {
            tracing::error!(bus, "{halted}; its points are bad until the host starts again");
            shown.halted = Some(halted.to_string());
            return;
        }
        drop(shown);
        // Steps that were missed are made up for by a longer one, not by a burst.
        while next <= Instant::now() {
            next += step;
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use super::*;
    use crate::sim::{
        LinearSettings,
        model::{Stock, stock},
    };

    #[test]
    fn a_model_moves_in_the_hosts_time_and_ends_when_told() {
        let model = stock(
            &Stock::Linear(LinearSettings {
                gain: 2.0,
                lags_s: vec![0.001],
                ..LinearSettings::default()
            }),
            0,
        );
        let paced = Paced::start(model.unwrap(), "t", Duration::from_millis(1), 0).unwrap();
        paced.set(1, 3.0);
        assert_eq!(paced.read(1, 7).value, Ok(3.0));
        let until = Instant::now() + Duration::from_secs(10);
        while paced.read(0, u64::MAX).value != Ok(6.0) && Instant::now() < until {
            std::thread::yield_now();
        }
        let value = paced.read(0, u64::MAX).value.unwrap();
        assert!((value - 6.0).abs() < 1e-6, "{value}");
        assert!(paced.read(9, 0).value.is_err());
        paced.stop();
    }

    #[derive(Debug)]
    struct Dies(Vec<Signal>);

    impl Model for Dies {
        fn signals(&self) -> &[Signal] {
            &self.0
        }
        fn advance(&mut self, _: u64) -> Result<(), super::super::model::Halted> {
            Err(super::super::model::Halted("it is broken".to_owned()))
        }
        fn truth(&self, _: usize) -> f64 {
            4.0
        }
        fn set(&mut self, _: usize, _: f64) {}
    }

    #[test]
    fn a_model_that_fails_makes_its_points_bad() {
        let signals = vec![super::super::model::signal(
            "pv",
            SignalRole::Measures,
            "",
            (0.0, 9.0),
            "",
        )];
        let paced = Paced::start(Box::new(Dies(signals)), "t", Duration::from_millis(1), 0).unwrap();
        let until = Instant::now() + Duration::from_secs(10);
        while paced.halted().is_none() && Instant::now() < until {
            std::thread::yield_now();
        }
        assert_eq!(paced.halted().unwrap(), "the plant's model stopped: it is broken");
        let reading = paced.read(0, u64::MAX);
        assert_eq!((reading.value, reading.last_good), (Err(NoData::CommsLost), 4.0));
    }
}
