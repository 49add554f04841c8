//! Expressions: names become places, operations get the type that both sides meet in.
//!
//! Never: calls; `call` and `standard` do those.

use super::{
    Checker, Symbol, Writable,
    convert::{Literal, WRONG, literal, value},
};
use crate::{
    ast::{self, Binary, ExprKind, Name, Unary},
    diagnostic::Span,
    hir::{Expr, Index, Kind, One, Op, Place, Value},
    types::{Access, Scalar, Ty},
};

impl Checker<'_> {
    /// An expression where a value of a type is wanted; it is converted where that is safe.
    pub(super) fn expression_as(&mut self, expr: &ast::Expr, ty: &Ty) -> Expr {
        let checked = self.expression(expr, Some(ty));
        self.coerce(checked, ty, expr.span)
    }

    /// An expression. `want` only gives literals their type.
    pub(super) fn expression(&mut self, expr: &ast::Expr, want: Option<&Ty>) -> Expr {
        if let Some(literal) = literal(expr) {
            let want = match want {
                Some(Ty::Scalar(scalar)) => Some(*scalar),
                _ => None,
            };
            return self.typed_literal(literal, want, expr.span);
        }
        match &expr.kind {
            ExprKind::Bool(b) => value(Value::Whole(i64::from(*b)), Ty::Scalar(Scalar::Bool)),
            ExprKind::Time(ns) => value(Value::Whole(*ns), Ty::Scalar(Scalar::Time)),
            ExprKind::Typed(name, inner) => self.typed(name, inner, expr.span),
            ExprKind::Name(name) => self.named(name),
            ExprKind::Field(..) | ExprKind::Index(..) => match self.place(expr) {
                Some((place, _)) => Expr {
                    ty: place.ty.clone(),
                    kind: Kind::Load(place),
                },
                None => WRONG,
            },
            ExprKind::Call(callee, arguments) => self.call(callee, arguments, want, expr.span),
            ExprKind::Unary(Unary::Minus, inner) => {
                let operand = self.expression(inner, want);
                match operand.ty.scalar() {
                    Some(scalar) if scalar.is_number() && scalar.range().0 == 0 && scalar.is_int() => {
                        self.error(
                            expr.span,
                            format!("{} has no negative values: convert it first", scalar.name()),
                        );
                        WRONG
                    }
                    Some(scalar) if scalar.is_number() || scalar == Scalar::Time => {
                        Self::one(One::Negate, scalar, operand)
                    }
                    _ => self.not_for("-", "a number", &operand, inner.span),
                }
            }
            ExprKind::Unary(Unary::Not, inner) => {
                let operand = self.expression(inner, want);
                match operand.ty {
                    Ty::Scalar(scalar) if scalar == Scalar::Bool || scalar.is_bits() => {
                        Self::one(One::Not, scalar, operand)
                    }
                    _ => self.not_for("NOT", "BOOL or bits", &operand, inner.span),
                }
            }
            ExprKind::Binary(op, left, right) => self.binary(*op, left, right, want, expr.span),
            ExprKind::Int(_) | ExprKind::Real(_) | ExprKind::Wrong => WRONG,
        }
    }

    /// An operand of a type that an operation does not have.
    pub(super) fn not_for(&mut self, operation: &str, wanted: &str, operand: &Expr, span: Span) -> Expr {
        if operand.ty != Ty::Wrong {
            let name = self.types.name(&operand.ty);
            self.error(span, format!("{operation} needs {wanted}, not {name}"));
        }
        WRONG
    }

    /// `INT#5`, `COLOR#RED`.
    fn typed(&mut self, name: &Name, inner: &ast::Expr, span: Span) -> Expr {
        if let Some(scalar) = Scalar::named(&name.upper) {
            return match (literal(inner), &inner.kind) {
                (Some(Literal::Real(_)), _) if !scalar.is_real() => {
                    self.error(span, format!("{} holds whole values", name.upper));
                    WRONG
                }
                // A pattern of bits may be given to a signed type as the standard shows it.
                (Some(literal), _) => self.typed_literal(literal, Some(scalar), span),
                (None, ExprKind::Bool(_)) if scalar == Scalar::Bool => self.expression(inner, None),
                _ => {
                    self.error(inner.span, "a literal is expected here");
                    WRONG
                }
            };
        }
        let type_name = Name {
            upper: name.upper.clone(),
            span: name.span,
        };
        match (self.named_type(&type_name).0, &inner.kind) {
            (Ty::Enum(number), ExprKind::Name(wanted)) => {
                let found = self
                    .types
                    .enumerations
                    .get(number)
                    .and_then(|e| e.values.iter().find(|(name, _)| *name == wanted.upper).map(|(_, v)| *v));
                match found {
                    Some(v) => value(Value::Whole(i64::from(v)), Ty::Enum(number)),
                    None => {
                        self.error(wanted.span, format!("{} has no value {}", name.upper, wanted.upper));
                        WRONG
                    }
                }
            }
            (Ty::Wrong, _) => WRONG,
            _ => {
                self.error(
                    name.span,
                    format!("{} is neither elementary nor an enumeration", name.upper),
                );
                WRONG
            }
        }
    }

    fn lookup(&self, name: &str) -> Option<&Symbol> {
        self.scope.get(name).or_else(|| self.globals.get(name))
    }

    fn named(&mut self, name: &Name) -> Expr {
        match self.lookup(&name.upper).cloned() {
            Some(Symbol::Place(place, _)) => Expr {
                ty: place.ty.clone(),
                kind: Kind::Load(place),
            },
            Some(Symbol::Constant(known, ty)) => value(known, ty),
            Some(Symbol::Parameter(index, ty)) => Expr {
                kind: Kind::Parameter(index),
                ty,
            },
            Some(Symbol::External(external, ty)) => Expr {
                kind: Kind::External(external),
                ty,
            },
            None => match self.values.get(&name.upper).map(Vec::as_slice) {
                Some([(number, v)]) => value(Value::Whole(i64::from(*v)), Ty::Enum(*number)),
                Some(_) => {
                    self.error(
                        name.span,
                        format!("several enumerations have {0}: say which, as in TYPE#{0}", name.upper),
                    );
                    WRONG
                }
                None => {
                    self.not_known(name);
                    WRONG
                }
            },
        }
    }

    /// Says so once per name and body.
    fn not_known(&mut self, name: &Name) {
        if self.unknown.contains(&name.upper) {
            return;
        }
        self.unknown.push(name.upper.clone());
        let near = self
            .scope
            .keys()
            .chain(self.globals.keys())
            .filter(|known| distance(known, &name.upper) <= name.upper.len() / 3)
            .min_by_key(|known| (distance(known, &name.upper), (*known).clone()))
            .cloned();
        let mut text = format!("there is no variable {}", name.upper);
        if self.pou_names.contains_key(&name.upper) {
            text = format!("{} is a function or block, not a variable", name.upper);
        } else if let Some(near) = near {
            text = format!("{text}; did you mean {near}?");
        }
        self.error(name.span, text);
    }

    /// A variable or a part of one, and whether this body may assign it.
    pub(super) fn place(&mut self, expr: &ast::Expr) -> Option<(Place, Writable)> {
        match &expr.kind {
            ExprKind::Name(name) => match self.lookup(&name.upper).cloned() {
                Some(Symbol::Place(place, writable)) => (place.ty != Ty::Wrong).then_some((place, writable)),
                Some(Symbol::Constant(..) | Symbol::Parameter(..)) => {
                    self.error(name.span, format!("{} is a constant", name.upper));
                    None
                }
                Some(Symbol::External(..)) => {
                    self.error(
                        name.span,
                        format!("{} comes from the host, and can only be read", name.upper),
                    );
                    None
                }
                None => {
                    self.not_known(name);
                    None
                }
            },
            ExprKind::Field(base, name) => {
                let (mut place, writable) = self.place(base)?;
                let found = self
                    .types
                    .structure(&place.ty)
                    .and_then(|s| s.fields.iter().find(|field| field.name == name.upper))
                    .map(|field| (field.offset, field.ty.clone(), field.access));
                let of = self.types.name(&place.ty);
                match found {
                    Some((_, _, Access::None)) => {
                        self.error(
                            name.span,
                            format!("{} is a variable inside of {of}: make it a VAR_OUTPUT", name.upper),
                        );
                        None
                    }
                    Some((offset, ty, access)) => {
                        place.offset += offset;
                        place.ty = ty;
                        let writable = match access {
                            Access::Read => Writable::Output,
                            _ => writable,
                        };
                        (place.ty != Ty::Wrong).then_some((place, writable))
                    }
                    None if self.types.structure(&place.ty).is_some() => {
                        self.error(name.span, format!("{of} has no field {}", name.upper));
                        None
                    }
                    None => {
                        self.error(base.span, format!("{of} has no fields"));
                        None
                    }
                }
            }
            ExprKind::Index(base, indices) => {
                let (mut place, writable) = self.place(base)?;
                let Ty::Array(array) = place.ty.clone() else {
                    let of = self.types.name(&place.ty);
                    self.error(base.span, format!("{of} is no array"));
                    return None;
                };
                if indices.len() != array.ranges.len() {
                    let (have, need) = (indices.len(), array.ranges.len());
                    self.error(expr.span, format!("{need} indices are needed here, not {have}"));
                    return None;
                }
                let mut stride = array.stride;
                let mut found = Vec::new();
                for ((low, count), index) in array.ranges.iter().zip(indices).rev() {
                    found.push((index, *low, *count, stride));
                    stride = stride.saturating_mul(*count);
                }
                let mut good = true;
                for (index, low, count, stride) in found.into_iter().rev() {
                    good &= self.index(&mut place, index, low, count, stride);
                }
                place.ty = array.of.clone();
                (good && place.ty != Ty::Wrong).then_some((place, writable))
            }
            ExprKind::Wrong => None,
            _ => {
                self.error(expr.span, "a variable is expected here");
                None
            }
        }
    }

    /// Goes on from a place by one index; false where it is wrong.
    fn index(&mut self, place: &mut Place, index: &ast::Expr, low: i64, count: u32, stride: u32) -> bool {
        let checked = self.expression(index, Some(&Ty::Scalar(Scalar::Lint)));
        let Some(scalar) = checked.ty.scalar().filter(|s| s.is_int()) else {
            self.not_for("an index", "an integer", &checked, index.span);
            return false;
        };
        let checked = Self::converted(checked, scalar, Scalar::Lint);
        let high = low + i64::from(count) - 1;
        if let Kind::Value(Value::Whole(known)) = checked.kind {
            if known < low || known > high {
                self.error(index.span, format!("the index {known} lies outside of {low}..{high}"));
                return false;
            }
            place.offset += known.abs_diff(low) as u32 * stride;
            return true;
        }
        let site = self.site(index.span, &format!("an index outside of {low}..{high}"));
        place.indices.push(Index {
            value: checked,
            low,
            count,
            stride,
            site,
        });
        true
    }

    /// Two operands, where a literal takes the type of the other.
    pub(super) fn pair(&mut self, left: &ast::Expr, right: &ast::Expr, want: Option<&Ty>) -> (Expr, Expr) {
        match (literal(left), literal(right)) {
            (Some(l), None) => {
                let right = self.expression(right, want);
                let left = self.beside(l, &right, left.span);
                (left, right)
            }
            (None, Some(r)) => {
                let left = self.expression(left, want);
                let right = self.beside(r, &left, right.span);
                (left, right)
            }
            _ => {
                let left = self.expression(left, want);
                let right = self.expression(right, want);
                (left, right)
            }
        }
    }

    /// A literal beside a value that has a type: of this type where it fits, else of its own.
    fn beside(&mut self, literal: Literal, other: &Expr, span: Span) -> Expr {
        let Some(scalar) = other.ty.scalar() else {
            return self.typed_literal(literal, None, span);
        };
        let fits = match literal {
            Literal::Int(n) => scalar.is_real() || (scalar.range().0 <= n && n <= scalar.range().1),
            Literal::Real(_) => scalar.is_real(),
        };
        let natural = scalar.is_bits() || scalar.is_number();
        self.typed_literal(literal, (fits && natural).then_some(scalar), span)
    }

    fn binary(&mut self, op: Binary, left: &ast::Expr, right: &ast::Expr, want: Option<&Ty>, span: Span) -> Expr {
        if op == Binary::Power {
            return self.power(left, right, want, span);
        }
        let want = if op.compares() { None } else { want };
        let (a, b) = self.pair(left, right, want);
        if a.ty == Ty::Wrong || b.ty == Ty::Wrong {
            return WRONG;
        }
        if let (Ty::Enum(x), Ty::Enum(y)) = (&a.ty, &b.ty)
            && matches!(op, Binary::Eq | Binary::Ne)
            && x == y
        {
            let operation = if op == Binary::Eq { Op::Eq } else { Op::Ne };
            return self.two(operation, Scalar::Dint, a, b, span);
        }
        let (Ty::Scalar(x), Ty::Scalar(y)) = (&a.ty, &b.ty) else {
            let (x, y) = (self.types.name(&a.ty), self.types.name(&b.ty));
            self.error(span, format!("{} cannot take {x} and {y} together", op.text()));
            return WRONG;
        };
        let (x, y) = (*x, *y);
        if x == Scalar::Time || y == Scalar::Time {
            return self.time(op, (a, x), (b, y), span);
        }
        let Some(scalar) = self.meet(x, y, span, op.text()) else {
            return WRONG;
        };
        let good = match op {
            Binary::And | Binary::Or | Binary::Xor => scalar == Scalar::Bool || scalar.is_bits(),
            Binary::Mod => scalar.is_int(),
            _ if op.compares() => true,
            _ => scalar.is_number(),
        };
        if !good {
            let wanted = match op {
                Binary::And | Binary::Or | Binary::Xor => "BOOL or bits",
                Binary::Mod => "whole numbers",
                _ => "numbers",
            };
            self.error(span, format!("{} needs {wanted}, not {}", op.text(), scalar.name()));
            return WRONG;
        }
        let (a, b) = (Self::converted(a, x, scalar), Self::converted(b, y, scalar));
        let operation = self.operation(op, span);
        self.two(operation, scalar, a, b, span)
    }

    fn operation(&mut self, op: Binary, span: Span) -> Op {
        match op {
            Binary::Or => Op::Or,
            Binary::Xor => Op::Xor,
            Binary::And => Op::And,
            Binary::Eq => Op::Eq,
            Binary::Ne => Op::Ne,
            Binary::Lt => Op::Lt,
            Binary::Le => Op::Le,
            Binary::Gt => Op::Gt,
            Binary::Ge => Op::Ge,
            Binary::Sub => Op::Sub,
            Binary::Mul => Op::Mul,
            Binary::Div => Op::Div(self.site(span, "a division by 0")),
            Binary::Mod => Op::Mod(self.site(span, "a division by 0")),
            Binary::Add | Binary::Power => Op::Add,
        }
    }

    /// TIME with TIME, or with a number that stretches it.
    fn time(&mut self, op: Binary, (a, x): (Expr, Scalar), (b, y): (Expr, Scalar), span: Span) -> Expr {
        let both = x == Scalar::Time && y == Scalar::Time;
        if both && (op.compares() || matches!(op, Binary::Add | Binary::Sub)) {
            let operation = self.operation(op, span);
            return self.two(operation, Scalar::Time, a, b, span);
        }
        let stretches = match op {
            Binary::Mul => !both && (x.is_number() || y.is_number()),
            Binary::Div => x == Scalar::Time && y.is_number(),
            _ => false,
        };
        if !stretches {
            self.error(
                span,
                format!(
                    "{} cannot take {} and {} together: TIME + TIME, TIME - TIME, TIME * number and TIME / number are possible",
                    op.text(),
                    x.name(),
                    y.name()
                ),
            );
            return WRONG;
        }
        let real = x.is_real() || y.is_real();
        let via = if real { Scalar::Lreal } else { Scalar::Lint };
        let (a, b) = (Self::converted(a, x, via), Self::converted(b, y, via));
        let operation = self.operation(op, span);
        let answer = self.two(operation, via, a, b, span);
        Self::converted(answer, via, Scalar::Time)
    }
}

/// Changes of single letters between two names.
fn distance(a: &str, b: &str) -> usize {
    let (a, b) = (a.as_bytes(), b.as_bytes());
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, x) in a.iter().enumerate() {
        let mut corner = i;
        let mut left = i + 1;
        if let Some(first) = row.first_mut() {
            *first = left;
        }
        for (y, cell) in b.iter().zip(row.iter_mut().skip(1)) {
            let here = (corner + usize::from(x != y)).min(left + 1).min(*cell + 1);
            corner = *cell;
            *cell = here;
            left = here;
        }
    }
    row.last().copied().unwrap_or(0)
}
