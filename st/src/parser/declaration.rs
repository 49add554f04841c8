//! Declarations: types, first values, variables with their pragmas.
//!
//! Never: looks a name up.

use super::{Parsed, Parser, Slip};
use crate::{
    ast::{Attribute, Declaration, Expr, ExprKind, Init, InitKind, TypeDeclaration, TypeKind, TypeRef},
    lexer::{Kind, Token},
};

impl Parser<'_> {
    pub(super) fn types(&mut self, types: &mut Vec<TypeDeclaration>) -> Parsed<()> {
        self.bump();
        while !self.is_word("END_TYPE") {
            if self.at_end() {
                return Err(self.expected("END_TYPE"));
            }
            let read = (|| {
                let name = self.name("the name of a type")?;
                self.need_symbol(":")?;
                let ty = self.type_ref()?;
                let init = self.initial()?;
                types.push(TypeDeclaration { name, ty, init });
                Ok(())
            })();
            match read {
                // Behind END_STRUCT many write none.
                Ok(()) if matches!(types.last(), Some(t) if matches!(t.ty.kind, TypeKind::Struct(_))) => {
                    self.take_symbol(";");
                }
                Ok(()) => self.semicolon(),
                Err(Slip) => self.recover(&["END_TYPE", "PROGRAM", "FUNCTION", "FUNCTION_BLOCK", "VAR_GLOBAL"]),
            }
            if matches!(self.kind(), Kind::Ident(w) if ["PROGRAM", "FUNCTION", "FUNCTION_BLOCK", "VAR_GLOBAL"].contains(&w.as_str()))
            {
                return Err(self.expected("END_TYPE"));
            }
        }
        self.bump();
        Ok(())
    }

    pub(super) fn type_ref(&mut self) -> Parsed<TypeRef> {
        self.deeper(Self::type_here)
    }

    fn type_here(&mut self) -> Parsed<TypeRef> {
        let start = self.span();
        let kind = if self.take_word("ARRAY") {
            self.need_symbol("[")?;
            let mut ranges = Vec::new();
            loop {
                let low = self.expression()?;
                self.need_symbol("..")?;
                ranges.push((low, self.expression()?));
                if !self.take_symbol(",") {
                    break;
                }
            }
            self.need_symbol("]")?;
            self.need_word("OF")?;
            TypeKind::Array(ranges, Box::new(self.type_ref()?))
        } else if self.take_word("STRUCT") {
            let mut fields = Vec::new();
            while !self.is_word("END_STRUCT") {
                if self.at_end() || matches!(self.kind(), Kind::Ident(w) if w == "END_TYPE" || w == "END_VAR") {
                    return Err(self.expected("END_STRUCT"));
                }
                if self.declarations(&mut fields).is_err() {
                    self.recover(&["END_STRUCT", "END_TYPE", "END_VAR"]);
                }
            }
            self.bump();
            TypeKind::Struct(fields)
        } else if self.take_symbol("(") {
            let mut values = Vec::new();
            loop {
                let name = self.name("the name of an enumerated value")?;
                let value = if self.take_symbol(":=") {
                    Some(self.expression()?)
                } else {
                    None
                };
                values.push((name, value));
                if !self.take_symbol(",") {
                    break;
                }
            }
            self.need_symbol(")")?;
            TypeKind::Enum(values)
        } else {
            let name = self.name("a type")?;
            if self.is_symbol("(") {
                let span = self.span();
                self.sink.error(
                    span,
                    "subranges are outside the subset: use LIMIT where a value must stay in a range",
                );
                return Err(Slip);
            }
            TypeKind::Named(name)
        };
        Ok(TypeRef {
            kind,
            span: start.to(self.before()),
        })
    }

    fn initial(&mut self) -> Parsed<Option<Init>> {
        if self.take_symbol(":=") {
            self.init().map(Some)
        } else {
            Ok(None)
        }
    }

    fn init(&mut self) -> Parsed<Init> {
        self.deeper(Self::init_here)
    }

    fn init_here(&mut self) -> Parsed<Init> {
        let start = self.span();
        let kind = if self.take_symbol("[") {
            let mut items = Vec::new();
            loop {
                // `3(0)`: a count before what is repeated.
                let repeats = matches!(self.kind(), Kind::Int(_)) && matches!(self.ahead(1), Kind::Symbol("("));
                if repeats {
                    let count = Expr {
                        kind: match self.kind() {
                            Kind::Int(n) => ExprKind::Int(*n),
                            _ => ExprKind::Wrong,
                        },
                        span: self.span(),
                        depth: 1,
                    };
                    self.bump();
                    self.bump();
                    items.push((Some(count), self.init()?));
                    self.need_symbol(")")?;
                } else {
                    items.push((None, self.init()?));
                }
                if !self.take_symbol(",") {
                    break;
                }
            }
            self.need_symbol("]")?;
            InitKind::Array(items)
        } else if self.is_symbol("(")
            && matches!(self.ahead(1), Kind::Ident(_))
            && matches!(self.ahead(2), Kind::Symbol(":="))
        {
            self.bump();
            let mut fields = Vec::new();
            loop {
                let name = self.name("the name of a field")?;
                self.need_symbol(":=")?;
                fields.push((name, self.init()?));
                if !self.take_symbol(",") {
                    break;
                }
            }
            self.need_symbol(")")?;
            InitKind::Struct(fields)
        } else {
            InitKind::Expr(self.expression()?)
        };
        Ok(Init {
            kind,
            span: start.to(self.before()),
        })
    }

    /// `a, b : INT := 5;` with pragmas before it or before the semicolon.
    pub(super) fn declarations(&mut self, into: &mut Vec<Declaration>) -> Parsed<()> {
        let mut attributes = self.pragmas();
        let mut names = vec![self.name("the name of a variable")?];
        while self.take_symbol(",") {
            names.push(self.name("the name of a variable")?);
        }
        if self.is_word("AT") {
            let span = self.span();
            self.sink
                .error(span, "AT is outside the subset: a loop's file connects ports to points");
            return Err(Slip);
        }
        self.need_symbol(":")?;
        let ty = self.type_ref()?;
        let init = self.initial()?;
        attributes.extend(self.pragmas());
        self.semicolon();
        // And behind it, on the same line.
        while let Kind::Pragma(_) = self.kind() {
            let between = self.source.get(self.before().end as usize..self.span().start as usize);
            if between.is_none_or(|text| text.contains('\n')) {
                break;
            }
            attributes.extend(self.pragmas_once());
        }
        for name in names {
            into.push(Declaration {
                name,
                ty: ty.clone(),
                init: init.clone(),
                attributes: attributes.clone(),
            });
        }
        Ok(())
    }

    /// The one pragma that stands here.
    fn pragmas_once(&mut self) -> Vec<Attribute> {
        let rest = self.tokens.split_off((self.at + 1).min(self.tokens.len()));
        self.tokens.push(Token {
            kind: Kind::End,
            span: self.span(),
        });
        let attributes = self.pragmas();
        self.tokens.pop();
        self.tokens.extend(rest);
        attributes
    }
}
