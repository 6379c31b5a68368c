//! Work in the background that other programs of the house do: planning what to record next, learning, exporting. One at a time.
//!
//! Each job has a thread of its own that waits for its program. Allocates; only the newest job is remembered. A job that fails says why in
//! one line, and another can be started.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::{Arc, Mutex, MutexGuard};

use feature_worker::episodes::folder::{Folder, MEGABYTE};
use serde_json::{Value, json};
use shared::disk_space::{LEAST_FREE, Room, room};

use crate::lock::locked;
use crate::programs::{self, Step};

/// A job, and how far it has come.
#[derive(Debug, Clone, Default)]
struct Job {
    /// Its number; 0 before the first.
    number: u64,
    kind: &'static str,
    step: Step,
    done: bool,
    error: String,
    result: Value,
    stop: Arc<AtomicBool>,
}

/// The background's state.
#[derive(Default)]
pub struct Jobs {
    newest: Mutex<Job>,
    /// The newest plan with what it was made from.
    plan: Mutex<Value>,
}

/// What a job does: it gets something to call with its progress, and tells its result.
type Work = Box<dyn FnOnce(&AtomicBool, &mut dyn FnMut(Step)) -> Result<Value, String> + Send>;

fn words(path: &Path) -> String {
    path.display().to_string()
}

/// The words of a plan or a check. Which goals it is for, and what the vessel holds if nobody says it, is left to the command, which takes them from the
/// configuration.
fn arguments_of(command: &str, config: String, of: Vec<String>, holds_ml: Option<f64>) -> Vec<String> {
    let holds = holds_ml.iter().flat_map(|ml| ["--holds".into(), ml.to_string()]);
    [command.into(), "--json".into(), "--config".into(), config].into_iter().chain(of).chain(holds).collect()
}

/// What `trainer` calls all episodes together.
const DATA_SET: &str = "data set";

/// The names of which there still is a doubt. A weight that was corrected after it was judged is doubted no more, and then nobody has left it out.
fn standing(doubts: &[Value], mut names: Vec<String>) -> Vec<String> {
    names.retain(|name| doubts.iter().any(|d| d[0] == name.as_str()));
    names
}

/// What a person has answered to the doubts of a check.
#[derive(Debug, PartialEq)]
struct Judged {
    accept: Vec<String>,
    leave_out: Vec<String>,
    /// Doubts without an answer.
    open: Vec<Value>,
    /// What is only said of all episodes together.
    remarks: Vec<Value>,
}

/// Holds what a person has answered against what `check` doubts. All episodes together are a question where they would be refused; they cannot be left out.
fn judge(check: &Value, accept: Vec<String>, leave_out: Vec<String>) -> Judged {
    let list = |key: &str| check[key].as_array().cloned().unwrap_or_default();
    let (of_set, questions): (Vec<Value>, Vec<Value>) = list("doubts").into_iter().partition(|d| d[0] == DATA_SET);
    let refused: Vec<Value> = list("refused").into_iter().filter(|d| d[0] == DATA_SET).collect();
    let asked = [refused, questions.clone()].concat();
    let (accept, leave_out) = (standing(&asked, accept), standing(&questions, leave_out));
    let judged = |d: &Value| accept.iter().chain(&leave_out).any(|name| d[0] == name.as_str());
    let open = asked.iter().filter(|d| !judged(d)).cloned().collect();
    let remarks = of_set.iter().map(|d| d[1].clone()).collect();
    Judged { accept, leave_out, open, remarks }
}

/// Whether a disk with this `room` may take an export of episodes of `bytes`. Nobody deletes old exports, which lie beside the episodes in `beside`, and what
/// they leave free is for episodes, journal and weights. An export is about as large as what it is made of.
fn may_take(bytes: u64, room: Option<Room>, beside: &Path) -> Result<(), String> {
    let short = |room: &Room| room.bytes < bytes.saturating_add(LEAST_FREE) || room.lacks_files();
    match room.filter(short) {
        None => Ok(()),
        Some(Room { bytes: free, .. }) => Err(format!(
            "the disk has {} MB free, and the export of {} MB would leave too little for episodes, journal and weights: delete old exports in {}",
            free / MEGABYTE,
            bytes.div_ceil(MEGABYTE),
            beside.display()
        )),
    }
}

