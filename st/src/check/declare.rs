//! Declarations: types, variables, layouts of blocks, frames of functions, parameters.
//!
//! Never: looks into a body.

use std::rc::Rc;

use super::{Checker, FRAMES_MAX, Named, Progress, Symbol, VARIABLE_MAX, Writable};
use crate::{
    ast::{self, BlockKind, PouKind, Retain, TypeKind},
    diagnostic::Span,
    hir::{Base, External, Kind, Parameter, Place, Value},
    types::{Access, Array, Enumeration, Field, Scalar, Structure, Ty},
};

/// What the host says of each cycle, by name and type.
const EXTERNALS: [(&str, External, Scalar); 7] = [
    ("SETPOINT", External::Setpoint, Scalar::Lreal),
    ("AUTOMATIC", External::Automatic, Scalar::Bool),
    ("TRACK", External::Track, Scalar::Bool),
    ("FIRST", External::First, Scalar::Bool),
    ("DT", External::Dt, Scalar::Time),
    ("CYCLE", External::Cycle, Scalar::Ulint),
    ("__CLOCK", External::Clock, Scalar::Time),
];

impl<'a> Checker<'a> {
    /// The type of a name and its first value; asked again it answers from its table.
    pub(super) fn named_type(&mut self, name: &ast::Name) -> (Ty, Vec<u8>) {
        if let Some(scalar) = Scalar::named(&name.upper) {
            return (Ty::Scalar(scalar), vec![0; scalar.bits() as usize / 8]);
        }
        if let Some(&number) = self.pou_names.get(&name.upper) {
            if self
                .pous
                .get(number)
                .is_some_and(|pou| pou.ast.kind == PouKind::FunctionBlock)
            {
                self.declare(number, Some(name.span));
                let init = self.block_init(number);
                return (Ty::Block(number), init);
            }
            self.error(
                name.span,
                format!("{} is no type: only function blocks have instances", name.upper),
            );
            return (Ty::Wrong, Vec::new());
        }
        match self.named.get_mut(&name.upper) {
            Some(Named::Done(ty, init)) => (ty.clone(), init.clone()),
            Some(entry @ Named::Untouched(_)) => {
                let Named::Untouched(declaration) = std::mem::replace(entry, Named::Under) else {
                    return (Ty::Wrong, Vec::new());
                };
                let made = self.declared_type(declaration);
                self.named
                    .insert(name.upper.clone(), Named::Done(made.0.clone(), made.1.clone()));
                made
            }
            Some(Named::Under) => {
                self.error(name.span, format!("the type {} holds itself", name.upper));
                (Ty::Wrong, Vec::new())
            }
            None => {
                let cure = match name.upper.as_str() {
                    "DATE" | "TOD" | "DT" | "TIME_OF_DAY" | "DATE_AND_TIME" | "LDATE" | "LTOD" | "LDT" => {
                        ": dates are outside the subset, for a controller has no calendar"
                    }
                    "CHAR" | "WCHAR" => ": texts are outside the subset",
                    _ => "",
                };
                self.error(name.span, format!("there is no type {}{cure}", name.upper));
                (Ty::Wrong, Vec::new())
            }
        }
    }

    fn declared_type(&mut self, declaration: &'a ast::TypeDeclaration) -> (Ty, Vec<u8>) {
        let (ty, mut first) = self.type_of(&declaration.ty, Some(&declaration.name.upper));
        if let Some(init) = &declaration.init {
            self.init(&ty, init, &mut first);
        }
        (ty, first)
    }

    /// The type of a reference and its first value. `name` is what a structure or enumeration is called.
    pub(super) fn type_of(&mut self, ty: &ast::TypeRef, name: Option<&str>) -> (Ty, Vec<u8>) {
        match &ty.kind {
            TypeKind::Named(name) => self.named_type(name),
            TypeKind::Array(ranges, of) => self.array(ranges, of, ty.span),
            TypeKind::Struct(fields) => self.structure(fields, name.unwrap_or("STRUCT")),
            TypeKind::Enum(values) => self.enumeration(values, name.unwrap_or("ENUM")),
        }
    }

