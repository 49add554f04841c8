//! Calls of functions and of instances of blocks: arguments by place or by name, outputs, references.
//!
//! Never: standard functions that take several types; `standard` does those.

use super::{Checker, Writable, convert::WRONG};
use crate::{
    ast::{self, Argument, ExprKind, PouKind},
    diagnostic::Span,
    hir::{self, Base, Expr, Input, Kind, Output, Place, Stmt},
    types::{Access, Ty},
};

impl Checker<'_> {
    /// A call within an expression.
    pub(super) fn call(&mut self, callee: &ast::Expr, arguments: &[Argument], want: Option<&Ty>, span: Span) -> Expr {
        match self.function(callee, arguments, want, span) {
            Some((expr, outputs)) if outputs.is_empty() => expr,
            Some(_) => {
                self.error(
                    span,
                    "outputs of a function are taken where it stands alone as a statement",
                );
                WRONG
            }
            None => WRONG,
        }
    }

    /// A call of a function: its value, and which variables take its outputs.
    fn function(
        &mut self,
        callee: &ast::Expr,
        arguments: &[Argument],
        want: Option<&Ty>,
        span: Span,
    ) -> Option<(Expr, Vec<(Place, Expr)>)> {
        let ExprKind::Name(name) = &callee.kind else {
            self.error(
                callee.span,
                "a call of a block stands alone as a statement; its outputs are fields",
            );
            return None;
        };
        // A function of the text or the library comes before the overloaded ones, of which none can have its name.
        let Some(&number) = self.pou_names.get(&name.upper) else {
            if self.scope.contains_key(&name.upper) {
                self.error(
                    callee.span,
                    "a call of a block stands alone as a statement; its outputs are fields",
                );
                return None;
            }
            return match self.standard(name, arguments, want, span) {
                Some(expr) => Some((expr, Vec::new())),
                None => {
                    if !self.unknown.contains(&name.upper) {
                        self.unknown.push(name.upper.clone());
                        self.error(name.span, format!("there is no function {}", name.upper));
                    }
                    None
                }
            };
        };
        let kind = self.pous.get(number).map(|pou| pou.ast.kind)?;
        if kind != PouKind::Function {
            self.error(
                name.span,
                format!(
                    "{} is no function: declare an instance of it in VAR and call that",
                    name.upper
                ),
            );
            return None;
        }
        self.declare(number, Some(name.span));
        self.calls.push(number);
        let (parameters, outputs, result) = {
            let pou = self.pous.get(number)?;
            (pou.parameters.clone(), pou.outputs.clone(), pou.result.clone()?)
        };
        let mut given: Vec<Option<hir::Argument>> = vec![None; parameters.len()];
        let mut taken = Vec::new();
        for (place, argument) in arguments.iter().enumerate() {
            if argument.output {
                let formal = argument.name.as_ref()?;
                let Some((_, ty, offset)) = outputs.iter().find(|(output, ..)| *output == formal.upper) else {
                    self.error(formal.span, format!("{} has no output {}", name.upper, formal.upper));
                    continue;
                };
                let from = Place {
                    base: Base::Frame(number),
                    offset: *offset,
                    indices: Vec::new(),
                    ty: ty.clone(),
                };
                let load = Expr {
                    kind: Kind::Load(from),
                    ty: ty.clone(),
                };
                if ty.scalar().is_none() {
                    self.error(formal.span, "outputs of functions are elementary");
                    continue;
                }
                if let Some(target) = self.target(&argument.value) {
                    let load = self.coerce(load, &target.ty, argument.value.span);
                    taken.push((target, load));
                }
                continue;
            }
            let at = match &argument.name {
                Some(formal) => parameters.iter().position(|parameter| parameter.name == formal.upper),
                None => (place < parameters.len()).then_some(place),
            };
            let Some(at) = at else {
                match &argument.name {
                    Some(formal) => self.error(formal.span, format!("{} has no input {}", name.upper, formal.upper)),
                    None => {
                        let need = parameters.len();
                        self.error(argument.value.span, format!("{} takes {need} arguments", name.upper));
                    }
                }
                continue;
            };
            let Some(parameter) = parameters.get(at) else { continue };
            let value = self.argument(parameter, argument);
            if let Some(slot) = given.get_mut(at) {
                if slot.is_some() {
                    self.error(argument.value.span, format!("{} is given twice", parameter.name));
                }
                *slot = Some(value.unwrap_or(hir::Argument::Value(WRONG)));
            }
        }
        let mut all = Vec::new();
        for (parameter, slot) in parameters.iter().zip(given) {
            let default = parameter.default.map(|known| {
                hir::Argument::Value(Expr {
                    kind: Kind::Value(known),
                    ty: parameter.ty.clone(),
                })
            });
            match slot.or(default) {
                Some(argument) => all.push(argument),
                None => self.error(span, format!("{} is called without {}", name.upper, parameter.name)),
            }
        }
        if result.0 == Ty::Wrong || all.len() != parameters.len() {
            return None;
        }
        let call = Expr {
            kind: Kind::Call(number, all),
            ty: result.0,
        };
        Some((call, taken))
    }

    fn argument(&mut self, parameter: &hir::Parameter, argument: &Argument) -> Option<hir::Argument> {
        if parameter.reference {
            let target = self.target(&argument.value)?;
            if target.ty != parameter.ty {
                let (want, have) = (self.types.name(&parameter.ty), self.types.name(&target.ty));
                self.error(
                    argument.value.span,
                    format!(
                        "{} is a VAR_IN_OUT of type {want}; a variable of just this type is needed, not {have}",
                        parameter.name
                    ),
                );
                return None;
            }
            return Some(hir::Argument::Address(target));
        }
        if parameter.ty.scalar().is_some() || parameter.ty == Ty::Wrong {
            let value = self.expression_as(&argument.value, &parameter.ty);
            return Some(hir::Argument::Value(value));
        }
        let (place, _) = self.place(&argument.value)?;
        if place.ty != parameter.ty {
            let (want, have) = (self.types.name(&parameter.ty), self.types.name(&place.ty));
            self.error(argument.value.span, format!("{want} is expected here, not {have}"));
            return None;
        }
        Some(hir::Argument::Address(place))
    }

    /// A variable that may be assigned.
    pub(super) fn target(&mut self, expr: &ast::Expr) -> Option<Place> {
        let (place, writable) = self.place(expr)?;
        match writable {
            Writable::Yes => Some(place),
            Writable::Input => {
                self.error(expr.span, "an input cannot be assigned within its own block");
                None
            }
            Writable::Output => {
                self.error(expr.span, "an output is assigned by its own block only");
                None
            }
        }
    }

    /// A call that stands alone.
    pub(super) fn call_statement(&mut self, callee: &ast::Expr, arguments: &[Argument], span: Span) -> Option<Stmt> {
        let is_function = match &callee.kind {
            ExprKind::Name(name) => !self.scope.contains_key(&name.upper),
            _ => false,
        };
        if is_function {
            let (expr, outputs) = self.function(callee, arguments, None, span)?;
            return (expr.ty != Ty::Wrong).then_some(Stmt::Call(expr, outputs));
        }
        let (instance, _) = self.place(callee)?;
        let Ty::Block(block) = instance.ty else {
            let name = self.types.name(&instance.ty);
            self.error(callee.span, format!("{name} cannot be called"));
            return None;
        };
        self.calls.push(block);
        let name = self.types.name(&instance.ty);
        let fields = self
            .types
            .blocks
            .get(block)
            .map(|b| b.fields.clone())
            .unwrap_or_default();
        let parameters = self
            .pous
            .get(block)
            .map(|pou| pou.parameters.clone())
            .unwrap_or_default();
        let inputs_in_order: Vec<_> = fields.iter().filter(|field| field.access == Access::Free).collect();
        let (mut inputs, mut outputs) = (Vec::new(), Vec::new());
        let mut references: Vec<Option<Place>> = vec![None; parameters.len()];
        let mut next = 0;
        for argument in arguments {
            if argument.output {
                let formal = argument.name.as_ref()?;
                let field = fields
                    .iter()
                    .find(|f| f.name == formal.upper && f.access == Access::Read);
                let Some(field) = field else {
                    self.error(formal.span, format!("{name} has no output {}", formal.upper));
                    continue;
                };
                let Some(target) = self.target(&argument.value) else {
                    continue;
                };
                let convert = match (field.ty.scalar(), target.ty.scalar()) {
                    _ if field.ty == target.ty => None,
                    (Some(from), Some(to)) if from.widens_to(to) => Some((from, to)),
                    _ => {
                        let (have, need) = (self.types.name(&field.ty), self.types.name(&target.ty));
                        self.error(argument.value.span, format!("{have} does not become {need} by itself"));
                        continue;
                    }
                };
                outputs.push(Output {
                    target,
                    offset: field.offset,
                    from: field.ty.clone(),
                    size: self.types.size(&field.ty),
                    convert,
                });
                continue;
            }
            if let Some(formal) = &argument.name
                && let Some(at) = parameters.iter().position(|parameter| parameter.name == formal.upper)
            {
                let Some(parameter) = parameters.get(at) else { continue };
                if let (Some(hir::Argument::Address(place)), Some(slot)) =
                    (self.argument(parameter, argument), references.get_mut(at))
                {
                    *slot = Some(place);
                }
                continue;
            }
            let field = match &argument.name {
                Some(formal) => inputs_in_order.iter().find(|field| field.name == formal.upper),
                None => {
                    next += 1;
                    inputs_in_order.get(next - 1)
                }
            };
            let Some(field) = field else {
                match &argument.name {
                    Some(formal) => self.error(formal.span, format!("{name} has no input {}", formal.upper)),
                    None => self.error(
                        argument.value.span,
                        format!("{name} has {} inputs", inputs_in_order.len()),
                    ),
                }
                continue;
            };
            if field.ty.scalar().is_some() {
                let value = self.expression_as(&argument.value, &field.ty);
                inputs.push((field.offset, Input::Value(value)));
            } else if let Some((place, _)) = self.place(&argument.value) {
                if place.ty == field.ty {
                    let size = self.types.size(&field.ty);
                    inputs.push((field.offset, Input::Copy(place, size)));
                } else {
                    let (want, have) = (self.types.name(&field.ty), self.types.name(&place.ty));
                    self.error(argument.value.span, format!("{want} is expected here, not {have}"));
                }
            }
        }
        let mut all = Vec::new();
        for (parameter, slot) in parameters.iter().zip(references) {
            match slot {
                Some(place) => all.push(place),
                None => self.error(
                    span,
                    format!("{name} is called without its VAR_IN_OUT {}", parameter.name),
                ),
            }
        }
        Some(Stmt::Invoke {
            block,
            instance,
            inputs,
            references: all,
            outputs,
        })
    }
}
