//! The functions of the world: `describe`, `start`, `step`, `migrate`, and the constant data that they use.
//!
//! Never: trusts a length that it did not write itself.

use wasm_encoder::{Instruction as I, ValType};

use super::{
    Code, Data, Functions, Global, Plan, READ, READING_AT, WRITE, at, pair,
    state::{CHANGED, FIRST, FLAG_AT, HIDDEN, Layout, MARK, OWN_MARK},
};
use crate::{check::Checked, types::Scalar};

const I32: ValType = ValType::I32;
const I64: ValType = ValType::I64;
const F64: ValType = ValType::F64;

/// Addresses of constant data.
#[derive(Debug)]
pub(super) struct Tables {
    descriptor: u32,
    /// Records of parameters within the descriptor.
    parameters: u32,
    template: u32,
    /// Per entry its place among the variables and its life.
    entries: u32,
    /// Address and length of the text of each fault, from 1.
    sites: u32,
    texts: Vec<[u8; 8]>,
    /// Per input without a usable value its text.
    inputs: Vec<[u8; 8]>,
}

const BAD_COUNT: usize = 0;
const BAD_RANGE: usize = 1;
const BAD_STATE: usize = 2;
const NO_STATE: usize = 3;
const NOTHING: usize = 4;
const TEXTS: [&str; 5] = [
    "one value per parameter and per output is needed",
    "a parameter is out of its range",
    "the state belongs to another component or layout",
    "the state is not one of a Structured Text program",
    "this program has none of the retained variables of the state",
];

impl Tables {
    pub(super) fn put(data: &mut Data, checked: &Checked<'_>, layout: &Layout) -> Self {
        let interface = &checked.interface;
        let mut ports = Vec::new();
        for port in &interface.ports {
            ports.extend(data.text(&port.name));
            let digital = u8::from(port.scalar == Scalar::Bool);
            ports.extend([u8::from(port.output), digital, 0, 0]);
            ports.extend(data.text(&port.unit));
            ports.extend([u8::from(port.required), 0, 0, 0]);
            ports.extend(data.text(&port.text));
        }
        let ports_at = data.put(&ports);
        let mut parameters = Vec::new();
        for parameter in &interface.parameters {
            parameters.extend(data.text(&parameter.name));
            parameters.extend(data.text(&parameter.unit));
            for value in [parameter.default, parameter.minimum, parameter.maximum] {
                parameters.extend(value.to_le_bytes());
            }
            let choices: Vec<u8> = parameter.choices.iter().flat_map(|choice| data.text(choice)).collect();
            let choices_at = data.put(&choices);
            parameters.extend(pair(choices_at, parameter.choices.len() as u32));
            parameters.extend(data.text(&parameter.text));
        }
        let parameters_at = data.put(&parameters);
        let mut descriptor = Vec::new();
        descriptor.extend(data.text(&interface.name));
        descriptor.extend(data.text(&interface.version));
        descriptor.extend(data.text(&interface.text));
        descriptor.extend(pair(ports_at, interface.ports.len() as u32));
        descriptor.extend(pair(parameters_at, interface.parameters.len() as u32));
        descriptor.extend(layout.version.to_le_bytes());
        let entries: Vec<u8> = layout
            .entries
            .iter()
            .flat_map(|entry| pair(entry.offset, entry.life as u32))
            .collect();
        let sites: Vec<u8> = checked.sites.iter().flat_map(|site| data.text(site)).collect();
        Self {
            descriptor: data.put(&descriptor),
            parameters: parameters_at,
            template: data.put(&layout.template),
            entries: data.put(&entries),
            sites: data.put(&sites),
            texts: TEXTS.iter().map(|text| data.text(text)).collect(),
            inputs: interface
                .ports
                .iter()
                .map(|port| data.text(&format!("input {} has no usable value", port.name)))
                .collect(),
        }
    }
}

/// Adds and exports the world's functions.
pub(super) fn add(functions: &mut Functions, plan: &Plan<'_>, layout: &Layout, tables: &Tables) {
    let world = World { plan, layout, tables };
    let mut describe = Code::new(&[], &[I32]);
    describe.int(tables.descriptor);
    let export = |name: &str| format!("bumpless:control/control@0.1.0#{name}");
    functions.export("describe", &export("describe"), describe);
    functions.export("start", &export("start"), world.start());
    functions.export("step", &export("step"), world.step());
    functions.export("migrate", &export("migrate"), world.migrate());
}

