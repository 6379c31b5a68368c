//! The weight files: the one that the controller watches, the one that was just learned and is offered, and those from before.
//!
//! Ordinary threads use it; it allocates, and reads and writes files. A file is exchanged in one step, so the controller reads the old one or
//! the new one, and takes it between two pours. Nothing is deleted but an offer that is declined. Every failure is a line that names the file.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::SystemTime;

use rt_controller::foreseen;
use serde_json::{Value, json};
use shared::limits::Limits;
use shared::weights::{Estimator, Weights};

/// Goals for which the expected error is said, ml, as far as the cell allows them.
const GOALS_ML: [f32; 4] = [25.0, 50.0, 100.0, 200.0];
/// Number of files of which the expected errors are remembered. Chosen by hand; no measurement is recorded.
const REMEMBERED: usize = 16;

/// The weight files of one cell.
pub struct Shelf {
    weights: PathBuf,
    limits: Limits,
    goal_max_ml: f32,
    expected: Mutex<BTreeMap<String, Value>>,
}

/// `path` with `ending` behind its name.
fn beside(path: &Path, ending: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(ending);
    name.into()
}

fn fault(path: &Path) -> impl Fn(std::io::Error) -> String + '_ {
    move |e| format!("{}: {e}", path.display())
}

impl Shelf {
    /// The files around `weights`.
    pub fn new(weights: PathBuf, limits: Limits, goal_max_ml: f32) -> Self {
        Self { weights, limits, goal_max_ml, expected: Mutex::default() }
    }

    /// Where a training writes what it offers.
    pub fn offer(&self) -> PathBuf {
        beside(&self.weights, ".offer")
    }

    /// Where files from before lie.
    fn kept(&self) -> PathBuf {
        beside(&self.weights, ".kept")
    }

    /// The file that one click goes back to, if there is one.
    fn before(&self) -> Option<PathBuf> {
        let name = fs::read_to_string(self.kept().join("before")).ok()?;
        let name = name.trim();
        let plain = name.bytes().all(|b| b.is_ascii_hexdigit()) && !name.is_empty();
        plain.then(|| self.kept().join(format!("{name}.bin"))).filter(|file| file.exists())
    }

    /// The weights in use, offered and from before, as the page shows them. A file that is there and cannot be read says why.
    pub fn about(&self) -> Value {
        let of = |path: Option<PathBuf>| path.filter(|p| p.exists()).map_or(Value::Null, |p| self.one(&p));
        json!({ "now": of(Some(self.weights.clone())), "offer": of(Some(self.offer())), "before": of(self.before()) })
    }

    fn one(&self, path: &Path) -> Value {
        let weights = match Weights::read(path) {
            Ok(weights) => weights,
            Err(e) => return json!({ "error": e.to_string() }),
        };
        let age = fs::metadata(path).ok().and_then(|m| m.modified().ok()).and_then(|at| SystemTime::now().duration_since(at).ok());
        json!({
            "identity": weights.identity(),
            "episodes": weights.origin.episodes,
            "method": format!("{:?}", weights.origin.method).to_lowercase(),
            "fused": matches!(weights.estimator, Estimator::Fused { .. }),
            "age_s": age.map(|a| a.as_secs()),
            "expected": self.expected(&weights),
        })
    }

    /// The deviation with which pours are expected to end, for some goals. `null` where the weights do not tell.
    fn expected(&self, weights: &Weights) -> Value {
        let identity = weights.identity();
        let mut known = self.expected.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(found) = known.get(&identity) {
            return found.clone();
        }
        let goals = GOALS_ML.into_iter().filter(|goal| *goal <= self.goal_max_ml);
        let one = |goal: f32| json!({ "goal_ml": goal, "sd_ml": foreseen::poured_sd_ml(weights, self.limits, goal) });
        let value = Value::Array(goals.map(one).collect());
        if known.len() >= REMEMBERED {
            known.clear();
        }
        known.insert(identity, value.clone());
        value
    }