    fn array(&mut self, ranges: &[(ast::Expr, ast::Expr)], of: &ast::TypeRef, span: Span) -> (Ty, Vec<u8>) {
        let (of, first) = self.type_of(of, None);
        let mut counts = Vec::new();
        let mut elements: u64 = 1;
        for (low, high) in ranges {
            let (Some(low_value), Some(high_value)) = (self.constant_lint(low), self.constant_lint(high)) else {
                return (Ty::Wrong, Vec::new());
            };
            if high_value < low_value {
                self.error(low.span.to(high.span), format!("{low_value}..{high_value} is empty"));
                return (Ty::Wrong, Vec::new());
            }
            let count = high_value.abs_diff(low_value).saturating_add(1);
            elements = elements.saturating_mul(count);
            counts.push((low_value, u32::try_from(count).unwrap_or(u32::MAX)));
        }
        if of == Ty::Wrong {
            return (Ty::Wrong, Vec::new());
        }
        let stride = self.types.size(&of);
        let size = elements.saturating_mul(u64::from(stride));
        if size > u64::from(VARIABLE_MAX) {
            self.error(
                span,
                format!("this array has {size} bytes; a variable has at most {VARIABLE_MAX}"),
            );
            return (Ty::Wrong, Vec::new());
        }
        let array = Array {
            ranges: counts,
            of,
            stride,
            size: size as u32,
        };
        (Ty::Array(Rc::new(array)), first.repeat(elements as usize))
    }

    fn structure(&mut self, declarations: &[ast::Declaration], name: &str) -> (Ty, Vec<u8>) {
        let mut made = Structure {
            name: name.to_owned(),
            ..Structure::default()
        };
        let mut bytes = Vec::new();
        for declaration in declarations {
            if made.fields.iter().any(|field| field.name == declaration.name.upper) {
                self.error(
                    declaration.name.span,
                    format!("the field {} is declared twice", declaration.name.upper),
                );
                continue;
            }
            let (ty, mut first) = self.type_of(&declaration.ty, None);
            if matches!(ty, Ty::Block(_)) {
                self.error(
                    declaration.ty.span,
                    "a structure holds no function blocks; declare it beside the structure",
                );
                continue;
            }
            if let Some(init) = &declaration.init {
                self.init(&ty, init, &mut first);
            }
            made.fields.push(Field {
                name: declaration.name.upper.clone(),
                offset: bytes.len() as u32,
                ty,
                access: Access::Free,
                init: first.clone(),
            });
            bytes.extend_from_slice(&first);
        }
        if bytes.len() > VARIABLE_MAX as usize
            && let Some(first) = declarations.first()
        {
            self.error(
                first.name.span,
                format!("this structure is larger than {VARIABLE_MAX} bytes"),
            );
        }
        made.size = bytes.len() as u32;
        self.types.structures.push(made);
        (Ty::Struct(self.types.structures.len() - 1), bytes)
    }

    fn enumeration(&mut self, values: &[(ast::Name, Option<ast::Expr>)], name: &str) -> (Ty, Vec<u8>) {
        let number = self.types.enumerations.len();
        let mut made = Enumeration {
            name: name.to_owned(),
            values: Vec::new(),
        };
        let mut next: i64 = 0;
        for (name, value) in values {
            if let Some(value) = value {
                next = self.constant_lint(value).unwrap_or(next);
            }
            let Ok(here) = i32::try_from(next) else {
                self.error(name.span, "an enumerated value is a DINT");
                continue;
            };
            if made.values.iter().any(|(other, _)| *other == name.upper) {
                self.error(name.span, format!("{} is enumerated twice", name.upper));
            }
            made.values.push((name.upper.clone(), here));
            self.values.entry(name.upper.clone()).or_default().push((number, here));
            next += 1;
        }
        let first = made.values.first().map_or(0, |(_, value)| *value);
        self.types.enumerations.push(made);
        (Ty::Enum(number), first.to_le_bytes().to_vec())
    }

