//! URScript's grammar: tokens in, a tree out. Pure; recursive descent with a bounded depth, so that no source can exhaust the
//! stack.

use super::ScriptError;
use super::lex::{Token, lex};

/// Longest program that is accepted, bytes (ur_rtde's is 42 kB).
pub const MAX_SOURCE_BYTES: usize = 1 << 20;
/// Deepest nesting of blocks and expressions.
const MAX_DEPTH: u32 = 64;
/// Most levels of one expression's tree; a chain `a + a + a` has as many levels as terms.
const MAX_HEIGHT: u16 = 200;

/// One uploaded program.
#[derive(Debug, Clone, PartialEq)]
pub struct Unit {
    /// The program's name: that of its `def`, or "unnamed" for bare statements.
    pub name: String,
    /// True for `sec`: runs beside the running program, within one cycle.
    pub secondary: bool,
    /// The program's statements.
    pub body: Vec<Statement>,
}

/// A statement and its line.
#[derive(Debug, Clone, PartialEq)]
pub struct Statement {
    pub line: u32,
    pub kind: StatementKind,
}

/// Where a name is to live.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scope {
    /// `global x = ...`
    Global,
    /// `local x = ...`
    Local,
    /// No word before it.
    Free,
}

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
    /// Names and default values.
    pub parameters: Vec<(String, Option<Expr>)>,
    pub body: Vec<Statement>,
    /// True for `thread`.
    pub thread: bool,
}

/// An expression and its line.
#[derive(Debug, Clone, PartialEq)]
pub struct Expr {
    pub line: u32,
    /// Levels of the tree below and with this one, at most [`MAX_HEIGHT`].
    height: u16,
    pub kind: ExprKind,
}

