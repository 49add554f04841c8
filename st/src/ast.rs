//! What a text says, as it stands there: declarations, statements, expressions, each with its place.
//!
//! Never: a type that was looked up, or a value that was worked out; `check` does both.

use crate::diagnostic::Span;

#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Name {
    /// In upper case: names have no case.
    pub(crate) upper: String,
    pub(crate) span: Span,
}

#[derive(Debug, Clone)]
pub(crate) struct Expr {
    pub(crate) kind: ExprKind,
    pub(crate) span: Span,
    /// Levels of nesting, so that nobody recurses without end.
    pub(crate) depth: u32,
}

#[derive(Debug, Clone)]
pub(crate) enum ExprKind {
    Int(i128),
    Real(f64),
    Bool(bool),
    Time(i64),
    /// `INT#5`, `COLOR#RED`.
    Typed(Name, Box<Expr>),
    Name(Name),
    Field(Box<Expr>, Name),
    Index(Box<Expr>, Vec<Expr>),
    Call(Box<Expr>, Vec<Argument>),
    Unary(Unary, Box<Expr>),
    Binary(Binary, Box<Expr>, Box<Expr>),
    /// What could not be read; said already.
    Wrong,
}

#[derive(Debug, Clone)]
pub(crate) struct Argument {
    pub(crate) name: Option<Name>,
    /// `name => variable`.
    pub(crate) output: bool,
    pub(crate) value: Expr,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Unary {
    Minus,
    Not,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Binary {
    Or,
    Xor,
    And,
    Eq,
    Ne,
    Lt,
    Le,
    Gt,
    Ge,
    Add,
    Sub,
    Mul,
    Div,
    Mod,
    Power,
}

impl Binary {
    /// As it is written.
    pub(crate) const fn text(self) -> &'static str {
        match self {
            Self::Or => "OR",
            Self::Xor => "XOR",
            Self::And => "AND",
            Self::Eq => "=",
            Self::Ne => "<>",
            Self::Lt => "<",
            Self::Le => "<=",
            Self::Gt => ">",
            Self::Ge => ">=",
            Self::Add => "+",
            Self::Sub => "-",
            Self::Mul => "*",
            Self::Div => "/",
            Self::Mod => "MOD",
            Self::Power => "**",
        }
    }

    pub(crate) const fn compares(self) -> bool {
        matches!(self, Self::Eq | Self::Ne | Self::Lt | Self::Le | Self::Gt | Self::Ge)
    }
}

#[derive(Debug, Clone)]
pub(crate) struct Stmt {
    pub(crate) kind: StmtKind,
    pub(crate) span: Span,
}

#[derive(Debug, Clone)]
pub(crate) enum StmtKind {
    Assign(Expr, Expr),
    Call(Expr),
    If(Vec<(Expr, Vec<Stmt>)>, Vec<Stmt>),
    Case(Expr, Vec<(Vec<Label>, Vec<Stmt>)>, Vec<Stmt>),
    For {
        variable: Name,
        from: Expr,
        to: Expr,
        by: Option<Expr>,
        body: Vec<Stmt>,
    },
    While(Expr, Vec<Stmt>),
    Repeat(Vec<Stmt>, Expr),
    Exit,
    Continue,
    Return,
}

#[derive(Debug, Clone)]
pub(crate) struct Label {
    pub(crate) from: Expr,
    pub(crate) to: Option<Expr>,
}

#[derive(Debug, Clone)]
pub(crate) struct TypeRef {
    pub(crate) kind: TypeKind,
    pub(crate) span: Span,
}

#[derive(Debug, Clone)]
pub(crate) enum TypeKind {
    Named(Name),
    Array(Vec<(Expr, Expr)>, Box<TypeRef>),
    Struct(Vec<Declaration>),
    Enum(Vec<(Name, Option<Expr>)>),
}

#[derive(Debug, Clone)]
pub(crate) struct Init {
    pub(crate) kind: InitKind,
    pub(crate) span: Span,
}

#[derive(Debug, Clone)]
pub(crate) enum InitKind {
    Expr(Expr),
    /// `[1, 2, 3(0)]`: a count and what is repeated.
    Array(Vec<(Option<Expr>, Init)>),
    Struct(Vec<(Name, Init)>),
}

/// One `key := value` of a pragma.
#[derive(Debug, Clone)]
pub(crate) struct Attribute {
    pub(crate) key: Name,
    pub(crate) value: AttributeValue,
    pub(crate) span: Span,
}

#[derive(Debug, Clone)]
pub(crate) enum AttributeValue {
    Text(String),
    Expr(Expr),
}

#[derive(Debug, Clone)]
pub(crate) struct Declaration {
    pub(crate) name: Name,
    pub(crate) ty: TypeRef,
    pub(crate) init: Option<Init>,
    pub(crate) attributes: Vec<Attribute>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum BlockKind {
    Var,
    Input,
    Output,
    InOut,
    Temp,
    External,
    Global,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Retain {
    Usual,
    /// RETAIN.
    Always,
    /// NON_RETAIN.
    Never,
}

#[derive(Debug, Clone)]
pub(crate) struct Block {
    pub(crate) kind: BlockKind,
    pub(crate) constant: bool,
    pub(crate) retain: Retain,
    pub(crate) declarations: Vec<Declaration>,
    pub(crate) span: Span,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum PouKind {
    Function,
    FunctionBlock,
    Program,
}

#[derive(Debug, Clone)]
pub(crate) struct Pou {
    pub(crate) kind: PouKind,
    pub(crate) name: Name,
    pub(crate) result: Option<TypeRef>,
    pub(crate) attributes: Vec<Attribute>,
    pub(crate) blocks: Vec<Block>,
    pub(crate) body: Vec<Stmt>,
}

#[derive(Debug, Clone)]
pub(crate) struct TypeDeclaration {
    pub(crate) name: Name,
    pub(crate) ty: TypeRef,
    pub(crate) init: Option<Init>,
}

/// A whole text.
#[derive(Debug, Clone, Default)]
pub(crate) struct File {
    pub(crate) types: Vec<TypeDeclaration>,
    pub(crate) globals: Vec<Block>,
    pub(crate) pous: Vec<Pou>,
}
