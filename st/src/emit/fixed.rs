//! The fixed part of every module, functions that each has: memory for the host, division, indices, the first fault of a call.
//!
//! A fault does not trap: the first one is kept, loops end at it, and the step returns it in words instead of effects.
//! Never: anything that depends on a text.

use wasm_encoder::{Instruction as I, ValType};

use super::{Code, Functions, Global, PAGE, RESULT_AT, at};

/// Their numbers.
#[derive(Debug, Clone, Copy)]
pub(super) struct Fixed {
    pub(super) alloc: u32,
    pub(super) index: u32,
    pub(super) div_s32: u32,
    pub(super) div_u32: u32,
    pub(super) rem_s32: u32,
    pub(super) rem_u32: u32,
    pub(super) div_s64: u32,
    pub(super) div_u64: u32,
    pub(super) rem_s64: u32,
    pub(super) rem_u64: u32,
    pub(super) div_f32: u32,
    pub(super) div_f64: u32,
    /// Address and length of a state become a good result.
    pub(super) ok: u32,
    /// Case, address and length of a text become a fault.
    pub(super) err: u32,
    /// Are two pieces of memory of one length the same?
    pub(super) same: u32,
}

const I32: ValType = ValType::I32;
const I64: ValType = ValType::I64;

impl Fixed {
    pub(super) fn add(functions: &mut Functions, heap: u32) -> Self {
        let alloc = functions.add("allocate", allocate());
        functions.export("cabi_realloc", "cabi_realloc", reallocate(alloc));
        for (name, export) in
            ["start", "step", "migrate"].map(|name| (name, format!("cabi_post_bumpless:control/control@0.1.0#{name}")))
        {
            let mut code = Code::new(&[I32], &[]);
            code.int(heap);
            code.set_global(Global::Heap);
            functions.export(&format!("give back after {name}"), &export, code);
        }
        let fault = functions.add("fault", first_fault());
        let whole = |code: Divide| divide(code, fault);
        Self {
            alloc,
            index: functions.add("index", index(fault)),
            div_s32: functions.add("divide", whole(Divide::signed(I32, I::I32DivS))),
            div_u32: functions.add("divide", whole(Divide::unsigned(I32, I::I32DivU))),
            rem_s32: functions.add("remainder", whole(Divide::unsigned(I32, I::I32RemS))),
            rem_u32: functions.add("remainder", whole(Divide::unsigned(I32, I::I32RemU))),
            div_s64: functions.add("divide", whole(Divide::signed(I64, I::I64DivS))),
            div_u64: functions.add("divide", whole(Divide::unsigned(I64, I::I64DivU))),
            rem_s64: functions.add("remainder", whole(Divide::unsigned(I64, I::I64RemS))),
            rem_u64: functions.add("remainder", whole(Divide::unsigned(I64, I::I64RemU))),
            div_f32: functions.add("divide", whole(Divide::unsigned(ValType::F32, I::F32Div))),
            div_f64: functions.add("divide", whole(Divide::unsigned(ValType::F64, I::F64Div))),
            ok: functions.add("good result", ok()),
            err: functions.add("fault result", err()),
            same: functions.add("same", same()),
        }
    }
}

/// `(bytes) -> address`, in steps of 16, with more memory where it is needed.
fn allocate() -> Code {
    let mut code = Code::new(&[I32], &[I32]);
    let from = code.local(I32);
    let end = code.local(I32);
    code.global(Global::Heap);
    code.all([
        I::LocalTee(from),
        I::LocalGet(0),
        I::I32Add,
        I::I32Const(15),
        I::I32Add,
        I::I32Const(-16),
        I::I32And,
    ]);
    code.set(end);
    // Around the end of all addresses.
    code.all([I::LocalGet(end), I::LocalGet(from), I::I32LtU]);
    code.when();
    code.push(I::Unreachable);
    code.end();
    code.all([
        I::MemorySize(0),
        I::I32Const(16),
        I::I32Shl,
        I::LocalGet(end),
        I::I32LtU,
    ]);
    code.when();
    code.all([
        I::LocalGet(end),
        I::I32Const(PAGE as i32 - 1),
        I::I32Add,
        I::I32Const(16),
        I::I32ShrU,
        I::MemorySize(0),
        I::I32Sub,
        I::MemoryGrow(0),
        I::I32Const(-1),
        I::I32Eq,
    ]);
    code.when();
    code.push(I::Unreachable);
    code.end();
    code.end();
    code.get(end);
    code.set_global(Global::Heap);
    code.get(from);
    code
}

/// `cabi_realloc`: old address and size, alignment, new size.
fn reallocate(alloc: u32) -> Code {
    let mut code = Code::new(&[I32, I32, I32, I32], &[I32]);
    let made = code.local(I32);
    code.all([I::LocalGet(3), I::Call(alloc), I::LocalSet(made)]);
    code.all([I::LocalGet(made), I::LocalGet(0)]);
    code.all([
        I::LocalGet(1),
        I::LocalGet(3),
        I::LocalGet(1),
        I::LocalGet(3),
        I::I32LtU,
        I::Select,
    ]);
    code.copy();
    code.get(made);
    code
}

