//! Literals without a type, what converts by itself, and how values of two types meet.
//!
//! Never: converts where a value could be lost; a text says `DINT_TO_INT` for that.

use super::Checker;
use crate::{
    ast::{self, Binary, ExprKind, Unary},
    diagnostic::Span,
    fold,
    hir::{Expr, Kind, One, Op, Value},
    types::{Scalar, Ty},
};

/// A number that has no type yet.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Literal {
    Int(i128),
    Real(f64),
}

pub(super) const WRONG: Expr = Expr {
    kind: Kind::Value(Value::Whole(0)),
    ty: Ty::Wrong,
};

pub(super) const fn value(value: Value, ty: Ty) -> Expr {
    Expr {
        kind: Kind::Value(value),
        ty,
    }
}

/// The exact value of an expression of nothing but literals without types.
pub(super) fn literal(expr: &ast::Expr) -> Option<Literal> {
    let real = |l| match l {
        Literal::Int(n) => n as f64,
        Literal::Real(x) => x,
    };
    match &expr.kind {
        ExprKind::Int(n) => Some(Literal::Int(*n)),
        ExprKind::Real(x) => Some(Literal::Real(*x)),
        ExprKind::Unary(Unary::Minus, inner) => Some(match literal(inner)? {
            Literal::Int(n) => Literal::Int(-n),
            Literal::Real(x) => Literal::Real(-x),
        }),
        ExprKind::Binary(op, left, right) => match (literal(left)?, literal(right)?) {
            (Literal::Int(a), Literal::Int(b)) => {
                let answer = match op {
                    Binary::Add => a.checked_add(b),
                    Binary::Sub => a.checked_sub(b),
                    Binary::Mul => a.checked_mul(b),
                    Binary::Div => a.checked_div(b),
                    Binary::Mod => a.checked_rem(b),
                    _ => None,
                };
                answer.map(Literal::Int)
            }
            (a, b) => {
                let (a, b) = (real(a), real(b));
                Some(Literal::Real(match op {
                    Binary::Add => a + b,
                    Binary::Sub => a - b,
                    Binary::Mul => a * b,
                    Binary::Div if b != 0.0 => a / b,
                    _ => return None,
                }))
            }
        },
        _ => None,
    }
}

