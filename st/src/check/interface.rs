//! What a PROGRAM shows its host: ports from its inputs and outputs, parameters from its constants, attributes of both.
//!
//! Never: a name that a descriptor would refuse; it is refused here, with its place.

use super::{Checker, convert::Literal, convert::literal};
use crate::{
    ast::{self, Attribute, AttributeValue, BlockKind},
    diagnostic::Span,
    fold,
    hir::Value,
    types::{Access, Scalar, Ty},
};

/// Ports of one component.
const PORTS_MAX: usize = 64;
/// Parameters of one component.
const PARAMETERS_MAX: usize = 128;
/// Characters of a name.
const NAME_MAX: usize = 32;
/// Characters of a text.
const TEXT_MAX: usize = 512;

/// A port.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Port {
    pub(crate) name: String,
    pub(crate) output: bool,
    pub(crate) scalar: Scalar,
    pub(crate) unit: String,
    pub(crate) required: bool,
    pub(crate) text: String,
    /// Of its variable in the program.
    pub(crate) offset: u32,
    /// Outputs are held within it.
    pub(crate) range: Option<(f64, f64)>,
    /// Variable that tells whether there is a value.
    pub(crate) quality: Option<u32>,
}

/// A parameter.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Tunable {
    pub(crate) name: String,
    pub(crate) unit: String,
    pub(crate) default: f64,
    pub(crate) minimum: f64,
    pub(crate) maximum: f64,
    pub(crate) choices: Vec<String>,
    pub(crate) text: String,
    /// What it is in the program.
    pub(crate) ty: Ty,
}

/// What a component says of itself.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Interface {
    pub(crate) name: String,
    pub(crate) version: String,
    pub(crate) text: String,
    pub(crate) ports: Vec<Port>,
    pub(crate) parameters: Vec<Tunable>,
}

/// Attributes, taken one by one.
struct Attributes<'e>(Vec<&'e Attribute>);

impl<'e> Attributes<'e> {
    fn new(attributes: &'e [Attribute]) -> Self {
        Self(attributes.iter().collect())
    }

    fn take(&mut self, key: &str) -> Option<&'e Attribute> {
        let at = self.0.iter().position(|attribute| attribute.key.upper == key)?;
        Some(self.0.remove(at))
    }

    fn text(&mut self, checker: &mut Checker<'_>, key: &str) -> Option<(String, Span)> {
        let attribute = self.take(key)?;
        match &attribute.value {
            AttributeValue::Text(text) if text.chars().count() <= TEXT_MAX => Some((text.clone(), attribute.span)),
            AttributeValue::Text(_) => {
                checker.error(attribute.span, format!("a text has at most {TEXT_MAX} characters"));
                None
            }
            AttributeValue::Expr(_) => {
                let key = key.to_lowercase();
                checker.error(attribute.span, format!("{key} is a text: {key} := '…'"));
                None
            }
        }
    }

    /// A number, or a duration where the type is TIME; then in s.
    fn number(&mut self, checker: &mut Checker<'_>, key: &str, ty: &Ty) -> Option<f64> {
        let attribute = self.take(key)?;
        if let AttributeValue::Expr(expr) = &attribute.value {
            match (literal(expr), &expr.kind) {
                (Some(Literal::Int(n)), _) => return Some(n as f64),
                (Some(Literal::Real(x)), _) => return Some(x),
                (None, ast::ExprKind::Time(ns)) if *ty == Ty::Scalar(Scalar::Time) => return Some(*ns as f64 / 1e9),
                _ => {}
            }
        }
        checker.error(attribute.span, format!("{} is a number", key.to_lowercase()));
        None
    }

    fn flag(&mut self, checker: &mut Checker<'_>, key: &str) -> Option<bool> {
        let attribute = self.take(key)?;
        if let AttributeValue::Expr(expr) = &attribute.value
            && let ast::ExprKind::Bool(flag) = expr.kind
        {
            return Some(flag);
        }
        checker.error(attribute.span, format!("{} is TRUE or FALSE", key.to_lowercase()));
        None
    }

    /// What is left is not known.
    fn finish(self, checker: &mut Checker<'_>, known: &str) {
        for attribute in self.0 {
            let key = attribute.key.upper.to_lowercase();
            checker.error(
                attribute.key.span,
                format!("there is no attribute {key} here; there are {known}"),
            );
        }
    }
}