    pub(super) fn global_constants(&mut self, file: &'a ast::File) {
        for block in &file.globals {
            if !block.constant {
                self.error(
                    block.span,
                    "VAR_GLOBAL is outside the subset, but for VAR_GLOBAL CONSTANT: the state of a controller is its PROGRAM's",
                );
                continue;
            }
            for declaration in &block.declarations {
                if let Some((value, ty)) = self.constant(declaration) {
                    let symbol = Symbol::Constant(value, ty);
                    if self.globals.insert(declaration.name.upper.clone(), symbol).is_some() {
                        self.error(
                            declaration.name.span,
                            format!("{} is declared twice", declaration.name.upper),
                        );
                    }
                }
            }
        }
    }

    /// An elementary constant.
    fn constant(&mut self, declaration: &ast::Declaration) -> Option<(Value, Ty)> {
        let (ty, first) = self.type_of(&declaration.ty, None);
        let Some(scalar) = ty.scalar() else {
            if ty != Ty::Wrong {
                self.error(
                    declaration.ty.span,
                    "constants are elementary: declare a structure or an array as VAR with its first values",
                );
            }
            return None;
        };
        match &declaration.init {
            Some(ast::Init {
                kind: ast::InitKind::Expr(expr),
                ..
            }) => {
                let value = self.constant_of(expr, &ty)?;
                Some((value, ty))
            }
            Some(init) => {
                self.error(init.span, "one value is expected here");
                None
            }
            None => Some((super::init::value_of(scalar, &first), ty)),
        }
    }

    /// First values of an instance.
    pub(super) fn block_init(&self, number: usize) -> Vec<u8> {
        self.types
            .blocks
            .get(number)
            .map(|block| {
                block
                    .fields
                    .iter()
                    .flat_map(|field| field.init.iter().copied())
                    .collect()
            })
            .unwrap_or_default()
    }

    /// Lays a POU out, once. `from` is where an instance of it is declared.
    pub(super) fn declare(&mut self, number: usize, from: Option<Span>) {
        let Some(pou) = self.pous.get_mut(number) else { return };
        match pou.state {
            Progress::Done => return,
            Progress::Under => {
                let (name, own) = (pou.ast.name.upper.clone(), pou.ast.name.span);
                self.error(from.unwrap_or(own), format!("{name} holds an instance of itself"));
                return;
            }
            Progress::Untouched => pou.state = Progress::Under,
        }
        let ast = pou.ast;
        let outer = (self.current, std::mem::take(&mut self.scope));
        self.current = number;
        Layout {
            number,
            ast,
            fields: Vec::new(),
            size: 0,
            retains: Vec::new(),
            frame: Vec::new(),
            references: 0,
            parameters: Vec::new(),
            outputs: Vec::new(),
        }
        .all(self);
        (self.current, self.scope) = outer;
    }
}

/// A layout that is being made.
struct Layout<'a> {
    number: usize,
    ast: &'a ast::Pou,
    fields: Vec<Field>,
    size: u32,
    retains: Vec<Retain>,
    frame: Vec<u8>,
    references: u32,
    parameters: Vec<Parameter>,
    outputs: Vec<(String, Ty, u32)>,
}

impl<'a> Layout<'a> {
    fn all(mut self, checker: &mut Checker<'a>) {
        let name = &self.ast.name;
        let is_function = self.ast.kind == PouKind::Function;
        let result = match (&self.ast.result, is_function) {
            (Some(ty), true) => {
                let (ty, first) = checker.type_of(ty, None);
                if ty.scalar().is_none() && ty != Ty::Wrong {
                    let span = self.ast.result.as_ref().map_or(name.span, |ty| ty.span);
                    checker.error(span, "a function gives an elementary value; use VAR_OUTPUT for more");
                }
                let offset = self.frame.len() as u32;
                self.frame.extend(first);
                self.symbol(checker, name, self.frame_place(offset, &ty), Writable::Yes);
                Some((ty, offset))
            }
            (Some(ty), false) => {
                checker.error(ty.span, "only a FUNCTION has a type");
                None
            }
            (None, true) => {
                checker.error(
                    name.span,
                    format!("{} needs a type: FUNCTION {} : REAL", name.upper, name.upper),
                );
                None
            }
            (None, false) => None,
        };
        for block in &self.ast.blocks {
            for declaration in &block.declarations {
                self.variable(checker, block, declaration);
            }
        }
        if checker.frames.len() + self.frame.len() > FRAMES_MAX as usize {
            checker.error(
                name.span,
                format!("all functions together need more than {FRAMES_MAX} bytes"),
            );
            self.frame.clear();
        }
        // Only now: blocks that were laid out meanwhile have their frames before this one.
        let base = checker.frames.len() as u32;
        checker.frames.extend_from_slice(&self.frame);
        let symbols = std::mem::take(&mut checker.scope);
        if let Some(block) = checker.types.blocks.get_mut(self.number) {
            block.fields = self.fields;
            block.size = self.size;
        }
        if let Some(pou) = checker.pous.get_mut(self.number) {
            pou.symbols = symbols;
            pou.parameters = self.parameters;
            pou.outputs = self.outputs;
            pou.result = result;
            pou.frame = (base, self.frame.len() as u32);
            pou.retains = self.retains;
            pou.state = Progress::Done;
        }
    }

