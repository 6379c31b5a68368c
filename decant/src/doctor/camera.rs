//! The camera that the configuration names: whether it can be opened, and gives pictures of that size and rate; and whether the worker runs that measures
//! in them.
//!
//! Called once by an ordinary thread; allocates; nothing fails. A camera that streams is not disturbed, and a cell that does not run is not joined.

use std::path::Path;

use feature_worker::source::{controls, devices};
use rt_controller::stop_client;
use shared::config::{CameraConfig, CameraSource, Config};
use shared::ipc::{IpcError, Publishers, publishers};
use shared::machine::Finding;
use shared::runtime_dir::Place;

/// What to do where a cell cannot be joined: its shared memory is private to its user (ARCHITECTURE.md).
const OWN_USER: &str = "run this as the cell's own user, and see what is red";
/// What there is to do about a cell that may be stopped.
const START_OR_USER: &str = "start the cell and the program that publishes its camera's frames, or run this as the cell's own user";
/// What is said of a cell that is stopped, or runs where this process cannot see it.
const UNSEEN: &str = "no program of the cell is seen to run";

/// Who publishes in the cell, if it runs.
type Published = Result<Option<Publishers>, IpcError>;

/// Looks at the camera and the worker.
pub fn look(config: &Config) -> Vec<Finding> {
    let published = publishers(&config.cell);
    let mut findings = source(&config.camera, &published);
    let controlled = matches!(stop_client::running_at(&Place::from(&config.cell)), Ok(Some(_)));
    findings.push(worker(&published, controlled));
    findings
}

/// Whether there are pictures.
fn source(camera: &CameraConfig, published: &Published) -> Vec<Finding> {
    match camera.source {
        CameraSource::Device => device(camera),
        CameraSource::SharedMemory => vec![frames(published)],
        CameraSource::Video | CameraSource::Images => {
            let pattern = camera.path.contains('%');
            let there = Path::new(&camera.path);
            let there = if pattern { there.parent().unwrap_or(there) } else { there };
            if there.exists() {
                vec![Finding::yellow(
                    "source",
                    camera.path.clone(),
                    "recorded pictures are no camera: nothing can be poured by them",
                    "set camera.source to \"device\"",
                )]
            } else {
                vec![Finding::red("source", format!("{}: no such file", camera.path), "there are no pictures", "set camera.path")]
            }
        }
    }
}

/// Whether another program publishes the frames that the worker reads.
fn frames(published: &Published) -> Finding {
    let (means, advice) = ("there are no pictures", "start the program that publishes the camera's frames in this cell");
    match published {
        Ok(Some(Publishers { frames: true, .. })) => Finding::green("source", "another program publishes the frames in shared memory"),
        Ok(Some(_)) => Finding::red("source", "no program publishes frames in shared memory", means, advice),
        // It may be stopped, or run where this process cannot see its lock: as another user, or in another container.
        Ok(None) => Finding::yellow("source", UNSEEN, "whether a program publishes frames in shared memory is not known", START_OR_USER),
        Err(e) => Finding::yellow("source", e.to_string(), "whether a program publishes frames is not known", OWN_USER),
    }
}

/// Whether a feature worker runs. Without a controller (`controlled`) nobody waits for one.
fn worker(published: &Published, controlled: bool) -> Finding {
    match published {
        Ok(Some(Publishers { features: true, .. })) => Finding::green("worker", "a feature worker runs"),
        Ok(None) if controlled => Finding::yellow("worker", UNSEEN, "whether a feature worker runs is not known", OWN_USER),
        Ok(None) => Finding::green("worker", UNSEEN),
        Ok(_) if controlled => {
            let means = "the controller gets no measurements, and refuses every pour and recording";
            Finding::red("worker", "no feature worker runs", means, "start it: `feature-worker run`, or decant-feature-worker@CELL")
        }
        Ok(_) => Finding::green("worker", "none runs"),
        Err(e) => Finding::yellow("worker", e.to_string(), "whether a feature worker runs is not known", OWN_USER),
    }
}

fn device(camera: &CameraConfig) -> Vec<Finding> {
    let path = Path::new(&camera.path);
    let file = match devices::open(path) {
        Ok(file) => file,
        Err(e) => {
            return vec![Finding::red(
                "device",
                e.to_string(),
                "there are no pictures",
                "`decant camera` lists the cameras of this machine",
            )];
        }
    };
    let node = std::fs::canonicalize(path).unwrap_or_else(|_| path.into());
    let found = devices::list(Path::new("/")).into_iter().find(|d| d.path == node);
    let Some(mut found) = found else {
        return vec![Finding::yellow("device", camera.path.clone(), "the kernel does not list it", "`decant camera` lists what it knows")];
    };
    found.ask();
    let mut findings = vec![Finding::green("device", format!("{} ({})", camera.path, found.card))];
    if !camera.path.contains("/by-") {
        let name = found.names.first().map_or("/dev/v4l/by-id/...".into(), |n| n.display().to_string());
        let advice = format!("set camera.path to {name}");
        findings.push(Finding::yellow("name", camera.path.clone(), "node numbers change when another camera is plugged in", advice));
    }
    let users = found.users.join(", ");
    // Whoever has it open need not stream from it. What other users run is not seen: it may be the worker.
    let worker = found.users.iter().any(|user| user.starts_with("feature-worker "));
    if !users.is_empty() && !worker && devices::is_taken(&file) {
        findings.push(Finding::yellow("used by", users, "it reads pictures, so the worker cannot", "end that program"));
    } else if !users.is_empty() {
        findings.push(Finding::green("used by", users));
    }
    findings.push(format(camera, &found.formats));
    findings.push(settings(&controls::compare(&file, camera), !found.users.is_empty()));
    let automatic = [("exposure_ms", camera.exposure_ms.is_none()), ("white_balance_k", camera.white_balance_k.is_none())];
    let left: Vec<&str> = automatic.iter().filter(|(_, left)| *left).map(|(name, _)| *name).collect();
    if !left.is_empty() {
        let is = format!("camera.{} not set", left.join(", camera."));
        let advice = "set them, or \"locked\" (docs/VISION.md)";
        findings.push(Finding::yellow("automatics", is, "colours and brightness may change during a pour", advice));
    }
    findings
}