struct World<'w> {
    plan: &'w Plan<'w>,
    layout: &'w Layout,
    tables: &'w Tables,
}

impl World<'_> {
    /// Ends with a fault of the given case.
    fn fail(&self, code: &mut Code, case: u32, text: [u8; 8]) {
        let both = u64::from_le_bytes(text);
        code.int(case);
        code.int(both as u32);
        code.int((both >> 32) as u32);
        code.all([I::Call(self.plan.fixed.err), I::Return]);
    }

    fn text(&self, number: usize) -> [u8; 8] {
        self.tables.texts.get(number).copied().unwrap_or_default()
    }

    /// Numbers of parameters and outputs, and the parameters' ranges.
    fn check(&self, code: &mut Code, [parameters, count, track_count]: [u32; 3]) {
        let interface = &self.plan.checked.interface;
        let outputs = interface.ports.iter().filter(|port| port.output).count();
        code.get(count);
        code.int(interface.parameters.len() as u32);
        code.push(I::I32Ne);
        code.get(track_count);
        code.int(outputs as u32);
        code.all([I::I32Ne, I::I32Or]);
        code.when();
        self.fail(code, 0, self.text(BAD_COUNT));
        code.end();
        for n in 0..interface.parameters.len() as u32 {
            // The records of the descriptor: least value at 24, greatest at 32, of 56 bytes.
            code.get(parameters);
            code.load(Scalar::Lreal, n * 8);
            code.int(0);
            code.load(Scalar::Lreal, self.tables.parameters + n * 56 + 24);
            code.push(I::F64Ge);
            code.get(parameters);
            code.load(Scalar::Lreal, n * 8);
            code.int(0);
            code.load(Scalar::Lreal, self.tables.parameters + n * 56 + 32);
            code.all([I::F64Le, I::I32And, I::I32Eqz]);
            code.when();
            self.fail(code, 0, self.text(BAD_RANGE));
            code.end();
        }
    }

    /// A first state with these parameters, in a new piece of memory.
    fn fresh(&self, code: &mut Code, made: u32, parameters: u32) {
        let bytes = self.layout.bytes() as u32;
        code.int(bytes);
        code.all([I::Call(self.plan.fixed.alloc), I::LocalTee(made)]);
        code.int(self.tables.template);
        code.int(bytes);
        code.copy();
        code.get(made);
        code.int(self.layout.parameters);
        code.push(I::I32Add);
        code.get(parameters);
        code.int(self.plan.checked.interface.parameters.len() as u32 * 8);
        code.copy();
    }

    /// Outputs hold what the actuators hold.
    fn track(&self, code: &mut Code, made: u32, track: u32) {
        let outputs = self.plan.checked.interface.ports.iter().filter(|port| port.output);
        for (n, port) in outputs.enumerate() {
            code.get(made);
            code.get(track);
            code.load(Scalar::Lreal, n as u32 * 8);
            code.convert(Scalar::Lreal, port.scalar);
            code.store(port.scalar, self.variable(port.offset));
        }
    }

    /// Where a variable of the program lies in a state.
    const fn variable(&self, offset: u32) -> u32 {
        self.layout.variables + HIDDEN + offset
    }

    fn good(&self, code: &mut Code, state: u32) {
        code.get(state);
        code.int(self.layout.bytes() as u32);
        code.push(I::Call(self.plan.fixed.ok));
    }

    /// `(parameters, count, track, count)`.
    fn start(&self) -> Code {
        let mut code = Code::new(&[I32, I32, I32, I32], &[I32]);
        let made = code.local(I32);
        self.check(&mut code, [0, 1, 3]);
        self.fresh(&mut code, made, 0);
        self.track(&mut code, made, 2);
        self.good(&mut code, made);
        code
    }

    /// `(sequence, time, dt, mode, setpoint, connected, state, length)`.
    fn step(&self) -> Code {
        let mut code = Code::new(&[I64, I64, I64, I32, F64, I64, I32, I32], &[I32]);
        let (dt, mode, setpoint, state, length) = (2, 3, 4, 6, 7);
        let fault = code.local(I32);
        code.get(length);
        code.int(self.layout.bytes() as u32);
        code.push(I::I32Ne);
        code.when();
        self.fail(&mut code, 1, self.text(BAD_STATE));
        code.end();
        // Name, layout and number of parameters; then the marks and entries, which follow from the layout.
        code.get(state);
        code.int(self.tables.template);
        code.int(self.layout.parameters);
        code.all([I::Call(self.plan.fixed.same), I::I32Eqz]);
        code.when();
        self.fail(&mut code, 1, self.text(BAD_STATE));
        code.end();

        code.int(0);
        code.set_global(Global::Fault);
        code.get(setpoint);
        code.set_global(Global::Setpoint);
        code.get(mode);
        code.set_global(Global::Automatic);
        code.get(dt);
        code.set_global(Global::Dt);
        code.get(0);
        code.set_global(Global::Cycle);
        code.get(state);
        code.int(self.layout.parameters);
        code.push(I::I32Add);
        code.set_global(Global::Parameters);
        let variables = self.layout.variables;
        code.get(state);
        code.get(state);
        code.load(Scalar::Time, variables);
        code.all([I::LocalGet(dt), I::I64Add]);
        code.store(Scalar::Time, variables);
        code.get(state);
        code.load(Scalar::Time, variables);
        code.set_global(Global::Clock);
        code.get(state);
        code.load(Scalar::Byte, variables + FLAG_AT);
        code.int(u32::from(FIRST));
        code.push(I::I32Eq);
        code.set_global(Global::First);
        code.get(state);
        code.load(Scalar::Byte, variables + FLAG_AT);
        code.all([I::I32Const(0), I::I32Ne, I::LocalGet(mode), I::I32Eqz, I::I32Or]);
        code.set_global(Global::Track);
        code.all([I::LocalGet(state), I::I32Const(0)]);
        code.store(Scalar::Byte, variables + FLAG_AT);

        self.inputs(&mut code, state);
        code.get(state);
        code.int(self.variable(0));
        code.push(I::I32Add);
        if let Some(function) = self.plan.pous.get(self.plan.checked.program).copied().flatten() {
            code.push(I::Call(function));
        }
        code.global(Global::Fault);
        code.push(I::LocalTee(fault));
        code.when();
        code.int(3);
        for word in [0, 4] {
            code.all([I::LocalGet(fault), I::I32Const(8), I::I32Mul]);
            // Faults are numbered from 1.
            code.push(I::I32Load(at(self.tables.sites.wrapping_sub(8) + word)));
        }
        code.all([I::Call(self.plan.fixed.err), I::Return]);
        code.end();
        self.outputs(&mut code, state);
        self.good(&mut code, state);
        code
    }

    /// What the frame holds, into the variables of the ports.
    fn inputs(&self, code: &mut Code, state: u32) {
        let connected = 5;
        for (n, port) in self.plan.checked.interface.ports.iter().enumerate() {
            let n = n as u32;
            if port.output {
                code.global(Global::Track);
                code.when();
            }
            code.int(n);
            code.all([I::I32Const(READING_AT), I::Call(READ)]);
            // 0 is good, 1 uncertain, 2 bad.
            code.int(0);
            code.push(I::I32Load8U(at(READING_AT as u32 + 8)));
            code.all([I::I32Const(2), I::I32LtU]);
            code.when();
            code.get(state);
            code.int(0);
            code.load(Scalar::Lreal, READING_AT as u32);
            code.convert(Scalar::Lreal, port.scalar);
            code.store(port.scalar, self.variable(port.offset));
            if let Some(quality) = port.quality {
                code.all([I::LocalGet(state), I::I32Const(1)]);
                code.store(Scalar::Bool, self.variable(quality));
            }
            if !port.output {
                code.push(I::Else);
                match (port.quality, port.required) {
                    (Some(quality), _) => {
                        code.all([I::LocalGet(state), I::I32Const(0)]);
                        code.store(Scalar::Bool, self.variable(quality));
                    }
                    (None, true) => self.no_value(code, n),
                    (None, false) => {
                        // One that nobody connected keeps its first value.
                        code.all([
                            I::LocalGet(connected),
                            I::I64Const(i64::from(n)),
                            I::I64ShrU,
                            I::I64Const(1),
                            I::I64And,
                            I::I64Eqz,
                            I::I32Eqz,
                        ]);
                        code.when();
                        self.no_value(code, n);
                        code.end();
                    }
                }
            }
            code.end();
            if port.output {
                code.end();
            }
        }
    }

    fn no_value(&self, code: &mut Code, port: u32) {
        let text = self.tables.inputs.get(port as usize).copied().unwrap_or_default();
        self.fail(code, 2, text);
    }

    /// Variables of the outputs, held within their ranges, to the host.
    fn outputs(&self, code: &mut Code, state: u32) {
        let value = code.local(F64);
        for (n, port) in self.plan.checked.interface.ports.iter().enumerate() {
            if !port.output {
                continue;
            }
            code.get(state);
            code.load(port.scalar, self.variable(port.offset));
            code.convert(port.scalar, Scalar::Lreal);
            if let Some((low, high)) = port.range {
                code.all([I::F64Const(low.into()), I::F64Max, I::F64Const(high.into()), I::F64Min]);
            }
            code.set(value);
            if port.range.is_some() {
                // The program sees what was sent.
                code.get(state);
                code.get(value);
                code.convert(Scalar::Lreal, port.scalar);
                code.store(port.scalar, self.variable(port.offset));
            }
            code.int(n as u32);
            code.all([I::LocalGet(value), I::Call(WRITE)]);
        }
    }

    /// `(name, length, version, length, layout, state, length, parameters, count, track, count)`.
    fn migrate(&self) -> Code {
        let mut code = Code::new(&[I32; 11], &[I32]);
        let (state, length, parameters, count, track, track_count) = (5, 6, 7, 8, 9, 10);
        let (made, end, at_own, old_table, old_count, old_at, same) = (
            code.local(I32),
            code.local(I32),
            code.local(I32),
            code.local(I32),
            code.local(I32),
            code.local(I32),
            code.local(I32),
        );
        let (n, m, size, taken) = (code.local(I32), code.local(I32), code.local(I32), code.local(I32));
        let (word, other) = (code.local(I64), code.local(I64));
        self.check(&mut code, [parameters, count, track_count]);
        code.all([I::LocalGet(state), I::LocalGet(length), I::I32Add, I::LocalSet(end)]);

        // Behind the front: 7 bytes, the name, the parameters. Each length is checked before what lies behind it is read.
        let bad = code.block();
        code.all([I::LocalGet(length), I::I32Const(7), I::I32LtU]);
        code.branch_if(bad);
        code.get(state);
        code.load(Scalar::Byte, 0);
        code.int(u32::from(MARK));
        code.push(I::I32Ne);
        code.branch_if(bad);
        code.get(state);
        code.load(Scalar::Byte, 1);
        code.all([
            I::LocalGet(state),
            I::I32Add,
            I::I32Const(7),
            I::I32Add,
            I::LocalTee(at_own),
        ]);
        code.all([I::LocalGet(end), I::I32GtU]);
        code.branch_if(bad);
        // The byte before is the number of parameters.
        code.all([I::LocalGet(at_own), I::LocalGet(at_own), I::I32Const(1), I::I32Sub]);
        code.load(Scalar::Byte, 0);
        code.all([I::I32Const(8), I::I32Mul, I::I32Add, I::LocalTee(at_own)]);
        code.all([I::I32Const(8), I::I32Add, I::LocalGet(end), I::I32GtU]);
        code.branch_if(bad);
        code.get(at_own);
        code.load(Scalar::Udint, 0);
        code.int(OWN_MARK);
        code.push(I::I32Ne);
        code.branch_if(bad);
        code.get(at_own);
        code.load(Scalar::Udint, 4);
        code.push(I::LocalTee(old_count));
        // No state holds more entries than it has bytes; so the sum below cannot wrap.
        code.all([I::LocalGet(length), I::I32GtU]);
        code.branch_if(bad);
        code.all([I::LocalGet(at_own), I::I32Const(8), I::I32Add, I::LocalTee(old_table)]);
        code.all([
            I::LocalGet(old_count),
            I::I32Const(8),
            I::I32Mul,
            I::I32Add,
            I::LocalGet(end),
            I::I32GtU,
        ]);
        code.branch_if(bad);

        // The same program, by its name?
        code.get(state);
        code.load(Scalar::Byte, 1);
        code.int(self.layout.name);
        code.push(I::I32Eq);
        code.when();
        code.all([I::LocalGet(state), I::I32Const(2), I::I32Add]);
        code.int(self.tables.template + 2);
        code.int(self.layout.name);
        code.all([I::Call(self.plan.fixed.same), I::LocalSet(same)]);
        code.end();

        self.fresh(&mut code, made, parameters);
        let done = code.block();
        let each = code.repeat();
        code.get(n);
        code.int(self.layout.entries.len() as u32);
        code.push(I::I32GeU);
        code.branch_if(done);
        let next = code.block();
        // Lives it on? 1 in the same program, 2 in any.
        code.all([I::LocalGet(n), I::I32Const(8), I::I32Mul]);
        code.load(Scalar::Udint, self.tables.entries + 4);
        code.all([I::I32Const(2), I::LocalGet(same), I::I32Sub, I::I32LtU]);
        code.branch_if(next);
        let table = self.layout.variables - self.layout.entries.len() as u32 * 8;
        code.all([I::LocalGet(made), I::LocalGet(n), I::I32Const(8), I::I32Mul, I::I32Add]);
        code.load(Scalar::Ulint, table);
        code.set(word);
        // The old variables lie behind their table.
        code.all([
            I::LocalGet(old_table),
            I::LocalGet(old_count),
            I::I32Const(8),
            I::I32Mul,
            I::I32Add,
            I::LocalSet(old_at),
        ]);
        code.all([I::I32Const(0), I::LocalSet(m)]);
        let search = code.repeat();
        code.all([I::LocalGet(m), I::LocalGet(old_count), I::I32GeU]);
        code.branch_if(next);
        code.all([
            I::LocalGet(old_table),
            I::LocalGet(m),
            I::I32Const(8),
            I::I32Mul,
            I::I32Add,
        ]);
        code.load(Scalar::Ulint, 0);
        code.all([
            I::LocalTee(other),
            I::I32WrapI64,
            I::I32Const(0xffff),
            I::I32And,
            I::LocalSet(size),
        ]);
        code.all([
            I::LocalGet(old_at),
            I::LocalGet(size),
            I::I32Add,
            I::LocalGet(end),
            I::I32GtU,
        ]);
        code.branch_if(bad);
        code.all([I::LocalGet(other), I::LocalGet(word), I::I64Eq]);
        code.when();
        code.all([I::LocalGet(made), I::LocalGet(n), I::I32Const(8), I::I32Mul]);
        code.load(Scalar::Udint, self.tables.entries);
        code.push(I::I32Add);
        code.int(self.layout.variables);
        code.all([I::I32Add, I::LocalGet(old_at), I::LocalGet(size)]);
        code.copy();
        // The clock alone is no reason to take a state over.
        code.all([
            I::LocalGet(taken),
            I::LocalGet(n),
            I::I32Const(0),
            I::I32Ne,
            I::I32Add,
            I::LocalSet(taken),
        ]);
        code.branch(next);
        code.end();
        code.all([I::LocalGet(old_at), I::LocalGet(size), I::I32Add, I::LocalSet(old_at)]);
        code.all([I::LocalGet(m), I::I32Const(1), I::I32Add, I::LocalSet(m)]);
        code.branch(search);
        code.end();
        code.end();
        code.all([I::LocalGet(n), I::I32Const(1), I::I32Add, I::LocalSet(n)]);
        code.branch(each);
        code.end();
        code.end();

        code.all([I::LocalGet(same), I::LocalGet(taken), I::I32Or, I::I32Eqz]);
        code.when();
        self.fail(&mut code, 1, self.text(NOTHING));
        code.end();
        code.get(same);
        code.when();
        code.all([I::LocalGet(made), I::I32Const(CHANGED)]);
        code.store(Scalar::Byte, self.layout.variables + FLAG_AT);
        code.end();
        self.track(&mut code, made, track);
        self.good(&mut code, made);
        code.push(I::Return);
        code.end();
        self.fail(&mut code, 1, self.text(NO_STATE));
        code.push(I::Unreachable);
        code
    }
}
