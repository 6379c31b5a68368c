//! The grammar of programs and statements: text in, a tree out.
//!
//! Pure; recursive descent with a bounded depth. A mistake is an error with its line, and nothing is skipped silently.

use super::ScriptError;
use super::lex::Token;
use super::parser::Parser;
use super::syntax::{Expr, ExprKind, Function, ProgramTree, Scope, Statement, StatementKind};

/// Longest program that is accepted, in bytes. Chosen by hand: ur_rtde's program, the longest that is known here, has 42 kB.
pub const MAX_SOURCE_BYTES: usize = 1 << 20;

/// Reads one uploaded program: a `def` or `sec` with its `end`, or bare statements.
///
/// # Errors
/// The program's first mistake, with its line.
pub fn parse(source: &str) -> Result<ProgramTree, ScriptError> {
    if source.len() > MAX_SOURCE_BYTES {
        return Err(ScriptError::new(1, format!("program of {} bytes, at most {MAX_SOURCE_BYTES} are accepted", source.len())));
    }
    let mut parser = Parser::new(source)?;
    let first = parser.peek().cloned();
    let unit = match first {
        Some(Token::Keyword(word @ ("def" | "sec"))) => {
            parser.advance();
            let function = parser.function(false)?;
            if !function.parameters.is_empty() {
                return Err(ScriptError::new(1, format!("program '{}' takes no parameters", function.name)));
            }
            if let Some(token) = parser.peek() {
                return Err(parser.error(format!("{} after the program's last 'end'", token.in_words())));
            }
            ProgramTree { name: function.name, secondary: word == "sec", body: function.body }
        }
        Some(_) => {
            let body = parser.block(&[])?;
            if parser.peek().is_some() {
                return Err(parser.error("'end' without its beginning"));
            }
            ProgramTree { name: "unnamed".to_owned(), secondary: false, body }
        }
        None => return Err(ScriptError::new(1, "empty program")),
    };
    Ok(unit)
}

impl Parser {
    /// Reads statements up to one of `ends`, which is left for the caller. When `ends` is empty, it reads up to the end of the
    /// program.
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
        self.shallower();
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
            self.advance();
        }
        let kind = match keyword {
            "def" | "thread" => return Ok(Statement { line, kind: StatementKind::Function(self.function(keyword == "thread")?) }),
            "if" => return Ok(Statement { line, kind: self.branches()? }),
            "while" => {
                let (condition, body) = self.guarded_block(&["end"])?;
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
                self.back();
                StatementKind::Expr(self.expr()?)
            }
            "sec" => return Err(ScriptError::new(line, "'sec' begins a secondary program of its own, in column 0")),
            word => return Err(ScriptError::new(line, format!("'{word}' cannot begin a statement"))),
        };
        self.newline()?;
        Ok(Statement { line, kind })
    }

    /// A condition and the statements that it guards, up to one of `ends`.
    fn guarded_block(&mut self, ends: &[&str]) -> Result<(Expr, Vec<Statement>), ScriptError> {
        let condition = self.expr()?;
        self.colon()?;
        Ok((condition, self.block(ends)?))
    }

    /// What follows `if`, up to its `end`.
    fn branches(&mut self) -> Result<StatementKind, ScriptError> {
        let mut branches = vec![self.guarded_block(&["elif", "else", "end"])?];
        let mut otherwise = Vec::new();
        loop {
            if self.keyword("elif") {
                branches.push(self.guarded_block(&["elif", "else", "end"])?);
            } else if self.keyword("else") {
                self.colon()?;
                otherwise = self.block(&["end"])?;
            } else {
                self.end()?;
                return Ok(StatementKind::If { branches, otherwise });
            }
        }
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
}
