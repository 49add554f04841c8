//! The checks of an experiment that need nothing but its text. Each refusal names the place and the cure.
//!
//! Never: looks at a component or a plant; `lab` does.

use bumpless_core::{Strategy, limits as core_limits};

use super::{Event, Experiment, LoopPlan, is_name};
use crate::{
    error::Error,
    limits::{CYCLES_MAX, DURATION_S_MAX, HOSTS_MAX, LOOPS_MAX},
};

impl Experiment {
    /// Checks what needs nothing but the text.
    pub(crate) fn check(&self, place: &str) -> Result<(), Error> {
        let wrong = |inner: &str, problem: String| Err(Error::at(format!("{place}: {inner}"), problem));
        if !is_name(&self.name) {
            return wrong("name", "use 1 to 64 letters, digits, dashes and dots".to_owned());
        }
        if !(self.duration_s > 0.0 && self.duration_s <= DURATION_S_MAX) {
            return wrong(
                "duration_s",
                format!("it must be greater than 0 and at most {DURATION_S_MAX}"),
            );
        }
        if self.seeds.list().is_empty() {
            return wrong("seeds", "at least one is needed".to_owned());
        }
        self.check_plant(place)?;
        if !(1..=LOOPS_MAX).contains(&self.loops.len()) {
            return wrong("[[loop]]", format!("1 to {LOOPS_MAX} loops are possible"));
        }
        let mut cycles = 0.0;
        for (n, plan) in self.loops.iter().enumerate() {
            self.check_loop(plan, place)?;
            if self.loops.iter().take(n).any(|other| other.name == plan.name) {
                return wrong(&format!("loop {:?}", plan.name), "two loops have this name".to_owned());
            }
            cycles += self.duration_s * 1e3 / plan.period_ms;
        }
        if cycles > CYCLES_MAX {
            return wrong(
                "duration_s",
                format!(
                    "{cycles:.0} cycles are asked for; at most {CYCLES_MAX:.0} make a run: shorten it or slow it down"
                ),
            );
        }
        self.check_surroundings(place)
    }

    fn check_plant(&self, place: &str) -> Result<(), Error> {
        let wrong = |problem: String| Err(Error::at(format!("{place}: [plant]"), problem));
        let p = &self.plant;
        let tables = [
            ("pilot", p.pilot.is_some()),
            ("fopdt", p.fopdt.is_some()),
            ("linear", p.linear.is_some()),
            ("recorded", p.recorded.is_some()),
            ("component", !p.constants.is_empty()),
        ];
        let kind = p.model.split(':').next().unwrap_or_default();
        if !tables.iter().any(|(name, _)| *name == kind) || (kind == "component") != p.model.contains(':') {
            return wrong(format!(
                "model = {:?} is unknown: use pilot, fopdt, linear, recorded, component:NAME or component:PATH",
                p.model
            ));
        }
        if let Some((other, _)) = tables.iter().find(|(name, given)| *given && *name != kind) {
            let field = if *other == "component" { "constants" } else { other };
            return wrong(format!("{field} belongs to another model than {:?}", p.model));
        }
        if kind == "recorded" && p.recorded.is_none() {
            return wrong("a recorded plant needs recorded = { file = \"…\" }".to_owned());
        }
        Ok(())
    }

    fn check_loop(&self, plan: &LoopPlan, place: &str) -> Result<(), Error> {
        let wrong = |problem: String| Err(Error::at(format!("{place}: loop {:?}", plan.name), problem));
        if bumpless_core::LoopId::new(plan.name.as_str()).is_err() {
            return wrong("its name is no loop's name: use lower-case letters, digits, dots and dashes".to_owned());
        }
        let period_ns = plan.period_ms * 1e6;
        let (least, most) = (core_limits::PERIOD_NS_MIN as f64, core_limits::PERIOD_NS_MAX as f64);
        if !(period_ns >= least && period_ns <= most) {
            return wrong("period_ms must be 1 to 3,600,000".to_owned());
        }
        if !(plan.phase_ms >= 0.0 && plan.phase_ms < plan.period_ms) {
            return wrong("phase_ms must be 0 or more, and less than period_ms".to_owned());
        }
        if let Strategy::Vote(n) = plan.strategy
            && usize::from(n) > self.cell.hosts.len()
        {
            return wrong(format!(
                "strategy: vote({n}) needs {n} hosts that control, and cell.host names {}",
                self.cell.hosts.len()
            ));
        }
        if self.controller_of(plan).is_none() {
            return wrong("it has no controller: write [controller] for all loops, or one here".to_owned());
        }
        if plan.setpoint.first().is_none_or(|first| first.at_s != 0.0) {
            return wrong("setpoint must begin at 0 s: setpoint = [{ at_s = 0, to = 1 }]".to_owned());
        }
        if !plan.setpoint.windows(2).all(|w| w[0].at_s + w[0].over_s <= w[1].at_s) {
            return wrong("the moves of the setpoint must come one after the other".to_owned());
        }
        if !plan.setpoint.iter().all(|m| m.to.is_finite() && m.over_s >= 0.0) {
            return wrong("a move of the setpoint needs a finite to, and over_s of 0 or more".to_owned());
        }
        Ok(())
    }

