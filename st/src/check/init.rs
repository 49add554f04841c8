//! First values: literals, `[1, 2, 3(0)]`, `(a := 1, b := 2)`, as the bytes that they lie in memory with.
//!
//! Never: a value that is worked out in a cycle.

use super::Checker;
use crate::{
    ast::{Init, InitKind},
    fold,
    hir::Value,
    types::{Access, Scalar, Ty},
};

/// The value that bytes hold.
pub(crate) fn value_of(scalar: Scalar, bytes: &[u8]) -> Value {
    let mut whole = [0_u8; 8];
    for (to, from) in whole.iter_mut().zip(bytes) {
        *to = *from;
    }
    let raw = i64::from_le_bytes(whole);
    match scalar {
        Scalar::Real => Value::Real(f32::from_bits(raw as u32)),
        Scalar::Lreal => Value::Lreal(f64::from_bits(raw as u64)),
        _ => Value::Whole(fold::wrap(scalar, raw)),
    }
}

impl Checker<'_> {
    /// Writes a first value over the bytes of a type's own.
    pub(super) fn init(&mut self, ty: &Ty, init: &Init, bytes: &mut [u8]) {
        match (&init.kind, ty) {
            (_, Ty::Wrong) => {}
            (InitKind::Expr(expr), _) => match ty.scalar() {
                Some(scalar) => {
                    if let Some(value) = self.constant_of(expr, ty) {
                        write(bytes, 0, &fold::bytes(scalar, value));
                    }
                }
                None => {
                    let name = self.types.name(ty);
                    self.error(init.span, format!("one value does not make a {name}"));
                }
            },
            (InitKind::Array(items), Ty::Array(array)) => {
                let total: usize = array.ranges.iter().map(|(_, count)| *count as usize).product();
                let stride = array.stride as usize;
                let mut at = 0_usize;
                for (count, item) in items {
                    let count = match count {
                        Some(count) => self.constant_lint(count).unwrap_or(1).clamp(0, i64::from(u32::MAX)) as usize,
                        None => 1,
                    };
                    if at.saturating_add(count) > total {
                        self.error(
                            item.span,
                            format!("more values than the {total} elements of this array"),
                        );
                        return;
                    }
                    let mut one = bytes.get(at * stride..(at + 1) * stride).unwrap_or_default().to_vec();
                    self.init(&array.of, item, &mut one);
                    for n in at..at + count {
                        write(bytes, n * stride, &one);
                    }
                    at += count;
                }
            }
            (InitKind::Struct(fields), Ty::Struct(_) | Ty::Block(_)) => {
                for (name, value) in fields {
                    let found = self
                        .types
                        .structure(ty)
                        .and_then(|s| s.fields.iter().find(|field| field.name == name.upper))
                        .cloned();
                    let Some(field) = found.filter(|field| field.access != Access::None) else {
                        let of = self.types.name(ty);
                        self.error(name.span, format!("{of} has no field {}", name.upper));
                        continue;
                    };
                    let from = field.offset as usize;
                    let to = from + self.types.size(&field.ty) as usize;
                    let mut one = bytes.get(from..to).unwrap_or_default().to_vec();
                    self.init(&field.ty, value, &mut one);
                    write(bytes, from, &one);
                }
            }
            (InitKind::Array(_), _) => {
                let name = self.types.name(ty);
                self.error(
                    init.span,
                    format!("a list of values is for arrays; this is of type {name}"),
                );
            }
            (InitKind::Struct(_), _) => {
                let name = self.types.name(ty);
                self.error(
                    init.span,
                    format!("fields are for structures and blocks; this is of type {name}"),
                );
            }
        }
    }
}

fn write(bytes: &mut [u8], at: usize, value: &[u8]) {
    for (to, from) in bytes.iter_mut().skip(at).zip(value) {
        *to = *from;
    }
}
