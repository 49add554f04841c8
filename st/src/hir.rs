//! A checked program: every name is a place, every operation has one type, every conversion is written out.
//!
//! Never: anything that could still be wrong.

use crate::types::{Scalar, Ty};

/// A value of an elementary type. Whole types hold their value, ULINT and LWORD its 64 bits.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Value {
    Whole(i64),
    Real(f32),
    Lreal(f64),
}

/// What the host says of a cycle.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum External {
    /// LREAL.
    Setpoint,
    /// BOOL: the controller decides.
    Automatic,
    /// BOOL: the outputs hold what the actuators hold, and the law must go on from there.
    Track,
    /// BOOL: the first cycle since `start`.
    First,
    /// TIME since the cycle before.
    Dt,
    /// ULINT.
    Cycle,
    /// TIME that all cycles of this state took together; for timers only.
    Clock,
}

/// Where a place begins.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Base {
    /// The instance that is called: the first parameter of the function.
    Own,
    /// The frame of a POU, by its number: the memory of a call.
    Frame(usize),
    /// What a VAR_IN_OUT names: a parameter of the function, by number.
    InOut(u32),
}

/// A variable, or a part of one.
#[derive(Debug, Clone)]
pub(crate) struct Place {
    pub(crate) base: Base,
    pub(crate) offset: u32,
    pub(crate) indices: Vec<Index>,
    pub(crate) ty: Ty,
}

/// An index that is known in the cycle only.
#[derive(Debug, Clone)]
pub(crate) struct Index {
    /// LINT.
    pub(crate) value: Expr,
    pub(crate) low: i64,
    pub(crate) count: u32,
    pub(crate) stride: u32,
    /// The fault where it lies outside.
    pub(crate) site: u32,
}

#[derive(Debug, Clone)]
pub(crate) struct Expr {
    pub(crate) kind: Kind,
    pub(crate) ty: Ty,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Op {
    Add,
    Sub,
    Mul,
    /// With the fault where the divisor is 0.
    Div(u32),
    Mod(u32),
    And,
    Or,
    Xor,
    Eq,
    Ne,
    Lt,
    Le,
    Gt,
    Ge,
    Min,
    Max,
    Shl,
    Shr,
    Rol,
    Ror,
}

impl Op {
    pub(crate) const fn compares(self) -> bool {
        matches!(self, Self::Eq | Self::Ne | Self::Lt | Self::Le | Self::Gt | Self::Ge)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum One {
    Negate,
    Not,
    Abs,
    Sqrt,
    Floor,
    /// Toward zero.
    Trunc,
    /// To the nearest, halves to the even one.
    Nearest,
    /// LREAL to its bits as LWORD.
    Bits,
    /// LWORD as the bits of an LREAL.
    OfBits,
}

#[derive(Debug, Clone)]
pub(crate) enum Kind {
    Value(Value),
    Load(Place),
    /// The number of a parameter of the component.
    Parameter(u32),
    External(External),
    One(One, Box<Expr>),
    /// Both operands have the type that is named; the answer has it too, or BOOL.
    Two(Op, Scalar, Box<Expr>, Box<Expr>),
    /// To another elementary type: whole to whole keeps the low bits, real to whole rounds and stays in range.
    Convert(Box<Expr>, Scalar, Scalar),
    /// BOOL, then the value where it is false, then where it is true. All are worked out.
    Select(Box<Expr>, Box<Expr>, Box<Expr>),
    /// A function of the text, with one argument per input in order.
    Call(usize, Vec<Argument>),
}

#[derive(Debug, Clone)]
pub(crate) enum Argument {
    Value(Expr),
    /// The address of a place: VAR_IN_OUT, and inputs that are structures or arrays.
    Address(Place),
}

/// Of a CASE: ranges of labels, and what is done for them.
pub(crate) type Branch = (Vec<(i64, i64)>, Vec<Stmt>);

#[derive(Debug, Clone)]
pub(crate) enum Stmt {
    /// What follows stands here in the text, in bytes.
    At(u32),
    Assign(Place, Expr),
    /// Structures and arrays: so many bytes.
    Copy(Place, Place, u32),
    /// A call of an instance: inputs, references, outputs.
    Invoke {
        block: usize,
        instance: Place,
        /// Offset within the instance, its type, the value.
        inputs: Vec<(u32, Input)>,
        references: Vec<Place>,
        /// Target, then the place in the instance and the conversion.
        outputs: Vec<Output>,
    },
    /// A call of a function whose answer nobody takes, or whose outputs somebody takes.
    Call(Expr, Vec<(Place, Expr)>),
    If(Vec<(Expr, Vec<Stmt>)>, Vec<Stmt>),
    /// Selector (LINT), ranges of labels.
    Case(Expr, Vec<Branch>, Vec<Stmt>),
    /// Variable, first, last and step, all LINT; by how much is known to go up, down, or only in the cycle.
    For {
        variable: Place,
        scalar: Scalar,
        from: Expr,
        to: Expr,
        by: Expr,
        body: Vec<Stmt>,
    },
    While(Expr, Vec<Stmt>),
    Repeat(Vec<Stmt>, Expr),
    Exit,
    Continue,
    Return,
}

#[derive(Debug, Clone)]
pub(crate) enum Input {
    Value(Expr),
    Copy(Place, u32),
}

/// An output that is taken from an instance behind a call.
#[derive(Debug, Clone)]
pub(crate) struct Output {
    pub(crate) target: Place,
    pub(crate) offset: u32,
    pub(crate) from: Ty,
    /// In bytes where it is no elementary type.
    pub(crate) size: u32,
    /// What becomes of an elementary value on its way.
    pub(crate) convert: Option<(Scalar, Scalar)>,
}

/// A parameter of a function, in the order of its declaration.
#[derive(Debug, Clone)]
pub(crate) struct Parameter {
    pub(crate) name: String,
    pub(crate) ty: Ty,
    /// VAR_IN_OUT: its address is given.
    pub(crate) reference: bool,
    /// In the frame; of inputs only.
    pub(crate) offset: u32,
    /// The value where the caller gives none; none where it must.
    pub(crate) default: Option<Value>,
}

/// Code of a POU that is reached.
#[derive(Debug, Clone, Default)]
pub(crate) struct Body {
    pub(crate) statements: Vec<Stmt>,
    /// POUs that it calls, by number.
    pub(crate) calls: Vec<usize>,
}
