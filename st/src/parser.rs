//! From tokens to the tree of a text: the parts of a file and their declarations. Statements and expressions are below.
//!
//! Recovers at the next semicolon or keyword, so that one slip gives one diagnostic.
//! Never: recurses deeper than [`DEPTH_MAX`], whatever the text is.

mod declaration;
mod expression;
mod statement;

use crate::{
    ast::{Attribute, AttributeValue, Block, BlockKind, File, Name, Pou, PouKind, Retain},
    diagnostic::{Sink, Span},
    lexer::{Kind, Token, tokens},
};

/// Levels of nesting of expressions and statements: deeper text is not read by people either.
pub(crate) const DEPTH_MAX: u32 = 64;

/// Words that cannot be names.
const KEYWORDS: [&str; 62] = [
    "PROGRAM",
    "END_PROGRAM",
    "FUNCTION",
    "END_FUNCTION",
    "FUNCTION_BLOCK",
    "END_FUNCTION_BLOCK",
    "TYPE",
    "END_TYPE",
    "STRUCT",
    "END_STRUCT",
    "VAR",
    "VAR_INPUT",
    "VAR_OUTPUT",
    "VAR_IN_OUT",
    "VAR_TEMP",
    "VAR_EXTERNAL",
    "VAR_GLOBAL",
    "END_VAR",
    "CONSTANT",
    "RETAIN",
    "NON_RETAIN",
    "PERSISTENT",
    "ARRAY",
    "OF",
    "IF",
    "THEN",
    "ELSIF",
    "ELSE",
    "END_IF",
    "CASE",
    "END_CASE",
    "FOR",
    "TO",
    "BY",
    "DO",
    "END_FOR",
    "WHILE",
    "END_WHILE",
    "REPEAT",
    "UNTIL",
    "END_REPEAT",
    "EXIT",
    "CONTINUE",
    "RETURN",
    "AND",
    "OR",
    "XOR",
    "NOT",
    "MOD",
    "TRUE",
    "FALSE",
    "AT",
    "CONFIGURATION",
    "RESOURCE",
    "CLASS",
    "INTERFACE",
    "METHOD",
    "NAMESPACE",
    "POINTER",
    "REF_TO",
    "STRING",
    "WSTRING",
];

/// What the standard has and the subset does not, with what to do instead.
const OUTSIDE: [(&str, &str); 12] = [
    ("CONFIGURATION", "the loop's file says period, points and parameters"),
    ("RESOURCE", "the loop's file says period, points and parameters"),
    ("CLASS", "use a FUNCTION_BLOCK"),
    ("INTERFACE", "use a FUNCTION_BLOCK"),
    ("METHOD", "use a FUNCTION_BLOCK of its own"),
    ("NAMESPACE", "put everything into one file"),
    ("POINTER", "use VAR_IN_OUT"),
    ("REF_TO", "use VAR_IN_OUT"),
    ("REFERENCE", "use VAR_IN_OUT"),
    ("STRING", "a controller has numbers only"),
    ("WSTRING", "a controller has numbers only"),
    ("ACTION", "write it as a FUNCTION_BLOCK"),
];

pub(crate) struct Parser<'a> {
    source: &'a str,
    tokens: Vec<Token>,
    at: usize,
    sink: &'a mut Sink,
    depth: u32,
}

/// Reads a whole text.
pub(crate) fn parse(source: &str, sink: &mut Sink) -> File {
    let whole = Span {
        start: 0,
        end: source.len() as u32,
    };
    let tokens = tokens(source, whole, sink);
    // What is no token leaves a hole, and everything behind it would be said to be wrong.
    if !sink.is_empty() {
        return File::default();
    }
    let mut parser = Parser {
        source,
        tokens,
        at: 0,
        sink,
        depth: 0,
    };
    parser.file()
}

/// A slip that was said; whoever sees it recovers.
pub(crate) struct Slip;

type Parsed<T> = Result<T, Slip>;

