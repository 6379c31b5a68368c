//! The weight files: the one that the controller watches, the one that was just learned and is offered, and those from before.
//!
//! Ordinary threads use it; it allocates, and reads and writes files. A file is exchanged in one step, so the controller reads the old one or
//! the new one, and takes it between two pours. Exchanges wait for each other at a lock file, and each says which weights a person was shown:
//! if they are others by now, nothing happens. Nothing is deleted but an offer that is declined. Every failure is a line that names the file.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::Write as _;
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::time::{Duration, Instant, SystemTime};

use rt_controller::core::Settings;
use rt_controller::{disk, foreseen};
use serde_json::{Value, json};
use shared::config::Config;
use shared::disk_space::error_words;
use shared::regular_file;
use shared::weights::{Estimator, Weights};

use crate::lock::locked;

/// Goals for which the expected error is said, ml, as far as the cell allows them.
const GOALS_ML: [f32; 4] = [25.0, 50.0, 100.0, 200.0];
/// Number of files of which the expected errors are remembered. Chosen by hand; no measurement is recorded.
const REMEMBERED: usize = 16;
/// Longest wait for another exchange. Chosen by hand: one takes milliseconds.
const TURN: Duration = Duration::from_secs(5);
/// Largest file `before`, bytes. Chosen by hand: 16 digits and a line's end.
const NAME_MAX: u64 = 64;
/// What a page is told that shows an older state of the files.
const OTHERS: &str = "the weight files have changed since this was shown: look at what is there now, and choose again";

/// The weight files of one cell.
pub struct Shelf {
    weights: PathBuf,
    settings: Settings,
    /// Frames a second of the camera.
    fps: f64,
    expected: Mutex<BTreeMap<String, Value>>,
}

/// `path` with `ending` behind its name.
fn beside(path: &Path, ending: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(ending);
    name.into()
}

fn fault(path: &Path) -> impl Fn(std::io::Error) -> String + '_ {
    move |e| format!("{}: {}", path.display(), error_words(&e))
}

impl Shelf {
    /// The files around the configured weights.
    pub fn new(config: &Config) -> Self {
        Self {
            weights: config.controller.weights.clone(),
            settings: Settings::new(config),
            fps: config.camera.fps,
            expected: Mutex::default(),
        }
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
        let name = regular_file::read_text(&self.kept().join("before"), NAME_MAX).ok()?;
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
        let mut known = locked(&self.expected);
        if let Some(found) = known.get(&identity) {
            return found.clone();
        }
        let goals = GOALS_ML.into_iter().filter(|goal| *goal <= self.settings.goal_max_ml);
        let one = |goal: f32| json!({ "goal_ml": goal, "sd_ml": foreseen::expected(weights, &self.settings, goal).sd_ml() });
        let value = Value::Array(goals.map(one).collect());
        if known.len() >= REMEMBERED {
            known.clear();
        }
        known.insert(identity, value.clone());
        value
    }

    /// Takes the offer `shown` into use, and keeps the file that was in use.
    pub fn accept(&self, shown: &str) -> Result<String, String> {
        let _turn = self.turn()?;
        let offer = self.offer();
        let identity = self.exchange(&offer, shown)?;
        // A training may have written another offer since.
        if Weights::read(&offer).is_ok_and(|w| w.identity() == identity) {
            fs::remove_file(&offer).map_err(fault(&offer))?;
            self.decline_report();
        }
        Ok(identity)
    }

    /// Goes back to the file from before, `shown`; the one that was in use is then the one from before.
    pub fn back(&self, shown: &str) -> Result<String, String> {
        let _turn = self.turn()?;
        let before = self.before().ok_or("there are no weights from before")?;
        self.exchange(&before, shown)
    }

    /// Deletes the offer `shown`; of an offer that cannot be read nothing is shown.
    pub fn decline(&self, shown: &str) -> Result<(), String> {
        let _turn = self.turn()?;
        let offer = self.offer();
        match Weights::read(&offer) {
            Ok(weights) if weights.identity() != shown => return Err(OTHERS.into()),
            Err(_) if !shown.is_empty() && offer.exists() => return Err(OTHERS.into()),
            _ => {}
        }
        fs::remove_file(&offer).map_err(fault(&offer))?;
        self.decline_report();
        Ok(())
    }