impl Expr {
    fn new(line: u32, kind: ExprKind) -> Result<Self, ScriptError> {
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

/// An argument, with its name if one was written.
pub type Argument = (Option<String>, Expr);

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

/// Reads one uploaded program: a `def` or `sec` with its `end`, or bare statements.
pub fn parse(source: &str) -> Result<Unit, ScriptError> {
    if source.len() > MAX_SOURCE_BYTES {
        return Err(ScriptError::new(1, format!("program of {} bytes, at most {MAX_SOURCE_BYTES} are accepted", source.len())));
    }
    let mut parser = Parser { tokens: lex(source)?, at: 0, depth: 0 };
    let first = parser.peek().cloned();
    let unit = match first {
        Some(Token::Keyword(word @ ("def" | "sec"))) => {
            parser.at += 1;
            let function = parser.function(false)?;
            if !function.parameters.is_empty() {
                return Err(ScriptError::new(1, format!("program '{}' takes no parameters", function.name)));
            }
            if let Some(token) = parser.peek() {
                return Err(parser.error(format!("{} after the program's last 'end'", show(token))));
            }
            Unit { name: function.name, secondary: word == "sec", body: function.body }
        }
        Some(_) => {
            let body = parser.block(&[])?;
            if parser.peek().is_some() {
                return Err(parser.error("'end' without its beginning"));
            }
            Unit { name: "unnamed".to_owned(), secondary: false, body }
        }
        None => return Err(ScriptError::new(1, "empty program")),
    };
    Ok(unit)
}

fn show(token: &Token) -> String {
    match token {
        Token::Name(name) => format!("'{name}'"),
        Token::Keyword(word) => format!("'{word}'"),
        Token::Int(value) => format!("'{value}'"),
        Token::Float(value) => format!("'{value}'"),
        Token::Str(_) => "a text".to_owned(),
        Token::Symbol(symbol) => format!("'{symbol}'"),
        Token::Newline => "the end of the line".to_owned(),
    }
}

struct Parser {
    tokens: Vec<(Token, u32)>,
    at: usize,
    depth: u32,
}

impl Parser {
    fn peek(&self) -> Option<&Token> {
        self.tokens.get(self.at).map(|t| &t.0)
    }

    fn line(&self) -> u32 {
        self.tokens.get(self.at).or(self.tokens.last()).map_or(1, |t| t.1)
    }

    fn error(&self, what: impl Into<String>) -> ScriptError {
        ScriptError::new(self.line(), what)
    }

    fn found(&self) -> String {
        self.peek().map_or_else(|| "the end of the program".to_owned(), show)
    }

    fn symbol(&mut self, symbol: &str) -> bool {
        let hit = matches!(self.peek(), Some(Token::Symbol(s)) if *s == symbol);
        self.at += usize::from(hit);
        hit
    }

    fn keyword(&mut self, word: &str) -> bool {
        let hit = matches!(self.peek(), Some(Token::Keyword(k)) if *k == word);
        self.at += usize::from(hit);
        hit
    }

    fn expect(&mut self, symbol: &str) -> Result<(), ScriptError> {
        if self.symbol(symbol) { Ok(()) } else { Err(self.error(format!("expected '{symbol}', found {}", self.found()))) }
    }

    fn newline(&mut self) -> Result<(), ScriptError> {
        match self.peek() {
            None => Ok(()),
            Some(Token::Newline) => {
                self.at += 1;
                Ok(())
            }
            Some(_) => Err(self.error(format!("expected the end of the line, found {}", self.found()))),
        }
    }

    fn name(&mut self) -> Result<String, ScriptError> {
        match self.peek() {
            Some(Token::Name(name)) => {
                let name = name.clone();
                self.at += 1;
                Ok(name)
            }
            _ => Err(self.error(format!("expected a name, found {}", self.found()))),
        }
    }

    fn deeper(&mut self) -> Result<(), ScriptError> {
        self.depth += 1;
        if self.depth > MAX_DEPTH { Err(self.error(format!("nested deeper than {MAX_DEPTH}"))) } else { Ok(()) }
    }

    /// Statements up to one of `ends`, which is left for the caller; up to the end of the program if `ends` is empty.
    fn block(&mut self, ends: &[&str]) -> Result<Vec<Statement>, ScriptError> {
        self.deeper()?;
        let mut body = Vec::new();
        loop {
            match self.peek() {
                Some(Token::Keyword(word)) if ends.contains(word) => break,
                Some(Token::Keyword("end" | "elif" | "else")) if ends.is_empty() => break,
                None if ends.is_empty() => break,
                None => return Err(self.error("the program ends before its 'end'")),
                Some(_) => body.push(self.statement()?),
            }
        }
        self.depth -= 1;
        Ok(body)
    }

    fn end(&mut self) -> Result<(), ScriptError> {
        if !self.keyword("end") {
            return Err(self.error(format!("expected 'end', found {}", self.found())));
        }
        self.newline()
    }

    fn colon(&mut self) -> Result<(), ScriptError> {
        self.expect(":")?;
        self.newline()
    }

    fn function(&mut self, thread: bool) -> Result<Function, ScriptError> {
        let name = self.name()?;
        self.expect("(")?;
        let mut parameters: Vec<(String, Option<Expr>)> = Vec::new();
        while !self.symbol(")") {
            if !parameters.is_empty() {
                self.expect(",")?;
            }
            let parameter = self.name()?;
            if parameters.iter().any(|(p, _)| *p == parameter) {
                return Err(self.error(format!("parameter '{parameter}' appears twice")));
            }
            let default = if self.symbol("=") { Some(self.expr()?) } else { None };
            parameters.push((parameter, default));
        }
        self.colon()?;
        let body = self.block(&["end"])?;
        self.end()?;
        Ok(Function { name, parameters, body, thread })
    }

    fn statement(&mut self) -> Result<Statement, ScriptError> {
        let line = self.line();
        let keyword = match self.peek() {
            Some(Token::Keyword(word)) => *word,
            _ => "",
        };
        if !keyword.is_empty() {
            self.at += 1;
        }
        let kind = match keyword {
            "def" | "thread" => return Ok(Statement { line, kind: StatementKind::Function(self.function(keyword == "thread")?) }),
            "if" => {
                let mut branches = Vec::new();
                let mut otherwise = Vec::new();
                let condition = self.expr()?;
                self.colon()?;
                branches.push((condition, self.block(&["elif", "else", "end"])?));
                loop {
                    if self.keyword("elif") {
                        let condition = self.expr()?;
                        self.colon()?;
                        branches.push((condition, self.block(&["elif", "else", "end"])?));
                    } else if self.keyword("else") {
                        self.colon()?;
                        otherwise = self.block(&["end"])?;
                    } else {
                        self.end()?;
                        return Ok(Statement { line, kind: StatementKind::If { branches, otherwise } });
                    }
                }
            }
            "while" => {
                let condition = self.expr()?;
                self.colon()?;
                let body = self.block(&["end"])?;
                self.end()?;
                return Ok(Statement { line, kind: StatementKind::While { condition, body } });
            }
            "return" => {
                if matches!(self.peek(), Some(Token::Newline) | None) {
                    return Err(ScriptError::new(line, "'return' needs a value; write 'return None' when there is none"));
                }
                StatementKind::Return(self.expr()?)
            }
            "break" => StatementKind::Break,
            "continue" => StatementKind::Continue,
            "halt" => StatementKind::Halt,
            "pause" => StatementKind::Pause,
            "join" => StatementKind::Join(self.expr()?),
            "kill" => StatementKind::Kill(self.expr()?),
            "global" | "local" => {
                let name = self.name()?;
                self.expect("=")?;
                let scope = if keyword == "global" { Scope::Global } else { Scope::Local };
                StatementKind::Assign { scope, name, index: None, value: self.expr()? }
            }
            "" => self.assignment_or_call()?,
            "run" => {
                self.at -= 1;
                StatementKind::Expr(self.expr()?)
            }
            "sec" => return Err(ScriptError::new(line, "'sec' begins a secondary program of its own, in column 0")),
            word => return Err(ScriptError::new(line, format!("'{word}' cannot begin a statement"))),
        };
        self.newline()?;
        Ok(Statement { line, kind })
    }

    fn assignment_or_call(&mut self) -> Result<StatementKind, ScriptError> {
        let target = self.expr()?;
        if !self.symbol("=") {
            return match target.kind {
                ExprKind::Call(..) => Ok(StatementKind::Expr(target)),
                _ => Err(ScriptError::new(target.line, "a statement is an assignment or a call")),
            };
        }
        let value = self.expr()?;
        match target.kind {
            ExprKind::Name(name) => Ok(StatementKind::Assign { scope: Scope::Free, name, index: None, value }),
            ExprKind::Index(list, index) => match list.kind {
                ExprKind::Name(name) => Ok(StatementKind::Assign { scope: Scope::Free, name, index: Some(*index), value }),
                _ => Err(ScriptError::new(target.line, "only an element of a variable can be assigned, as in a[0] = 1")),
            },
            _ => Err(ScriptError::new(target.line, "only a variable or its element can be assigned")),
        }
    }

    fn expr(&mut self) -> Result<Expr, ScriptError> {
        self.deeper()?;
        let mut left = self.conjunction()?;
        loop {
            let line = self.line();
            if self.keyword("or") {
                let right = self.conjunction()?;
                left = Expr::new(line, ExprKind::Or(Box::new(left), Box::new(right)))?;
            } else if self.keyword("xor") {
                let right = self.conjunction()?;
                left = Expr::new(line, ExprKind::Binary(Operator::Xor, Box::new(left), Box::new(right)))?;
            } else {
                break;
            }
        }
        self.depth -= 1;
        Ok(left)
    }

    fn conjunction(&mut self) -> Result<Expr, ScriptError> {
        let mut left = self.negation()?;
        loop {
            let line = self.line();
            if !self.keyword("and") {
                return Ok(left);
            }
            let right = self.negation()?;
            left = Expr::new(line, ExprKind::And(Box::new(left), Box::new(right)))?;
        }
    }

    fn negation(&mut self) -> Result<Expr, ScriptError> {
        let line = self.line();
        if self.keyword("not") {
            self.deeper()?;
            let inner = self.negation()?;
            self.depth -= 1;
            return Expr::new(line, ExprKind::Not(Box::new(inner)));
        }
        self.comparison()
    }

    fn operator(&mut self, table: &[(&str, Operator)]) -> Option<Operator> {
        table.iter().find(|(symbol, _)| self.symbol(symbol)).map(|(_, operator)| *operator)
    }

    fn comparison(&mut self) -> Result<Expr, ScriptError> {
        use Operator::*;
        const TABLE: &[(&str, Operator)] =
            &[("==", Equal), ("!=", NotEqual), ("<=", LessEqual), (">=", GreaterEqual), ("<", Less), (">", Greater)];
        let left = self.sum()?;
        let line = self.line();
        let Some(operator) = self.operator(TABLE) else { return Ok(left) };
        let right = self.sum()?;
        if self.operator(TABLE).is_some() {
            return Err(ScriptError::new(line, "comparisons cannot be chained; join them with 'and'"));
        }
        Expr::new(line, ExprKind::Binary(operator, Box::new(left), Box::new(right)))
    }

    fn sum(&mut self) -> Result<Expr, ScriptError> {
        let mut left = self.product()?;
        loop {
            let line = self.line();
            let Some(operator) = self.operator(&[("+", Operator::Add), ("-", Operator::Subtract)]) else { return Ok(left) };
            let right = self.product()?;
            left = Expr::new(line, ExprKind::Binary(operator, Box::new(left), Box::new(right)))?;
        }
    }

    fn product(&mut self) -> Result<Expr, ScriptError> {
        const TABLE: &[(&str, Operator)] = &[("*", Operator::Multiply), ("/", Operator::Divide), ("%", Operator::Modulo)];
        let mut left = self.unary()?;
        loop {
            let line = self.line();
            let Some(operator) = self.operator(TABLE) else { return Ok(left) };
            let right = self.unary()?;
            left = Expr::new(line, ExprKind::Binary(operator, Box::new(left), Box::new(right)))?;
        }
    }

    fn unary(&mut self) -> Result<Expr, ScriptError> {
        let line = self.line();
        if self.symbol("-") {
            self.deeper()?;
            let inner = self.unary()?;
            self.depth -= 1;
            return Expr::new(line, ExprKind::Negative(Box::new(inner)));
        }
        let mut value = self.primary()?;
        while self.symbol("[") {
            let index = self.expr()?;
            self.expect("]")?;
            value = Expr::new(line, ExprKind::Index(Box::new(value), Box::new(index)))?;
        }
        Ok(value)
    }

    fn list(&mut self) -> Result<Vec<Expr>, ScriptError> {
        let mut items = Vec::new();
        while !self.symbol("]") {
            if !items.is_empty() {
                self.expect(",")?;
            }
            items.push(self.expr()?);
        }
        Ok(items)
    }

    fn arguments(&mut self) -> Result<Vec<Argument>, ScriptError> {
        let mut arguments: Vec<Argument> = Vec::new();
        while !self.symbol(")") {
            if !arguments.is_empty() {
                self.expect(",")?;
            }
            let named =
                matches!((self.peek(), self.tokens.get(self.at + 1).map(|t| &t.0)), (Some(Token::Name(_)), Some(Token::Symbol("="))));
            if named {
                let name = self.name()?;
                self.at += 1;
                arguments.push((Some(name), self.expr()?));
            } else if arguments.last().is_some_and(|a| a.0.is_some()) {
                return Err(self.error("an argument without a name cannot follow one with a name"));
            } else {
                arguments.push((None, self.expr()?));
            }
        }
        Ok(arguments)
    }

    fn primary(&mut self) -> Result<Expr, ScriptError> {
        let line = self.line();
        let Some(token) = self.peek().cloned() else { return Err(self.error("the program ends inside an expression")) };
        self.at += 1;
        let kind = match token {
            Token::Int(value) => ExprKind::Int(value),
            Token::Float(value) => ExprKind::Float(value),
            Token::Str(text) => ExprKind::Str(text),
            Token::Keyword("True") => ExprKind::Bool(true),
            Token::Keyword("False") => ExprKind::Bool(false),
            Token::Keyword("None") => ExprKind::None,
            Token::Keyword("run") => {
                let name = self.name()?;
                self.expect("(")?;
                ExprKind::Run(name, self.arguments()?)
            }
            Token::Symbol("(") => {
                let inner = self.expr()?;
                self.expect(")")?;
                return Ok(inner);
            }
            Token::Symbol("[") => ExprKind::List(self.list()?),
            Token::Name(name) if name == "p" && matches!(self.peek(), Some(Token::Symbol("["))) && self.is_pose() => {
                self.at += 1;
                ExprKind::Pose(self.list()?)
            }
            Token::Name(name) => {
                if self.symbol("(") {
                    ExprKind::Call(name, self.arguments()?)
                } else {
                    ExprKind::Name(name)
                }
            }
            token => {
                self.at -= 1;
                return Err(self.error(format!("expected a value, found {}", show(&token))));
            }
        };
        Expr::new(line, kind)
    }

    /// `p[` starts a pose when a comma follows at the bracket's own level; `p[0]` is an element of a variable named p.
    fn is_pose(&self) -> bool {
        let mut depth = 0u32;
        for (token, _) in &self.tokens[self.at..] {
            match token {
                Token::Symbol("[" | "(") => depth += 1,
                Token::Symbol("]" | ")") if depth <= 1 => return false,
                Token::Symbol("]" | ")") => depth -= 1,
                Token::Symbol(",") if depth == 1 => return true,
                _ => {}
            }
        }
        false
    }
}
