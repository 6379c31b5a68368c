//! The grammar of expressions, from the loosest operators (`or`, `xor`) to the tightest (a value and its index).
//!
//! Pure; recursive descent with a bounded depth. A mistake is an error with its line.

use super::ScriptError;
use super::lex::Token;
use super::parser::Parser;
use super::syntax::{Argument, Expr, ExprKind, Operator};

impl Parser {
    /// Reads an expression.
    pub fn expr(&mut self) -> Result<Expr, ScriptError> {
        self.deeper()?;
        let mut left = self.conjunction()?;
        loop {
            let line = self.line();
            if self.keyword("or") {
                let right = self.conjunction()?;
                left = Expr::new(line, ExprKind::Or(Box::new(left), Box::new(right)))?;
            } else if self.keyword("xor") {
                let right = self.conjunction()?;
                left = binary(line, Operator::Xor, left, right)?;
            } else {
                break;
            }
        }
        self.shallower();
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
            self.shallower();
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
        binary(line, operator, left, right)
    }

    fn sum(&mut self) -> Result<Expr, ScriptError> {
        let mut left = self.product()?;
        loop {
            let line = self.line();
            let Some(operator) = self.operator(&[("+", Operator::Add), ("-", Operator::Subtract)]) else { return Ok(left) };
            let right = self.product()?;
            left = binary(line, operator, left, right)?;
        }
    }

    fn product(&mut self) -> Result<Expr, ScriptError> {
        const TABLE: &[(&str, Operator)] = &[("*", Operator::Multiply), ("/", Operator::Divide), ("%", Operator::Modulo)];
        let mut left = self.unary()?;
        loop {
            let line = self.line();
            let Some(operator) = self.operator(TABLE) else { return Ok(left) };
            let right = self.unary()?;
            left = binary(line, operator, left, right)?;
        }
    }

    fn unary(&mut self) -> Result<Expr, ScriptError> {
        let line = self.line();
        if self.symbol("-") {
            self.deeper()?;
            let inner = self.unary()?;
            self.shallower();
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
            let mut rest = self.rest();
            let named = matches!((rest.next(), rest.next()), (Some(Token::Name(_)), Some(Token::Symbol("="))));
            drop(rest);
            if named {
                let name = self.name()?;
                self.advance();
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
        self.advance();
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
                self.advance();
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
                self.back();
                return Err(self.error(format!("expected a value, found {}", token.in_words())));
            }
        };
        Expr::new(line, kind)
    }

    /// Tells a pose from an element: `p[` starts a pose when a comma follows at the bracket's own level, and `p[0]` is an element
    /// of a variable named p.
    fn is_pose(&self) -> bool {
        let mut depth = 0u32;
        for token in self.rest() {
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

fn binary(line: u32, operator: Operator, left: Expr, right: Expr) -> Result<Expr, ScriptError> {
    Expr::new(line, ExprKind::Binary(operator, Box::new(left), Box::new(right)))
}
