//! Arithmetic while compiling. It gives, bit for bit, what the compiled code gives; a property test holds both together.
//!
//! Never: a value where the code would fault.

use crate::{
    hir::{One, Op, Value},
    types::Scalar,
};

/// Keeps the low bits, as storing does.
#[must_use]
pub(crate) const fn wrap(scalar: Scalar, value: i64) -> i64 {
    match scalar {
        Scalar::Bool => value & 1,
        Scalar::Sint => value as i8 as i64,
        Scalar::Usint | Scalar::Byte => value as u8 as i64,
        Scalar::Int => value as i16 as i64,
        Scalar::Uint | Scalar::Word => value as u16 as i64,
        Scalar::Dint => value as i32 as i64,
        Scalar::Udint | Scalar::Dword => value as u32 as i64,
        _ => value,
    }
}

const fn is_u64(scalar: Scalar) -> bool {
    matches!(scalar, Scalar::Ulint | Scalar::Lword)
}

/// Both operands are of the type `scalar`. None where the code would fault, or there is no such operation.
pub(crate) fn two(op: Op, scalar: Scalar, a: Value, b: Value) -> Option<Value> {
    match (a, b) {
        (Value::Whole(a), Value::Whole(b)) => whole(op, scalar, a, b).map(Value::Whole),
        (Value::Real(a), Value::Real(b)) => {
            if let Some(answer) = compare(op, a.partial_cmp(&b)) {
                return Some(answer);
            }
            Some(Value::Real(match op {
                Op::Add => a + b,
                Op::Sub => a - b,
                Op::Mul => a * b,
                Op::Div(_) if b != 0.0 => a / b,
                Op::Min => wasm_min(f64::from(a), f64::from(b)) as f32,
                Op::Max => wasm_max(f64::from(a), f64::from(b)) as f32,
                _ => return None,
            }))
        }
        (Value::Lreal(a), Value::Lreal(b)) => {
            if let Some(answer) = compare(op, a.partial_cmp(&b)) {
                return Some(answer);
            }
            Some(Value::Lreal(match op {
                Op::Add => a + b,
                Op::Sub => a - b,
                Op::Mul => a * b,
                Op::Div(_) if b != 0.0 => a / b,
                Op::Min => wasm_min(a, b),
                Op::Max => wasm_max(a, b),
                _ => return None,
            }))
        }
        _ => None,
    }
}

/// As WebAssembly has it: no number goes through, and -0 lies below 0.
fn wasm_min(a: f64, b: f64) -> f64 {
    if a.is_nan() || b.is_nan() {
        f64::NAN
    } else if a < b || (a == b && a.is_sign_negative()) {
        a
    } else {
        b
    }
}

fn wasm_max(a: f64, b: f64) -> f64 {
    -wasm_min(-a, -b)
}

/// None for operations that are no comparisons; of what cannot be compared all but `<>` is false.
fn compare(op: Op, ordering: Option<std::cmp::Ordering>) -> Option<Value> {
    let answer = match op {
        Op::Eq => ordering.is_some_and(std::cmp::Ordering::is_eq),
        Op::Ne => !ordering.is_some_and(std::cmp::Ordering::is_eq),
        Op::Lt => ordering.is_some_and(std::cmp::Ordering::is_lt),
        Op::Le => ordering.is_some_and(std::cmp::Ordering::is_le),
        Op::Gt => ordering.is_some_and(std::cmp::Ordering::is_gt),
        Op::Ge => ordering.is_some_and(std::cmp::Ordering::is_ge),
        _ => return None,
    };
    Some(Value::Whole(i64::from(answer)))
}

fn whole(op: Op, scalar: Scalar, a: i64, b: i64) -> Option<i64> {
    let ordering = if is_u64(scalar) {
        (a as u64).cmp(&(b as u64))
    } else {
        a.cmp(&b)
    };
    if let Some(Value::Whole(answer)) = compare(op, Some(ordering)) {
        return Some(answer);
    }
    let bits = scalar.bits();
    let mask = if bits == 64 { u64::MAX } else { (1_u64 << bits) - 1 };
    let low = a as u64 & mask;
    let turn = (b as u64 % u64::from(bits)) as u32;
    let answer = match op {
        Op::Add => a.wrapping_add(b),
        Op::Sub => a.wrapping_sub(b),
        Op::Mul => a.wrapping_mul(b),
        Op::Div(_) | Op::Mod(_) if b == 0 => return None,
        Op::Div(_) if is_u64(scalar) => (a as u64 / b as u64) as i64,
        Op::Mod(_) if is_u64(scalar) => (a as u64 % b as u64) as i64,
        Op::Div(_) => a.wrapping_div(b),
        Op::Mod(_) => a.wrapping_rem(b),
        Op::And => a & b,
        Op::Or => a | b,
        Op::Xor => a ^ b,
        Op::Min => {
            if ordering.is_lt() {
                a
            } else {
                b
            }
        }
        Op::Max => {
            if ordering.is_lt() {
                b
            } else {
                a
            }
        }
        Op::Shl | Op::Shr if b < 0 || b >= i64::from(bits) => 0,
        Op::Shl => (low << b) as i64,
        Op::Shr => (low >> b) as i64,
        Op::Rol => ((low << turn) | (low.checked_shr(bits - turn).unwrap_or(0))) as i64,
        Op::Ror => ((low >> turn) | (low.checked_shl(bits - turn).unwrap_or(0))) as i64,
        Op::Eq | Op::Ne | Op::Lt | Op::Le | Op::Gt | Op::Ge => return None,
    };
    Some(wrap(scalar, answer))
}