    fn frame_place(&self, offset: u32, ty: &Ty) -> Place {
        Place {
            base: Base::Frame(self.number),
            offset,
            indices: Vec::new(),
            ty: ty.clone(),
        }
    }

    fn symbol(&self, checker: &mut Checker<'a>, name: &ast::Name, place: Place, writable: Writable) {
        self.put(checker, name, Symbol::Place(place, writable));
    }

    fn put(&self, checker: &mut Checker<'a>, name: &ast::Name, symbol: Symbol) {
        let library = checker.pous.get(self.number).is_some_and(|pou| pou.library);
        if !library && name.upper.starts_with("__") {
            checker.error(name.span, "names do not begin with two underscores");
        }
        if checker.scope.insert(name.upper.clone(), symbol).is_some() {
            checker.error(name.span, format!("{} is declared twice", name.upper));
        }
    }

    fn variable(&mut self, checker: &mut Checker<'a>, block: &ast::Block, declaration: &ast::Declaration) {
        let name = &declaration.name;
        let is_function = self.ast.kind == PouKind::Function;
        let is_program = self.ast.kind == PouKind::Program;
        let is_port = is_program && matches!(block.kind, BlockKind::Input | BlockKind::Output);
        if !(declaration.attributes.is_empty() || is_port || is_program && block.constant) {
            let span = declaration.attributes.first().map_or(name.span, |a| a.span);
            checker.error(span, "attributes belong to ports and to constants of the PROGRAM");
        }
        if block.constant && block.kind == BlockKind::Var {
            if is_program && !declaration.attributes.is_empty() {
                if let Some((index, ty)) = checker.tunable(declaration) {
                    self.put(checker, name, Symbol::Parameter(index, ty));
                }
            } else if let Some((value, ty)) = checker.constant(declaration) {
                self.put(checker, name, Symbol::Constant(value, ty));
            }
            return;
        }
        if block.constant && block.kind != BlockKind::External {
            checker.error(block.span, "CONSTANT goes with VAR, VAR_GLOBAL or VAR_EXTERNAL");
        }
        if block.kind == BlockKind::External {
            return self.external(checker, declaration);
        }
        if block.kind == BlockKind::Global {
            checker.error(block.span, "VAR_GLOBAL stands beside the PROGRAM, not in it");
            return;
        }
        let (ty, mut first) = checker.type_of(&declaration.ty, None);
        if let Some(init) = &declaration.init {
            checker.init(&ty, init, &mut first);
        }
        if ty == Ty::Wrong {
            // Known, so that its uses say nothing more.
            return self.symbol(checker, name, self.frame_place(0, &Ty::Wrong), Writable::Yes);
        }
        let in_frame = is_function || block.kind == BlockKind::Temp;
        if in_frame && matches!(ty, Ty::Block(_)) && block.kind != BlockKind::InOut {
            checker.error(
                declaration.ty.span,
                "a function block needs memory: declare it in VAR of a PROGRAM or FUNCTION_BLOCK",
            );
            return;
        }
        let writable = if block.kind == BlockKind::Input {
            Writable::Input
        } else {
            Writable::Yes
        };
        match block.kind {
            BlockKind::InOut if is_program => {
                checker.error(
                    name.span,
                    "a PROGRAM has inputs and outputs; VAR_IN_OUT is for functions and blocks",
                );
            }
            BlockKind::InOut => {
                // Parameter 0 of a block's code is the instance.
                let index = if is_function {
                    self.parameters.len() as u32
                } else {
                    1 + self.references
                };
                self.references += 1;
                self.parameters.push(Parameter {
                    name: name.upper.clone(),
                    ty: ty.clone(),
                    reference: true,
                    offset: 0,
                    default: None,
                });
                let place = Place {
                    base: Base::InOut(index),
                    offset: 0,
                    indices: Vec::new(),
                    ty,
                };
                self.symbol(checker, name, place, Writable::Yes);
            }
            _ if in_frame => {
                let offset = self.frame.len() as u32;
                if is_function && block.kind == BlockKind::Input {
                    let default = ty.scalar().map(|scalar| super::init::value_of(scalar, &first));
                    self.parameters.push(Parameter {
                        name: name.upper.clone(),
                        ty: ty.clone(),
                        reference: false,
                        offset,
                        default: declaration.init.as_ref().and(default),
                    });
                }
                if is_function && block.kind == BlockKind::Output {
                    self.outputs.push((name.upper.clone(), ty.clone(), offset));
                }
                self.frame.extend(first);
                self.symbol(checker, name, self.frame_place(offset, &ty), writable);
            }
            _ => {
                let offset = self.size;
                self.size += first.len() as u32;
                let access = match block.kind {
                    BlockKind::Input => Access::Free,
                    BlockKind::Output => Access::Read,
                    _ => Access::None,
                };
                self.retains.push(block.retain);
                self.fields.push(Field {
                    name: name.upper.clone(),
                    ty: ty.clone(),
                    offset,
                    access,
                    init: first,
                });
                let place = Place {
                    base: Base::Own,
                    offset,
                    indices: Vec::new(),
                    ty,
                };
                self.symbol(checker, name, place, writable);
            }
        }
    }