/// Whether the camera's controls are the configured ones; `differ` says where not. The worker sets them when it starts, so before that they may differ.
fn settings(differ: &[String], used: bool) -> Finding {
    if differ.is_empty() {
        return Finding::green("controls", "as configured");
    }
    let is = differ.join("; ");
    if used {
        let means = "pictures are not as configured, so colours and edges may not be found";
        Finding::yellow("controls", is, means, "restart the worker, which sets them, and let no other program change them")
    } else {
        Finding::green("controls", format!("the worker sets them when it starts: {is}"))
    }
}

/// Whether one of the device's formats, a line each, has the size and rate.
fn format(camera: &CameraConfig, formats: &[String]) -> Finding {
    let size = format!(" {} x {}: ", camera.width_px, camera.height_px);
    let wanted = format!("{} x {} at {} Hz", camera.width_px, camera.height_px, camera.fps);
    let lists = formats.iter().filter(|f| f.contains(" x ")).count();
    let of_size: Vec<&String> = formats.iter().filter(|f| f.contains(&size)).collect();
    let has_rate = |line: &&String| {
        let rates = line.split(": ").nth(1).unwrap_or_default();
        let rates = rates.split(" (").next().unwrap_or_default();
        rates.split([',']).any(|r| match r.split_once(" to ") {
            Some((least, most)) => {
                least.trim().parse().is_ok_and(|l: f64| l <= camera.fps) && most.trim().parse().is_ok_and(|m: f64| camera.fps <= m)
            }
            None => r.trim().parse().is_ok_and(|r: f64| (r / camera.fps - 1.0).abs() < 0.01),
        })
    };
    let advice = "`decant camera` lists its formats; set camera.width_px, height_px and fps";
    if lists == 0 || formats.iter().any(|f| f.contains(" to ") && !f.contains(": ")) {
        return Finding::green("format", format!("{wanted}; the device does not list single sizes"));
    }
    if of_size.iter().any(has_rate) {
        Finding::green("format", wanted)
    } else {
        let is = if of_size.is_empty() { format!("{wanted}: no such size") } else { format!("{wanted}: not at this rate") };
        Finding::red("format", is, "the worker refuses the camera", advice)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use shared::machine::Verdict;

    /// Protects who asks why nothing is measured: frames that nobody publishes, and a worker that a controller waits for, are red; what cannot be known is
    /// yellow.
    #[test]
    fn who_publishes_is_told() {
        let judge = |published: Published, controlled| [frames(&published).verdict, worker(&published, controlled).verdict];
        let of = |frames, features| Ok(Some(Publishers { frames, features }));
        assert_eq!(judge(of(true, true), true), [Verdict::Green; 2]);
        assert_eq!(judge(of(false, true), true), [Verdict::Red, Verdict::Green]);
        assert_eq!(judge(of(true, false), true), [Verdict::Green, Verdict::Red]);
        assert_eq!(judge(of(true, false), false), [Verdict::Green; 2], "nobody waits for it");
        assert_eq!(judge(Ok(None), false), [Verdict::Yellow, Verdict::Green]);
        assert_eq!(judge(Ok(None), true), [Verdict::Yellow; 2], "the controller answers, so its cell cannot be seen from here");
        let unknown = IpcError::Node { cell: "lab".into(), what: "Refused".into() };
        assert_eq!(judge(Err(unknown), true), [Verdict::Yellow; 2]);
    }

    /// Protects the colours of a pour: controls that somebody changed while the camera is used are yellow, and those that nobody has set yet are not.
    #[test]
    fn controls_that_were_changed_are_named() {
        let differ = ["camera.gain = 10: the camera has 64".to_owned()];
        assert_eq!(settings(&[], true).verdict, Verdict::Green);
        assert_eq!(settings(&differ, false).verdict, Verdict::Green);
        let used = settings(&differ, true);
        assert!(used.verdict == Verdict::Yellow && used.is.contains("camera.gain"), "{used:?}");
    }

    /// Protects the operator from a camera that cannot do what is configured: sizes and rates are told apart, in the words of
    /// `feature-worker camera`.
    #[test]
    fn size_and_rate_are_looked_up() {
        let camera = CameraConfig { width_px: 640, height_px: 480, fps: 30.0, ..CameraConfig::default() };
        let judge = |formats: &[&str]| format(&camera, &formats.iter().map(|f| f.to_string()).collect::<Vec<_>>());
        assert_eq!(judge(&["MJPG 640 x 480: 30, 15 (Motion-JPEG)"]).verdict, Verdict::Green);
        assert_eq!(judge(&["MJPG 640 x 480: 5.00 to 60.00 (Motion-JPEG)"]).verdict, Verdict::Green);
        assert!(judge(&["MJPG 640 x 480: 15 (Motion-JPEG)"]).is.contains("not at this rate"));
        assert!(judge(&["MJPG 1280 x 720: 30 (Motion-JPEG)"]).is.contains("no such size"));
        assert_eq!(judge(&["YUYV 32 x 32 to 4096 x 4096 (YUYV)"]).verdict, Verdict::Green);
    }
}
