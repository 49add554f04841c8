//! Code of programs, blocks and functions.
//!
//! A block's function takes the address of its instance and of what its VAR_IN_OUT name; a function takes one value or address per
//! parameter and gives its answer. Never: a fault that leaves a loop running.

use wasm_encoder::{Instruction as I, ValType};

use super::{Code, Global, Plan, is_function, val_type};
use crate::{
    hir::{Argument, Base, Branch, Expr, External, Input, Kind, Place, Stmt},
    types::{Scalar, Ty},
};

/// What can be left.
#[derive(Debug, Clone, Copy)]
struct Loop {
    exit: u32,
    next: u32,
}

struct Writer<'p, 'c> {
    plan: &'p Plan<'c>,
    code: Code,
    loops: Vec<Loop>,
    /// Where the answer lies, of a function.
    answer: Option<(Scalar, u32)>,
}

/// The code of one POU.
pub(super) fn code(plan: &Plan<'_>, number: usize) -> Code {
    let Some(pou) = plan.checked.pous.get(number) else {
        return Code::default();
    };
    let (begin, length) = pou.frame;
    let function = is_function(pou.ast.kind);
    let parameters: Vec<ValType> = pou
        .parameters
        .iter()
        .map(|parameter| match parameter.ty.scalar() {
            Some(scalar) if !parameter.reference => val_type(scalar),
            _ => ValType::I32,
        })
        .collect();
    let answer = pou
        .result
        .as_ref()
        .and_then(|(ty, offset)| Some((ty.scalar()?, *offset)));
    let code = if function {
        let results: Vec<ValType> = answer.iter().map(|(scalar, _)| val_type(*scalar)).collect();
        Code::new(&parameters, &results)
    } else {
        Code::new(&[&[ValType::I32], parameters.as_slice()].concat(), &[])
    };
    let mut writer = Writer {
        plan,
        code,
        loops: Vec::new(),
        answer: answer.map(|(scalar, offset)| (scalar, plan.frames + begin + offset)),
    };
    if length > 0 {
        writer.code.int(plan.frames + begin);
        writer.code.int(plan.templates + begin);
        writer.code.int(length);
        writer.code.copy();
    }
    if function {
        for (n, parameter) in pou.parameters.iter().enumerate() {
            if parameter.reference {
                continue;
            }
            let address = plan.frames + begin + parameter.offset;
            writer.code.int(address);
            writer.code.get(n as u32);
            match parameter.ty.scalar() {
                Some(scalar) => writer.code.store(scalar, 0),
                None => {
                    writer.code.int(plan.checked.types.size(&parameter.ty));
                    writer.code.copy();
                }
            }
        }
    }
    if let Some(body) = &pou.body {
        writer.statements(&body.statements);
    }
    writer.give_answer();
    writer.code
}

impl Writer<'_, '_> {
    fn give_answer(&mut self) {
        if let Some((scalar, address)) = self.answer {
            self.code.int(0);
            self.code.load(scalar, address);
        }
    }

    /// Leaves an address on the stack; what is given back is to be added to it.
    fn address(&mut self, place: &Place) -> u32 {
        let mut offset = place.offset;
        match place.base {
            Base::Own => self.code.get(0),
            Base::InOut(parameter) => self.code.get(parameter),
            Base::Frame(number) => {
                let begin = self.plan.checked.pous.get(number).map_or(0, |pou| pou.frame.0);
                offset += self.plan.frames + begin;
                self.code.int(0);
            }
        }
        for index in &place.indices {
            self.expression(&index.value);
            self.code.push(I::I64Const(index.low));
            self.code.int(index.count);
            self.code.int(index.site);
            self.code.push(I::Call(self.plan.fixed.index));
            self.code.int(index.stride);
            self.code.all([I::I32Mul, I::I32Add]);
        }
        offset
    }

    /// Leaves the whole address on the stack.
    fn whole_address(&mut self, place: &Place) {
        let offset = self.address(place);
        if offset > 0 {
            self.code.int(offset);
            self.code.push(I::I32Add);
        }
    }

