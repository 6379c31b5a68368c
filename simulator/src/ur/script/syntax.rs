//! The tree of a program: what the parser makes of the text, and what the compiler reads.
//!
//! Pure; the parser allocates it. An expression of too many levels is refused when it is built, so that no source can exhaust
//! the stack.

use super::ScriptError;

/// Most levels of one expression's tree; a chain `a + a + a` has as many levels as terms. Chosen by hand, above what real
/// programs have and below what the stack holds.
const MAX_HEIGHT: u16 = 200;

/// One uploaded program.
#[derive(Debug, Clone, PartialEq)]
pub struct ProgramTree {
    /// The name after `def`, or "unnamed" for bare statements.
    pub name: String,
    /// True for `sec`: such a program runs beside the running program, within one cycle.
    pub secondary: bool,
    /// The program's statements.
    pub body: Vec<Statement>,
}

/// A statement and its line, from 1.
#[derive(Debug, Clone, PartialEq)]
pub struct Statement {
    pub line: u32,
    pub kind: StatementKind,
}

/// Where the variable of an assignment lives.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scope {
    /// The assignment says `global x = ...`.
    Global,
    /// The assignment says `local x = ...`.
    Local,
    /// There is no word before the name.
    Free,
}

/// What a statement does.
#[derive(Debug, Clone, PartialEq)]
pub enum StatementKind {
    Assign { scope: Scope, name: String, index: Option<Expr>, value: Expr },
    Expr(Expr),
    If { branches: Vec<(Expr, Vec<Statement>)>, otherwise: Vec<Statement> },
    While { condition: Expr, body: Vec<Statement> },
    Return(Expr),
    Break,
    Continue,
    Halt,
    Pause,
    Function(Function),
    Join(Expr),
    Kill(Expr),
}

/// A `def` or `thread` inside a program.
#[derive(Debug, Clone, PartialEq)]
pub struct Function {
    pub name: String,
    /// The parameters' names and default values.
    pub parameters: Vec<(String, Option<Expr>)>,
    pub body: Vec<Statement>,
    /// True for a `thread`, which is started with `run`.
    pub thread: bool,
}

/// An expression and its line, from 1.
#[derive(Debug, Clone, PartialEq)]
pub struct Expr {
    pub line: u32,
    /// Levels of the tree from this expression down, at most [`MAX_HEIGHT`].
    height: u16,
    pub kind: ExprKind,
}

impl Expr {
    /// Builds an expression.
    ///
    /// # Errors
    /// The tree would have more levels than are allowed.
    pub fn new(line: u32, kind: ExprKind) -> Result<Self, ScriptError> {
        let of_all = |arguments: &[Argument]| arguments.iter().map(|a| a.1.height).max().unwrap_or(0);
        let below = match &kind {
            ExprKind::List(items) | ExprKind::Pose(items) => items.iter().map(|i| i.height).max().unwrap_or(0),
            ExprKind::Call(_, arguments) | ExprKind::Run(_, arguments) => of_all(arguments),
            ExprKind::Not(a) | ExprKind::Negative(a) => a.height,
            ExprKind::Index(a, b) | ExprKind::Binary(_, a, b) | ExprKind::And(a, b) | ExprKind::Or(a, b) => a.height.max(b.height),
            _ => 0,
        };
        if below >= MAX_HEIGHT { Err(ScriptError::new(line, "expression too long")) } else { Ok(Self { line, height: below + 1, kind }) }
    }
}

/// What an expression is made of.
#[derive(Debug, Clone, PartialEq)]
pub enum ExprKind {
    None,
    Bool(bool),
    Int(i32),
    Float(f64),
    Str(String),
    List(Vec<Expr>),
    Pose(Vec<Expr>),
    Name(String),
    Index(Box<Expr>, Box<Expr>),
    Call(String, Vec<Argument>),
    Run(String, Vec<Argument>),
    Not(Box<Expr>),
    Negative(Box<Expr>),
    Binary(Operator, Box<Expr>, Box<Expr>),
    And(Box<Expr>, Box<Expr>),
    Or(Box<Expr>, Box<Expr>),
}

/// An argument of a call, with its name if one was written.
pub type Argument = (Option<String>, Expr);

/// An operator that needs both its operands; `and` and `or` may need only the first.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Operator {
    Add,
    Subtract,
    Multiply,
    Divide,
    Modulo,
    Equal,
    NotEqual,
    Less,
    LessEqual,
    Greater,
    GreaterEqual,
    Xor,
}
