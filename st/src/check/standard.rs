//! The standard functions that are overloaded: each takes several types, so none can be written in the language itself.
//!
//! Never: functions of one type; those are in `library.st`.

use super::{
    Checker,
    convert::{WRONG, literal, value},
};
use crate::{
    ast::{self, Argument, Binary},
    diagnostic::Span,
    hir::{self, Expr, Kind, One, Op, Value},
    types::{Scalar, Ty},
};

/// Functions of one real number: their name and the library's function for it.
const REALS: [(&str, &str); 9] = [
    ("LN", "__LN"),
    ("LOG", "__LOG"),
    ("EXP", "__EXP"),
    ("SIN", "__SIN"),
    ("COS", "__COS"),
    ("TAN", "__TAN"),
    ("ASIN", "__ASIN"),
    ("ACOS", "__ACOS"),
    ("ATAN", "__ATAN"),
];

/// Names of the arguments, where they are no IN, IN1, IN2, …
const FORMALS: [(&str, &[&str]); 8] = [
    ("LIMIT", &["MN", "IN", "MX"]),
    ("SEL", &["G", "IN0", "IN1"]),
    ("SHL", &["IN", "N"]),
    ("SHR", &["IN", "N"]),
    ("ROL", &["IN", "N"]),
    ("ROR", &["IN", "N"]),
    ("ATAN2", &["Y", "X"]),
    ("EXPT", &["IN1", "IN2"]),
];

/// Functions that are operators with another look; any number of arguments where the flag says so.
const OPERATORS: [(&str, Binary, bool); 15] = [
    ("ADD", Binary::Add, true),
    ("MUL", Binary::Mul, true),
    ("SUB", Binary::Sub, false),
    ("DIV", Binary::Div, false),
    ("MOD", Binary::Mod, false),
    ("AND", Binary::And, true),
    ("OR", Binary::Or, true),
    ("XOR", Binary::Xor, true),
    ("GT", Binary::Gt, false),
    ("GE", Binary::Ge, false),
    ("EQ", Binary::Eq, false),
    ("LE", Binary::Le, false),
    ("LT", Binary::Lt, false),
    ("NE", Binary::Ne, false),
    ("EXPT", Binary::Power, false),
];

const OTHERS: [&str; 15] = [
    "ABS", "SQRT", "ATAN2", "MIN", "MAX", "LIMIT", "SEL", "MUX", "SHL", "SHR", "ROL", "ROR", "TRUNC", "MOVE", "NOT",
];

/// Does the standard have an overloaded function of this name?
pub(super) fn is_standard(upper: &str) -> bool {
    OTHERS.contains(&upper)
        || REALS.iter().any(|(name, _)| *name == upper)
        || OPERATORS.iter().any(|(name, ..)| *name == upper)
        || conversion(upper).is_some()
}

/// `A_TO_B`, `TO_B`, `A_TRUNC_B`: from, to, and whether it cuts.
fn conversion(upper: &str) -> Option<(Option<Scalar>, Scalar, bool)> {
    if let Some(to) = upper.strip_prefix("TO_") {
        return Some((None, Scalar::named(to)?, false));
    }
    if let Some((from, to)) = upper.split_once("_TO_") {
        return Some((Some(Scalar::named(from)?), Scalar::named(to)?, false));
    }
    let (from, to) = upper.split_once("_TRUNC_")?;
    let (from, to) = (Scalar::named(from)?, Scalar::named(to)?);
    (from.is_real() && to.is_int()).then_some((Some(from), to, true))
}