    fn decline_report(&self) {
        // It is only there beside a training of this build.
        let _ = fs::remove_file(beside(&self.offer(), ".json"));
    }

    /// One exchange at a time, of all pages of this cell.
    fn turn(&self) -> Result<File, String> {
        let kept = self.kept();
        fs::create_dir_all(&kept).map_err(fault(&kept))?;
        let path = kept.join("lock");
        let file = File::options().create(true).append(true).mode(0o600).open(&path).map_err(fault(&path))?;
        let until = Instant::now() + TURN;
        while file.try_lock().is_err() {
            if Instant::now() > until {
                return Err(format!("{}: another page exchanges weights and does not end: end that page's program", path.display()));
            }
            std::thread::sleep(TURN / 1000);
        }
        Ok(file)
    }

    /// Puts `new` where the controller watches, if it is what was `shown`, and keeps what was there.
    fn exchange(&self, new: &Path, shown: &str) -> Result<String, String> {
        let taken = Taken::read(new)?;
        if taken.identity != shown {
            return Err(OTHERS.into());
        }
        // What is there is replaced only if it is a weight file, also one that is damaged.
        Weights::may_write(&self.weights).map_err(|e| e.to_string())?;
        // What the controller refuses would look as if it were in use.
        disk::check_weights(&taken.weights, self.fps, &self.settings.limits)?;
        let kept = self.kept();
        taken.put(&kept.join(format!("{shown}.bin")))?;
        // Without a readable file in use there is nothing to go back to.
        if let Ok(old) = Taken::read(&self.weights)
            && old.identity != taken.identity
        {
            old.put(&kept.join(format!("{}.bin", old.identity)))?;
            put(format!("{}\n", old.identity).as_bytes(), None, &kept.join("before"))?;
        }
        taken.put(&self.weights)?;
        Ok(taken.identity)
    }
}

/// A weight file as it was read: what is checked is what is put somewhere else.
struct Taken {
    weights: Weights,
    identity: String,
    bytes: Vec<u8>,
    modified: Option<SystemTime>,
}

impl Taken {
    fn read(path: &Path) -> Result<Self, String> {
        let modified = fs::metadata(path).and_then(|m| m.modified()).ok();
        let weights = Weights::read(path).map_err(|e| e.to_string())?;
        let bytes = weights.to_bytes().map_err(|e| e.to_string())?;
        Ok(Self { identity: weights.identity(), weights, bytes, modified })
    }

    fn put(&self, to: &Path) -> Result<(), String> {
        put(&self.bytes, self.modified, to)
    }
}

/// Writes a file in one step, with its time. Only whoever has the turn does it, so that one name for what is not whole yet is enough.
fn put(bytes: &[u8], modified: Option<SystemTime>, to: &Path) -> Result<(), String> {
    let partial = beside(to, &format!(".{}.partial", std::process::id()));
    let write = || {
        let mut file = File::create(&partial)?;
        file.write_all(bytes)?;
        // Without its time a file only looks younger than it is.
        let _ = modified.map(|at| file.set_modified(at));
        file.sync_all()?;
        fs::rename(&partial, to)
    };
    write().map_err(|e| {
        // Nobody needs what is not whole, and it does no harm if it cannot be removed.
        let _ = fs::remove_file(&partial);
        fault(to)(e)
    })
}

