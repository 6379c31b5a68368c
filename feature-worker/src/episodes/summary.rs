//! What there is to say about an episode: a summary as JSON, and what is wrong with it in words. It works on an
//! episode in memory, on any thread; it allocates and cannot fail.

use serde_json::{Value, json};
use shared::episode::{Episode, EpisodeKind, EpisodeRow, hex};
use shared::messages::Doubt;
use shared::plural::counted;

/// A weight above this without any flow means that the vision saw nothing, g. Chosen by hand: more than drops and evaporation.
const SURELY_POURED_G: f64 = 3.0;
/// A weight below this means that nothing was poured, g. Chosen by hand: about the resolution of a kitchen scale.
const NOTHING_POURED_G: f64 = 1.0;
/// More frames with flow than this contradict a weight of nothing. Chosen by hand: a few drops may look like flow.
const CHANCE_FLOW_FRAMES: usize = 5;
/// A weight that is further from the controller's own estimate than this share of it is remarked. Chosen by hand, as on the page: a slipped digit is
/// further off.
const FAR: f64 = 0.5;

/// One remark about an episode.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Remark {
    /// Whether it keeps the episode from being trained on.
    pub is_wrong: bool,
    /// The remark in words, with what to do.
    pub text: String,
}

impl Remark {
    /// A remark that keeps the episode from being trained on.
    pub fn wrong(text: impl Into<String>) -> Self {
        Self { is_wrong: true, text: text.into() }
    }

    /// A remark that is only worth knowing.
    fn note(text: impl Into<String>) -> Self {
        Self { is_wrong: false, text: text.into() }
    }
}

/// All that is worth saying about an episode.
pub fn remarks(episode: &Episode) -> Vec<Remark> {
    let info = &episode.info;
    let mut all = Vec::new();
    if info.ended.is_empty() {
        all.push(Remark::wrong("the recorder was killed before the end; record it again"));
    } else if info.recoverable {
        all.push(Remark::wrong("the file's end is missing; `feature-worker episodes recover FILE` makes a whole file of it"));
    } else if !episode.complete {
        let last_s = episode.rows.last().map_or(0.0, |r| r.t_s);
        all.push(Remark::wrong(format!("incomplete: {}; the last frame is from {last_s:.1} s; record it again", info.ended)));
    }
    all.extend(about_weight(episode));
    all.extend(episode.stream_faults().map(Remark::wrong));
    if info.lost_frames > 0 {
        let runs = episode.rows.chunk_by(|a, b| a.lost == b.lost);
        let longest = runs.filter(|run| run[0].lost).map(<[EpisodeRow]>::len).max().unwrap_or(0);
        all.push(Remark::note(format!("{} lost, at most {longest} in a row", counted(info.lost_frames, "frame"))));
    }
    for (doubt, frames) in doubts(episode) {
        let used = episode.rows.iter().filter(|r| r.doubt == doubt && r.area_px2.is_finite()).count();
        let use_of_it = if used == 0 { "not used".into() } else { format!("{used} of them still used") };
        all.push(Remark::note(format!("{} doubtful: {} ({use_of_it})", counted(frames, "frame"), doubt.words())));
    }
    if info.dropped_images > 0 {
        all.push(Remark::note(format!("{} dropped; V_e is there all the same", counted(info.dropped_images, "image"))));
    }
    if info.lost_ticks > 0 {
        all.push(Remark::note(format!("{} of the controller missing", counted(info.lost_ticks, "tick"))));
    }
    let unknown = episode.rows.iter().filter(|r| r.alpha_measured_deg.is_nan()).count();
    if unknown > 0 {
        all.push(Remark::note(format!("the robot's measured alpha is unknown in {}", counted(unknown, "frame"))));
    }
    all
}

