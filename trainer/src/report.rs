//! Pages of plots and tables: self-contained HTML with the plots inline as SVG.
//!
//! Pure functions, for any thread; they allocate. `trainer report` and the experiments make their pages of these parts.
//!
//! | file | what it holds |
//! |---|---|
//! | [`page`] | tables, figures, and the page around them |
//! | [`plot`] | plots as SVG |
//! | `training`, `evaluation` | what is shown of a training and of an evaluation |
//! | `json` | reading the values of a report |

use serde_json::Value;

mod evaluation;
mod json;
pub mod json_out;
pub mod page;
pub mod plot;
mod training;

/// The page of some JSON values; an error names the value that is of no known kind.
pub fn build(files: &[(String, Value)]) -> Result<String, String> {
    let mut body = evaluation::against_episodes(files.iter().map(|(_, v)| v));
    for (name, v) in files {
        match v["kind"].as_str() {
            Some("training") => body += &training::training(v),
            Some("evaluation") => body += &evaluation::evaluation(v),
            Some("reproduction") => body += v["html"].as_str().unwrap_or_default(),
            _ => return Err(format!("{name}: not a JSON report of `train`, `refine`, `evaluate` or `reproduce`")),
        }
    }
    Ok(page::page("Decant: report", &body))
}
