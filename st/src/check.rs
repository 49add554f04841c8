//! From the tree of a text to a checked program: names, types, layouts, and everything that can be wrong.
//!
//! ```text
//!   types ─► global constants ─► layouts of blocks and frames of functions ─► bodies, each once, from the program on
//! ```
//! Owns: the tables of names and types. Never: reports what follows from something that was reported.

mod call;
mod convert;
mod declare;
mod expression;
mod init;
mod interface;
mod standard;
mod statement;

use std::collections::HashMap;

use crate::{
    ast,
    diagnostic::{Sink, Span},
    hir::{Body, External, Parameter, Place, Value},
    types::{Ty, Types},
};

use interface::Tunable;

/// POUs of one text, those of the library too.
pub(crate) const POUS_MAX: usize = 512;
/// Bytes of the frames of all functions together: what an instance's memory has room for beside everything else.
pub(crate) const FRAMES_MAX: u32 = 1024 * 1024;
/// Bytes of one variable.
pub(crate) const VARIABLE_MAX: u32 = 64 * 1024;

/// What a name in a body means.
#[derive(Debug, Clone)]
pub(crate) enum Symbol {
    Place(Place, Writable),
    Constant(Value, Ty),
    Parameter(u32, Ty),
    External(External, Ty),
}

/// May a body assign it, and if not, what is it?
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Writable {
    Yes,
    Input,
    /// Of a block that it belongs to.
    Output,
}

/// A program, block or function.
#[derive(Debug)]
pub(crate) struct Pou<'a> {
    pub(crate) ast: &'a ast::Pou,
    pub(crate) library: bool,
    pub(crate) symbols: HashMap<String, Symbol>,
    /// Of a function: inputs and references in their order. Of a block: its references.
    pub(crate) parameters: Vec<Parameter>,
    /// Outputs of a function, by name, with their places in the frame.
    pub(crate) outputs: Vec<(String, Ty, u32)>,
    /// Of a function: its type and where the answer lies in the frames.
    pub(crate) result: Option<(Ty, u32)>,
    /// Begin and length of its frame.
    pub(crate) frame: (u32, u32),
    /// How variables of a block outlive a change, by field.
    pub(crate) retains: Vec<ast::Retain>,
    state: Progress,
    pub(crate) body: Option<Body>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Progress {
    Untouched,
    Under,
    Done,
}

/// A type's name.
enum Named<'a> {
    Untouched(&'a ast::TypeDeclaration),
    Under,
    Done(Ty, Vec<u8>),
}

/// A checked program.
#[derive(Debug)]
pub(crate) struct Checked<'a> {
    pub(crate) types: Types,
    pub(crate) pous: Vec<Pou<'a>>,
    /// The one PROGRAM.
    pub(crate) program: usize,
    /// First values of all frames.
    pub(crate) frames: Vec<u8>,
    /// Texts of the faults that code may raise, by their number.
    pub(crate) sites: Vec<String>,
    pub(crate) interface: interface::Interface,
}

pub(crate) struct Checker<'a> {
    pub(crate) types: Types,
    named: HashMap<String, Named<'a>>,
    /// Enumerated values by name: enumeration and value.
    values: HashMap<String, Vec<(usize, i32)>>,
    globals: HashMap<String, Symbol>,
    pous: Vec<Pou<'a>>,
    pou_names: HashMap<String, usize>,
    frames: Vec<u8>,
    sites: Vec<String>,
    source: &'a str,
    sink: &'a mut Sink,
    /// What is being checked.
    current: usize,
    scope: HashMap<String, Symbol>,
    calls: Vec<usize>,
    loops: u32,
    /// Names that are not known and were reported.
    unknown: Vec<String>,
    tunables: Vec<Tunable>,
}

/// Checks a text together with the library. None where something is wrong; the sink says what.
pub(crate) fn check<'a>(
    library: &'a ast::File,
    file: &'a ast::File,
    source: &'a str,
    sink: &'a mut Sink,
) -> Option<Checked<'a>> {
    let mut checker = Checker {
        types: Types::default(),
        named: HashMap::new(),
        values: HashMap::new(),
        globals: HashMap::new(),
        pous: Vec::new(),
        pou_names: HashMap::new(),
        frames: Vec::new(),
        sites: Vec::new(),
        source,
        sink,
        current: 0,
        scope: HashMap::new(),
        calls: Vec::new(),
        loops: 0,
        unknown: Vec::new(),
        tunables: Vec::new(),
    };
    checker.names(library, file);
    checker.all(file)
}

impl<'a> Checker<'a> {
    pub(crate) fn error(&mut self, span: Span, message: impl Into<String>) {
        self.sink.error(span, message);
    }

    /// A fault that code here may raise; gives its number, from 1.
    fn site(&mut self, span: Span, what: &str) -> u32 {
        let pou = self.pous.get(self.current);
        let text = match pou {
            Some(pou) if pou.library => format!("{what} in a function of the standard library"),
            _ => {
                let (line, column) = crate::diagnostic::position(self.source, span.start);
                let name = pou.map_or("", |pou| pou.ast.name.upper.as_str());
                format!("{what} in {name}, line {line}, column {column}")
            }
        };
        self.sites.push(text);
        self.sites.len() as u32
    }

