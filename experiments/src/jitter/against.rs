//! The gate: this measurement against an earlier one of the same machine, by ratios to the yardsticks of the same run.
//!
//! Pure; allocates. An earlier file that does not fit is an error of one line.

use serde_json::Value;

use super::ratios::{RATIOS, Ratios};

/// By how much a median ratio must have grown to count, in a full run: 20 % for p50, 60 % for p99, which a single pause of the machine
/// moves. See docs/REALTIME.md for the rate of false alarms with these bounds.
const GROWTH: [f64; 2] = [1.2, 1.6];
/// The same for a quick run on either side, which has one stretch of each instead of turns.
const GROWTH_QUICK: [f64; 2] = [1.4, 2.2];
/// Fewer rounds than this cannot be told from chance, even if all of them are worse: of 3 and 3, one order in 20 is so.
const ROUNDS_MIN: usize = 3;

/// One ratio that was compared.
#[derive(Debug, Clone, PartialEq)]
pub struct Comparison {
    /// Condition and ratio, in words.
    pub what: String,
    /// Median of the earlier rounds.
    pub before: f64,
    /// Median of these rounds.
    pub now: f64,
    /// Whether it became worse: every round is above every earlier one, and the median has grown by more than the bound.
    pub worse: bool,
}

/// Compares the rounds of each condition with those of an earlier `jitter.json`.
///
/// # Errors
/// One line, when the earlier file is of another machine or another form, or either side has too few rounds.
pub fn compare(now: &[(&str, Vec<Ratios>)], quick: bool, machine: &str, earlier: &Value) -> Result<Vec<Comparison>, String> {
    let version = earlier["version"].as_u64();
    if version != Some(super::VERSION) {
        return Err(format!("it has version {}, and this program writes version {}", version.unwrap_or(0), super::VERSION));
    }
    let was = earlier["machine_key"].as_str().unwrap_or_default();
    if was != machine {
        return Err(format!("it was measured on another machine ({was}); this is {machine}"));
    }
    let growth = if quick || earlier["quick"].as_bool() == Some(true) { GROWTH_QUICK } else { GROWTH };
    let mut all = Vec::new();
    for (condition, rounds) in now {
        let Some(before) = earlier["result"][condition]["rounds"].as_array() else { continue };
        let before: Vec<Ratios> = before.iter().map(Ratios::from_json).collect();
        if rounds.len() < ROUNDS_MIN || before.len() < ROUNDS_MIN {
            return Err(format!("{condition}: {} rounds then and {} now; it takes {ROUNDS_MIN} of each", before.len(), rounds.len()));
        }
        for (k, name) in RATIOS.iter().enumerate() {
            let of = |rounds: &[Ratios]| -> Vec<f64> { rounds.iter().map(|r| r.0[k]).collect() };
            all.push(one(format!("{condition}: {name}"), &of(&before), &of(rounds), growth[k % 2]));
        }
    }
    if all.is_empty() { Err("it has no condition that was measured now".into()) } else { Ok(all) }
}

/// Compares one ratio. A ratio that is no number on either side is worse only if it was one before.
fn one(what: String, before: &[f64], now: &[f64], growth: f64) -> Comparison {
    let median = |values: &[f64]| super::statistics::median(values.iter().copied());
    let (then, this) = (median(before), median(now));
    let highest = before.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let apart = now.iter().all(|v| *v > highest);
    let lost = then.is_finite() && !this.is_finite();
    Comparison { what, before: then, now: this, worse: lost || (apart && this > then * growth) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn rounds(scale: f64) -> Vec<Ratios> {
        [0.95, 1.0, 1.02, 1.05, 0.98].map(|r| Ratios([r * scale; RATIOS.len()])).to_vec()
    }

    fn earlier(scale: f64) -> Value {
        let rounds: Vec<Value> = rounds(scale).iter().map(Ratios::json).collect();
        json!({ "version": super::super::VERSION, "machine_key": "m", "quick": false, "result": { "at rest": { "rounds": rounds } } })
    }

    /// Protects a runner: the same machine and code pass, a tick that takes half as long again fails, a faster one passes.
    #[test]
    fn slower_is_worse_and_the_same_is_not() {
        let worse = |scale: f64| {
            let found = compare(&[("at rest", rounds(scale))], false, "m", &earlier(1.0)).unwrap();
            found.iter().filter(|c| c.worse).count()
        };
        assert_eq!(worse(1.0), 0);
        assert_eq!(worse(0.5), 0);
        assert_eq!(worse(1.5), RATIOS.len() / 2, "the p50 of each, not yet its p99");
        assert_eq!(worse(2.0), RATIOS.len());
    }

    /// Protects against alarms by chance: one undisturbed round among the new ones is enough to pass.
    #[test]
    fn one_good_round_is_no_alarm() {
        let mut now = rounds(3.0);
        now[2] = Ratios([1.0; RATIOS.len()]);
        let found = compare(&[("at rest", now)], false, "m", &earlier(1.0)).unwrap();
        assert!(found.iter().all(|c| !c.worse), "{found:?}");
    }

    /// Protects the comparison from files that say nothing about this machine.
    #[test]
    fn another_machine_or_form_is_an_error() {
        let now = [("at rest", rounds(1.0))];
        assert!(compare(&now, false, "another", &earlier(1.0)).is_err());
        assert!(compare(&now, false, "m", &json!({})).is_err());
        assert!(compare(&[("at rest", rounds(1.0)[..2].to_vec())], false, "m", &earlier(1.0)).is_err());
        assert!(compare(&[("under load", rounds(1.0))], false, "m", &earlier(1.0)).is_err());
    }
}