impl Checker<'_> {
    /// A call of a standard function; none where there is none of this name.
    pub(super) fn standard(
        &mut self,
        name: &ast::Name,
        arguments: &[Argument],
        want: Option<&Ty>,
        span: Span,
    ) -> Option<Expr> {
        let upper = name.upper.as_str();
        if !is_standard(upper) && !upper.starts_with("__") {
            return None;
        }
        let Some(ordered) = self.ordered(name, arguments) else {
            return Some(WRONG);
        };
        let given = ordered.as_slice();
        if let Some((_, function)) = REALS.iter().find(|(real, _)| *real == upper) {
            return Some(match given {
                [x] => self.real(function, &[x], want, span),
                _ => self.count(name, "1", given.len()),
            });
        }
        if let Some((_, op, many)) = OPERATORS.iter().find(|(operator, ..)| *operator == upper) {
            let good = if *many { given.len() >= 2 } else { given.len() == 2 };
            if !good {
                return Some(self.count(name, if *many { "2 or more" } else { "2" }, given.len()));
            }
            return Some(self.chain(*op, given, want, span));
        }
        if let Some((from, to, cut)) = conversion(upper) {
            return Some(match given {
                [x] => self.conversion(from, to, cut, x, span),
                _ => self.count(name, "1", given.len()),
            });
        }
        Some(match (upper, given) {
            ("ABS", [x]) => {
                let x_checked = self.expression(x, want);
                match x_checked.ty {
                    Ty::Scalar(scalar) if scalar.is_number() => Self::one(One::Abs, scalar, x_checked),
                    _ => self.not_for("ABS", "a number", &x_checked, x.span),
                }
            }
            ("SQRT", [x]) => {
                let (operand, scalar) = self.real_operand(x, want);
                if operand.ty == Ty::Wrong {
                    WRONG
                } else {
                    Self::one(One::Sqrt, scalar, operand)
                }
            }
            ("ATAN2", [y, x]) => self.real("__ATAN2", &[y, x], want, span),
            ("MOVE", [x]) => self.expression(x, want),
            ("NOT", [x]) => {
                let inner = ast::Expr {
                    kind: ast::ExprKind::Unary(ast::Unary::Not, Box::new((*x).clone())),
                    span,
                    depth: x.depth + 1,
                };
                self.expression(&inner, want)
            }
            ("TRUNC", [x]) => {
                let (operand, scalar) = self.real_operand(x, None);
                let to = want.and_then(Ty::scalar).filter(|s| s.is_int()).unwrap_or(Scalar::Dint);
                if operand.ty == Ty::Wrong {
                    WRONG
                } else {
                    Self::converted(Self::one(One::Trunc, scalar, operand), scalar, to)
                }
            }
            ("MIN" | "MAX", [_, _, ..]) => {
                let op = if upper == "MIN" { Op::Min } else { Op::Max };
                self.extreme(op, given, want, span)
            }
            ("LIMIT", [low, x, high]) => {
                // MIN(MAX(IN, MN), MX), as the standard has it.
                let Some((mut met, scalar)) = self.together(&[*low, *x, *high], want, span, upper) else {
                    return Some(WRONG);
                };
                let (high, x, low) = (met.pop(), met.pop(), met.pop());
                match (low, x, high) {
                    (Some(low), Some(x), Some(high)) => {
                        let above = self.two(Op::Max, scalar, x, low, span);
                        self.two(Op::Min, scalar, above, high, span)
                    }
                    _ => WRONG,
                }
            }
            ("SEL", [choice, a, b]) => {
                let choice = self.expression_as(choice, &Ty::Scalar(Scalar::Bool));
                self.choose(vec![(choice, *b)], a, want, span)
            }
            ("MUX", [index, inputs @ ..]) if inputs.len() >= 2 => self.multiplex(index, inputs, want, span),
            ("SHL" | "SHR" | "ROL" | "ROR", [x, n]) => self.shift(upper, x, n, want, span),
            ("__BITS" | "__OF_BITS" | "__FLOOR" | "__NEAREST", [x]) => {
                let (op, from) = match upper {
                    "__BITS" => (One::Bits, Scalar::Lreal),
                    "__OF_BITS" => (One::OfBits, Scalar::Lword),
                    "__FLOOR" => (One::Floor, Scalar::Lreal),
                    _ => (One::Nearest, Scalar::Lreal),
                };
                let x = self.expression_as(x, &Ty::Scalar(from));
                if x.ty == Ty::Wrong {
                    WRONG
                } else {
                    Self::one(op, from, x)
                }
            }
            _ if upper.starts_with("__") => return None,
            _ => {
                let need = match upper {
                    "MIN" | "MAX" | "SHL" | "SHR" | "ROL" | "ROR" | "ATAN2" => "2",
                    "LIMIT" | "SEL" => "3",
                    "MUX" => "3 or more",
                    _ => "1",
                };
                self.count(name, need, given.len())
            }
        })
    }

    pub(super) fn count(&mut self, name: &ast::Name, need: &str, have: usize) -> Expr {
        self.error(name.span, format!("{} takes {need} arguments, not {have}", name.upper));
        WRONG
    }

    /// The arguments by place, where they may have been given by name.
    fn ordered<'e>(&mut self, name: &ast::Name, arguments: &'e [Argument]) -> Option<Vec<&'e ast::Expr>> {
        let formals = FORMALS
            .iter()
            .find(|(function, _)| *function == name.upper)
            .map(|(_, formals)| *formals);
        let named = arguments.iter().filter(|argument| argument.name.is_some()).count();
        if named == 0 {
            return Some(arguments.iter().map(|argument| &argument.value).collect());
        }
        let mut places: Vec<Option<&ast::Expr>> = vec![None; arguments.len()];
        for argument in arguments {
            let Some(formal) = &argument.name else {
                self.error(argument.value.span, "arguments are given by name or by place, not both");
                return None;
            };
            let number = |text: &str| text.parse::<usize>().ok();
            let upper = formal.upper.as_str();
            let at = match (formals, name.upper.as_str()) {
                (Some(formals), _) => formals.iter().position(|known| *known == upper),
                (None, "MUX") if upper == "K" => Some(0),
                (None, "MUX") => upper.strip_prefix("IN").and_then(number).map(|n| n + 1),
                _ if upper == "IN" && arguments.len() == 1 => Some(0),
                _ => upper.strip_prefix("IN").and_then(number).and_then(|n| n.checked_sub(1)),
            };
            match at.and_then(|at| places.get_mut(at)) {
                Some(place @ None) if !argument.output => *place = Some(&argument.value),
                _ => {
                    self.error(formal.span, format!("{} has no input {upper} here", name.upper));
                    return None;
                }
            }
        }
        places.into_iter().collect()
    }

    /// A real operand and its type; whole numbers become LREAL.
    fn real_operand(&mut self, x: &ast::Expr, want: Option<&Ty>) -> (Expr, Scalar) {
        let wanted = want
            .and_then(Ty::scalar)
            .filter(|s| s.is_real())
            .unwrap_or(Scalar::Lreal);
        let checked = self.expression(x, Some(&Ty::Scalar(wanted)));
        match checked.ty {
            Ty::Scalar(scalar) if scalar.is_real() => (checked, scalar),
            Ty::Scalar(scalar) if scalar.widens_to(Scalar::Lreal) => {
                (Self::converted(checked, scalar, Scalar::Lreal), Scalar::Lreal)
            }
            _ => (
                self.not_for("this function", "REAL or LREAL", &checked, x.span),
                Scalar::Lreal,
            ),
        }
    }

    /// A function of the library on LREAL; where all operands are REAL so is the answer.
    fn real(&mut self, function: &str, operands: &[&ast::Expr], want: Option<&Ty>, span: Span) -> Expr {
        let mut arguments = Vec::new();
        let mut answer = Scalar::Real;
        for operand in operands {
            let (x, scalar) = self.real_operand(operand, want);
            if x.ty == Ty::Wrong {
                return WRONG;
            }
            if scalar == Scalar::Lreal {
                answer = Scalar::Lreal;
            }
            arguments.push(hir::Argument::Value(Self::converted(x, scalar, Scalar::Lreal)));
        }
        let Some(&number) = self.pou_names.get(function) else {
            self.error(span, format!("the library has no {function}"));
            return WRONG;
        };
        self.declare(number, None);
        self.calls.push(number);
        let call = Expr {
            kind: Kind::Call(number, arguments),
            ty: Ty::Scalar(Scalar::Lreal),
        };
        Self::converted(call, Scalar::Lreal, answer)
    }

    /// `x ** y`.
    pub(super) fn power(&mut self, x: &ast::Expr, y: &ast::Expr, want: Option<&Ty>, span: Span) -> Expr {
        let (a, b) = self.pair(x, y, want);
        let (Some(from), Some(by)) = (a.ty.scalar(), b.ty.scalar()) else {
            return WRONG;
        };
        for (operand, scalar, span) in [(&a, from, x.span), (&b, by, y.span)] {
            if !scalar.is_number() || !scalar.widens_to(Scalar::Lreal) {
                return self.not_for("a power", "numbers of at most 32 bits, REAL or LREAL", operand, span);
            }
        }
        let answer = if from == Scalar::Real {
            Scalar::Real
        } else {
            Scalar::Lreal
        };
        let Some(&number) = self.pou_names.get("__EXPT") else {
            self.error(span, "the library has no __EXPT");
            return WRONG;
        };
        self.declare(number, None);
        self.calls.push(number);
        let arguments = vec![
            hir::Argument::Value(Self::converted(a, from, Scalar::Lreal)),
            hir::Argument::Value(Self::converted(b, by, Scalar::Lreal)),
        ];
        let call = Expr {
            kind: Kind::Call(number, arguments),
            ty: Ty::Scalar(Scalar::Lreal),
        };
        Self::converted(call, Scalar::Lreal, answer)
    }

    /// `ADD(a, b, c)` is `a + b + c`.
    fn chain(&mut self, op: Binary, given: &[&ast::Expr], want: Option<&Ty>, span: Span) -> Expr {
        let Some((first, rest)) = given.split_first() else {
            return WRONG;
        };
        let mut whole = (*first).clone();
        for next in rest {
            whole = ast::Expr {
                depth: whole.depth.max(next.depth) + 1,
                kind: ast::ExprKind::Binary(op, Box::new(whole), Box::new((*next).clone())),
                span,
            };
        }
        self.expression(&whole, want)
    }

    /// Several operands in the type that all meet in.
    fn together(
        &mut self,
        operands: &[&ast::Expr],
        want: Option<&Ty>,
        span: Span,
        what: &str,
    ) -> Option<(Vec<Expr>, Scalar)> {
        let mut met: Option<Scalar> = None;
        for operand in operands.iter().filter(|operand| literal(operand).is_none()) {
            let checked = self.expression(operand, want);
            let Ty::Scalar(scalar) = checked.ty else {
                self.not_for(what, "an elementary value", &checked, operand.span);
                return None;
            };
            met = Some(match met {
                Some(before) => self.meet(before, scalar, span, what)?,
                None => scalar,
            });
        }
        let wanted = met.map_or_else(|| want.cloned(), |scalar| Some(Ty::Scalar(scalar)));
        let mut all = Vec::new();
        for operand in operands {
            let checked = self.expression(operand, wanted.as_ref());
            let scalar = checked.ty.scalar()?;
            met = Some(match met {
                Some(before) => self.meet(before, scalar, operand.span, what)?,
                None => scalar,
            });
            all.push((checked, scalar));
        }
        let met = met?;
        let all = all.into_iter().map(|(x, from)| Self::converted(x, from, met)).collect();
        Some((all, met))
    }

    fn extreme(&mut self, op: Op, given: &[&ast::Expr], want: Option<&Ty>, span: Span) -> Expr {
        let Some((all, scalar)) = self.together(given, want, span, "MIN and MAX") else {
            return WRONG;
        };
        let mut all = all.into_iter();
        let Some(mut answer) = all.next() else { return WRONG };
        for next in all {
            answer = self.two(op, scalar, answer, next, span);
        }
        answer
    }

    /// The last of `cases` whose condition holds, else `otherwise`.
    fn choose(&mut self, cases: Vec<(Expr, &ast::Expr)>, otherwise: &ast::Expr, want: Option<&Ty>, span: Span) -> Expr {
        let plain = self.expression(otherwise, want);
        if let Ty::Enum(_) = plain.ty {
            let ty = plain.ty.clone();
            let mut answer = plain;
            for (condition, input) in cases {
                let input = self.expression_as(input, &ty);
                answer = select(condition, answer, input);
            }
            return answer;
        }
        let mut operands = vec![otherwise];
        operands.extend(cases.iter().map(|(_, input)| *input));
        let Some((all, _)) = self.together(&operands, want, span, "the inputs") else {
            return WRONG;
        };
        let mut all = all.into_iter();
        let Some(mut answer) = all.next() else { return WRONG };
        for ((condition, _), input) in cases.into_iter().zip(all) {
            if condition.ty == Ty::Wrong {
                return WRONG;
            }
            answer = select(condition, answer, input);
        }
        answer
    }

    /// MUX: below its first input it takes the first, beyond its last the last one.
    fn multiplex(&mut self, index: &ast::Expr, inputs: &[&ast::Expr], want: Option<&Ty>, span: Span) -> Expr {
        let checked = self.expression(index, Some(&Ty::Scalar(Scalar::Lint)));
        let Some(scalar) = checked.ty.scalar().filter(|s| s.is_int()) else {
            return self.not_for("MUX", "an integer first", &checked, index.span);
        };
        let Some((first, rest)) = inputs.split_first() else {
            return WRONG;
        };
        let mut cases = Vec::new();
        for (n, input) in rest.iter().enumerate() {
            let at = Self::converted(checked.clone(), scalar, Scalar::Lint);
            let bound = value(Value::Whole(n as i64 + 1), Ty::Scalar(Scalar::Lint));
            cases.push((self.two(Op::Ge, Scalar::Lint, at, bound, span), *input));
        }
        self.choose(cases, first, want, span)
    }

    fn shift(&mut self, name: &str, x: &ast::Expr, n: &ast::Expr, want: Option<&Ty>, span: Span) -> Expr {
        let op = match name {
            "SHL" => Op::Shl,
            "SHR" => Op::Shr,
            "ROL" => Op::Rol,
            _ => Op::Ror,
        };
        let checked = self.expression(x, want);
        let Some(scalar) = checked.ty.scalar().filter(|s| s.is_bits()) else {
            return self.not_for(name, "BYTE, WORD, DWORD or LWORD", &checked, x.span);
        };
        let by = self.expression(n, Some(&Ty::Scalar(Scalar::Lint)));
        let Some(count) = by.ty.scalar().filter(|s| s.is_int()) else {
            return self.not_for(name, "a whole number of bits", &by, n.span);
        };
        // Every count fits into 16 bits and no type has more; what is beyond stays beyond.
        let by = Self::converted(by, count, Scalar::Lint);
        let low = value(Value::Whole(0), Ty::Scalar(Scalar::Lint));
        let high = value(
            Value::Whole(if matches!(op, Op::Shl | Op::Shr) {
                i64::from(scalar.bits())
            } else {
                i64::MAX
            }),
            Ty::Scalar(Scalar::Lint),
        );
        let by = self.two(Op::Max, Scalar::Lint, by, low, span);
        let by = self.two(Op::Min, Scalar::Lint, by, high, span);
        let by = match op {
            Op::Shl | Op::Shr => by,
            _ => {
                let bits = value(Value::Whole(i64::from(scalar.bits())), Ty::Scalar(Scalar::Lint));
                self.two(Op::Mod(0), Scalar::Lint, by, bits, span)
            }
        };
        let by = Self::converted(by, Scalar::Lint, scalar);
        self.two(op, scalar, checked, by, span)
    }

    fn conversion(&mut self, from: Option<Scalar>, to: Scalar, cut: bool, x: &ast::Expr, span: Span) -> Expr {
        let wanted = from.map(Ty::Scalar);
        let checked = self.expression(x, wanted.as_ref());
        // An enumeration gives its number.
        let Some(scalar) = checked.ty.scalar() else {
            return self.not_for("a conversion", "an elementary value", &checked, x.span);
        };
        let checked = Expr {
            ty: Ty::Scalar(scalar),
            ..checked
        };
        let (checked, scalar) = match from {
            Some(from) => {
                let checked = self.coerce(checked, &Ty::Scalar(from), x.span);
                if checked.ty == Ty::Wrong {
                    return WRONG;
                }
                (checked, from)
            }
            None => (checked, scalar),
        };
        let ms = value(Value::Lreal(1e6), Ty::Scalar(Scalar::Lreal));
        let whole_ms = value(Value::Whole(1_000_000), Ty::Scalar(Scalar::Lint));
        match (scalar, to) {
            _ if cut => Self::converted(Self::one(One::Trunc, scalar, checked), scalar, to),
            // A number that is a time, or a time that is a number, counts ms.
            (Scalar::Time, to) if to.is_real() => {
                let ns = Self::converted(checked, Scalar::Time, Scalar::Lreal);
                let answer = self.two(Op::Div(0), Scalar::Lreal, ns, ms, span);
                Self::converted(answer, Scalar::Lreal, to)
            }
            (Scalar::Time, to) if to != Scalar::Time && to != Scalar::Bool => {
                let ns = Self::converted(checked, Scalar::Time, Scalar::Lint);
                let answer = self.two(Op::Div(0), Scalar::Lint, ns, whole_ms, span);
                Self::converted(answer, Scalar::Lint, to)
            }
            (from, Scalar::Time) if from.is_real() => {
                let x = Self::converted(checked, from, Scalar::Lreal);
                let answer = self.two(Op::Mul, Scalar::Lreal, x, ms, span);
                Self::converted(answer, Scalar::Lreal, Scalar::Time)
            }
            (from, Scalar::Time) if from != Scalar::Time && from != Scalar::Bool => {
                let x = Self::converted(checked, from, Scalar::Lint);
                let answer = self.two(Op::Mul, Scalar::Lint, x, whole_ms, span);
                Self::converted(answer, Scalar::Lint, Scalar::Time)
            }
            (from, to) => Self::converted(checked, from, to),
        }
    }
}

fn select(condition: Expr, no: Expr, yes: Expr) -> Expr {
    let ty = no.ty.clone();
    if let Kind::Value(Value::Whole(known)) = condition.kind {
        return if known == 0 { no } else { yes };
    }
    Expr {
        kind: Kind::Select(Box::new(condition), Box::new(no), Box::new(yes)),
        ty,
    }
}
