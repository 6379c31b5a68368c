//! What a measurement becomes: numbers for `jitter.json`, text for the terminal, and a part of the page.

use serde_json::Value;
use trainer::report::page;

use super::ratios::Ratios;

/// Verdict, numbers, terminal text and page of a measurement.
pub struct Measured {
    /// Sentences that say whether it is good; they stand first.
    pub verdict: String,
    /// The rounds of each condition, for the comparison with an earlier run; none for a soak.
    pub rounds: Vec<(&'static str, Vec<Ratios>)>,
    /// For `jitter.json`.
    pub numbers: Value,
    /// For the terminal.
    pub text: String,
    /// For the page.
    pub html: String,
}

/// A heading and a list of facts, for the page.
pub fn facts_html(facts: &[String]) -> String {
    let items: String = facts.iter().map(|fact| format!("<li>{}</li>", page::escape(fact))).collect();
    format!("<ul>{items}</ul>")
}