    fn check_surroundings(&self, place: &str) -> Result<(), Error> {
        let wrong = |inner: String, problem: &str| Err(Error::at(format!("{place}: {inner}"), problem));
        let channels = [
            ("network.reads", &self.network.reads),
            ("network.writes", &self.network.writes),
            ("network.both", &self.network.both),
            ("cell.link", &self.cell.link),
        ];
        for (name, channel) in channels {
            channel.check().or_else(|problem| wrong(name.to_owned(), &problem))?;
        }
        let positive = |value: Option<f64>| value.is_none_or(|v| v.is_finite() && v > 0.0);
        if !(positive(self.network.poll_ms) && positive(self.network.bad_after_ms)) {
            return wrong("network".to_owned(), "poll_ms and bad_after_ms must be greater than 0");
        }
        if self.cell.hosts.len() > HOSTS_MAX {
            return wrong("cell".to_owned(), &format!("at most {HOSTS_MAX} hosts are possible"));
        }
        for (n, host) in self.cell.hosts.iter().enumerate() {
            let place = format!("cell.host {:?}", host.name);
            if bumpless_core::HostId::new(host.name.as_str()).is_err()
                || ["home", "owner"].contains(&host.name.as_str())
            {
                return wrong(place, "it is no host's name, or one that means something else here");
            }
            if self.cell.hosts.iter().take(n).any(|other| other.name == host.name) {
                return wrong(place, "two hosts have this name");
            }
            host.step.check().or_else(|problem| wrong(place.clone(), &problem))?;
            if !(0.0..=1.0).contains(&host.cpu) {
                return wrong(place, "cpu must be 0 to 1");
            }
        }
        if !(self.cell.notice_ms >= 0.0 && self.cell.jitter_ms >= 0.0) {
            return wrong("cell".to_owned(), "notice_ms and jitter_ms must be 0 or more");
        }
        for instrument in &self.instruments {
            let place = format!("instrument {:?}", instrument.signal);
            if !(instrument.noise.is_finite() && instrument.noise >= 0.0) {
                return wrong(place, "noise must be 0 or more");
            }
            if instrument.bits.is_some_and(|bits| !(1..=24).contains(&bits)) {
                return wrong(place, "bits must be 1 to 24");
            }
            if instrument
                .range
                .is_some_and(|(low, high)| !(low.is_finite() && high.is_finite() && low < high))
            {
                return wrong(place, "range must be two finite numbers in order");
            }
        }
        for event in &self.events {
            let place = format!("event at {} s", event.at_s());
            if event.at_s().is_nan() || event.at_s() < 0.0 {
                return wrong(place, "at_s must be 0 or more");
            }
            let known = |host: &String| host == "owner" || self.cell.hosts.iter().any(|h| h.name == *host);
            if event.host().is_some_and(|host| !known(host)) {
                return wrong(place, "there is no such host: name one of cell.host, or owner");
            }
            if event
                .loop_name()
                .is_some_and(|name| !self.loops.iter().any(|l| l.name == *name))
            {
                return wrong(place, "there is no such loop");
            }
            match event {
                Event::Pause { for_s: time_s, .. }
                | Event::Wrong { for_s: time_s, .. }
                | Event::Kill {
                    back_after_s: Some(time_s),
                    ..
                } if time_s.is_nan() || *time_s <= 0.0 => {
                    return wrong(place, "a time must be greater than 0 s");
                }
                Event::Load { cpu, .. } if !(0.0..=1.0).contains(cpu) => return wrong(place, "cpu must be 0 to 1"),
                Event::Wrong { by, .. } if !by.is_finite() || *by == 0.0 => {
                    return wrong(place, "by must be a finite number that is not 0");
                }
                _ => {}
            }
        }
        let m = &self.measure;
        if !(m.from_s >= 0.0 && m.to_s.is_none_or(|to| to > m.from_s) && positive(m.every_ms) && m.band_percent >= 0.0)
        {
            return wrong(
                "measure".to_owned(),
                "from_s must be 0 or more, to_s after it, every_ms greater than 0, band_percent 0 or more",
            );
        }
        Ok(())
    }
}