impl Checker<'_> {
    /// The name that a host knows a variable by.
    fn short_name(&mut self, name: &ast::Name) -> String {
        let short = name.upper.to_lowercase().replace('_', "-");
        if short.len() > NAME_MAX {
            self.error(
                name.span,
                format!("names of programs, ports and parameters have at most {NAME_MAX} characters"),
            );
        }
        short
    }

    /// A constant with attributes is a parameter; gives its number.
    pub(super) fn tunable(&mut self, declaration: &ast::Declaration) -> Option<(u32, Ty)> {
        let (ty, mut first) = self.type_of(&declaration.ty, None);
        if let Some(init) = &declaration.init {
            self.init(&ty, init, &mut first);
        }
        let Some(scalar) = ty.scalar() else {
            if ty != Ty::Wrong {
                self.error(declaration.ty.span, "a parameter is elementary");
            }
            return None;
        };
        let seconds = if scalar == Scalar::Time { 1e-9 } else { 1.0 };
        let default = number(scalar, super::init::value_of(scalar, &first)) * seconds;
        let mut attributes = Attributes::new(&declaration.attributes);
        let (mut low, mut high) = (
            attributes.number(self, "LOW", &ty),
            attributes.number(self, "HIGH", &ty),
        );
        let unit = attributes.text(self, "UNIT").map(|(text, _)| text);
        let text = attributes.text(self, "TEXT").map(|(text, _)| text).unwrap_or_default();
        attributes.finish(self, "unit, low, high, text");
        let mut choices = Vec::new();
        if let Ty::Enum(number) = ty {
            let values = self
                .types
                .enumerations
                .get(number)
                .map(|e| e.values.clone())
                .unwrap_or_default();
            if values
                .iter()
                .enumerate()
                .any(|(n, (_, value))| i32::try_from(n) != Ok(*value))
            {
                self.error(
                    declaration.ty.span,
                    "an enumeration that is a parameter counts 0, 1, 2, …",
                );
            }
            choices = values
                .iter()
                .map(|(name, _)| name.to_lowercase().replace('_', "-"))
                .collect();
            (low, high) = (Some(0.0), Some(values.len().saturating_sub(1) as f64));
        } else if scalar == Scalar::Bool {
            choices = vec!["false".to_owned(), "true".to_owned()];
            (low, high) = (Some(0.0), Some(1.0));
        }
        let (Some(minimum), Some(maximum)) = (low, high) else {
            self.error(
                declaration.name.span,
                "a parameter has a range: {low := …, high := …}; without attributes it is a constant",
            );
            return None;
        };
        if !(minimum <= default && default <= maximum) {
            self.error(
                declaration.name.span,
                format!("{default} lies outside of {minimum} to {maximum}"),
            );
        }
        let name = self.short_name(&declaration.name);
        if self.tunables.len() >= PARAMETERS_MAX {
            self.error(declaration.name.span, format!("more than {PARAMETERS_MAX} parameters"));
            return None;
        }
        let seconds_unit = if scalar == Scalar::Time { "s" } else { "" };
        self.tunables.push(Tunable {
            name,
            unit: unit.unwrap_or_else(|| seconds_unit.to_owned()),
            default,
            minimum,
            maximum,
            choices,
            text,
            ty: ty.clone(),
        });
        Some((self.tunables.len() as u32 - 1, ty))
    }

    /// What the program shows; none where that is wrong.
    pub(super) fn interface(&mut self, program: usize) -> Option<Interface> {
        let ast = self.pous.get(program)?.ast;
        let mut attributes = Attributes::new(&ast.attributes);
        let version = attributes.text(self, "VERSION");
        let text = attributes.text(self, "TEXT").map(|(text, _)| text).unwrap_or_default();
        attributes.finish(self, "version, text");
        if let Some((version, span)) = &version
            && !is_version(version)
        {
            self.error(*span, "a version is three numbers, as in '1.0.0'");
        }
        let mut made = Interface {
            name: self.short_name(&ast.name),
            version: version.map_or_else(|| "1.0.0".to_owned(), |(version, _)| version),
            text,
            ports: Vec::new(),
            parameters: std::mem::take(&mut self.tunables),
        };
        let mut qualities = Vec::new();
        for block in &ast.blocks {
            if !matches!(block.kind, BlockKind::Input | BlockKind::Output) {
                continue;
            }
            for declaration in &block.declarations {
                self.port(
                    program,
                    block.kind == BlockKind::Output,
                    declaration,
                    &mut made,
                    &mut qualities,
                );
            }
        }
        for (of, offset, span) in qualities {
            match made.ports.iter_mut().find(|port| port.name == of && !port.output) {
                Some(port) => port.quality = Some(offset),
                None => self.error(span, format!("there is no input {of}")),
            }
        }
        if self.sink.is_empty() && !made.ports.iter().any(|port| port.output) {
            self.error(
                ast.name.span,
                "a controller moves something: declare at least one VAR_OUTPUT",
            );
        }
        if made.ports.len() > PORTS_MAX {
            self.error(ast.name.span, format!("more than {PORTS_MAX} ports"));
        }
        Some(made)
    }

    fn port(
        &mut self,
        program: usize,
        output: bool,
        declaration: &ast::Declaration,
        made: &mut Interface,
        qualities: &mut Vec<(String, u32, Span)>,
    ) {
        let name = &declaration.name;
        let access = if output { Access::Read } else { Access::Free };
        let found = self
            .types
            .blocks
            .get(program)
            .and_then(|block| block.fields.iter().find(|f| f.name == name.upper && f.access == access))
            .map(|field| (field.ty.clone(), field.offset));
        let Some((ty, offset)) = found else { return };
        let Ty::Scalar(scalar) = ty else {
            self.error(declaration.ty.span, "a port carries BOOL or a number");
            return;
        };
        if !(scalar.is_number() || scalar == Scalar::Bool) {
            self.error(
                declaration.ty.span,
                format!("a port carries BOOL or a number, not {}", scalar.name()),
            );
            return;
        }
        let mut attributes = Attributes::new(&declaration.attributes);
        if !output && let Some((of, span)) = attributes.text(self, "QUALITY") {
            if scalar != Scalar::Bool {
                self.error(declaration.ty.span, "what tells the quality of an input is BOOL");
            }
            attributes.finish(self, "quality alone");
            qualities.push((of.to_lowercase().replace('_', "-"), offset, span));
            return;
        }
        let unit = attributes.text(self, "UNIT").map(|(text, _)| text).unwrap_or_default();
        let mut text = attributes.text(self, "TEXT").map(|(text, _)| text).unwrap_or_default();
        let range = match (
            attributes.number(self, "LOW", &ty),
            attributes.number(self, "HIGH", &ty),
        ) {
            (Some(low), Some(high)) if low <= high => Some((low, high)),
            (None, None) => None,
            (Some(low), Some(high)) => {
                self.error(name.span, format!("{low} to {high} is no range"));
                None
            }
            _ => {
                self.error(name.span, "a range has both ends: {low := …, high := …}");
                None
            }
        };
        let required = attributes.flag(self, "REQUIRED").unwrap_or(true);
        attributes.finish(
            self,
            if output {
                "unit, low, high, required, text"
            } else {
                "unit, low, high, required, quality, text"
            },
        );
        if let Some((low, high)) = range {
            let range = format!("{low} to {high} {unit}");
            text = if text.is_empty() {
                range
            } else {
                format!("{text}, {range}")
            };
            text = text.trim_end().chars().take(TEXT_MAX).collect();
        }
        let name = self.short_name(name);
        made.ports.push(Port {
            name,
            output,
            scalar,
            unit,
            required,
            text,
            offset,
            range,
            quality: None,
        });
    }
}

fn is_version(text: &str) -> bool {
    let parts: Vec<&str> = text.split('.').collect();
    parts.len() == 3
        && parts
            .iter()
            .all(|part| !part.is_empty() && part.len() < 10 && part.bytes().all(|b| b.is_ascii_digit()))
}

/// A value as a number.
fn number(scalar: Scalar, value: Value) -> f64 {
    match fold::convert(scalar, Scalar::Lreal, value) {
        Value::Lreal(x) => x,
        Value::Real(x) => f64::from(x),
        Value::Whole(n) => n as f64,
    }
}
