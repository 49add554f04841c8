//! Arithmetic and conversions of elementary values.
//!
//! Whole values narrower than 32 bits lie on the stack as i32, extended by their sign or by zeros. `fold` does the same while
//! compiling. Never: memory.

use wasm_encoder::{Instruction as I, ValType};

use super::{Code, fixed::Fixed, val_type};
use crate::{
    hir::{One, Op, Value},
    types::Scalar,
};

const fn is_64(scalar: Scalar) -> bool {
    scalar.bits() == 64
}

impl Code {
    pub(super) fn value(&mut self, scalar: Scalar, value: Value) {
        self.push(match value {
            Value::Real(x) => I::F32Const(x.into()),
            Value::Lreal(x) => I::F64Const(x.into()),
            Value::Whole(n) if is_64(scalar) => I::I64Const(n),
            Value::Whole(n) => I::I32Const(n as i32),
        });
    }

    /// Keeps the low bits of a narrow type.
    fn narrow(&mut self, scalar: Scalar) {
        match scalar {
            Scalar::Sint => self.push(I::I32Extend8S),
            Scalar::Int => self.push(I::I32Extend16S),
            Scalar::Usint | Scalar::Byte => self.all([I::I32Const(0xff), I::I32And]),
            Scalar::Uint | Scalar::Word => self.all([I::I32Const(0xffff), I::I32And]),
            Scalar::Bool => self.all([I::I32Const(1), I::I32And]),
            _ => {}
        }
    }

    pub(super) fn convert(&mut self, from: Scalar, to: Scalar) {
        if from == to {
            return;
        }
        match (from, to) {
            (Scalar::Real, Scalar::Lreal) => self.push(I::F64PromoteF32),
            (Scalar::Lreal, Scalar::Real) => self.push(I::F32DemoteF64),
            (from, to) if from.is_real() => {
                if from == Scalar::Real {
                    self.push(I::F64PromoteF32);
                }
                self.rounded(to);
            }
            (from, Scalar::Real) => self.push(match (is_64(from), from.signed()) {
                (false, true) => I::F32ConvertI32S,
                (false, false) => I::F32ConvertI32U,
                (true, true) => I::F32ConvertI64S,
                (true, false) => I::F32ConvertI64U,
            }),
            (from, Scalar::Lreal) => self.push(match (is_64(from), from.signed()) {
                (false, true) => I::F64ConvertI32S,
                (false, false) => I::F64ConvertI32U,
                (true, true) => I::F64ConvertI64S,
                (true, false) => I::F64ConvertI64U,
            }),
            (from, Scalar::Bool) => {
                if is_64(from) {
                    self.push(I::I64Eqz);
                } else {
                    self.push(I::I32Eqz);
                }
                self.push(I::I32Eqz);
            }
            (from, to) => match (is_64(from), is_64(to)) {
                (true, false) => {
                    self.push(I::I32WrapI64);
                    self.narrow(to);
                }
                (false, true) => self.push(if from.signed() {
                    I::I64ExtendI32S
                } else {
                    I::I64ExtendI32U
                }),
                (false, false) => self.narrow(to),
                (true, true) => {}
            },
        }
    }

    /// An LREAL becomes a whole value: to the nearest, within the range.
    fn rounded(&mut self, to: Scalar) {
        match to {
            // Also false where there is no number.
            Scalar::Bool => self.all([I::F64Nearest, I::F64Abs, I::F64Const(0.0.into()), I::F64Gt]),
            Scalar::Ulint | Scalar::Lword => self.all([I::F64Nearest, I::I64TruncSatF64U]),
            to if is_64(to) => self.all([I::F64Nearest, I::I64TruncSatF64S]),
            to => {
                let (low, high) = to.range();
                self.all([
                    I::F64Nearest,
                    I::F64Const((low as f64).into()),
                    I::F64Max,
                    I::F64Const((high as f64).into()),
                    I::F64Min,
                    I::I64TruncSatF64S,
                    I::I32WrapI64,
                ]);
            }
        }
    }

