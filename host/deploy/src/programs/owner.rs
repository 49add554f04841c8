//! The owner's part: runs what homes ask for, and says how it is.
//!
//! Never: decides what runs here, or under which term.

use std::sync::Arc;

use bumpless_core::{HostId, ProgramId, ProgramSpec};
use bumpless_programs::{Order, RunView};

use super::{LINES_MAX, LineView, RunTold, arm::Arm};
use crate::{
    bench::engine_error,
    book::on_disk,
    error::{Error, chain},
    room::Room,
};

fn told(view: RunView) -> RunTold {
    RunTold {
        id: view.id,
        home: view.home,
        term: view.term,
        status: view.status,
        reason: view.reason,
        used_ns: view.used_ns,
        memory_bytes: view.memory_bytes,
        up_ms: view.up_ms,
        lines: view.lines,
    }
}

impl Room {
    /// What runs here.
    pub(super) fn program_runs(&self) -> Vec<RunTold> {
        self.programs.runner.views().into_iter().map(told).collect()
    }

    /// How one of them is; none where it did not run here.
    pub(super) fn program_run_of(&self, id: &ProgramId) -> Option<RunTold> {
        self.programs.runner.view(id).map(told)
    }

    /// Runs a program for its home.
    pub(super) async fn program_run(
        self: &Arc<Self>,
        from: &HostId,
        spec: ProgramSpec,
        term: u64,
        checkpoint: Option<Vec<u8>>,
    ) -> Result<(), Error> {
        spec.check().map_err(|error| Error::invalid(error.to_string(), ""))?;
        if spec.home != *from {
            return Err(Error::invalid(
                format!("program {} has its home at host {}, not at {from}", spec.id, spec.home),
                "",
            ));
        }
        self.may_load(&spec.digest)?;
        let bytes = self.bytes_of(spec.digest, Some(from)).await?;
        let engine = self.bench.engine.clone();
        let (prepared, _) = on_disk(move || engine.programs().open(&bytes))
            .await?
            .map_err(|error| engine_error(&error))?;
        let points = match (&self.io, spec.home == self.here) {
            (Some(io), true) => spec.grants.values().map(|grant| io.index(&grant.point)).collect(),
            _ => None,
        };
        let paused = spec.wanted == bumpless_core::program::Wanted::Paused;
        let arm = Arm {
            room: Arc::downgrade(self),
            runtime: self.async_runtime(),
            spec: Arc::new(spec.clone()),
            term,
            points,
        };
        let order = Order {
            spec,
            term,
            prepared,
            checkpoint,
            reach: Arc::new(arm),
            paused,
        };
        match self.programs.runner.run(order) {
            // Asked twice: it runs, as it shall.
            Err(bumpless_programs::Error::Runs(_, at)) if at == term => Ok(()),
            end => end.map_err(|error| Error::refused(chain(&error), "")),
        }
    }

    pub(super) fn program_pause(&self, id: &ProgramId, term: u64, paused: bool) -> Result<(), Error> {
        self.programs
            .runner
            .pause(id, term, paused)
            .map_err(|error| Error::not_found(chain(&error), ""))
    }

    pub(super) fn program_lines(&self, id: &ProgramId, after: u64, max: u32) -> Vec<LineView> {
        let lines = self.programs.runner.lines(id, after, max.min(LINES_MAX) as usize);
        lines.into_iter().map(LineView::from).collect()
    }
}