impl Parser<'_> {
    fn kind(&self) -> &Kind {
        self.tokens.get(self.at).map_or(&Kind::End, |token| &token.kind)
    }

    fn ahead(&self, n: usize) -> &Kind {
        self.tokens.get(self.at + n).map_or(&Kind::End, |token| &token.kind)
    }

    fn span(&self) -> Span {
        self.tokens
            .get(self.at)
            .or(self.tokens.last())
            .map_or_else(Span::default, |token| token.span)
    }

    /// Where the token before this one stood.
    fn before(&self) -> Span {
        self.at
            .checked_sub(1)
            .and_then(|n| self.tokens.get(n))
            .map_or_else(Span::default, |token| token.span)
    }

    fn bump(&mut self) {
        if self.at + 1 < self.tokens.len() {
            self.at += 1;
        }
    }

    fn is_symbol(&self, symbol: &str) -> bool {
        matches!(self.kind(), Kind::Symbol(s) if *s == symbol)
    }

    fn is_word(&self, word: &str) -> bool {
        matches!(self.kind(), Kind::Ident(w) if w == word)
    }

    fn take_symbol(&mut self, symbol: &str) -> bool {
        let is = self.is_symbol(symbol);
        if is {
            self.bump();
        }
        is
    }

    fn take_word(&mut self, word: &str) -> bool {
        let is = self.is_word(word);
        if is {
            self.bump();
        }
        is
    }

    /// The token as a reader sees it.
    fn found(&self) -> String {
        let span = self.span();
        match self.kind() {
            Kind::End => "the end of the text".to_owned(),
            _ => {
                let text = self
                    .source
                    .get(span.start as usize..span.end as usize)
                    .unwrap_or_default();
                format!("`{}`", text.chars().take(32).collect::<String>())
            }
        }
    }

    fn expected(&mut self, what: &str) -> Slip {
        let message = match self.kind() {
            Kind::Ident(word) => match OUTSIDE.iter().find(|(outside, _)| outside == word) {
                Some((outside, cure)) => format!("{outside} is outside the subset: {cure}"),
                None => format!("{what} is expected here, not {}", self.found()),
            },
            _ => format!("{what} is expected here, not {}", self.found()),
        };
        let span = self.span();
        self.sink.error(span, message);
        Slip
    }

    fn need_symbol(&mut self, symbol: &str) -> Parsed<()> {
        if self.take_symbol(symbol) {
            Ok(())
        } else {
            Err(self.expected(&format!("`{symbol}`")))
        }
    }

    fn need_word(&mut self, word: &str) -> Parsed<()> {
        if self.take_word(word) {
            Ok(())
        } else {
            Err(self.expected(word))
        }
    }

    /// A semicolon. Where it is missing, the place behind what stands before it is named, and nothing is skipped.
    fn semicolon(&mut self) {
        if !self.take_symbol(";") {
            let end = self.before().end;
            let found = self.found();
            self.sink.error(
                Span { start: end, end },
                format!("`;` is expected here, before {found}"),
            );
        }
    }

    fn name(&mut self, what: &str) -> Parsed<Name> {
        let span = self.span();
        match self.kind() {
            Kind::Ident(word) if !KEYWORDS.contains(&word.as_str()) => {
                let upper = word.clone();
                self.bump();
                Ok(Name { upper, span })
            }
            _ => Err(self.expected(what)),
        }
    }

    /// One level deeper; fails where that is too deep.
    fn deeper<T>(&mut self, read: impl FnOnce(&mut Self) -> Parsed<T>) -> Parsed<T> {
        if self.depth >= DEPTH_MAX {
            let span = self.span();
            self.sink.error(
                span,
                format!("nested deeper than {DEPTH_MAX} levels: take parts out into functions"),
            );
            return Err(Slip);
        }
        self.depth += 1;
        let done = read(self);
        self.depth -= 1;
        done
    }

    fn at_end(&self) -> bool {
        matches!(self.kind(), Kind::End)
    }

    /// Goes on behind the next semicolon, or before one of the words.
    fn recover(&mut self, words: &[&str]) {
        while !self.at_end() {
            if self.take_symbol(";") || matches!(self.kind(), Kind::Ident(word) if words.contains(&word.as_str())) {
                return;
            }
            self.bump();
        }
    }

    fn file(&mut self) -> File {
        let mut file = File::default();
        while !self.at_end() {
            let before = self.at;
            let attributes = self.pragmas();
            let done = match self.kind() {
                Kind::Ident(word) => match word.as_str() {
                    "TYPE" => self.types(&mut file.types),
                    "VAR_GLOBAL" => self.block(BlockKind::Global).map(|block| file.globals.push(block)),
                    "PROGRAM" => self.pou(PouKind::Program, attributes).map(|pou| file.pous.push(pou)),
                    "FUNCTION" => self.pou(PouKind::Function, attributes).map(|pou| file.pous.push(pou)),
                    "FUNCTION_BLOCK" => self
                        .pou(PouKind::FunctionBlock, attributes)
                        .map(|pou| file.pous.push(pou)),
                    _ => Err(self.expected("PROGRAM, FUNCTION_BLOCK, FUNCTION, TYPE or VAR_GLOBAL CONSTANT")),
                },
                Kind::End => Ok(()),
                Kind::Symbol(";") => {
                    self.bump();
                    Ok(())
                }
                _ => Err(self.expected("PROGRAM, FUNCTION_BLOCK, FUNCTION, TYPE or VAR_GLOBAL CONSTANT")),
            };
            if done.is_err() {
                // What stands before the next part is what was not understood.
                if self.at == before {
                    self.bump();
                }
                while !self.at_end()
                    && !matches!(self.kind(), Kind::Ident(word)
                        if ["TYPE", "VAR_GLOBAL", "PROGRAM", "FUNCTION", "FUNCTION_BLOCK"].contains(&word.as_str()))
                {
                    self.bump();
                }
            }
        }
        file
    }

    /// What stands in braces here. Pragmas of other tools have another form, and are passed over.
    fn pragmas(&mut self) -> Vec<Attribute> {
        let mut attributes = Vec::new();
        while let Kind::Pragma(inner) = *self.kind() {
            self.bump();
            // Of a text in a language of another tool nothing is said.
            let mut quiet = Sink::default();
            let tokens = tokens(self.source, inner, &mut quiet);
            let ours = matches!(
                tokens.as_slice(),
                [
                    Token {
                        kind: Kind::Ident(_),
                        ..
                    },
                    Token {
                        kind: Kind::Symbol(":="),
                        ..
                    },
                    ..
                ]
            );
            if !ours {
                continue;
            }
            let mut parser = Parser {
                source: self.source,
                tokens,
                at: 0,
                sink: self.sink,
                depth: self.depth,
            };
            while let Ok(attribute) = parser.attribute() {
                attributes.push(attribute);
                if !(parser.take_symbol(",") || parser.take_symbol(";")) {
                    if !parser.at_end() {
                        parser.expected("`,`");
                    }
                    break;
                }
            }
        }
        attributes
    }

    fn attribute(&mut self) -> Parsed<Attribute> {
        let key = self.name("the name of an attribute")?;
        self.need_symbol(":=")?;
        let value = match self.kind().clone() {
            Kind::Text(text) => {
                self.bump();
                AttributeValue::Text(text)
            }
            _ => AttributeValue::Expr(self.expression()?),
        };
        let span = key.span.to(self.before());
        Ok(Attribute { key, value, span })
    }

    fn block(&mut self, kind: BlockKind) -> Parsed<Block> {
        let span = self.span();
        self.bump();
        let (mut constant, mut retain) = (false, Retain::Usual);
        loop {
            if self.take_word("CONSTANT") {
                constant = true;
            } else if self.take_word("RETAIN") || self.take_word("PERSISTENT") {
                retain = Retain::Always;
            } else if self.take_word("NON_RETAIN") {
                retain = Retain::Never;
            } else {
                break;
            }
        }
        let mut declarations = Vec::new();
        while !self.take_word("END_VAR") {
            let ended = matches!(self.kind(), Kind::Ident(w) if w.starts_with("END_") || w.starts_with("VAR"));
            if self.at_end() || ended {
                return Err(self.expected("END_VAR"));
            }
            if self.declarations(&mut declarations).is_err() {
                self.recover(&["END_VAR", "END_PROGRAM", "END_FUNCTION", "END_FUNCTION_BLOCK"]);
            }
        }
        Ok(Block {
            kind,
            constant,
            retain,
            declarations,
            span,
        })
    }

    fn pou(&mut self, kind: PouKind, mut attributes: Vec<Attribute>) -> Parsed<Pou> {
        self.bump();
        let end = match kind {
            PouKind::Function => "END_FUNCTION",
            PouKind::FunctionBlock => "END_FUNCTION_BLOCK",
            PouKind::Program => "END_PROGRAM",
        };
        let name = self.name("a name")?;
        let result = if self.take_symbol(":") {
            Some(self.type_ref()?)
        } else {
            None
        };
        attributes.extend(self.pragmas());
        self.take_symbol(";");
        let mut blocks = Vec::new();
        loop {
            let kind = match self.kind() {
                Kind::Ident(word) => match word.as_str() {
                    "VAR" => BlockKind::Var,
                    "VAR_INPUT" => BlockKind::Input,
                    "VAR_OUTPUT" => BlockKind::Output,
                    "VAR_IN_OUT" => BlockKind::InOut,
                    "VAR_TEMP" => BlockKind::Temp,
                    "VAR_EXTERNAL" => BlockKind::External,
                    "VAR_GLOBAL" => BlockKind::Global,
                    _ => break,
                },
                // One that stands before a block means nothing here.
                Kind::Pragma(_) => {
                    self.pragmas();
                    continue;
                }
                _ => break,
            };
            let block = self.block(kind);
            match block {
                Ok(block) => blocks.push(block),
                Err(Slip) => {
                    if self.is_word(end) || self.at_end() {
                        break;
                    }
                    self.recover(&["END_VAR", end]);
                    self.take_word("END_VAR");
                }
            }
        }
        let body = self.statements(&[end]);
        if !self.take_word(end) {
            self.expected(end);
        }
        Ok(Pou {
            kind,
            name,
            result,
            attributes,
            blocks,
            body,
        })
    }
}
