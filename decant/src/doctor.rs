//! `decant doctor`: looks at everything that a pour needs, and changes nothing.
//!
//! Ordinary process; allocates, reads files, and waits some seconds for a robot that does not answer. Each line is green, yellow or red,
//! and says what it means and what to do. The exit code is 0 if nothing is red, else that of the first red line: 2 for configuration and
//! files, 3 for a robot or camera that cannot be reached, 1 for the rest.

mod camera;
mod files;
mod rights;
mod robot;

use std::io::IsTerminal as _;
use std::path::PathBuf;

use serde_json::json;
use shared::config::Config;
use shared::exit::{BAD_INPUT, FAILED, Failure, UNREACHABLE, failure};
use shared::machine::{self, Finding, Verdict};

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  decant doctor --config config/cell.toml
  decant doctor --config config/cell.toml --json

Exit codes: 0 nothing is red, 1 the machine cannot run a cell, 2 configuration or files, 3 camera or robot cannot be reached.")]
pub struct Args {
    /// The cell's configuration.
    #[arg(long, env = shared::config::VARIABLE, default_value = shared::config::DEFAULT_FILE)]
    config: PathBuf,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// What belongs together: its heading, the exit code of a red line in it, and its lines.
struct Section(&'static str, u8, Vec<Finding>);

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let mut sections = Vec::new();
    let config = Config::read(&args.config);
    let core = config.as_ref().map_or(1, |c| c.controller.core);
    sections.push(Section("machine", FAILED, machine::look(core)));
    match &config {
        Ok(config) => {
            sections.push(Section("rights", FAILED, rights::look(config)));
            sections.push(Section("files", BAD_INPUT, files::look(&args.config, config)));
            sections.push(Section("camera", UNREACHABLE, camera::look(config)));
            sections.push(Section("robot", UNREACHABLE, robot::look(config)));
        }
        Err(e) => {
            let read =
                Finding::red("configuration", e.to_string(), "no program of the cell starts", "mend the file, or give --config FILE");
            sections.push(Section("files", BAD_INPUT, vec![read]));
        }
    }
    if args.json {
        print_json(&sections)
    } else {
        print(&sections)
    }
    let red = |section: &&Section| section.2.iter().any(|f| f.verdict == Verdict::Red);
    match sections.iter().find(red) {
        None => Ok(()),
        Some(first) => {
            let red = sections.iter().flat_map(|s| &s.2).filter(|f| f.verdict == Verdict::Red).count();
            Err(failure(first.1, format!("{red} red, the first in '{}': mend that before you pour", first.0)))
        }
    }
}

fn print_json(sections: &[Section]) {
    let sections: Vec<_> = sections.iter().map(|Section(name, _, lines)| json!({ "section": name, "lines": lines })).collect();
    println!("{:#}", json!({ "version": 1, "sections": sections }));
}

/// Prints a line for each finding, and under it what it means and what to do. The colour repeats the word.
fn print(sections: &[Section]) {
    let coloured = std::io::stdout().is_terminal() && std::env::var_os("NO_COLOR").is_none();
    for Section(name, _, findings) in sections {
        println!("{name}");
        for f in findings {
            let (word, colour) = match f.verdict {
                Verdict::Green => ("green", 32),
                Verdict::Yellow => ("yellow", 33),
                Verdict::Red => ("red", 31),
            };
            let word = if coloured { format!("\x1b[{colour}m{word:<6}\x1b[0m") } else { format!("{word:<6}") };
            println!("  {word} {:<22} {}", f.what, f.is);
            let what_to_do = [f.means.as_str(), &f.advice].into_iter().filter(|text| !text.is_empty()).collect::<Vec<_>>().join(": ");
            if !what_to_do.is_empty() {
                println!("  {:<6} {:<22} {what_to_do}", "", "");
            }
        }
    }
}