impl Checker<'_> {
    /// Gives a literal the type that is wanted, or its usual one.
    pub(super) fn typed_literal(&mut self, literal: Literal, want: Option<Scalar>, span: Span) -> Expr {
        match (literal, want) {
            (Literal::Int(n), Some(Scalar::Real)) => value(Value::Real(n as f32), Ty::Scalar(Scalar::Real)),
            (Literal::Int(n), Some(Scalar::Lreal)) => value(Value::Lreal(n as f64), Ty::Scalar(Scalar::Lreal)),
            (Literal::Int(n), Some(scalar)) if scalar != Scalar::Time => {
                let (low, high) = scalar.range();
                // Bits may be written as negative numbers nowhere, and as all of their pattern everywhere.
                if n < low || n > high {
                    let name = scalar.name();
                    self.error(
                        span,
                        format!("{n} does not fit into {name}, which holds {low} to {high}"),
                    );
                    return WRONG;
                }
                value(Value::Whole(n as i64), Ty::Scalar(scalar))
            }
            (Literal::Int(n), _) => {
                let fits = |scalar: Scalar| (scalar.range().0..=scalar.range().1).contains(&n);
                match [Scalar::Dint, Scalar::Lint, Scalar::Ulint]
                    .into_iter()
                    .find(|s| fits(*s))
                {
                    Some(scalar) => value(Value::Whole(n as i64), Ty::Scalar(scalar)),
                    None => {
                        self.error(span, format!("{n} does not fit into any type"));
                        WRONG
                    }
                }
            }
            (Literal::Real(x), Some(Scalar::Real)) => {
                if (x as f32).is_infinite() && x.is_finite() {
                    self.error(span, format!("{x:e} does not fit into REAL; use LREAL"));
                    return WRONG;
                }
                value(Value::Real(x as f32), Ty::Scalar(Scalar::Real))
            }
            (Literal::Real(x), _) => value(Value::Lreal(x), Ty::Scalar(Scalar::Lreal)),
        }
    }

    /// Converts, with a value that is known worked out at once.
    pub(super) fn converted(expr: Expr, from: Scalar, to: Scalar) -> Expr {
        let ty = Ty::Scalar(to);
        if from == to {
            return Expr { ty, ..expr };
        }
        match expr.kind {
            Kind::Value(value) => Expr {
                kind: Kind::Value(fold::convert(from, to, value)),
                ty,
            },
            _ => Expr {
                kind: Kind::Convert(Box::new(expr), from, to),
                ty,
            },
        }
    }

    /// Takes a value as another type where that is safe by itself, else says how to convert.
    pub(super) fn coerce(&mut self, expr: Expr, to: &Ty, span: Span) -> Expr {
        if expr.ty == *to || *to == Ty::Wrong || expr.ty == Ty::Wrong {
            return if expr.ty == *to { expr } else { WRONG };
        }
        if let (Ty::Scalar(from), Ty::Scalar(into)) = (&expr.ty, to) {
            if from.widens_to(*into) {
                let (from, into) = (*from, *into);
                return Self::converted(expr, from, into);
            }
            let (a, b) = (from.name(), into.name());
            let cure = match (from, into) {
                (Scalar::Bool, _) | (_, Scalar::Bool) if from.is_real() || into.is_real() => {
                    "compare it with a number".to_owned()
                }
                _ => format!("write {a}_TO_{b}(…)"),
            };
            self.error(span, format!("{a} does not become {b} by itself: {cure}"));
            return WRONG;
        }
        let (a, b) = (self.types.name(&expr.ty), self.types.name(to));
        self.error(span, format!("{b} is expected here, not {a}"));
        WRONG
    }

    /// The type that two operands meet in.
    pub(super) fn meet(&mut self, a: Scalar, b: Scalar, span: Span, what: &str) -> Option<Scalar> {
        if a.widens_to(b) {
            return Some(b);
        }
        if b.widens_to(a) {
            return Some(a);
        }
        // Two types of which neither holds the other may both fit into a third one.
        let third = [Scalar::Int, Scalar::Dint, Scalar::Lint]
            .into_iter()
            .find(|third| a.widens_to(*third) && b.widens_to(*third));
        let third = third.or_else(|| {
            let reals = a.is_real() || b.is_real();
            (reals && a.widens_to(Scalar::Lreal) && b.widens_to(Scalar::Lreal)).then_some(Scalar::Lreal)
        });
        if third.is_none() {
            self.error(
                span,
                format!(
                    "{what} cannot take {} and {} together: convert one of them",
                    a.name(),
                    b.name()
                ),
            );
        }
        third
    }

    pub(super) fn one(op: One, scalar: Scalar, operand: Expr) -> Expr {
        let to = match op {
            One::Bits => Scalar::Lword,
            One::OfBits => Scalar::Lreal,
            _ => scalar,
        };
        if let Kind::Value(known) = operand.kind
            && let Some(answer) = fold::one(op, scalar, known)
        {
            return value(answer, Ty::Scalar(to));
        }
        Expr {
            kind: Kind::One(op, Box::new(operand)),
            ty: Ty::Scalar(to),
        }
    }

    /// Both operands are of the type that is named.
    pub(super) fn two(&mut self, op: Op, scalar: Scalar, left: Expr, right: Expr, span: Span) -> Expr {
        let ty = Ty::Scalar(if op.compares() { Scalar::Bool } else { scalar });
        if let Kind::Value(divisor) = right.kind
            && matches!(op, Op::Div(_) | Op::Mod(_))
            && matches!(divisor, Value::Whole(0) | Value::Real(0.0) | Value::Lreal(0.0))
        {
            self.error(span, "this divides by 0");
            return WRONG;
        }
        if let (Kind::Value(a), Kind::Value(b)) = (&left.kind, &right.kind)
            && let Some(answer) = fold::two(op, scalar, *a, *b)
        {
            return value(answer, ty);
        }
        Expr {
            kind: Kind::Two(op, scalar, Box::new(left), Box::new(right)),
            ty,
        }
    }
}
