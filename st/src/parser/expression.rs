//! Expressions: precedence by climbing, then what stands behind a name.
//!
//! Never: types; `2 + TRUE` is read here and refused in `check`.

use super::{DEPTH_MAX, KEYWORDS, Parsed, Parser, Slip};
use crate::{
    ast::{Argument, Binary, Expr, ExprKind, Name, Unary},
    diagnostic::Span,
    lexer::Kind,
};

impl Parser<'_> {
    pub(super) fn expression(&mut self) -> Parsed<Expr> {
        self.deeper(|parser| parser.climb(0))
    }

    /// A node over others; too deep ones are refused.
    fn node(&mut self, kind: ExprKind, span: Span, below: u32) -> Parsed<Expr> {
        let depth = below + 1;
        if depth > DEPTH_MAX * 4 {
            self.sink.error(
                span,
                format!(
                    "this expression has more than {} operations in a row: split it",
                    DEPTH_MAX * 4
                ),
            );
            return Err(Slip);
        }
        Ok(Expr { kind, span, depth })
    }

    fn operator(&self) -> Option<(Binary, u8)> {
        let found = match self.kind() {
            Kind::Symbol(symbol) => match *symbol {
                "&" => (Binary::And, 3),
                "=" => (Binary::Eq, 4),
                "<>" => (Binary::Ne, 4),
                "<" => (Binary::Lt, 5),
                "<=" => (Binary::Le, 5),
                ">" => (Binary::Gt, 5),
                ">=" => (Binary::Ge, 5),
                "+" => (Binary::Add, 6),
                "-" => (Binary::Sub, 6),
                "*" => (Binary::Mul, 7),
                "/" => (Binary::Div, 7),
                "**" => (Binary::Power, 8),
                _ => return None,
            },
            Kind::Ident(word) => match word.as_str() {
                "OR" => (Binary::Or, 1),
                "XOR" => (Binary::Xor, 2),
                "AND" => (Binary::And, 3),
                "MOD" => (Binary::Mod, 7),
                _ => return None,
            },
            _ => return None,
        };
        Some(found)
    }

    /// Operators that bind tighter than `above`.
    fn climb(&mut self, above: u8) -> Parsed<Expr> {
        let mut left = self.unary()?;
        while let Some((operator, binds)) = self.operator() {
            if binds <= above {
                break;
            }
            self.bump();
            let right = self.deeper(|parser| parser.climb(binds))?;
            let (span, below) = (left.span.to(right.span), left.depth.max(right.depth));
            left = self.node(ExprKind::Binary(operator, Box::new(left), Box::new(right)), span, below)?;
        }
        Ok(left)
    }

    fn unary(&mut self) -> Parsed<Expr> {
        let start = self.span();
        let operator = if self.take_symbol("-") {
            Unary::Minus
        } else if self.take_word("NOT") {
            Unary::Not
        } else if self.take_symbol("+") {
            return self.deeper(Self::unary);
        } else {
            return self.postfix();
        };
        let operand = self.deeper(Self::unary)?;
        let (span, below) = (start.to(operand.span), operand.depth);
        self.node(ExprKind::Unary(operator, Box::new(operand)), span, below)
    }

    fn postfix(&mut self) -> Parsed<Expr> {
        let mut expr = self.primary()?;
        loop {
            if self.take_symbol(".") {
                let name = self.name("the name of a field")?;
                let (span, below) = (expr.span.to(name.span), expr.depth);
                expr = self.node(ExprKind::Field(Box::new(expr), name), span, below)?;
            } else if self.take_symbol("[") {
                let mut indices = vec![self.expression()?];
                while self.take_symbol(",") {
                    indices.push(self.expression()?);
                }
                self.need_symbol("]")?;
                let below = indices.iter().map(|i| i.depth).max().unwrap_or(0).max(expr.depth);
                let span = expr.span.to(self.before());
                expr = self.node(ExprKind::Index(Box::new(expr), indices), span, below)?;
            } else if self.is_symbol("(")
                && matches!(expr.kind, ExprKind::Name(_) | ExprKind::Field(..) | ExprKind::Index(..))
            {
                self.bump();
                let arguments = self.arguments()?;
                let below = arguments
                    .iter()
                    .map(|a| a.value.depth)
                    .max()
                    .unwrap_or(0)
                    .max(expr.depth);
                let span = expr.span.to(self.before());
                expr = self.node(ExprKind::Call(Box::new(expr), arguments), span, below)?;
            } else {
                return Ok(expr);
            }
        }
    }

    /// Behind the opening parenthesis.
    fn arguments(&mut self) -> Parsed<Vec<Argument>> {
        let mut arguments = Vec::new();
        if self.take_symbol(")") {
            return Ok(arguments);
        }
        loop {
            let named = matches!(self.kind(), Kind::Ident(_)) && matches!(self.ahead(1), Kind::Symbol(":=" | "=>"));
            let (name, output) = if named {
                let name = self.name("the name of an argument")?;
                let output = self.is_symbol("=>");
                self.bump();
                (Some(name), output)
            } else {
                (None, false)
            };
            let value = self.expression()?;
            arguments.push(Argument { name, output, value });
            if !self.take_symbol(",") {
                break;
            }
        }
        self.need_symbol(")")?;
        Ok(arguments)
    }

    fn primary(&mut self) -> Parsed<Expr> {
        let span = self.span();
        let leaf = |kind| Expr { kind, span, depth: 1 };
        let expr = match self.kind().clone() {
            Kind::Int(value) => leaf(ExprKind::Int(value)),
            Kind::Real(value) => leaf(ExprKind::Real(value)),
            Kind::Time(value) => leaf(ExprKind::Time(value)),
            Kind::Prefix(upper) => {
                self.bump();
                let name = Name { upper, span };
                // `INT#-5`: the sign belongs to the literal.
                let value = if matches!(self.kind(), Kind::Symbol("-" | "+")) {
                    self.unary()?
                } else {
                    self.primary_simple()?
                };
                let whole = span.to(value.span);
                let below = value.depth;
                return self.node(ExprKind::Typed(name, Box::new(value)), whole, below);
            }
            Kind::Ident(word) if word == "TRUE" => leaf(ExprKind::Bool(true)),
            Kind::Ident(word) if word == "FALSE" => leaf(ExprKind::Bool(false)),
            Kind::Ident(word) if !KEYWORDS.contains(&word.as_str()) => leaf(ExprKind::Name(Name { upper: word, span })),
            Kind::Symbol("(") => {
                self.bump();
                let mut inner = self.expression()?;
                self.need_symbol(")")?;
                inner.span = span.to(self.before());
                return Ok(inner);
            }
            Kind::Text(_) => {
                self.sink
                    .error(span, "texts are outside the subset: a controller has numbers only");
                return Err(Slip);
            }
            _ => return Err(self.expected("a value")),
        };
        self.bump();
        Ok(expr)
    }

    /// A literal or a name behind `TYPE#`.
    fn primary_simple(&mut self) -> Parsed<Expr> {
        match self.kind() {
            Kind::Int(_) | Kind::Real(_) | Kind::Ident(_) => self.primary(),
            _ => Err(self.expected("a literal")),
        }
    }
}
