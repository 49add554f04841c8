//! 3C scripts: Lua 5.1 with the three modules of the published platform, `h3c` (points), `n3c` (messages) and `o3c` (time), and
//! one of our own, `bl` (checkpoints).
//!
//! | script | host |
//! |---|---|
//! | `h3c.aIn(i)`, `h3c.aOut(i, v)`, `h3c.dIn(i)`, `h3c.dOut(i, v)` | granted points named `ain-i`, `aout-i`, `din-i`, `dout-i` |
//! | `h3c.naIn`, `naOut`, `ndIn`, `ndOut` | greatest number of each kind, plus one |
//! | `n3c.tx(id, data)`, `listen(id)`, `rx()`, `clearAll()` | topics named `n3c.id` |
//! | `o3c.dms(ms)`, `o3c.dus(us)`, `o3c.ems()` | the clock |
//! | `bl.save(text)`, `bl.restore()` | the checkpoint |
//! | `print(…)` | a line of the program's log |
//!
//! A pin that is not connected is a pin: an analog input reads 0, a digital one 1 (the published board pulls them up, and its
//! keys read 0 when pressed), a write goes nowhere. Inputs give a second value, `false` where the first may not be trusted.
//! A write that the host refuses gives `false` and the reason.
//! Owns: the interpreter for the time of one run. Never: files, processes, a date, bytecode from outside.

mod board;
mod modules;
#[cfg(test)]
mod tests;

use bumpless_sdk::program::{Fault, Program};
use rilua::{Lua, LuaApiMut as _, StdLib};

/// The name that errors call the script by.
const CHUNK: &str = "=script";

struct Lua3c;

impl Program for Lua3c {
    const NAME: &'static str = "lua3c";
    const VERSION: &'static str = "1.0.0";
    const TEXT: &'static str = "Runs 3C scripts: Lua 5.1 with h3c, n3c and o3c";

    fn run(script: Vec<u8>, checkpoint: Option<Vec<u8>>) -> Result<(), Fault> {
        run(&script, checkpoint)
    }
}

/// Runs a script to its end.
fn run(script: &[u8], checkpoint: Option<Vec<u8>>) -> Result<(), Fault> {
    if script.is_empty() {
        return Err(Fault::BadParameter("there is no script: upload a .lua file".to_owned()));
    }
    // Compiled code could be made to do anything to the interpreter.
    if script.starts_with(b"\x1bLua") {
        return Err(Fault::BadParameter(
            "this is compiled Lua: upload the script itself".to_owned(),
        ));
    }
    let libraries = StdLib::BASE | StdLib::STRING | StdLib::TABLE | StdLib::MATH | StdLib::COROUTINE;
    let mut lua = Lua::new_with(libraries).map_err(|error| Fault::Failed(error.to_string()))?;
    modules::open(&mut lua, checkpoint).map_err(|error| Fault::Failed(error.to_string()))?;
    lua.exec_bytes(script, CHUNK).map_err(|error| {
        let text = error.to_string();
        match error {
            rilua::LuaError::Syntax(_) => Fault::BadParameter(text),
            rilua::LuaError::Memory => Fault::Failed(format!("{text}: the script needs more than it is given")),
            _ => Fault::Failed(text),
        }
    })?;
    // So that finalizers run while their host still listens.
    lua.gc_collect().map_err(|error| Fault::Failed(error.to_string()))
}

bumpless_sdk::export_program!(Lua3c);