/// `(site)`: keeps the first one.
fn first_fault() -> Code {
    let mut code = Code::new(&[I32], &[]);
    code.global(Global::Fault);
    code.push(I::I32Eqz);
    code.when();
    code.get(0);
    code.set_global(Global::Fault);
    code.end();
    code
}

/// `(value, low, count, site) -> index from 0`; 0 with a fault where it lies outside.
fn index(fault: u32) -> Code {
    let mut code = Code::new(&[I64, I64, I32, I32], &[I32]);
    code.all([I::LocalGet(0), I::LocalGet(1), I::I64Sub, I::LocalTee(0)]);
    code.all([I::LocalGet(2), I::I64ExtendI32U, I::I64GeU]);
    code.when();
    code.all([I::LocalGet(3), I::Call(fault), I::I32Const(0), I::Return]);
    code.end();
    code.all([I::LocalGet(0), I::I32WrapI64]);
    code
}

struct Divide {
    ty: ValType,
    operation: I<'static>,
    /// The least value by -1 is itself, and no trap.
    wraps: bool,
}

impl Divide {
    const fn signed(ty: ValType, operation: I<'static>) -> Self {
        Self {
            ty,
            operation,
            wraps: true,
        }
    }

    const fn unsigned(ty: ValType, operation: I<'static>) -> Self {
        Self {
            ty,
            operation,
            wraps: false,
        }
    }
}

/// `(a, b, site) -> a / b`; 0 with a fault where b is 0.
fn divide(what: Divide, fault: u32) -> Code {
    let mut code = Code::new(&[what.ty, what.ty, I32], &[what.ty]);
    let zero = match what.ty {
        ValType::F32 => I::F32Const(0.0.into()),
        ValType::F64 => I::F64Const(0.0.into()),
        ValType::I64 => I::I64Const(0),
        _ => I::I32Const(0),
    };
    code.get(1);
    match what.ty {
        ValType::F32 => code.all([I::F32Const(0.0.into()), I::F32Eq]),
        ValType::F64 => code.all([I::F64Const(0.0.into()), I::F64Eq]),
        ValType::I64 => code.push(I::I64Eqz),
        _ => code.push(I::I32Eqz),
    }
    code.when();
    code.all([I::LocalGet(2), I::Call(fault)]);
    code.push(zero);
    code.push(I::Return);
    code.end();
    if what.wraps {
        code.get(1);
        match what.ty {
            ValType::I64 => code.all([I::I64Const(-1), I::I64Eq]),
            _ => code.all([I::I32Const(-1), I::I32Eq]),
        }
        code.when();
        match what.ty {
            ValType::I64 => code.all([I::I64Const(0), I::LocalGet(0), I::I64Sub, I::Return]),
            _ => code.all([I::I32Const(0), I::LocalGet(0), I::I32Sub, I::Return]),
        }
        code.end();
    }
    code.all([I::LocalGet(0), I::LocalGet(1)]);
    code.push(what.operation);
    code
}

fn ok() -> Code {
    let mut code = Code::new(&[I32, I32], &[I32]);
    code.all([I::I32Const(RESULT_AT), I::I32Const(0), I::I32Store(at(0))]);
    code.all([I::I32Const(RESULT_AT), I::LocalGet(0), I::I32Store(at(4))]);
    code.all([I::I32Const(RESULT_AT), I::LocalGet(1), I::I32Store(at(8))]);
    code.push(I::I32Const(RESULT_AT));
    code
}

fn err() -> Code {
    let mut code = Code::new(&[I32, I32, I32], &[I32]);
    code.all([I::I32Const(RESULT_AT), I::I32Const(1), I::I32Store(at(0))]);
    for (parameter, offset) in [(0, 4), (1, 8), (2, 12)] {
        code.all([I::I32Const(RESULT_AT), I::LocalGet(parameter), I::I32Store(at(offset))]);
    }
    code.push(I::I32Const(RESULT_AT));
    code
}

/// `(a, b, bytes) -> 1 or 0`.
fn same() -> Code {
    let mut code = Code::new(&[I32, I32, I32], &[I32]);
    let n = code.local(I32);
    let out = code.block();
    let top = code.repeat();
    code.all([I::LocalGet(n), I::LocalGet(2), I::I32GeU]);
    code.branch_if(out);
    code.all([I::LocalGet(0), I::LocalGet(n), I::I32Add, I::I32Load8U(at(0))]);
    code.all([I::LocalGet(1), I::LocalGet(n), I::I32Add, I::I32Load8U(at(0)), I::I32Ne]);
    code.when();
    code.all([I::I32Const(0), I::Return]);
    code.end();
    code.all([I::LocalGet(n), I::I32Const(1), I::I32Add, I::LocalSet(n)]);
    code.branch(top);
    code.end();
    code.end();
    code.push(I::I32Const(1));
    code
}