    fn external(&mut self, checker: &mut Checker<'a>, declaration: &ast::Declaration) {
        let name = &declaration.name;
        let (ty, _) = checker.type_of(&declaration.ty, None);
        if let Some(init) = &declaration.init {
            checker.error(init.span, "what comes from the host has no first value");
        }
        let known = |library: bool| EXTERNALS.iter().filter(move |(n, ..)| library || !n.starts_with("__"));
        let library = checker.pous.get(self.number).is_some_and(|pou| pou.library);
        match known(library).find(|(known, ..)| *known == name.upper) {
            Some((_, external, scalar)) => {
                if ty != Ty::Scalar(*scalar) && ty != Ty::Wrong {
                    checker.error(
                        declaration.ty.span,
                        format!("{} is of type {}", name.upper, scalar.name()),
                    );
                }
                self.put(checker, name, Symbol::External(*external, Ty::Scalar(*scalar)));
            }
            None => {
                let names: Vec<&str> = known(false).map(|(name, ..)| *name).collect();
                checker.error(
                    name.span,
                    format!("the host has no variable {}; it has {}", name.upper, names.join(", ")),
                );
            }
        }
    }
}

impl Checker<'_> {
    /// A whole number that is known while compiling.
    pub(super) fn constant_lint(&mut self, expr: &ast::Expr) -> Option<i64> {
        match self.constant_of(expr, &Ty::Scalar(Scalar::Lint))? {
            Value::Whole(value) => Some(value),
            _ => None,
        }
    }

    /// A value of a type that is known while compiling.
    pub(super) fn constant_of(&mut self, expr: &ast::Expr, ty: &Ty) -> Option<Value> {
        let checked = self.expression_as(expr, ty);
        match checked.kind {
            _ if checked.ty == Ty::Wrong => None,
            Kind::Value(value) => Some(value),
            _ => {
                self.error(
                    expr.span,
                    "this must be known while compiling: use literals and constants",
                );
                None
            }
        }
    }
}
