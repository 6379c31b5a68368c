//! The table `[container]` of the configuration: what is known of the vessel before any picture. All of it may be left out.
//!
//! Plain data, read once at the start in an ordinary thread; it allocates nothing. Values out of range are refused with the configuration.

use serde::{Deserialize, Serialize};

/// The table `[container]`.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ContainerConfig {
    /// What the vessel holds up to its lip, ml.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub holds_ml: Option<f64>,
    /// The least that is ever filled in, ml: a pour in which nothing flows where even this would flow ends.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub least_fill_ml: Option<f64>,
}

impl ContainerConfig {
    /// The key that cannot be, its value, and what is allowed; `None` if all are possible.
    pub(crate) fn fault(&self) -> Option<(&'static str, f64, String)> {
        let holds_ml = self.holds_ml.unwrap_or(HOLDS_MAX_ML);
        if !(1.0..=HOLDS_MAX_ML).contains(&holds_ml) {
            return Some(("container.holds_ml", holds_ml, format!("1 to {HOLDS_MAX_ML}")));
        }
        let least_ml = self.least_fill_ml.unwrap_or(0.0);
        let possible = (0.0..=holds_ml).contains(&least_ml);
        (!possible).then(|| ("container.least_fill_ml", least_ml, format!("0 to {holds_ml}, what the vessel holds")))
    }
}

/// The most that a vessel may hold, ml: more than any robot of this kind can carry.
const HOLDS_MAX_ML: f64 = 10_000.0;

#[cfg(test)]
mod tests {
    use crate::config::Config;

    /// Protects a pour from a fill that cannot be: the table may be left out, and what does not fit into the vessel is refused by its key.
    #[test]
    fn what_a_vessel_cannot_hold_is_refused() {
        let read = |table: &str| {
            let text = include_str!("../../config/sim.toml").replace("[container]", &format!("[container]\n{table}"));
            Config::parse(&text, "sim.toml").map(|c| c.container).map_err(|e| e.to_string())
        };
        assert_eq!(read("").unwrap().least_fill_ml, None);
        assert_eq!(read("least_fill_ml = 150.0").unwrap().least_fill_ml, Some(150.0));
        for (table, key) in [
            ("holds_ml = 500.0\nleast_fill_ml = 501.0", "container.least_fill_ml"),
            ("least_fill_ml = -1.0", "container.least_fill_ml"),
            ("holds_ml = 0.0", "container.holds_ml"),
            ("holds = 500.0", "holds"),
        ] {
            assert!(read(table).unwrap_err().contains(key), "{table}");
        }
    }
}