    /// Takes the offer into use, and keeps the file that was in use.
    pub fn accept(&self) -> Result<String, String> {
        let offer = self.offer();
        let identity = self.exchange(&offer)?;
        fs::remove_file(&offer).map_err(fault(&offer))?;
        self.decline_report();
        Ok(identity)
    }

    /// Goes back to the file from before; the one that was in use is then the one from before.
    pub fn back(&self) -> Result<String, String> {
        let before = self.before().ok_or("there are no weights from before")?;
        self.exchange(&before)
    }

    /// Deletes the offer.
    pub fn decline(&self) -> Result<(), String> {
        let offer = self.offer();
        fs::remove_file(&offer).map_err(fault(&offer))?;
        self.decline_report();
        Ok(())
    }

    fn decline_report(&self) {
        // It is only there beside a training of this build.
        let _ = fs::remove_file(beside(&self.offer(), ".json"));
    }

    /// Puts `new` where the controller watches, and keeps what was there.
    fn exchange(&self, new: &Path) -> Result<String, String> {
        let identity = Weights::read(new).map_err(|e| e.to_string())?.identity();
        let kept = self.kept();
        fs::create_dir_all(&kept).map_err(fault(&kept))?;
        let keep = |path: &Path| -> Result<String, String> {
            let identity = Weights::read(path).map_err(|e| e.to_string())?.identity();
            copy(path, &kept.join(format!("{identity}.bin")))?;
            Ok(identity)
        };
        keep(new)?;
        // Without a readable file in use there is nothing to go back to.
        if let Ok(old) = keep(&self.weights)
            && old != identity
        {
            let file = kept.join("before");
            fs::write(&file, format!("{old}\n")).map_err(fault(&file))?;
        }
        copy(new, &self.weights)?;
        Ok(identity)
    }
}

/// Copies a file in one step, with its time.
fn copy(from: &Path, to: &Path) -> Result<(), String> {
    let partial = beside(to, ".partial");
    fs::copy(from, &partial).map_err(fault(&partial))?;
    if let Ok(at) = fs::metadata(from).and_then(|m| m.modified()) {
        // Without its time a file only looks younger than it is.
        let _ = fs::File::options().append(true).open(&partial).and_then(|f| f.set_modified(at));
    }
    fs::rename(&partial, to).map_err(fault(to))
}

#[cfg(test)]
mod tests {
    use shared::actions::{Selection, action_table};
    use shared::estimator::Calibration;
    use shared::mlp::{InputScale, Mlp};
    use shared::weights::{Method, Origin};

    use super::*;

    fn weights(seed: u64) -> Weights {
        Weights {
            network: Mlp::ZERO,
            actions_deg: action_table(),
            selection: Selection::Argmax,
            scale: InputScale::default(),
            calibration: Calibration { volume_at_1_px2_ml: 0.0002, area_exponent: 1.0, log_tilt_slope: 0.0, hold_above_px2: f32::INFINITY },
            estimator: Estimator::Sum,
            rate_hz: 30.0,
            origin: Origin { method: Method::Handmade, actions: 21, episodes: 5, data_sha256: [1; 32] },
            seed,
        }
    }

    /// Protects the operator's way back: an offer is taken into use in one click, the old file comes back in one more, and nothing is lost.
    #[test]
    fn an_offer_is_taken_and_given_back() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("weights.bin");
        let shelf = Shelf::new(file.clone(), Limits::default(), 120.0);
        assert!(shelf.back().is_err() && shelf.accept().is_err());
        weights(1).write(&file).unwrap();
        weights(2).write(&shelf.offer()).unwrap();
        let now = || Weights::read(&file).unwrap().seed;
        shelf.accept().unwrap();
        assert_eq!((now(), shelf.about()["offer"].is_null()), (2, true));
        shelf.back().unwrap();
        assert_eq!(now(), 1);
        shelf.back().unwrap();
        assert_eq!(now(), 2);
        fs::write(shelf.offer(), "no weights").unwrap();
        assert!(shelf.about()["offer"]["error"].is_string());
        assert!(shelf.accept().is_err());
        assert_eq!(now(), 2, "a file that is no weight file is not taken");
        shelf.decline().unwrap();
        assert!(shelf.about()["offer"].is_null());
    }
}
