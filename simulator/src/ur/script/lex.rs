//! URScript's words: text in, tokens out.
//!
//! Pure; allocates the tokens. A character that is not part of the language is an error with its line.

use super::ScriptError;

/// One word of a program.
#[derive(Debug, Clone, PartialEq)]
pub enum Token {
    /// A name that is not a keyword.
    Name(String),
    /// A reserved word of URScript.
    Keyword(&'static str),
    /// A whole number.
    Int(i32),
    /// A number with a point or an exponent.
    Float(f64),
    /// A text in double quotes.
    Str(String),
    /// An operator or bracket.
    Symbol(&'static str),
    /// The end of a line outside brackets.
    Newline,
}

impl Token {
    /// The token in words, for messages.
    pub fn in_words(&self) -> String {
        match self {
            Token::Name(name) => format!("'{name}'"),
            Token::Keyword(word) => format!("'{word}'"),
            Token::Int(value) => format!("'{value}'"),
            Token::Float(value) => format!("'{value}'"),
            Token::Str(_) => "a text".to_owned(),
            Token::Symbol(symbol) => format!("'{symbol}'"),
            Token::Newline => "the end of the line".to_owned(),
        }
    }
}

/// The reserved words that this interpreter knows (UR's script manual).
const KEYWORDS: &[&str] = &[
    "def", "sec", "thread", "end", "if", "elif", "else", "while", "return", "break", "continue", "halt", "pause", "global", "local", "and",
    "or", "xor", "not", "True", "False", "None", "run", "join", "kill",
];
/// The reserved words of URScript (UR's script manual) that this interpreter does not run. An error that says so helps more than
/// "unknown name".
const UNSUPPORTED: &[&str] = &["assert", "codeblock", "enum", "enter_critical", "exit_critical", "string", "struct", "to_num"];
/// Operators and brackets (UR's script manual), the longer ones first, so that "<=" is not read as "<".
const SYMBOLS: &[&str] = &["==", "!=", "<=", ">=", "+", "-", "*", "/", "%", "<", ">", "=", "(", ")", "[", "]", ",", ":"];

/// Splits `source` into tokens with their line numbers. Line ends inside brackets do not count.
///
/// # Errors
/// The first part of the source that is not of the language, with its line.
pub fn lex(source: &str) -> Result<Vec<(Token, u32)>, ScriptError> {
    let mut tokens = Vec::new();
    let mut line = 1u32;
    let mut depth = 0usize;
    let mut rest = source;
    while let Some(first) = rest.chars().next() {
        if first == '\n' {
            if depth == 0 && !matches!(tokens.last(), None | Some((Token::Newline, _))) {
                tokens.push((Token::Newline, line));
            }
            line += 1;
            rest = &rest[1..];
        } else if first == ' ' || first == '\t' || first == '\r' {
            rest = &rest[1..];
        } else if first == '#' {
            rest = &rest[rest.find('\n').unwrap_or(rest.len())..];
        } else if first == '"' {
            let end = rest[1..].find(['"', '\n']).filter(|&i| rest.as_bytes()[1 + i] == b'"');
            let end = end.ok_or_else(|| ScriptError::new(line, "text without its closing quote"))?;
            tokens.push((Token::Str(rest[1..1 + end].to_owned()), line));
            rest = &rest[end + 2..];
        } else if first.is_ascii_digit() || (first == '.' && rest[1..].starts_with(|c: char| c.is_ascii_digit())) {
            let (token, length) = number(rest, line)?;
            tokens.push((token, line));
            rest = &rest[length..];
        } else if first.is_ascii_alphabetic() || first == '_' {
            let length = rest.find(|c: char| !c.is_ascii_alphanumeric() && c != '_').unwrap_or(rest.len());
            let word = &rest[..length];
            if UNSUPPORTED.contains(&word) {
                return Err(ScriptError::new(line, format!("'{word}' is a word of URScript that this simulated controller does not run")));
            }
            let keyword = KEYWORDS.iter().find(|k| **k == word);
            tokens.push((keyword.map_or_else(|| Token::Name(word.to_owned()), |k| Token::Keyword(k)), line));
            rest = &rest[length..];
        } else if let Some(symbol) = SYMBOLS.iter().find(|s| rest.starts_with(**s)) {
            match *symbol {
                "(" | "[" => depth += 1,
                ")" | "]" => depth = depth.saturating_sub(1),
                _ => {}
            }
            tokens.push((Token::Symbol(symbol), line));
            rest = &rest[symbol.len()..];
        } else {
            return Err(ScriptError::new(line, format!("character {first:?} has no meaning in URScript")));
        }
    }
    if !matches!(tokens.last(), None | Some((Token::Newline, _))) {
        tokens.push((Token::Newline, line));
    }
    Ok(tokens)
}

/// The number at the start of `text`, and its length in bytes.
fn number(text: &str, line: u32) -> Result<(Token, usize), ScriptError> {
    let bytes = text.as_bytes();
    let digits = |mut at: usize| {
        while bytes.get(at).is_some_and(u8::is_ascii_digit) {
            at += 1;
        }
        at
    };
    let mut end = digits(0);
    let mut float = false;
    if bytes.get(end) == Some(&b'.') {
        float = true;
        end = digits(end + 1);
    }
    if matches!(bytes.get(end), Some(b'e' | b'E')) {
        let sign = usize::from(matches!(bytes.get(end + 1), Some(b'+' | b'-')));
        let after = digits(end + 1 + sign);
        if after > end + 1 + sign {
            float = true;
            end = after;
        }
    }
    let word = &text[..end];
    if text[end..].starts_with(|c: char| c.is_ascii_alphanumeric() || c == '_') {
        return Err(ScriptError::new(line, format!("'{word}' is followed by a letter: neither a number nor a name")));
    }
    let token =
        if float { word.parse::<f64>().ok().filter(|v| v.is_finite()).map(Token::Float) } else { word.parse::<i32>().ok().map(Token::Int) };
    token.map(|t| (t, end)).ok_or_else(|| ScriptError::new(line, format!("number {word} is out of range")))
}
