//! Errors and rates of many measured frames. Pure, any thread; allocates; cannot fail.

use feature_worker::vision::Measurement;
use serde::Serialize;
use shared::messages::Doubt;

/// Frames with a truth above this count for error and missed flow, px^2: below it a stream is a few pixels wide, and its error says
/// little about quality.
pub const MEASURED_PX2: f64 = 200.0;
/// An area further than this from the truth is wrong, per cent. This is what confidence speaks of.
pub const WRONG_PERCENT: f64 = 20.0;

/// Frames without a stream after which it has ended for good: half a second.
pub const DRY_FRAMES: usize = 15;
/// Frames in which an eye that has just started may not know the ground yet, so that no pour begins: a sixth of a second. Clear water takes three
/// before an even wall and four before a pattern.
pub const START_FRAMES: usize = 5;
/// Frames a second of what is measured here.
const RATE_HZ: f64 = 30.0;

/// Figures of many measured frames.
#[derive(Debug, Default, Serialize)]
pub struct CameraFigures {
    /// Number of frames.
    pub frames: usize,
    /// Number of frames with a truth above [`MEASURED_PX2`] that were measured.
    pub measured: usize,
    /// Median of the size of their errors, per cent.
    pub median_error_percent: f64,
    /// 95th percentile of the size of their errors, per cent.
    pub p95_error_percent: f64,
    /// Mean of their errors, per cent.
    pub bias_percent: f64,
    /// Number of frames without a stream.
    pub dry: usize,
    /// Share of the frames without a stream on which one was seen, per cent.
    pub false_flow_percent: f64,
    /// Number of frames with a truth above [`MEASURED_PX2`].
    pub wet: usize,
    /// Share of these on which no stream was seen, per cent.
    pub missed_flow_percent: f64,
    /// Share of these on which no stream was seen, and which the controller nevertheless uses, per cent.
    pub unnoticed_percent: f64,
    /// Share of all frames with a doubt, per cent.
    pub doubt_percent: f64,
    /// Share of the frames with a truth above [`MEASURED_PX2`] that the controller does not use, per cent.
    pub wet_unusable_percent: f64,
    /// Share of them that it uses, although the area is wrong by more than [`WRONG_PERCENT`], per cent.
    pub wrong_percent: f64,
    /// Share of the frames without a stream that have a doubt, per cent.
    pub dry_doubt_percent: f64,
    /// Share of the frames without a stream now and in the [`DRY_FRAMES`] before that have a doubt, per cent.
    pub undisturbed_doubt_percent: f64,
    /// The same, without the first [`START_FRAMES`] of each eye, per cent.
    pub settled_doubt_percent: f64,
    /// Number of streams that ended for good: at least [`DRY_FRAMES`] without one follow.
    pub ends: usize,
    /// 95th percentile of the time from their last frame to the first one that the controller uses and in which nothing flows, s.
    pub dry_after_p95_s: f64,
    /// The doubts with their number of frames, on frames with a stream and after a stroke without.
    pub doubts: String,
}

/// One measured frame beside the truth.
#[derive(Debug, Clone, Copy)]
pub struct Comparison {
    /// Its number in the run of frames.
    pub number: usize,
    /// True V_e, px^2; 0 without a stream.
    pub truth_px2: f64,
    /// Measured V_e, px^2.
    pub area_px2: f64,
    /// Its confidence.
    pub confidence: f64,
    /// The doubt about it.
    pub doubt: Doubt,
    /// Whether the controller uses it.
    pub usable: bool,
}

impl Comparison {
    /// The measurement of the frame with this number in its run, beside the true V_e, px^2.
    pub fn new(number: usize, truth_px2: f64, measured: &Measurement) -> Self {
        Self {
            number,
            truth_px2,
            area_px2: measured.area_px2.into(),
            confidence: measured.confidence.into(),
            doubt: measured.doubt,
            usable: measured.is_usable(),
        }
    }

    /// Signed error, per cent.
    pub fn error_percent(self) -> f64 {
        100.0 * (self.area_px2 / self.truth_px2 - 1.0)
    }

    /// How bad it is, for the list of the worst frames: 0 is not bad.
    pub fn badness(self) -> f64 {
        if self.truth_px2 == 0.0 {
            // False flow counts as worse than an error.
            if self.area_px2 > 0.0 { 200.0 + self.area_px2 / 10.0 } else { 0.0 }
        } else if self.truth_px2 >= MEASURED_PX2 {
            self.error_percent().abs()
        } else {
            0.0
        }
    }
}