impl Jobs {
    fn newest(&self) -> MutexGuard<'_, Job> {
        locked(&self.newest)
    }

    /// The newest job as the page shows it.
    pub fn about(&self) -> Value {
        let job = self.newest();
        json!({ "number": job.number, "kind": job.kind, "stage": job.step.stage, "step": job.step.step, "steps": job.step.steps,
            "note": job.step.note, "done": job.done, "error": job.error, "result": job.result })
    }

    /// The newest plan; null before the first.
    pub fn plan(&self) -> Value {
        locked(&self.plan).clone()
    }

    /// Cancels the job under way.
    pub fn cancel(&self) {
        self.newest().stop.store(true, Relaxed);
    }

    fn start(self: &Arc<Self>, kind: &'static str, work: Work) -> Result<(), String> {
        let mut job = self.newest();
        if job.number > 0 && !job.done {
            return Err(format!("another job is under way ({}): wait for it, or cancel it", job.kind));
        }
        let number = job.number + 1;
        *job = Job { number, kind, ..Job::default() };
        let stop = Arc::clone(&job.stop);
        drop(job);
        let this = Arc::clone(self);
        let run = move || {
            let result = work(&stop, &mut |step| this.newest().step = step);
            let mut job = this.newest();
            if kind == "plan"
                && let Ok(plan) = &result
            {
                *locked(&this.plan) = plan.clone();
            }
            match result {
                Ok(result) => job.result = result,
                Err(e) => job.error = e,
            }
            job.done = true;
        };
        std::thread::Builder::new().name("job".into()).spawn(run).map(drop).map_err(|e| {
            self.newest().done = true;
            e.to_string()
        })
    }

    /// Plans what to record next from `of`, of which `weighed` are weighed episodes: what is missing, and the best curve or pour.
    pub fn start_plan(self: &Arc<Self>, (of, weighed): (&[PathBuf], usize), config: &Path, holds_ml: Option<f64>) -> Result<(), String> {
        let config = words(config);
        let of: Vec<String> = of.iter().map(|f| words(f)).collect();
        self.start(
            "plan",
            Box::new(move |stop, step| {
                let mut check = Value::Null;
                if weighed > 0 {
                    step(Step { stage: "looking at the episodes".into(), ..Step::default() });
                    check = programs::run("trainer", &arguments_of("check", config.clone(), of.clone(), holds_ml), stop, |_| {})?.0;
                }
                step(Step { stage: "planning".into(), ..Step::default() });
                let plan = programs::run("trainer", &arguments_of("plan", config, of, holds_ml), stop, |_| {})?.0;
                Ok(json!({ "plan": plan["plan"], "check": check, "episodes": weighed }))
            }),
        )
    }

    /// Learns from `files`, and writes the weights to `out`. `accept` and `leave_out` are the doubts that a person has judged, by their names; if
    /// there are others, nothing is learned and they are told.
    pub fn start_learning(
        self: &Arc<Self>,
        files: &[PathBuf],
        accept: Vec<String>,
        leave_out: Vec<String>,
        out: &Path,
        config: &Path,
    ) -> Result<(), String> {
        if files.is_empty() {
            return Err("no episode has been weighed yet: record a curve and weigh it first".into());
        }
        let (out, config) = (words(out), words(config));
        let files: Vec<String> = files.iter().map(|f| words(f)).collect();
        self.start(
            "learn",
            Box::new(move |stop, step| {
                step(Step { stage: "looking at the episodes".into(), ..Step::default() });
                let check =
                    |of: &[String]| programs::run("trainer", &arguments_of("check", config.clone(), of.to_vec(), None), stop, |_| {});
                let mut judged = judge(&check(&files)?.0, accept.clone(), leave_out);
                let rest: Vec<String> = files.iter().filter(|file| !judged.leave_out.contains(file)).cloned().collect();
                if !rest.is_empty() && rest.len() < files.len() {
                    // Without those that are left out, others may be doubtful, and all together may be refused, or no longer.
                    judged = Judged { leave_out: judged.leave_out, ..judge(&check(&rest)?.0, accept, Vec::new()) };
                }
                let Judged { accept, leave_out, open, remarks } = judged;
                if !open.is_empty() {
                    return Ok(json!({ "doubts": open }));
                }
                let mut arguments = [vec!["refine".into(), "--json".into(), "--progress".into()], files.clone()].concat();
                arguments.extend(["--config".into(), config, "--out".into(), out]);
                arguments.extend(accept.iter().map(|name| format!("--accept={name}")));
                arguments.extend(leave_out.iter().map(|name| format!("--leave-out={name}")));
                let (report, _) = programs::run("trainer", &arguments, stop, step)?;
                let learned = report["episodes"].as_array().map_or(0, Vec::len);
                let mut left_out = report["left_out"].as_array().cloned().unwrap_or_default();
                left_out.extend(leave_out.iter().map(|name| json!([name, "you have answered so"])));
                Ok(json!({ "identity": report["identity"], "episodes": learned, "left_out": left_out, "remarks": remarks }))
            }),
        )
    }

    /// Exports `files` in the format `kind` into the new directory `to`.
    pub fn start_export(self: &Arc<Self>, files: &[PathBuf], kind: &'static str, to: PathBuf) -> Result<(), String> {
        if files.is_empty() {
            return Err("there is nothing to export".into());
        }
        let beside = to.parent().unwrap_or(&to);
        may_take(Folder::of(files.iter().map(PathBuf::as_path)).bytes, room(beside), beside)?;
        let files: Vec<String> = files.iter().map(|f| words(f)).collect();
        self.start(
            "export",
            Box::new(move |stop, step| {
                step(Step { stage: format!("writing {kind}"), ..Step::default() });
                let mut arguments: Vec<String> = vec!["episodes".into(), "export".into(), "--json".into(), "--as".into(), kind.into()];
                arguments.extend(["--to".into(), words(&to)]);
                arguments.extend(files);
                // What cannot be exported is left out and named, and the rest is there; if there is no rest, the program's line says why.
                let (written, _) = programs::run("feature-worker", &arguments, stop, |_| {})?;
                Ok(json!({ "directory": words(&to), "written": written["written"], "left_out": written["left_out"] }))
            }),
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects pours from exports, which nobody deletes: one that would leave less room than episodes need is refused, and the line says where the old ones
    /// lie. A disk that does not say its room refuses nothing.
    #[test]
    fn an_export_leaves_room_for_episodes() {
        let may = |bytes, room| may_take(bytes, room, Path::new("/lab/episodes/exports"));
        let room = |megabytes: u64, files| Some(Room { bytes: megabytes * MEGABYTE, files });
        assert_eq!(may(900 * MEGABYTE, room(1000, u64::MAX)), Ok(()));
        assert_eq!(may(900 * MEGABYTE, None), Ok(()));
        let refused = may(950 * MEGABYTE, room(1000, u64::MAX)).unwrap_err();
        assert!(
            refused.contains("the disk has 1000 MB free, and the export of 950 MB") && refused.contains("/lab/episodes/exports"),
            "{refused}"
        );
        assert!(may(1, room(1000, 3)).is_err(), "no more files");
    }

    /// Protects whoever corrects a weight that was doubted: the answer from before leaves the episode out no more.
    #[test]
    fn an_answer_counts_while_its_doubt_stands() {
        let doubts = [json!(["b.mcap", "odd"]), json!(["data set", "few"])];
        assert_eq!(standing(&doubts, vec!["a.mcap".into(), "b.mcap".into()]), ["b.mcap"]);
    }

    /// Protects a new cell's first training from ending where nobody can answer: what would be refused of all episodes together is asked, once it is
    /// accepted that is passed on while it stands, it cannot be left out, and what is only said of them is no question.
    #[test]
    fn what_would_be_refused_of_the_set_is_asked() {
        let [few, kilograms, odd] = [["data set", "few"], ["data set", "in grams?"], ["b.mcap", "odd"]].map(|d| json!(d));
        let refusing = json!({ "doubts": [odd, kilograms, few], "refused": [kilograms] });
        let names = |names: &[&str]| names.iter().map(|n| (*n).to_owned()).collect::<Vec<_>>();
        let set = names(&["data set"]);
        let unanswered = judge(&refusing, Vec::new(), set.clone());
        assert_eq!((unanswered.open, unanswered.leave_out), (vec![kilograms.clone(), odd.clone()], Vec::new()));
        let answered = judge(&refusing, set.clone(), names(&["b.mcap"]));
        let remarks = vec![json!("in grams?"), json!("few")];
        assert_eq!(answered, Judged { accept: set.clone(), leave_out: names(&["b.mcap"]), open: Vec::new(), remarks });
        let said = judge(&json!({ "doubts": [few], "refused": [] }), set, Vec::new());
        assert_eq!(said, Judged { accept: Vec::new(), leave_out: Vec::new(), open: Vec::new(), remarks: vec![json!("few")] });
    }

    /// Protects who plans on the page from another proposal than that of the command line: both take the largest goal from the configuration, which may
    /// be far beyond a cup.
    #[test]
    fn a_plan_is_for_the_goals_of_the_command() {
        let words = arguments_of("plan", "cell.toml".into(), vec!["a.mcap".into()], Some(500.0));
        assert_eq!(words, ["plan", "--json", "--config", "cell.toml", "a.mcap", "--holds", "500"]);
    }
}
