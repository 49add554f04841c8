//! The modules that a script sees: `h3c`, `n3c`, `o3c`, `bl`, and `print`.
//!
//! Owns: the numbers of the pins for one run, and the checkpoint that the run began with.
//! Never: blocks, except in `dms` and `dus`.

use std::cell::RefCell;

use rilua::{
    Lua, LuaApiMut as _, LuaResult, RustFn, Val, runtime_error,
    vm::closure::{Closure, RustClosure},
    vm::state::LuaState,
};

use crate::board;

/// Greatest number of a pin, and of a message's id (an identifier of CAN has at most 29 bits).
const NUMBER_MAX: i64 = 0x1fff_ffff;
/// The newest messages of one id that are kept: what is sent are measurements, of which the newest count; one more, because
/// the published scripts take one away before their loop begins.
const DEPTH: u32 = 2;

/// Kinds of pins, by their module's order.
#[derive(Clone, Copy)]
enum Kind {
    AnalogIn,
    AnalogOut,
    DigitalIn,
    DigitalOut,
}

const PREFIXES: [&str; 4] = ["ain-", "aout-", "din-", "dout-"];

#[derive(Default)]
struct Run {
    /// For each kind the slot of each pin.
    pins: [Vec<Option<u32>>; 4],
    checkpoint: Option<Vec<u8>>,
}

thread_local! {
    // The sandbox has one thread, and the interpreter's functions are plain ones.
    static RUN: RefCell<Run> = RefCell::default();
}

/// Pins by their kinds, as the granted points are named. Numbers are below 256, so that a name does not make a long table.
fn pins(slots: &[String]) -> [Vec<Option<u32>>; 4] {
    let mut pins: [Vec<Option<u32>>; 4] = Default::default();
    for (slot, name) in (0_u32..).zip(slots) {
        for (prefix, pins) in PREFIXES.iter().zip(&mut pins) {
            let number = name.strip_prefix(prefix).and_then(|number| number.parse::<u8>().ok());
            if let Some(number) = number.map(usize::from) {
                if pins.len() <= number {
                    pins.resize(number + 1, None);
                }
                if let Some(pin) = pins.get_mut(number) {
                    *pin = Some(slot);
                }
            }
        }
    }
    pins
}

/// Gives a new interpreter its modules.
pub(crate) fn open(lua: &mut Lua, checkpoint: Option<Vec<u8>>) -> LuaResult<()> {
    let pins = pins(&board::slots());
    let counts = pins.each_ref().map(|pins| pins.len() as f64);
    RUN.with(|run| *run.borrow_mut() = Run { pins, checkpoint });
    let hardware: [(&str, RustFn); 4] = [("aIn", a_in), ("aOut", a_out), ("dIn", d_in), ("dOut", d_out)];
    let names = ["naIn", "naOut", "ndIn", "ndOut"];
    module(
        lua,
        "h3c",
        &hardware,
        &names.into_iter().zip(counts).collect::<Vec<_>>(),
    )?;
    let network: [(&str, RustFn); 4] = [("tx", tx), ("listen", listen), ("clearAll", clear_all), ("rx", rx)];
    module(lua, "n3c", &network, &[])?;
    let system: [(&str, RustFn); 3] = [("dms", dms), ("dus", dus), ("ems", ems)];
    module(lua, "o3c", &system, &[])?;
    let own: [(&str, RustFn); 2] = [("save", save), ("restore", restore)];
    module(lua, "bl", &own, &[])?;
    lua.register_function("print", print)
}

fn module(lua: &mut Lua, name: &str, functions: &[(&str, RustFn)], numbers: &[(&str, f64)]) -> LuaResult<()> {
    let table = lua.create_table();
    // Held by the globals before anything else is made, so that no collection takes it away.
    lua.set_global_val(name, Val::Table(table.gc_ref()))?;
    let state = lua.state_mut();
    for (key, function) in functions {
        let closure = state.alloc(Closure::Rust(RustClosure::new(*function, key)));
        let key = Val::Str(state.gc.intern_string(key.as_bytes()));
        table.raw_set(state, key, closure)?;
    }
    for (key, number) in numbers {
        let key = Val::Str(state.gc.intern_string(key.as_bytes()));
        table.raw_set(state, key, Val::Num(*number))?;
    }
    Ok(())
}

/// A closure of the host's in the script's heap.
trait Alloc {
    fn alloc(&mut self, closure: Closure) -> Val;
}

impl Alloc for LuaState {
    fn alloc(&mut self, closure: Closure) -> Val {
        Val::Function(self.gc.alloc_closure(closure))
    }
}

fn number(state: &LuaState, place: usize) -> LuaResult<i64> {
    let number = state.check_integer(place)?;
    if (0..=NUMBER_MAX).contains(&number) {
        return Ok(number);
    }
    Err(runtime_error(format!(
        "bad argument #{place}: {number} is no number of a pin or an id"
    )))
}

fn slot(state: &LuaState, kind: Kind) -> LuaResult<Option<u32>> {
    let number = usize::try_from(number(state, 1)?).unwrap_or(usize::MAX);
    Ok(RUN.with(|run| run.borrow().pins.get(kind as usize)?.get(number).copied().flatten()))
}

fn input(state: &mut LuaState, kind: Kind, open: f64) -> LuaResult<u32> {
    let (value, good) = slot(state, kind)?.map_or((open, true), board::read);
    let value = match kind {
        Kind::DigitalIn => f64::from(value != 0.0),
        _ => value,
    };
    state.push(Val::Num(value));
    state.push(Val::Bool(good));
    Ok(2)
}

