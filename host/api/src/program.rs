//! What the API asks of programs, as a trait: the routes are tested against programs that exist only in memory.
//!
//! Never: adds a decision; [`Deploy`] is the only implementation outside of tests.

use bumpless_core::ProgramId;
use bumpless_deploy::{
    Deploy,
    programs::{LineView, ProgramDraft, ProgramList, ProgramOrder, ProgramView},
};

use crate::cell::Answer;

/// One host's way to the programs of the cell; see [`Deploy`] for what each method means.
pub(crate) trait Programs: Send + Sync + 'static {
    fn create_program(&self, draft: ProgramDraft) -> Answer<ProgramView>;
    fn order_program(&self, id: ProgramId, order: ProgramOrder) -> Answer<ProgramView>;
    fn remove_program(&self, id: ProgramId) -> Answer<()>;
    fn programs(&self) -> Answer<ProgramList>;
    fn program(&self, id: ProgramId) -> Answer<ProgramView>;
    fn program_log(&self, id: ProgramId, after: u64, max: u32) -> Answer<Vec<LineView>>;
    fn program_checkpoint(&self, id: ProgramId) -> Answer<Option<Vec<u8>>>;
    fn script(&self, reference: String) -> Answer<Vec<u8>>;
}

impl Programs for Deploy {
    fn create_program(&self, draft: ProgramDraft) -> Answer<ProgramView> {
        let deploy = self.clone();
        Box::pin(async move { deploy.create_program(draft).await })
    }

    fn order_program(&self, id: ProgramId, order: ProgramOrder) -> Answer<ProgramView> {
        let deploy = self.clone();
        Box::pin(async move { deploy.order_program(id, order).await })
    }

    fn remove_program(&self, id: ProgramId) -> Answer<()> {
        let deploy = self.clone();
        Box::pin(async move { deploy.remove_program(id).await })
    }

    fn programs(&self) -> Answer<ProgramList> {
        let deploy = self.clone();
        Box::pin(async move { Ok(deploy.programs().await) })
    }

    fn program(&self, id: ProgramId) -> Answer<ProgramView> {
        let deploy = self.clone();
        Box::pin(async move { deploy.program(id).await })
    }

    fn program_log(&self, id: ProgramId, after: u64, max: u32) -> Answer<Vec<LineView>> {
        let deploy = self.clone();
        Box::pin(async move { deploy.program_log(id, after, max).await })
    }

    fn program_checkpoint(&self, id: ProgramId) -> Answer<Option<Vec<u8>>> {
        let deploy = self.clone();
        Box::pin(async move { deploy.program_checkpoint(id).await })
    }

    fn script(&self, reference: String) -> Answer<Vec<u8>> {
        let deploy = self.clone();
        Box::pin(async move { deploy.script(&reference).await })
    }
}
