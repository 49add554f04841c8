//! The facade's part that looks back: recorded cycles, replays, and candidates tried on them or beside a running loop.
//!
//! Never: decides; the loop's home does all of it.

use bumpless_core::{LoopId, history::Series};
use bumpless_store::Window;

use super::{Deploy, unexpected};
use crate::{
    error::Error,
    history::{HistoryQuestion, HistoryView},
    limits::{ANSWER_WAIT, REHEARSAL_WAIT},
    report::{CyclesView, ReplayReport, ShadowView, Trial, TrialReport},
    wire::{Ask, ShadowAsk, Told},
};

impl Deploy {
    /// Recorded cycles of a loop, oldest first, at most `max` (1 to 1,000).
    ///
    /// # Errors
    /// [`Error::NotFound`], [`Error::Invalid`] for the window, [`Error::Refused`] where the home records nothing,
    /// [`Error::Unreachable`], [`Error::Store`].
    pub async fn cycles(&self, id: &LoopId, window: Window, max: u32) -> Result<CyclesView, Error> {
        let home = self.room.book.home(id)?;
        match self
            .room
            .ask(&home, Ask::Cycles(id.clone(), window, max), ANSWER_WAIT * 2)
            .await?
        {
            Told::Cycles(view) => Ok(*view),
            _ => Err(unexpected()),
        }
    }

    /// What the cell has of a loop's or a point's history: from the host that is nearest to it, gaps filled from all others.
    ///
    /// # Errors
    /// [`Error::NotFound`] where no host ever had any, [`Error::Invalid`] for the question, [`Error::Refused`] where nobody keeps
    /// history.
    pub async fn history(&self, series: Series, question: HistoryQuestion) -> Result<HistoryView, Error> {
        self.room.history(series, question).await
    }

    /// Now, by the clock that the times of a series are of, in ns since 1970.
    #[must_use]
    pub fn history_now_ns(&self, series: &Series) -> u64 {
        self.room.history_now_ns(series)
    }

    /// Makes the recorded steps of a window again, each through the component and the state that it was made with.
    ///
    /// # Errors
    /// As [`Deploy::cycles`]; [`Error::Busy`] while others are under way.
    pub async fn replay(&self, id: &LoopId, window: Window) -> Result<ReplayReport, Error> {
        let home = self.room.book.home(id)?;
        match self
            .room
            .ask(&home, Ask::Replay(id.clone(), window), REHEARSAL_WAIT)
            .await?
        {
            Told::Replayed(report) => Ok(*report),
            _ => Err(unexpected()),
        }
    }

    /// Lets a candidate step on recorded cycles. Nothing of the loop changes.
    ///
    /// # Errors
    /// As [`Deploy::replay`]; [`Error::NotFound`] and [`Error::Refused`] for the component, [`Error::Invalid`] where it does
    /// not fit the loop.
    pub async fn backtest(&self, id: &LoopId, trial: Trial, window: Window) -> Result<TrialReport, Error> {
        let (home, trial) = (self.room.book.home(id)?, self.by_digest(trial)?);
        let ask = Ask::Backtest(id.clone(), Box::new(trial), window);
        match self.room.ask(&home, ask, REHEARSAL_WAIT).await? {
            Told::Tried(report) => Ok(*report),
            _ => Err(unexpected()),
        }
    }

    /// As the home may not have heard of the component yet.
    fn by_digest(&self, mut trial: Trial) -> Result<Trial, Error> {
        trial.component = self.room.library.controller(&trial.component)?.digest.to_string();
        Ok(trial)
    }

    async fn shadow(&self, id: &LoopId, ask: ShadowAsk) -> Result<Vec<ShadowView>, Error> {
        let home = self.room.book.home(id)?;
        match self
            .room
            .ask(&home, Ask::Shadow(id.clone(), ask), REHEARSAL_WAIT)
            .await?
        {
            Told::Shadows(views) => Ok(views),
            _ => Err(unexpected()),
        }
    }

    async fn one_shadow(&self, id: &LoopId, ask: ShadowAsk) -> Result<ShadowView, Error> {
        self.shadow(id, ask).await?.into_iter().next().ok_or_else(unexpected)
    }

    /// Lets a candidate follow a running loop for so many cycles (1 to 1,000,000). Nothing of the loop changes.
    ///
    /// # Errors
    /// As [`Deploy::backtest`]; [`Error::Busy`] where the loop's home has too many shadows.
    pub async fn start_shadow(&self, id: &LoopId, trial: Trial, cycles: u64) -> Result<ShadowView, Error> {
        let trial = Box::new(self.by_digest(trial)?);
        self.one_shadow(id, ShadowAsk::Start(trial, cycles)).await
    }

    /// The shadows of a loop, those that ended a while ago too, without their curves.
    ///
    /// # Errors
    /// [`Error::NotFound`], [`Error::Unreachable`].
    pub async fn shadows(&self, id: &LoopId) -> Result<Vec<ShadowView>, Error> {
        self.shadow(id, ShadowAsk::List).await
    }

    /// One shadow with its curves so far.
    ///
    /// # Errors
    /// [`Error::NotFound`], [`Error::Unreachable`].
    pub async fn show_shadow(&self, id: &LoopId, shadow: u64) -> Result<ShadowView, Error> {
        self.one_shadow(id, ShadowAsk::Show(shadow)).await
    }

    /// Ends a shadow that follows, and forgets one that has ended.
    ///
    /// # Errors
    /// [`Error::NotFound`], [`Error::Unreachable`].
    pub async fn stop_shadow(&self, id: &LoopId, shadow: u64) -> Result<ShadowView, Error> {
        self.one_shadow(id, ShadowAsk::Stop(shadow)).await
    }
}