    /// Puts all names into their tables.
    fn names(&mut self, library: &'a ast::File, file: &'a ast::File) {
        for declaration in &file.types {
            let name = &declaration.name;
            let taken = crate::types::Scalar::named(&name.upper).is_some()
                || self
                    .named
                    .insert(name.upper.clone(), Named::Untouched(declaration))
                    .is_some();
            if taken {
                self.error(name.span, format!("the type {} is declared twice", name.upper));
            }
        }
        for (pou, is_library) in library
            .pous
            .iter()
            .map(|pou| (pou, true))
            .chain(file.pous.iter().map(|pou| (pou, false)))
        {
            let name = &pou.name;
            if self.pous.len() >= POUS_MAX {
                self.error(name.span, format!("more than {POUS_MAX} functions and blocks"));
                return;
            }
            let reserved = !is_library && (standard::is_standard(&name.upper) || name.upper.starts_with("__"));
            if reserved || self.named.contains_key(&name.upper) {
                self.error(name.span, format!("the name {} is taken; choose another", name.upper));
                continue;
            }
            let number = self.pous.len();
            if let Some(other) = self.pou_names.insert(name.upper.clone(), number) {
                let what = if self.pous.get(other).is_some_and(|pou| pou.library) {
                    "the standard library has one of this name; choose another"
                } else {
                    "it is declared twice"
                };
                self.error(name.span, format!("{}: {what}", name.upper));
            }
            self.types.blocks.push(crate::types::Structure {
                name: name.upper.clone(),
                ..Default::default()
            });
            self.pous.push(Pou {
                ast: pou,
                library: is_library,
                symbols: HashMap::new(),
                parameters: Vec::new(),
                outputs: Vec::new(),
                result: None,
                frame: (0, 0),
                retains: Vec::new(),
                state: Progress::Untouched,
                body: None,
            });
        }
    }

    fn all(mut self, file: &'a ast::File) -> Option<Checked<'a>> {
        for declaration in &file.types {
            self.named_type(&declaration.name);
        }
        self.global_constants(file);
        let ours: Vec<usize> = (0..self.pous.len())
            .filter(|&n| self.pous.get(n).is_some_and(|pou| !pou.library))
            .collect();
        for &number in &ours {
            self.declare(number, None);
        }
        let programs: Vec<usize> = ours
            .iter()
            .copied()
            .filter(|&n| {
                self.pous
                    .get(n)
                    .is_some_and(|pou| pou.ast.kind == ast::PouKind::Program)
            })
            .collect();
        let start = Span::default();
        match programs.as_slice() {
            [] if self.sink.is_empty() => {
                self.error(
                    start,
                    "there is no PROGRAM: a controller is one PROGRAM with its blocks and functions",
                );
            }
            [_, second, ..] => {
                let span = self.pous.get(*second).map_or(start, |pou| pou.ast.name.span);
                self.error(
                    span,
                    "a second PROGRAM: a controller has one; make this one a FUNCTION_BLOCK",
                );
            }
            _ => {}
        }
        for &number in &ours {
            self.body(number);
        }
        // Library code that is reached.
        let mut waiting = ours.clone();
        while let Some(number) = waiting.pop() {
            let calls = self
                .pous
                .get(number)
                .and_then(|pou| pou.body.as_ref())
                .map(|body| body.calls.clone())
                .unwrap_or_default();
            for called in calls {
                if self.pous.get(called).is_some_and(|pou| pou.body.is_none()) {
                    self.declare(called, None);
                    self.body(called);
                    waiting.push(called);
                }
            }
        }
        self.recursion(&ours);
        let program = *programs.first()?;
        let interface = self.interface(program)?;
        self.sink.is_empty().then_some(Checked {
            types: self.types,
            pous: self.pous,
            program,
            frames: self.frames,
            sites: self.sites,
            interface,
        })
    }

    fn body(&mut self, number: usize) {
        let Some(pou) = self.pous.get(number) else { return };
        if pou.body.is_some() {
            return;
        }
        let ast = pou.ast;
        self.scope.clone_from(&pou.symbols);
        self.current = number;
        self.calls.clear();
        self.unknown.clear();
        self.loops = 0;
        let statements = self.statements(&ast.body);
        let calls = std::mem::take(&mut self.calls);
        if let Some(pou) = self.pous.get_mut(number) {
            pou.body = Some(Body { statements, calls });
        }
    }

    /// The standard forbids that a POU calls itself, by whatever way; frames rely on it.
    fn recursion(&mut self, ours: &[usize]) {
        let mut done = vec![false; self.pous.len()];
        for &number in ours {
            let mut path = vec![(number, 0_usize)];
            while let Some((here, next)) = path.pop() {
                let calls = self
                    .pous
                    .get(here)
                    .and_then(|pou| pou.body.as_ref())
                    .map(|b| b.calls.as_slice());
                let Some(&called) = calls.unwrap_or_default().get(next) else {
                    if let Some(done) = done.get_mut(here) {
                        *done = true;
                    }
                    continue;
                };
                path.push((here, next + 1));
                if path.iter().any(|(on, _)| *on == called) {
                    let Some(pou) = self.pous.get(called) else { continue };
                    let (name, span) = (pou.ast.name.upper.clone(), pou.ast.name.span);
                    self.error(
                        span,
                        format!("{name} calls itself, at once or through others: use a loop"),
                    );
                } else if !done.get(called).copied().unwrap_or(true) {
                    path.push((called, 0));
                }
            }
        }
    }
}