#[cfg(test)]
mod tests {
    use shared::actions::{Selection, action_table};
    use shared::estimator::Calibration;
    use shared::framing::Framing;
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
            origin: Origin { method: Method::Handmade, actions: 21, episodes: 5, data_sha256: [1; 32], framing: Framing::default() },
            seed,
        }
    }

    /// The files around the weights `file` of a cell with the default limits.
    fn shelf(file: &Path) -> Shelf {
        let mut config = Config::parse(include_str!("../../config/sim.toml"), "sim.toml").unwrap();
        (config.controller.weights, config.controller.goal_max_ml) = (file.to_owned(), 120.0);
        config.limits = shared::limits::Limits::default();
        Shelf::new(&config)
    }

    /// Protects the operator's way back: an offer is taken into use in one click, the old file comes back in one more, and nothing is lost.
    #[test]
    fn an_offer_is_taken_and_given_back() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("weights.bin");
        let shelf = shelf(&file);
        let (one, two) = (weights(1).identity(), weights(2).identity());
        assert!(shelf.back(&one).is_err() && shelf.accept(&two).is_err());
        weights(1).write(&file).unwrap();
        weights(2).write(&shelf.offer()).unwrap();
        let now = || Weights::read(&file).unwrap().seed;
        shelf.accept(&two).unwrap();
        assert_eq!((now(), shelf.about()["offer"].is_null()), (2, true));
        shelf.back(&one).unwrap();
        assert_eq!(now(), 1);
        shelf.back(&two).unwrap();
        assert_eq!(now(), 2);
        fs::write(shelf.offer(), "no weights").unwrap();
        assert!(shelf.about()["offer"]["error"].is_string());
        assert!(shelf.accept("").is_err());
        assert_eq!(now(), 2, "a file that is no weight file is not taken");
        shelf.decline("").unwrap();
        assert!(shelf.about()["offer"].is_null());
    }

    /// Protects people from a page that is old: what it shows is exchanged or nothing is, also when another offer has come since.
    #[test]
    fn a_stale_page_exchanges_nothing() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("weights.bin");
        let shelf = shelf(&file);
        weights(1).write(&file).unwrap();
        weights(3).write(&shelf.offer()).unwrap();
        let (one, two) = (weights(1).identity(), weights(2).identity());
        for shown in [two.as_str(), ""] {
            assert!(shelf.accept(shown).unwrap_err().contains("choose again") && shelf.decline(shown).is_err());
        }
        assert_eq!((Weights::read(&file).unwrap().seed, shelf.offer().exists()), (1, true));
        shelf.accept(&weights(3).identity()).unwrap();
        assert!(shelf.back(&two).is_err());
        shelf.back(&one).unwrap();
    }

    /// Protects the cell from weights that the page says are in use and the controller refuses: they are refused here already, in its words.
    #[test]
    fn what_the_controller_refuses_is_not_put_into_use() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("weights.bin");
        let shelf = shelf(&file);
        weights(1).write(&file).unwrap();
        let fast = Weights { rate_hz: 60.0, ..weights(2) };
        fast.write(&shelf.offer()).unwrap();
        assert!(shelf.accept(&fast.identity()).unwrap_err().contains("trained at 60 frames/s, camera.fps is 30"));
        assert_eq!(Weights::read(&file).unwrap().seed, 1);
    }

    /// Protects a file that `controller.weights` names by mistake: what is no weight file is left as it is.
    #[test]
    fn a_file_of_another_kind_is_not_replaced() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("notes.txt");
        let shelf = shelf(&file);
        fs::write(&file, "my notes").unwrap();
        weights(1).write(&shelf.offer()).unwrap();
        assert!(shelf.accept(&weights(1).identity()).unwrap_err().contains("another kind"));
        assert_eq!(fs::read_to_string(&file).unwrap(), "my notes");
    }

    /// Protects the one way back from two people who click at the same time: of many exchanges at once, some in another process's place, each
    /// ends whole, and the file in use and the one from before are the two that there are.
    #[test]
    fn exchanges_wait_for_each_other() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("weights.bin");
        let shelves: Vec<Shelf> = (0..4).map(|_| shelf(&file)).collect();
        weights(1).write(&file).unwrap();
        weights(2).write(&shelves[0].offer()).unwrap();
        let (one, two) = (weights(1).identity(), weights(2).identity());
        shelves[0].accept(&two).unwrap();
        let exchanged: usize = std::thread::scope(|scope| {
            let run = |shelf: &Shelf| (0..12).filter(|k| shelf.back(if k % 2 == 0 { &one } else { &two }).is_ok()).count();
            let threads: Vec<_> = shelves.iter().map(|shelf| scope.spawn(move || run(shelf))).collect();
            threads.into_iter().map(|t| t.join().unwrap()).sum()
        });
        let about = shelves[0].about();
        let (now, before) = (about["now"]["identity"].as_str().unwrap(), about["before"]["identity"].as_str().unwrap());
        // Each exchange that happened has swapped the two.
        assert_eq!((now, before), if exchanged.is_multiple_of(2) { (two.as_str(), one.as_str()) } else { (one.as_str(), two.as_str()) });
        let left = fs::read_dir(dir.path()).unwrap().flatten().filter(|f| f.file_name().to_string_lossy().contains("partial")).count();
        assert_eq!(left, 0);
    }
}
