//! Statements, with a slip in one keeping the others readable.
//!
//! Never: skips a word that closes something that is open.

use super::{Parsed, Parser, Slip};
use crate::{
    ast::{ExprKind, Label, Stmt, StmtKind},
    lexer::Kind,
};

/// Words at which a statement that was not understood has ended at the latest.
const ENDS: [&str; 17] = [
    "END_IF",
    "ELSIF",
    "ELSE",
    "END_CASE",
    "END_FOR",
    "END_WHILE",
    "UNTIL",
    "END_REPEAT",
    "END_PROGRAM",
    "END_FUNCTION",
    "END_FUNCTION_BLOCK",
    "IF",
    "CASE",
    "FOR",
    "WHILE",
    "REPEAT",
    "RETURN",
];

impl Parser<'_> {
    /// Statements up to one of the words, or to a word that closes something outside.
    pub(super) fn statements(&mut self, ends: &[&str]) -> Vec<Stmt> {
        self.statements_until(|parser| match parser.kind() {
            Kind::End => true,
            Kind::Ident(word) => {
                ends.contains(&word.as_str())
                    || word.starts_with("END_")
                    || matches!(
                        word.as_str(),
                        "ELSIF" | "ELSE" | "UNTIL" | "PROGRAM" | "FUNCTION" | "FUNCTION_BLOCK" | "TYPE"
                    )
            }
            _ => false,
        })
    }

    /// Case elements end where the next label begins.
    fn case_statements(&mut self) -> Vec<Stmt> {
        self.statements_until(|parser| match parser.kind() {
            Kind::End | Kind::Int(_) | Kind::Prefix(_) | Kind::Symbol("-") => true,
            Kind::Ident(word) => {
                word.starts_with("END_")
                    || matches!(word.as_str(), "ELSE" | "ELSIF" | "UNTIL")
                    || matches!(parser.ahead(1), Kind::Symbol(":" | "," | ".."))
            }
            _ => false,
        })
    }

    /// Statements up to where a list of them closes; what is none is told, and passed over.
    fn statements_until(&mut self, closes: impl Fn(&Self) -> bool) -> Vec<Stmt> {
        let mut statements = Vec::new();
        while !closes(self) {
            if self.take_symbol(";") || matches!(self.kind(), Kind::Pragma(_)) && !self.pragmas().is_empty() {
                continue;
            }
            let before = self.at;
            match self.deeper(Self::statement) {
                Ok(statement) => statements.push(statement),
                Err(Slip) => {
                    if self.at == before {
                        self.bump();
                    }
                    self.recover(&ENDS);
                }
            }
        }
        statements
    }

    fn statement(&mut self) -> Parsed<Stmt> {
        let start = self.span();
        let word = match self.kind() {
            Kind::Ident(word) => word.clone(),
            _ => String::new(),
        };
        let kind = match word.as_str() {
            "IF" => self.if_statement()?,
            "CASE" => self.case_statement()?,
            "FOR" => self.for_statement()?,
            "WHILE" => {
                self.bump();
                let condition = self.expression()?;
                self.need_word("DO")?;
                let body = self.statements(&["END_WHILE"]);
                self.need_word("END_WHILE")?;
                StmtKind::While(condition, body)
            }
            "REPEAT" => {
                self.bump();
                let body = self.statements(&["UNTIL"]);
                self.need_word("UNTIL")?;
                let condition = self.expression()?;
                self.take_symbol(";");
                self.need_word("END_REPEAT")?;
                StmtKind::Repeat(body, condition)
            }
            "EXIT" => {
                self.bump();
                StmtKind::Exit
            }
            "CONTINUE" => {
                self.bump();
                StmtKind::Continue
            }
            "RETURN" => {
                self.bump();
                StmtKind::Return
            }
            _ => {
                let left = self.expression()?;
                if self.take_symbol(":=") {
                    StmtKind::Assign(left, self.expression()?)
                } else if matches!(left.kind, ExprKind::Call(..)) {
                    StmtKind::Call(left)
                } else if self.is_symbol("=") {
                    return Err(self.expected("`:=`"));
                } else if matches!(left.kind, ExprKind::Binary(crate::ast::Binary::Eq, ..)) {
                    self.sink.error(
                        start,
                        "this compares and does nothing with the answer: an assignment is written `:=`",
                    );
                    return Err(Slip);
                } else {
                    return Err(self.expected("`:=` or a call"));
                }
            }
        };
        let span = start.to(self.before());
        self.semicolon();
        Ok(Stmt { kind, span })
    }

    fn if_statement(&mut self) -> Parsed<StmtKind> {
        let mut branches = Vec::new();
        loop {
            self.bump();
            let condition = self.expression()?;
            self.need_word("THEN")?;
            branches.push((condition, self.statements(&["ELSIF", "ELSE", "END_IF"])));
            if !self.is_word("ELSIF") {
                break;
            }
        }
        let otherwise = if self.take_word("ELSE") {
            self.statements(&["END_IF"])
        } else {
            Vec::new()
        };
        self.need_word("END_IF")?;
        Ok(StmtKind::If(branches, otherwise))
    }

    fn case_statement(&mut self) -> Parsed<StmtKind> {
        self.bump();
        let selector = self.expression()?;
        self.need_word("OF")?;
        let mut cases = Vec::new();
        while !self.at_end() && !self.is_word("ELSE") && !self.is_word("END_CASE") {
            let mut labels = Vec::new();
            loop {
                let from = self.expression()?;
                let to = if self.take_symbol("..") {
                    Some(self.expression()?)
                } else {
                    None
                };
                labels.push(Label { from, to });
                if !self.take_symbol(",") {
                    break;
                }
            }
            self.need_symbol(":")?;
            cases.push((labels, self.case_statements()));
        }
        let otherwise = if self.take_word("ELSE") {
            self.statements(&["END_CASE"])
        } else {
            Vec::new()
        };
        self.need_word("END_CASE")?;
        Ok(StmtKind::Case(selector, cases, otherwise))
    }

    fn for_statement(&mut self) -> Parsed<StmtKind> {
        self.bump();
        let variable = self.name("the name of a variable")?;
        self.need_symbol(":=")?;
        let from = self.expression()?;
        self.need_word("TO")?;
        let to = self.expression()?;
        let by = if self.take_word("BY") {
            Some(self.expression()?)
        } else {
            None
        };
        self.need_word("DO")?;
        let body = self.statements(&["END_FOR"]);
        self.need_word("END_FOR")?;
        Ok(StmtKind::For {
            variable,
            from,
            to,
            by,
            body,
        })
    }
}
