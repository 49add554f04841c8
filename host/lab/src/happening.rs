//! What people and faults do to a run: swaps, deaths, pauses, load, modes.
//!
//! Never: tells the desk more than a live home would hear, nor sooner.

use bumpless_core::{CommandBody, HostId, place};

use crate::{
    experiment::Event,
    world::{What, World, ns},
};

impl World<'_> {
    /// The members as the home believes them to be.
    pub(crate) fn members(&mut self, n: usize) {
        let hosts: Vec<HostId> = if self.hosts.len() == 1 {
            self.hosts.iter().map(|h| h.id.clone()).collect()
        } else {
            self.hosts
                .iter()
                .skip(1)
                .filter(|h| h.on)
                .map(|h| h.id.clone())
                .collect()
        };
        let now_ns = self.now_ns;
        let Some(l) = self.loops.get_mut(n) else { return };
        let ranked = place::rank(&l.desk.spec().id, &hosts);
        let dispatch = l.desk.set_members(now_ns, ranked);
        self.dispatch(n, dispatch);
    }

    /// A host comes or goes.
    pub(crate) fn switch(&mut self, host: usize, on: bool) {
        if let Some(h) = self.hosts.get_mut(host) {
            h.switch(on);
        }
        let notice_ns = ns(self.plan.cell.notice_ms * 1e-3);
        self.at(self.now_ns + notice_ns, What::News);
    }

    pub(crate) fn target(&self, name: &str) -> usize {
        if name == "owner" {
            let owner = self.loops.first().and_then(|l| l.desk.owner());
            owner.map_or(0, |id| self.host(id))
        } else {
            self.hosts.iter().position(|h| h.id.as_str() == name).unwrap_or(0)
        }
    }

    pub(crate) fn happen(&mut self, n: usize) {
        let Some(event) = self.plan.events.get(n) else { return };
        let chosen = |name: &Option<String>, world: &Self| -> Vec<usize> {
            (0..world.loops.len())
                .filter(|&l| name.as_deref().is_none_or(|wanted| wanted == world.loop_name(l)))
                .collect()
        };
        match event {
            Event::Swap {
                loop_name, component, ..
            } => {
                for l in chosen(loop_name, self) {
                    let Some(revision) = self.waiting.remove(&(n, l)) else {
                        continue;
                    };
                    let number = revision.spec.revision;
                    if let Some(run) = self.loops.get_mut(l) {
                        run.held.push(revision);
                    }
                    self.command(l, CommandBody::Revise(number));
                    self.note(format!("{}: swap to {component}", self.loop_name(l)));
                }
            }
            Event::Kill { host, back_after_s, .. } => {
                let host = self.target(host);
                self.note(format!("{} is killed", self.hosts[host].id));
                self.switch(host, false);
                if let Some(after_s) = back_after_s {
                    self.at(self.now_ns + ns(*after_s), What::Back(host));
                }
            }
            Event::Off { host, .. } | Event::On { host, .. } => {
                let on = matches!(event, Event::On { .. });
                let host = self.target(host);
                self.note(format!(
                    "{} goes {}",
                    self.hosts[host].id,
                    if on { "on" } else { "off" }
                ));
                self.switch(host, on);
            }
            Event::Pause { host, for_s, .. } => {
                let host = self.target(host);
                let until_ns = self.now_ns + ns(*for_s);
                self.note(format!("{} stands still for {for_s} s", self.hosts[host].id));
                if let Some(h) = self.hosts.get_mut(host) {
                    h.paused_until_ns = until_ns;
                }
            }
            Event::Wrong { host, by, for_s, .. } => {
                let host = self.target(host);
                let until_ns = self.now_ns + ns(*for_s);
                self.note(format!("{}'s steps are off by {by} for {for_s} s", self.hosts[host].id));
                if let Some(h) = self.hosts.get_mut(host) {
                    h.wrong = Some((until_ns, *by));
                }
            }
            Event::Load { host, cpu, step, .. } => {
                let host = self.target(host);
                self.note(format!("{} is loaded to {} %", self.hosts[host].id, cpu * 100.0));
                if let Some(h) = self.hosts.get_mut(host) {
                    h.cpu = *cpu;
                    h.step = step.unwrap_or(h.step);
                }
            }
            Event::Mode { loop_name, mode, .. } => {
                for l in chosen(loop_name, self) {
                    self.command(l, CommandBody::Mode(*mode));
                    self.note(format!("{}: {}", self.loop_name(l), mode.name()));
                }
            }
            Event::Output { loop_name, values, .. } => {
                for l in chosen(loop_name, self) {
                    self.command(l, CommandBody::Output(values.clone()));
                }
            }
        }
    }
}