/// The figures of many frames; NaN where there is nothing to take them from.
pub fn figures(frames: &[Comparison]) -> CameraFigures {
    let wet: Vec<&Comparison> = frames.iter().filter(|s| s.truth_px2 > MEASURED_PX2).collect();
    let used = |s: &&&Comparison| s.usable && s.area_px2 > 0.0;
    let mut errors: Vec<f64> = wet.iter().filter(used).map(|s| s.error_percent()).collect();
    let wrong = errors.iter().filter(|e| e.abs() > WRONG_PERCENT).count();
    let bias_percent = errors.iter().sum::<f64>() / errors.len().max(1) as f64;
    errors.iter_mut().for_each(|e| *e = e.abs());
    errors.sort_by(f64::total_cmp);
    let dry: Vec<&Comparison> = frames.iter().filter(|s| s.truth_px2 == 0.0).collect();
    let undisturbed = undisturbed_frames(frames);
    let settled: Vec<&Comparison> = undisturbed.iter().copied().filter(|s| s.number >= START_FRAMES).collect();
    let doubted = |some: &[&Comparison]| some.iter().filter(|s| s.doubt != Doubt::None).count();
    let mut ends_s = times_to_dry_s(frames);
    ends_s.sort_by(f64::total_cmp);
    let percent = |part: usize, whole: usize| 100.0 * part as f64 / whole.max(1) as f64;
    CameraFigures {
        frames: frames.len(),
        measured: errors.len(),
        median_error_percent: quantile_of(&errors, 0.5),
        p95_error_percent: quantile_of(&errors, 0.95),
        bias_percent,
        dry: dry.len(),
        false_flow_percent: percent(dry.iter().filter(|s| s.area_px2 > 0.0).count(), dry.len()),
        wet: wet.len(),
        missed_flow_percent: percent(wet.iter().filter(|s| s.area_px2 == 0.0).count(), wet.len()),
        unnoticed_percent: percent(wet.iter().filter(|s| s.area_px2 == 0.0 && s.usable).count(), wet.len()),
        doubt_percent: percent(frames.iter().filter(|s| s.doubt != Doubt::None).count(), frames.len()),
        wet_unusable_percent: percent(wet.iter().filter(|s| !s.usable).count(), wet.len()),
        wrong_percent: percent(wrong, wet.len()),
        dry_doubt_percent: percent(doubted(&dry), dry.len()),
        undisturbed_doubt_percent: percent(doubted(&undisturbed), undisturbed.len()),
        settled_doubt_percent: percent(doubted(&settled), settled.len()),
        ends: ends_s.len(),
        dry_after_p95_s: quantile_of(&ends_s, 0.95),
        doubts: doubts_in_words(frames),
    }
}

/// The frames without a stream before which there was none for [`DRY_FRAMES`] either, or that many are not there yet: nothing disturbs them.
fn undisturbed_frames(frames: &[Comparison]) -> Vec<&Comparison> {
    let (mut since, mut undisturbed) = (usize::MAX, Vec::new());
    for frame in frames {
        since = match (frame.number, frame.truth_px2 > 0.0) {
            (_, true) => 0,
            (0, false) => usize::MAX,
            _ => since.saturating_add(1),
        };
        if since > DRY_FRAMES {
            undisturbed.push(frame);
        }
    }
    undisturbed
}

/// The quantile of sorted figures; NaN without any.
fn quantile_of(sorted: &[f64], share: f64) -> f64 {
    sorted.get(((sorted.len().max(1) - 1) as f64 * share).round() as usize).copied().unwrap_or(f64::NAN)
}

/// For each stream that ended for good, the time from its last frame to the first one that the controller uses and in which nothing
/// flows, s. It is endless if there is none before the run ends.
pub fn times_to_dry_s(frames: &[Comparison]) -> Vec<f64> {
    let same_run = |i: usize| frames[i..].iter().enumerate().take_while(move |(k, f)| *k == 0 || f.number == frames[i].number + k);
    let last = |i: &usize| {
        frames[*i].truth_px2 > 0.0 && {
            let dry = same_run(*i).skip(1).take_while(|(_, f)| f.truth_px2 == 0.0).count();
            dry >= DRY_FRAMES
        }
    };
    let seen_dry = |i: usize| same_run(i).skip(1).find(|(_, f)| f.usable && f.area_px2 == 0.0).map_or(f64::INFINITY, |(k, _)| k as f64);
    (0..frames.len()).filter(last).map(|i| seen_dry(i) / RATE_HZ).collect()
}

/// The doubts on frames with a truth above [`MEASURED_PX2`], with their number, and after a stroke those on frames without a stream.
fn doubts_in_words(frames: &[Comparison]) -> String {
    let count = |chosen: fn(&&Comparison) -> bool| {
        let counted = Doubt::ALL.into_iter().filter(|d| *d != Doubt::None);
        let counted = counted.map(|d| (d, frames.iter().filter(chosen).filter(|s| s.doubt == d).count()));
        counted.filter(|(_, n)| *n > 0).map(|(d, n)| format!("{} {n}", d.words())).collect::<Vec<_>>().join(", ")
    };
    format!("{} / {}", count(|s| s.truth_px2 > MEASURED_PX2), count(|s| s.truth_px2 == 0.0))
}

/// Steps of confidence in a table of reliability.
pub const CONFIDENCES: usize = 10;

/// For each step of confidence the number of frames that the controller uses, their mean confidence, and the share of them whose area is
/// within [`WRONG_PERCENT`] of the truth (0 where there is no stream); NaN without frames.
pub fn reliability(frames: &[Comparison]) -> [(usize, f64, f64); CONFIDENCES] {
    let mut sums = [(0usize, 0.0f64, 0.0f64); CONFIDENCES];
    for frame in frames.iter().filter(|f| f.usable) {
        let step = ((frame.confidence * CONFIDENCES as f64) as usize).min(CONFIDENCES - 1);
        let right = if frame.truth_px2 > 0.0 { frame.error_percent().abs() <= WRONG_PERCENT } else { frame.area_px2 == 0.0 };
        sums[step].0 += 1;
        sums[step].1 += frame.confidence;
        sums[step].2 += f64::from(u8::from(right));
    }
    sums.map(|(n, confidence, right)| (n, confidence / n as f64, right / n as f64))
}