/// Whether the weight fits what the vision saw, and what the controller made of it.
pub fn about_weight(episode: &Episode) -> Option<Remark> {
    let flow = flow_frames(episode);
    match episode.weight_g {
        None => Some(Remark::wrong("no weight yet: `feature-worker episodes weigh FILE --weight G`")),
        Some(w) if w > SURELY_POURED_G && flow == 0 => {
            Some(Remark::wrong(format!("{w} g on the scale, but no frame shows flow: check [image]")))
        }
        Some(w) if w < NOTHING_POURED_G && flow > CHANCE_FLOW_FRAMES => {
            Some(Remark::wrong(format!("flow in {}, but the scale says {w} g: check weight and [image]", counted(flow, "frame"))))
        }
        Some(w) if w <= 0.0 => Some(Remark::wrong("nothing was poured: there is nothing to learn from it")),
        Some(w) => {
            let estimate_ml = f64::from(episode.info.poured_ml.filter(|_| matches!(episode.kind, EpisodeKind::Pour { .. }))?);
            ((w - estimate_ml).abs() > FAR * estimate_ml.abs()).then(|| {
                Remark::note(format!(
                    "{w} g on the scale, but {estimate_ml:.1} ml by the pour's own estimate: look whether the reading and its decimal point are right"
                ))
            })
        }
    }
}

/// Frames in which the vision saw flow.
fn flow_frames(episode: &Episode) -> usize {
    episode.rows.iter().filter(|r| r.area_px2 > 0.0).count()
}

/// How many frames have each doubt; doubts without a frame are left out.
fn doubts(episode: &Episode) -> Vec<(Doubt, usize)> {
    let count = |doubt: Doubt| episode.rows.iter().filter(|r| r.doubt == doubt).count();
    Doubt::ALL.into_iter().filter(|d| *d != Doubt::None).map(|d| (d, count(d))).filter(|(_, n)| *n > 0).collect()
}

/// What was run in an episode, as JSON.
fn kind_json(kind: EpisodeKind) -> Value {
    match kind {
        EpisodeKind::Recording(c) => {
            json!({ "kind": "recording", "lambda_deg": c.lambda_deg, "gamma_per_s2": c.gamma_per_s2, "beta_s": c.beta_s })
        }
        EpisodeKind::Pour { goal_ml } => json!({ "kind": "pour", "goal_ml": goal_ml }),
        EpisodeKind::Table => json!({ "kind": "table" }),
    }
}

/// Everything about an episode but its rows and its images, as JSON.
pub fn summary(episode: &Episode) -> Value {
    let largest = |values: &mut dyn Iterator<Item = f32>| values.filter(|v| v.is_finite()).fold(0.0, f32::max);
    // The sum of no numbers is -0.
    let area: f64 = 0.0 + episode.rows.iter().filter(|r| !r.area_px2.is_nan()).map(|r| f64::from(r.area_px2)).sum::<f64>();
    let doubtful = doubts(episode).into_iter().map(|(doubt, n)| (doubt.words().to_string(), json!(n)));
    let info = &episode.info;
    json!({
        "file": episode.name,
        "number": info.number,
        "complete": episode.complete,
        "run": kind_json(episode.kind),
        "weight_g": episode.weight_g,
        "note": episode.info.note,
        "seconds": episode.seconds(),
        "frames": episode.rows.len(),
        "flow_frames": flow_frames(episode),
        "lost_frames": info.lost_frames,
        "doubtful_frames": doubtful.collect::<serde_json::Map<_, _>>(),
        "area_sum_px2": area,
        "area_max_px2": largest(&mut episode.rows.iter().map(|r| r.area_px2)),
        "alpha_max_deg": largest(&mut episode.rows.iter().map(|r| r.alpha_commanded_deg)),
        "images": info.images,
        "dropped_images": info.dropped_images,
        "ticks": info.ticks,
        "lost_ticks": info.lost_ticks,
        "ended": info.ended,
        "recoverable": info.recoverable,
        "started_at_utc": info.started_at_utc,
        "started_at_ns": info.started_at_ns,
        "cell": info.cell,
        "config_sha256": info.config_sha256,
        "weights": info.weights,
        "content_sha256": hex(&episode.content_sha256()),
    })
}