    /// One operand, which lies on the stack.
    pub(super) fn one(&mut self, op: One, scalar: Scalar) {
        match (op, val_type(scalar)) {
            (One::Negate, ValType::F32) => self.push(I::F32Neg),
            (One::Negate, ValType::F64) => self.push(I::F64Neg),
            (One::Negate, ValType::I64) => self.all([I::I64Const(-1), I::I64Mul]),
            (One::Negate, _) => {
                self.all([I::I32Const(-1), I::I32Mul]);
                self.narrow(scalar);
            }
            (One::Not, ValType::I64) => self.all([I::I64Const(-1), I::I64Xor]),
            (One::Not, _) if scalar == Scalar::Bool => self.push(I::I32Eqz),
            (One::Not, _) => {
                self.all([I::I32Const(-1), I::I32Xor]);
                self.narrow(scalar);
            }
            (One::Abs, ValType::F32) => self.push(I::F32Abs),
            (One::Abs, ValType::F64) => self.push(I::F64Abs),
            (One::Abs, _) if !scalar.signed() => {}
            (One::Abs, ValType::I64) => {
                let x = self.local(ValType::I64);
                self.all([I::LocalTee(x), I::I64Const(0), I::LocalGet(x), I::I64Sub]);
                self.all([I::LocalGet(x), I::I64Const(0), I::I64GeS, I::Select]);
            }
            (One::Abs, _) => {
                let x = self.local(ValType::I32);
                self.all([I::LocalTee(x), I::I32Const(0), I::LocalGet(x), I::I32Sub]);
                self.all([I::LocalGet(x), I::I32Const(0), I::I32GeS, I::Select]);
                self.narrow(scalar);
            }
            (One::Sqrt, ValType::F32) => self.push(I::F32Sqrt),
            (One::Sqrt, _) => self.push(I::F64Sqrt),
            (One::Floor, _) => self.push(I::F64Floor),
            (One::Trunc, ValType::F32) => self.push(I::F32Trunc),
            (One::Trunc, _) => self.push(I::F64Trunc),
            (One::Nearest, _) => self.push(I::F64Nearest),
            (One::Bits, _) => self.push(I::I64ReinterpretF64),
            (One::OfBits, _) => self.push(I::F64ReinterpretI64),
        }
    }

    /// Two operands, which lie on the stack.
    pub(super) fn two(&mut self, op: Op, scalar: Scalar, fixed: &Fixed) {
        match val_type(scalar) {
            ValType::F32 => self.two_f32(op, fixed),
            ValType::F64 => self.two_f64(op, fixed),
            ValType::I64 => self.two_i64(op, scalar, fixed),
            _ => self.two_i32(op, scalar, fixed),
        }
    }

    fn two_f32(&mut self, op: Op, fixed: &Fixed) {
        let instruction = match op {
            Op::Add => I::F32Add,
            Op::Sub => I::F32Sub,
            Op::Mul => I::F32Mul,
            Op::Div(site) | Op::Mod(site) => {
                self.push(I::I32Const(site as i32));
                return self.push(I::Call(fixed.div_f32));
            }
            Op::Ne => I::F32Ne,
            Op::Lt => I::F32Lt,
            Op::Le => I::F32Le,
            Op::Gt => I::F32Gt,
            Op::Ge => I::F32Ge,
            Op::Min => I::F32Min,
            Op::Max => I::F32Max,
            _ => I::F32Eq,
        };
        self.push(instruction);
    }

    fn two_f64(&mut self, op: Op, fixed: &Fixed) {
        let instruction = match op {
            Op::Add => I::F64Add,
            Op::Sub => I::F64Sub,
            Op::Mul => I::F64Mul,
            Op::Div(site) | Op::Mod(site) => {
                self.push(I::I32Const(site as i32));
                return self.push(I::Call(fixed.div_f64));
            }
            Op::Ne => I::F64Ne,
            Op::Lt => I::F64Lt,
            Op::Le => I::F64Le,
            Op::Gt => I::F64Gt,
            Op::Ge => I::F64Ge,
            Op::Min => I::F64Min,
            Op::Max => I::F64Max,
            _ => I::F64Eq,
        };
        self.push(instruction);
    }