fn output(state: &mut LuaState, kind: Kind) -> LuaResult<u32> {
    let slot = slot(state, kind)?;
    let value = match state.stack_get(state.base + 1) {
        Val::Bool(on) => f64::from(on),
        _ => state.check_number(2)?,
    };
    let value = match kind {
        Kind::DigitalOut => f64::from(value != 0.0),
        _ => value,
    };
    if !value.is_finite() {
        return Err(runtime_error(format!(
            "bad argument #2: {value} cannot be put on a pin"
        )));
    }
    match slot.map_or(Ok(()), |slot| board::write(slot, value)) {
        Ok(()) => Ok(0),
        Err(refusal) => Ok(refused(state, &refusal)),
    }
}

fn refused(state: &mut LuaState, refusal: &str) -> u32 {
    state.push(Val::Bool(false));
    push_bytes(state, refusal.as_bytes());
    2
}

fn push_bytes(state: &mut LuaState, bytes: &[u8]) {
    let text = state.gc.intern_string(bytes);
    state.push(Val::Str(text));
}

fn a_in(state: &mut LuaState) -> LuaResult<u32> {
    input(state, Kind::AnalogIn, 0.0)
}

fn d_in(state: &mut LuaState) -> LuaResult<u32> {
    input(state, Kind::DigitalIn, 1.0)
}

fn a_out(state: &mut LuaState) -> LuaResult<u32> {
    output(state, Kind::AnalogOut)
}

fn d_out(state: &mut LuaState) -> LuaResult<u32> {
    output(state, Kind::DigitalOut)
}

/// Numbers travel as text, so that any program can read them; a text that could be taken for a number or a word has a quote
/// before it.
fn encoded(state: &LuaState, place: usize) -> LuaResult<Vec<u8>> {
    Ok(match state.stack_get(state.base + place - 1) {
        Val::Num(number) => format!("{number}").into_bytes(),
        Val::Bool(true) => b"true".to_vec(),
        Val::Bool(false) => b"false".to_vec(),
        _ => {
            let text = state.check_string(place)?;
            let plain = !matches!(decoded(&text), Decoded::Number(_) | Decoded::Bool(_)) && text.first() != Some(&b'"');
            if plain { text } else { [b"\"", text.as_slice()].concat() }
        }
    })
}

enum Decoded<'a> {
    Number(f64),
    Bool(bool),
    Text(&'a [u8]),
}

fn decoded(data: &[u8]) -> Decoded<'_> {
    match data {
        b"true" => Decoded::Bool(true),
        b"false" => Decoded::Bool(false),
        [b'"', rest @ ..] => Decoded::Text(rest),
        _ => match std::str::from_utf8(data).ok().and_then(|text| text.parse().ok()) {
            Some(number) => Decoded::Number(number),
            None => Decoded::Text(data),
        },
    }
}

fn tx(state: &mut LuaState) -> LuaResult<u32> {
    let topic = format!("n3c.{}", number(state, 1)?);
    let data = encoded(state, 2)?;
    match board::publish(&topic, &data) {
        Ok(()) => Ok(0),
        Err(refusal) => Ok(refused(state, &refusal)),
    }
}

fn listen(state: &mut LuaState) -> LuaResult<u32> {
    let topic = format!("n3c.{}", number(state, 1)?);
    board::listen(&topic, DEPTH).map_err(|refusal| runtime_error(format!("listen: {refusal}")))?;
    Ok(0)
}

fn clear_all(_: &mut LuaState) -> LuaResult<u32> {
    board::forget();
    Ok(0)
}

fn rx(state: &mut LuaState) -> LuaResult<u32> {
    let Some((topic, data)) = board::receive() else {
        state.push(Val::Bool(false));
        return Ok(1);
    };
    state.push(Val::Bool(true));
    let id = topic.strip_prefix("n3c.").and_then(|id| id.parse::<f64>().ok());
    state.push(id.map_or(Val::Nil, Val::Num));
    match decoded(&data) {
        Decoded::Number(number) => state.push(Val::Num(number)),
        Decoded::Bool(on) => state.push(Val::Bool(on)),
        Decoded::Text(text) => push_bytes(state, text),
    }
    Ok(3)
}

fn pause(state: &LuaState, unit_ns: f64) -> LuaResult<u32> {
    // Negative times and what is no number are none, as on the published platform.
    board::sleep_ns((state.check_number(1)? * unit_ns) as u64);
    Ok(0)
}

fn dms(state: &mut LuaState) -> LuaResult<u32> {
    pause(state, 1e6)
}

fn dus(state: &mut LuaState) -> LuaResult<u32> {
    pause(state, 1e3)
}

fn ems(state: &mut LuaState) -> LuaResult<u32> {
    state.push_number((board::now_ns() / 1_000_000) as f64);
    Ok(1)
}

fn save(state: &mut LuaState) -> LuaResult<u32> {
    let data = state.check_string(1)?;
    match board::save(&data) {
        Ok(()) => Ok(0),
        Err(refusal) => Ok(refused(state, &refusal)),
    }
}

fn restore(state: &mut LuaState) -> LuaResult<u32> {
    let Some(data) = RUN.with(|run| run.borrow().checkpoint.clone()) else {
        state.push(Val::Nil);
        return Ok(1);
    };
    push_bytes(state, &data);
    Ok(1)
}

/// As Lua's own, to the program's log instead of a terminal.
fn print(state: &mut LuaState) -> LuaResult<u32> {
    let mut line = String::new();
    for place in state.base..state.top {
        if place > state.base {
            line.push('\t');
        }
        match state.stack_get(place) {
            Val::Str(text) => {
                if let Some(text) = state.gc.string_arena.get(text) {
                    line.push_str(&String::from_utf8_lossy(text.data()));
                }
            }
            other => line.push_str(&other.to_string()),
        }
    }
    board::line(line.trim_end_matches(['\r', '\n']));
    Ok(0)
}
