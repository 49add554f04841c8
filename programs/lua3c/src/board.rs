//! What the script's modules stand on: the host's interfaces in the sandbox, and a board of the test's in tests.
//!
//! Owns: nothing. Never: knows Lua.

#[cfg(target_arch = "wasm32")]
pub(crate) use in_sandbox::*;
#[cfg(not(target_arch = "wasm32"))]
pub(crate) use on_bench::*;

#[cfg(target_arch = "wasm32")]
mod in_sandbox {
    use bumpless_sdk::program::{Level, Quality, checkpoint, clock, log, points, topics};

    /// Names of the granted points, by number.
    pub(crate) fn slots() -> Vec<String> {
        points::slots().into_iter().map(|slot| slot.name).collect()
    }

    /// A point's value, and whether it may be trusted.
    pub(crate) fn read(slot: u32) -> (f64, bool) {
        let sight = points::read(slot);
        (sight.value, sight.quality != Quality::Bad)
    }

    pub(crate) fn write(slot: u32, value: f64) -> Result<(), String> {
        points::write(slot, value)
    }

    pub(crate) fn now_ns() -> u64 {
        clock::now_ns()
    }

    pub(crate) fn sleep_ns(duration_ns: u64) {
        clock::sleep_ns(duration_ns);
    }

    pub(crate) fn publish(topic: &str, data: &[u8]) -> Result<(), String> {
        topics::publish(topic, data)
    }

    pub(crate) fn listen(topic: &str, depth: u32) -> Result<(), String> {
        topics::listen(topic, depth)
    }

    pub(crate) fn forget() {
        topics::forget();
    }

    pub(crate) fn receive() -> Option<(String, Vec<u8>)> {
        topics::receive().map(|delivery| (delivery.topic, delivery.data))
    }

    pub(crate) fn save(data: &[u8]) -> Result<(), String> {
        checkpoint::save(data)
    }

    pub(crate) fn line(text: &str) {
        log(Level::Info, text);
    }
}

/// A board on the bench: what a test put there, and what the script did.
#[cfg(not(target_arch = "wasm32"))]
mod on_bench {
    use std::{cell::RefCell, collections::VecDeque};

    /// Called at each pause with the time; changes the board as a plant would. `false` ends the script.
    #[allow(dead_code, reason = "for tests")]
    pub(crate) type Plant = Box<dyn FnMut(&mut Board) -> bool>;

    /// Everything around a script.
    #[derive(Default)]
    #[allow(dead_code, reason = "filled in and read by tests")]
    pub(crate) struct Board {
        pub(crate) slots: Vec<(String, f64)>,
        pub(crate) now_ns: u64,
        pub(crate) heard: Vec<String>,
        pub(crate) inbox: VecDeque<(String, Vec<u8>)>,
        pub(crate) sent: Vec<(String, Vec<u8>)>,
        pub(crate) saved: Option<Vec<u8>>,
        pub(crate) lines: Vec<String>,
        pub(crate) refusal: Option<String>,
    }

    thread_local! {
        pub(crate) static BOARD: RefCell<Board> = RefCell::default();
        pub(crate) static PLANT: RefCell<Option<Plant>> = const { RefCell::new(None) };
    }

    fn with<T>(work: impl FnOnce(&mut Board) -> T) -> T {
        BOARD.with(|board| work(&mut board.borrow_mut()))
    }

    pub(crate) fn slots() -> Vec<String> {
        with(|board| board.slots.iter().map(|(name, _)| name.clone()).collect())
    }

    pub(crate) fn read(slot: u32) -> (f64, bool) {
        let value = with(|board| board.slots.get(slot as usize).map_or(0.0, |(_, value)| *value));
        (if value.is_nan() { 0.0 } else { value }, !value.is_nan())
    }

    pub(crate) fn write(slot: u32, value: f64) -> Result<(), String> {
        with(|board| {
            if let Some(refusal) = &board.refusal {
                return Err(refusal.clone());
            }
            if let Some((_, held)) = board.slots.get_mut(slot as usize) {
                *held = value;
            }
            Ok(())
        })
    }

    pub(crate) fn now_ns() -> u64 {
        with(|board| board.now_ns)
    }

    pub(crate) fn sleep_ns(duration_ns: u64) {
        with(|board| board.now_ns += duration_ns);
        let goes_on = PLANT.with(|plant| match plant.borrow_mut().as_mut() {
            Some(plant) => with(plant),
            None => true,
        });
        // The published scripts never end by themselves.
        if !goes_on {
            std::panic::resume_unwind(Box::new("the plant has ended"));
        }
    }

    pub(crate) fn publish(topic: &str, data: &[u8]) -> Result<(), String> {
        with(|board| board.sent.push((topic.to_owned(), data.to_vec())));
        Ok(())
    }

    pub(crate) fn listen(topic: &str, _depth: u32) -> Result<(), String> {
        with(|board| board.heard.push(topic.to_owned()));
        Ok(())
    }

    pub(crate) fn forget() {
        with(|board| board.heard.clear());
    }

    pub(crate) fn receive() -> Option<(String, Vec<u8>)> {
        with(|board| board.inbox.pop_front())
    }

    pub(crate) fn save(data: &[u8]) -> Result<(), String> {
        with(|board| board.saved = Some(data.to_vec()));
        Ok(())
    }

    pub(crate) fn line(text: &str) {
        with(|board| board.lines.push(text.to_owned()));
    }
}