    fn two_i64(&mut self, op: Op, scalar: Scalar, fixed: &Fixed) {
        let signed = scalar.signed();
        let or = |a, b| if signed { a } else { b };
        match op {
            Op::Div(site) => {
                self.int(site);
                self.push(I::Call(or(fixed.div_s64, fixed.div_u64)));
            }
            Op::Mod(site) => {
                self.int(site);
                self.push(I::Call(or(fixed.rem_s64, fixed.rem_u64)));
            }
            Op::Min | Op::Max => {
                let (a, b) = (self.local(ValType::I64), self.local(ValType::I64));
                self.all([
                    I::LocalSet(b),
                    I::LocalTee(a),
                    I::LocalGet(b),
                    I::LocalGet(a),
                    I::LocalGet(b),
                ]);
                let below = if signed { I::I64LtS } else { I::I64LtU };
                let above = if signed { I::I64GeS } else { I::I64GeU };
                self.push(if op == Op::Min { below } else { above });
                self.push(I::Select);
            }
            Op::Shl | Op::Shr => {
                let by = self.local(ValType::I64);
                self.push(I::LocalTee(by));
                self.push(if op == Op::Shl { I::I64Shl } else { I::I64ShrU });
                self.all([I::I64Const(0), I::LocalGet(by), I::I64Const(64), I::I64LtU, I::Select]);
            }
            Op::Add => self.push(I::I64Add),
            Op::Sub => self.push(I::I64Sub),
            Op::Mul => self.push(I::I64Mul),
            Op::And => self.push(I::I64And),
            Op::Or => self.push(I::I64Or),
            Op::Xor => self.push(I::I64Xor),
            Op::Rol => self.push(I::I64Rotl),
            Op::Ror => self.push(I::I64Rotr),
            Op::Eq => self.push(I::I64Eq),
            Op::Ne => self.push(I::I64Ne),
            Op::Lt => self.push(if signed { I::I64LtS } else { I::I64LtU }),
            Op::Le => self.push(if signed { I::I64LeS } else { I::I64LeU }),
            Op::Gt => self.push(if signed { I::I64GtS } else { I::I64GtU }),
            Op::Ge => self.push(if signed { I::I64GeS } else { I::I64GeU }),
        }
    }

    fn two_i32(&mut self, op: Op, scalar: Scalar, fixed: &Fixed) {
        let signed = scalar.signed();
        let or = |a, b| if signed { a } else { b };
        let bits = scalar.bits() as i32;
        match op {
            Op::Div(site) => {
                self.int(site);
                self.push(I::Call(or(fixed.div_s32, fixed.div_u32)));
            }
            Op::Mod(site) => {
                self.int(site);
                self.push(I::Call(or(fixed.rem_s32, fixed.rem_u32)));
            }
            Op::Min | Op::Max => {
                let (a, b) = (self.local(ValType::I32), self.local(ValType::I32));
                self.all([
                    I::LocalSet(b),
                    I::LocalTee(a),
                    I::LocalGet(b),
                    I::LocalGet(a),
                    I::LocalGet(b),
                ]);
                let below = if signed { I::I32LtS } else { I::I32LtU };
                let above = if signed { I::I32GeS } else { I::I32GeU };
                self.push(if op == Op::Min { below } else { above });
                self.push(I::Select);
            }
            Op::Shl | Op::Shr => {
                let by = self.local(ValType::I32);
                self.push(I::LocalTee(by));
                self.push(if op == Op::Shl { I::I32Shl } else { I::I32ShrU });
                self.all([I::I32Const(0), I::LocalGet(by), I::I32Const(bits), I::I32LtU, I::Select]);
            }
            Op::Rol if bits == 32 => self.push(I::I32Rotl),
            Op::Ror if bits == 32 => self.push(I::I32Rotr),
            Op::Rol | Op::Ror => {
                let (a, by) = (self.local(ValType::I32), self.local(ValType::I32));
                let (toward, back) = if op == Op::Rol {
                    (I::I32Shl, I::I32ShrU)
                } else {
                    (I::I32ShrU, I::I32Shl)
                };
                self.all([I::LocalSet(by), I::LocalTee(a), I::LocalGet(by)]);
                self.push(toward);
                self.all([I::LocalGet(a), I::I32Const(bits), I::LocalGet(by), I::I32Sub]);
                self.push(back);
                self.push(I::I32Or);
            }
            Op::Add => self.push(I::I32Add),
            Op::Sub => self.push(I::I32Sub),
            Op::Mul => self.push(I::I32Mul),
            Op::And => self.push(I::I32And),
            Op::Or => self.push(I::I32Or),
            Op::Xor => self.push(I::I32Xor),
            Op::Eq => self.push(I::I32Eq),
            Op::Ne => self.push(I::I32Ne),
            Op::Lt => self.push(if signed { I::I32LtS } else { I::I32LtU }),
            Op::Le => self.push(if signed { I::I32LeS } else { I::I32LeU }),
            Op::Gt => self.push(if signed { I::I32GtS } else { I::I32GtU }),
            Op::Ge => self.push(if signed { I::I32GeS } else { I::I32GeU }),
        }
        if !op.compares() {
            self.narrow(scalar);
        }
    }
}