    fn expression(&mut self, expr: &Expr) {
        let scalar = expr.ty.scalar().unwrap_or(Scalar::Dint);
        match &expr.kind {
            Kind::Value(value) => self.code.value(scalar, *value),
            Kind::Load(place) => {
                let offset = self.address(place);
                self.code.load(scalar, offset);
            }
            Kind::Parameter(number) => {
                self.code.global(Global::Parameters);
                self.code.load(Scalar::Lreal, number * 8);
                if expr.ty == Ty::Scalar(Scalar::Time) {
                    // Parameters of time are in s.
                    self.code.all([I::F64Const(1e9.into()), I::F64Mul]);
                }
                self.code.convert(Scalar::Lreal, scalar);
            }
            Kind::External(external) => self.code.global(match external {
                External::Setpoint => Global::Setpoint,
                External::Automatic => Global::Automatic,
                External::Track => Global::Track,
                External::First => Global::First,
                External::Dt => Global::Dt,
                External::Cycle => Global::Cycle,
                External::Clock => Global::Clock,
            }),
            Kind::One(op, operand) => {
                self.expression(operand);
                self.code.one(*op, operand.ty.scalar().unwrap_or(scalar));
            }
            Kind::Two(op, operands, left, right) => {
                self.expression(left);
                self.expression(right);
                self.code.two(*op, *operands, &self.plan.fixed);
            }
            Kind::Convert(inner, from, to) => {
                self.expression(inner);
                self.code.convert(*from, *to);
            }
            Kind::Select(condition, no, yes) => {
                self.expression(yes);
                self.expression(no);
                self.expression(condition);
                self.code.push(I::Select);
            }
            Kind::Call(number, arguments) => {
                for argument in arguments {
                    match argument {
                        Argument::Value(value) => self.expression(value),
                        Argument::Address(place) => self.whole_address(place),
                    }
                }
                self.call(*number);
            }
        }
    }

    fn call(&mut self, number: usize) {
        if let Some(function) = self.plan.pous.get(number).copied().flatten() {
            self.code.push(I::Call(function));
        }
    }

    fn statements(&mut self, statements: &[Stmt]) {
        for statement in statements {
            self.statement(statement);
        }
    }

    fn assign(&mut self, place: &Place, value: &Expr) {
        let Some(scalar) = place.ty.scalar() else { return };
        let offset = self.address(place);
        self.expression(value);
        self.code.store(scalar, offset);
    }

    fn statement(&mut self, statement: &Stmt) {
        match statement {
            Stmt::At(place) => self.code.mark(*place),
            Stmt::Assign(place, value) => self.assign(place, value),
            Stmt::Copy(to, from, bytes) => {
                self.whole_address(to);
                self.whole_address(from);
                self.code.int(*bytes);
                self.code.copy();
            }
            Stmt::Invoke {
                block,
                instance,
                inputs,
                references,
                outputs,
            } => {
                let at = self.code.local(ValType::I32);
                self.whole_address(instance);
                self.code.set(at);
                for (offset, input) in inputs {
                    self.code.get(at);
                    match input {
                        Input::Value(value) => {
                            self.expression(value);
                            self.code.store(value.ty.scalar().unwrap_or(Scalar::Dint), *offset);
                        }
                        Input::Copy(from, bytes) => {
                            self.code.int(*offset);
                            self.code.push(I::I32Add);
                            self.whole_address(from);
                            self.code.int(*bytes);
                            self.code.copy();
                        }
                    }
                }
                self.code.get(at);
                for place in references {
                    self.whole_address(place);
                }
                self.call(*block);
                for output in outputs {
                    match output.target.ty.scalar() {
                        Some(scalar) => {
                            let offset = self.address(&output.target);
                            self.code.get(at);
                            self.code.load(output.from.scalar().unwrap_or(scalar), output.offset);
                            if let Some((from, to)) = output.convert {
                                self.code.convert(from, to);
                            }
                            self.code.store(scalar, offset);
                        }
                        None => {
                            self.whole_address(&output.target);
                            self.code.get(at);
                            self.code.int(output.offset);
                            self.code.push(I::I32Add);
                            self.code.int(output.size);
                            self.code.copy();
                        }
                    }
                }
            }
            Stmt::Call(expr, outputs) => {
                self.expression(expr);
                self.code.push(I::Drop);
                for (target, value) in outputs {
                    self.assign(target, value);
                }
            }
            Stmt::If(branches, otherwise) => {
                for (condition, body) in branches {
                    self.expression(condition);
                    self.code.when();
                    self.statements(body);
                    self.code.push(I::Else);
                }
                self.statements(otherwise);
                for _ in branches {
                    self.code.end();
                }
            }
            Stmt::Case(selector, cases, otherwise) => self.case(selector, cases, otherwise),
            Stmt::For {
                variable,
                scalar,
                from,
                to,
                by,
                body,
            } => self.counted(variable, *scalar, [from, to, by], body),
            Stmt::While(condition, body) => {
                let exit = self.code.block();
                let top = self.code.repeat();
                self.expression(condition);
                self.code.push(I::I32Eqz);
                self.code.branch_if(exit);
                self.repeated(exit, body);
                self.code.branch(top);
                self.code.end();
                self.code.end();
            }
            Stmt::Repeat(body, until) => {
                let exit = self.code.block();
                let top = self.code.repeat();
                self.repeated(exit, body);
                self.expression(until);
                self.code.push(I::I32Eqz);
                self.code.branch_if(top);
                self.code.end();
                self.code.end();
            }
            Stmt::Exit => {
                if let Some(here) = self.loops.last().copied() {
                    self.code.branch(here.exit);
                }
            }
            Stmt::Continue => {
                if let Some(here) = self.loops.last().copied() {
                    self.code.branch(here.next);
                }
            }
            Stmt::Return => {
                self.give_answer();
                self.code.push(I::Return);
            }
        }
    }