/// The operand is of the type `scalar`.
pub(crate) fn one(op: One, scalar: Scalar, a: Value) -> Option<Value> {
    Some(match (op, a) {
        (One::Negate, Value::Whole(a)) => Value::Whole(wrap(scalar, a.wrapping_neg())),
        (One::Negate, Value::Real(a)) => Value::Real(-a),
        (One::Negate, Value::Lreal(a)) => Value::Lreal(-a),
        (One::Not, Value::Whole(a)) => Value::Whole(wrap(scalar, !a)),
        (One::Abs, Value::Whole(a)) if scalar.signed() => Value::Whole(wrap(scalar, a.wrapping_abs())),
        (One::Abs, Value::Whole(a)) => Value::Whole(a),
        (One::Abs, Value::Real(a)) => Value::Real(a.abs()),
        (One::Abs, Value::Lreal(a)) => Value::Lreal(a.abs()),
        (One::Sqrt, Value::Real(a)) => Value::Real(a.sqrt()),
        (One::Sqrt, Value::Lreal(a)) => Value::Lreal(a.sqrt()),
        (One::Floor, Value::Lreal(a)) => Value::Lreal(a.floor()),
        (One::Trunc, Value::Real(a)) => Value::Real(a.trunc()),
        (One::Trunc, Value::Lreal(a)) => Value::Lreal(a.trunc()),
        (One::Nearest, Value::Lreal(a)) => Value::Lreal(a.round_ties_even()),
        (One::Bits, Value::Lreal(a)) => Value::Whole(a.to_bits() as i64),
        (One::OfBits, Value::Whole(a)) => Value::Lreal(f64::from_bits(a as u64)),
        _ => return None,
    })
}

/// As the code converts: see [`crate::hir::Kind::Convert`].
pub(crate) fn convert(from: Scalar, to: Scalar, value: Value) -> Value {
    match value {
        Value::Whole(a) if to == Scalar::Bool => Value::Whole(i64::from(a != 0)),
        Value::Whole(a) if to.is_whole() => Value::Whole(wrap(to, a)),
        Value::Whole(a) if to == Scalar::Real => Value::Real(if is_u64(from) { a as u64 as f32 } else { a as f32 }),
        Value::Whole(a) => Value::Lreal(if is_u64(from) { a as u64 as f64 } else { a as f64 }),
        Value::Real(a) if to == Scalar::Real => Value::Real(a),
        Value::Real(a) if to == Scalar::Lreal => Value::Lreal(f64::from(a)),
        Value::Lreal(a) if to == Scalar::Lreal => Value::Lreal(a),
        Value::Lreal(a) if to == Scalar::Real => Value::Real(a as f32),
        Value::Real(a) => Value::Whole(rounded(to, f64::from(a))),
        Value::Lreal(a) => Value::Whole(rounded(to, a)),
    }
}

/// To the nearest, halves to the even one, and into the range; no number gives 0.
fn rounded(to: Scalar, value: f64) -> i64 {
    let value = value.round_ties_even();
    match to {
        Scalar::Bool => i64::from(value != 0.0 && !value.is_nan()),
        Scalar::Ulint | Scalar::Lword => value as u64 as i64,
        _ => {
            let (low, high) = to.range();
            (value as i64).clamp(low as i64, high as i64)
        }
    }
}

/// The value as it lies in memory.
pub(crate) fn bytes(scalar: Scalar, value: Value) -> Vec<u8> {
    match value {
        Value::Real(a) => a.to_le_bytes().to_vec(),
        Value::Lreal(a) => a.to_le_bytes().to_vec(),
        Value::Whole(a) => a
            .to_le_bytes()
            .get(..scalar.bits() as usize / 8)
            .unwrap_or_default()
            .to_vec(),
    }
}
