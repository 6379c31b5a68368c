//! What is known of the machine that is measured on, and what would make it better.
//!
//! Ordinary thread; allocates; cannot fail.

use serde_json::{Value, json};
use shared::machine::{self, Finding};
use trainer::report::page;

use crate::own_cell::OwnCell;

/// What is known of the machine, and what would make it better.
pub struct ThisMachine(Vec<Finding>);

impl ThisMachine {
    /// Reads what Linux tells about the machine, and how the cell's processes are scheduled.
    pub fn look(cell: &OwnCell) -> Self {
        let c = &cell.config;
        let mut findings = machine::look(c.controller.core);
        let controller = format!("core {}, SCHED_FIFO {}, {} Hz", c.controller.core, c.controller.priority, c.controller.rate_hz);
        findings.push(Finding::green("loop", controller));
        findings.push(Finding::green("feature worker", format!("core {}, SCHED_FIFO {}", c.worker.core, c.worker.priority)));
        findings.push(Finding::green("load before", machine::read("/proc/loadavg")));
        Self(findings)
    }

    /// What makes two runs comparable, in one line: processor, kernel, and how loop and worker are scheduled.
    pub fn key(&self) -> String {
        let of = |what: &str| self.0.iter().find(|f| f.what == what).map_or("", |f| f.is.as_str());
        ["processor", "kernel", "loop", "feature worker"].map(of).join("; ")
    }

    /// For `jitter.json`.
    pub fn json(&self) -> Value {
        json!(self.0)
    }

    /// For the terminal.
    pub fn text(&self) -> String {
        let better = |f: &Finding| {
            if f.advice.is_empty() { String::new() } else { format!("{:<22} {}; better: {}\n", "", f.means, f.advice) }
        };
        self.0.iter().map(|f| format!("{:<22} {}\n{}", f.what, f.is, better(f))).collect()
    }

    /// For the page.
    pub fn html(&self) -> String {
        let mut rows = vec![["machine", "is", "means", "better"].map(String::from).to_vec()];
        rows.extend(self.0.iter().map(|f| vec![f.what.clone(), f.is.clone(), f.means.clone(), f.advice.clone()]));
        page::table(&rows)
    }
}