    /// The body of a loop; behind it, a fault ends the loop.
    fn repeated(&mut self, exit: u32, body: &[Stmt]) {
        let next = self.code.block();
        self.loops.push(Loop { exit, next });
        self.statements(body);
        self.loops.pop();
        self.code.end();
        self.code.global(Global::Fault);
        self.code.branch_if(exit);
    }

    fn case(&mut self, selector: &Expr, cases: &[Branch], otherwise: &[Stmt]) {
        let chosen = self.code.local(ValType::I64);
        self.expression(selector);
        self.code.set(chosen);
        let end = self.code.block();
        for (ranges, body) in cases {
            self.code.int(0);
            for (low, high) in ranges {
                if low == high {
                    self.code.all([I::LocalGet(chosen), I::I64Const(*low), I::I64Eq]);
                } else {
                    self.code.all([I::LocalGet(chosen), I::I64Const(*low), I::I64GeS]);
                    self.code
                        .all([I::LocalGet(chosen), I::I64Const(*high), I::I64LeS, I::I32And]);
                }
                self.code.push(I::I32Or);
            }
            self.code.when();
            self.statements(body);
            self.code.branch(end);
            self.code.end();
        }
        self.statements(otherwise);
        self.code.end();
    }

    /// Counts in 64 bits, and never beyond the last value: a variable of any type ends where it should.
    fn counted(&mut self, variable: &Place, scalar: Scalar, [from, to, by]: [&Expr; 3], body: &[Stmt]) {
        let (count, last, step) = (
            self.code.local(ValType::I64),
            self.code.local(ValType::I64),
            self.code.local(ValType::I64),
        );
        for (expr, local) in [(from, count), (to, last), (by, step)] {
            self.expression(expr);
            self.code.set(local);
        }
        let exit = self.code.block();
        // Nothing to do: the first value lies beyond the last one, or there is no step.
        self.code.all([I::LocalGet(step), I::I64Eqz]);
        self.code.branch_if(exit);
        self.code.all([I::LocalGet(count), I::LocalGet(last), I::I64GtS]);
        self.code.all([I::LocalGet(count), I::LocalGet(last), I::I64LtS]);
        self.code.all([I::LocalGet(step), I::I64Const(0), I::I64GtS, I::Select]);
        self.code.branch_if(exit);
        let top = self.code.repeat();
        let offset = self.address(variable);
        self.code.get(count);
        self.code.convert(Scalar::Lint, scalar);
        self.code.store(scalar, offset);
        self.repeated(exit, body);
        // Fewer than a step is left.
        self.code.all([I::LocalGet(last), I::LocalGet(count), I::I64Sub]);
        self.code.all([I::LocalGet(step), I::I64LtU]);
        self.code.all([I::LocalGet(count), I::LocalGet(last), I::I64Sub]);
        self.code.all([I::I64Const(0), I::LocalGet(step), I::I64Sub, I::I64LtU]);
        self.code.all([I::LocalGet(step), I::I64Const(0), I::I64GtS, I::Select]);
        self.code.branch_if(exit);
        self.code
            .all([I::LocalGet(count), I::LocalGet(step), I::I64Add, I::LocalSet(count)]);
        self.code.branch(top);
        self.code.end();
        self.code.end();
    }
}
