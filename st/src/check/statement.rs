//! Statements. Never: decides how one is compiled.

use super::{Checker, convert::WRONG};
use crate::{
    ast::{self, ExprKind, StmtKind},
    hir::{Expr, Kind, Stmt, Value},
    types::{Scalar, Ty},
};

impl Checker<'_> {
    pub(super) fn statements(&mut self, statements: &[ast::Stmt]) -> Vec<Stmt> {
        let own = self.pous.get(self.current).is_some_and(|pou| !pou.library);
        let mut checked = Vec::new();
        for statement in statements {
            if let Some(found) = self.statement(statement) {
                checked.extend(own.then_some(Stmt::At(statement.span.start)));
                checked.push(found);
            }
        }
        checked
    }

    fn condition(&mut self, expr: &ast::Expr) -> Expr {
        let checked = self.expression(expr, Some(&Ty::Scalar(Scalar::Bool)));
        if checked.ty != Ty::Scalar(Scalar::Bool) {
            return self.not_for("a condition", "BOOL", &checked, expr.span);
        }
        checked
    }

    fn statement(&mut self, statement: &ast::Stmt) -> Option<Stmt> {
        match &statement.kind {
            StmtKind::Assign(target, value) => self.assign(target, value),
            StmtKind::Call(call) => match &call.kind {
                ExprKind::Call(callee, arguments) => self.call_statement(callee, arguments, call.span),
                _ => None,
            },
            StmtKind::If(branches, otherwise) => {
                let mut checked = Vec::new();
                for (condition, body) in branches {
                    checked.push((self.condition(condition), self.statements(body)));
                }
                Some(Stmt::If(checked, self.statements(otherwise)))
            }
            StmtKind::Case(selector, cases, otherwise) => self.case(selector, cases, otherwise),
            StmtKind::For {
                variable,
                from,
                to,
                by,
                body,
            } => self.counted(variable, from, to, by.as_ref(), body),
            StmtKind::While(condition, body) => {
                let condition = self.condition(condition);
                Some(Stmt::While(condition, self.repeated(body)))
            }
            StmtKind::Repeat(body, until) => {
                let body = self.repeated(body);
                Some(Stmt::Repeat(body, self.condition(until)))
            }
            StmtKind::Exit | StmtKind::Continue if self.loops == 0 => {
                let word = if matches!(statement.kind, StmtKind::Exit) {
                    "EXIT"
                } else {
                    "CONTINUE"
                };
                self.error(
                    statement.span,
                    format!("{word} stands within FOR, WHILE or REPEAT only"),
                );
                None
            }
            StmtKind::Exit => Some(Stmt::Exit),
            StmtKind::Continue => Some(Stmt::Continue),
            StmtKind::Return => Some(Stmt::Return),
        }
    }

    fn repeated(&mut self, body: &[ast::Stmt]) -> Vec<Stmt> {
        self.loops += 1;
        let checked = self.statements(body);
        self.loops -= 1;
        checked
    }

    fn assign(&mut self, target: &ast::Expr, value: &ast::Expr) -> Option<Stmt> {
        let place = self.target(target);
        let Some(place) = place else {
            // What is wrong on the right is said all the same.
            self.expression(value, None);
            return None;
        };
        if place.ty.scalar().is_some() {
            let value = self.expression_as(value, &place.ty);
            return (value.ty != Ty::Wrong).then_some(Stmt::Assign(place, value));
        }
        if matches!(place.ty, Ty::Block(_)) {
            self.error(
                target.span,
                "an instance of a block cannot be assigned; assign its inputs",
            );
            return None;
        }
        let (from, _) = self.place(value)?;
        if from.ty != place.ty {
            let (want, have) = (self.types.name(&place.ty), self.types.name(&from.ty));
            self.error(value.span, format!("{want} is expected here, not {have}"));
            return None;
        }
        let size = self.types.size(&place.ty);
        Some(Stmt::Copy(place, from, size))
    }

    fn case(
        &mut self,
        selector: &ast::Expr,
        cases: &[(Vec<ast::Label>, Vec<ast::Stmt>)],
        otherwise: &[ast::Stmt],
    ) -> Option<Stmt> {
        let checked = self.expression(selector, None);
        let ty = checked.ty.clone();
        let scalar = ty.scalar().filter(|scalar| {
            (scalar.is_int() && *scalar != Scalar::Ulint) || (scalar.is_bits() && *scalar != Scalar::Lword)
        });
        let selector_checked = match scalar {
            Some(scalar) => Self::converted(checked, scalar, Scalar::Lint),
            None => self.not_for("CASE", "an integer or an enumeration", &checked, selector.span),
        };
        let mut seen: Vec<(i64, i64)> = Vec::new();
        let mut all = Vec::new();
        for (labels, body) in cases {
            let mut ranges = Vec::new();
            for label in labels {
                if scalar.is_none() {
                    continue;
                }
                let known = |checker: &mut Self, expr| match checker.constant_of(expr, &ty) {
                    Some(Value::Whole(value)) => Some(value),
                    _ => None,
                };
                let Some(from) = known(self, &label.from) else { continue };
                let to = match &label.to {
                    Some(to) => match known(self, to) {
                        Some(to) => to,
                        None => continue,
                    },
                    None => from,
                };
                if to < from {
                    self.error(label.from.span, format!("{from}..{to} is empty"));
                    continue;
                }
                if seen.iter().any(|(a, b)| from <= *b && *a <= to) {
                    self.error(label.from.span, "this label is in a case before: it is never reached");
                }
                seen.push((from, to));
                ranges.push((from, to));
            }
            all.push((ranges, self.statements(body)));
        }
        let otherwise = self.statements(otherwise);
        Some(Stmt::Case(selector_checked, all, otherwise))
    }

    fn counted(
        &mut self,
        variable: &ast::Name,
        from: &ast::Expr,
        to: &ast::Expr,
        by: Option<&ast::Expr>,
        body: &[ast::Stmt],
    ) -> Option<Stmt> {
        let named = ast::Expr {
            kind: ExprKind::Name(variable.clone()),
            span: variable.span,
            depth: 1,
        };
        let place = self.target(&named);
        let scalar = place.as_ref().and_then(|place| match place.ty {
            Ty::Scalar(scalar) => Some(scalar),
            _ => None,
        });
        let scalar = match (scalar, &place) {
            (Some(scalar), _) if scalar.is_int() && scalar != Scalar::Ulint => scalar,
            (_, Some(_)) => {
                self.error(
                    variable.span,
                    "FOR counts with SINT, INT, DINT, LINT, USINT, UINT or UDINT",
                );
                Scalar::Dint
            }
            (_, None) => Scalar::Dint,
        };
        let ty = Ty::Scalar(scalar);
        let bound = |checker: &mut Self, expr: &ast::Expr, ty: &Ty| {
            let checked = checker.expression_as(expr, ty);
            match checked.ty.scalar() {
                Some(scalar) if checked.ty != Ty::Wrong => Self::converted(checked, scalar, Scalar::Lint),
                _ => WRONG,
            }
        };
        let from = bound(self, from, &ty);
        let to = bound(self, to, &ty);
        let by = match by {
            // A step down is a negative number, also of a variable that has none.
            Some(by_expr) => {
                let checked = bound(self, by_expr, &Ty::Scalar(Scalar::Lint));
                if matches!(checked.kind, Kind::Value(Value::Whole(0))) && checked.ty != Ty::Wrong {
                    self.error(by_expr.span, "a step of 0 never ends");
                }
                checked
            }
            None => super::convert::value(Value::Whole(1), Ty::Scalar(Scalar::Lint)),
        };
        let body = self.repeated(body);
        Some(Stmt::For {
            variable: place?,
            scalar,
            from,
            to,
            by,
            body,
        })
    }
}
