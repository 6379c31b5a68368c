//! The parser's place in the list of tokens, and the steps that all grammar rules share.
//!
//! Pure. Reading past the end is no mistake here: the rules in [`super::expressions`] and [`super::statements`] say what they
//! expected instead. The depth of nested rules is bounded, so that no source can exhaust the stack.

use super::ScriptError;
use super::lex::{Token, lex};

/// Deepest nesting of blocks and expressions. Chosen by hand, above what real programs have and below what the stack holds.
const MAX_DEPTH: u32 = 64;

/// A list of tokens with their lines, and a place in it.
pub struct Parser {
    tokens: Vec<(Token, u32)>,
    at: usize,
    depth: u32,
}

impl Parser {
    /// Stands before the first token of `source`.
    ///
    /// # Errors
    /// The source has a character or a number that is not part of the language.
    pub fn new(source: &str) -> Result<Self, ScriptError> {
        Ok(Self { tokens: lex(source)?, at: 0, depth: 0 })
    }

    /// The next token, if there is one.
    pub fn peek(&self) -> Option<&Token> {
        self.tokens.get(self.at).map(|t| &t.0)
    }

    /// The tokens from the next one on.
    pub fn rest(&self) -> impl Iterator<Item = &Token> {
        self.tokens[self.at..].iter().map(|t| &t.0)
    }

    /// Passes over the next token.
    pub fn advance(&mut self) {
        self.at += 1;
    }

    /// Goes back to the token that was passed over last.
    pub fn back(&mut self) {
        self.at -= 1;
    }

    /// Line of the next token, or of the last one at the end of the program.
    pub fn line(&self) -> u32 {
        self.tokens.get(self.at).or(self.tokens.last()).map_or(1, |t| t.1)
    }

    /// A mistake at the next token.
    pub fn error(&self, what: impl Into<String>) -> ScriptError {
        ScriptError::new(self.line(), what)
    }

    /// The next token in words, for messages.
    pub fn found(&self) -> String {
        self.peek().map_or_else(|| "the end of the program".to_owned(), Token::in_words)
    }

    /// Passes over the next token if it is `symbol`; true if it was.
    pub fn symbol(&mut self, symbol: &str) -> bool {
        let hit = matches!(self.peek(), Some(Token::Symbol(s)) if *s == symbol);
        self.at += usize::from(hit);
        hit
    }

    /// Passes over the next token if it is the keyword `word`; true if it was.
    pub fn keyword(&mut self, word: &str) -> bool {
        let hit = matches!(self.peek(), Some(Token::Keyword(k)) if *k == word);
        self.at += usize::from(hit);
        hit
    }

    /// Passes over `symbol`.
    ///
    /// # Errors
    /// The next token is another one.
    pub fn expect(&mut self, symbol: &str) -> Result<(), ScriptError> {
        if self.symbol(symbol) { Ok(()) } else { Err(self.error(format!("expected '{symbol}', found {}", self.found()))) }
    }

    /// Passes over the end of a line, which the end of the program is too.
    ///
    /// # Errors
    /// There is more on the line.
    pub fn newline(&mut self) -> Result<(), ScriptError> {
        match self.peek() {
            None => Ok(()),
            Some(Token::Newline) => {
                self.at += 1;
                Ok(())
            }
            Some(_) => Err(self.error(format!("expected the end of the line, found {}", self.found()))),
        }
    }

    /// Passes over a name and gives it.
    ///
    /// # Errors
    /// The next token is no name.
    pub fn name(&mut self) -> Result<String, ScriptError> {
        match self.peek() {
            Some(Token::Name(name)) => {
                let name = name.clone();
                self.at += 1;
                Ok(name)
            }
            _ => Err(self.error(format!("expected a name, found {}", self.found()))),
        }
    }

    /// Enters a nested rule.
    ///
    /// # Errors
    /// The source is nested too deep.
    pub fn deeper(&mut self) -> Result<(), ScriptError> {
        self.depth += 1;
        if self.depth > MAX_DEPTH { Err(self.error(format!("nested deeper than {MAX_DEPTH}"))) } else { Ok(()) }
    }

    /// Leaves a nested rule.
    pub fn shallower(&mut self) {
        self.depth -= 1;
    }
}
