//! Experimental episodes `E = (L_E, w_E)` (section 3.1 of the paper): MCAP files and CSV tables, in and out.
//!
//! Each episode is one MCAP file that describes itself. [`mod@write`] makes it; [`read`] gives the plain [`Episode`] that the trainer works
//! on, and the images on demand; [`weigh`] adds the weight or a note afterwards; [`mod@recover`] makes a whole file of one that was cut; [`table`]
//! reads and writes the CSV pair for people who measure V_e with software of their own. All of it is for ordinary threads only: it allocates,
//! and it reads and writes files. A damaged file is an error of one line that names the file. A file whose recorder was killed can be read up
//! to its last whole chunk, and is then not `complete`.
//!
//! What is in the file, in format 2. Log times are Unix time, so that Foxglove and Rerun show episodes of different days one after the other.
//! Times in the messages are CLOCK_MONOTONIC ns, so that they match every other message of the cell; `clock_offset_ns` of the metadata
//! `episode` is the one less the other at the start. What is unknown is NaN.
//!
//! | topic or metadata | encoding | what |
//! |---|---|---|
//! | `/camera/image/compressed` | protobuf, `foxglove.CompressedImage` | `Image_i`, JPEG or PNG |
//! | `/camera/annotations` | protobuf, `foxglove.ImageAnnotations` | the triangle and V_e over the image, or the doubt |
//! | `/feature` | protobuf, `decant.Feature` | what the feature worker measured in each frame, with all its times |
//! | `/telemetry` | protobuf, `decant.Telemetry` | each tick of the controller: alpha, phase, d, v, poured |
//! | `/sample` | protobuf, `decant.Sample` | one row for each frame: alpha(i) commanded and measured at the capture time, V_e, doubt |
//! | metadata `episode` | text | kind, lambda, gamma, beta or goal, cell, hashes of configuration and weights, wall-clock start, clock offset |
//! | metadata `config` | text | the whole configuration |
//! | metadata `end` | text | how it ended and what was dropped; missing if the recorder was killed |
//! | metadata `weight` | text | `w_E` in g; missing until it is read from the scale |
//! | metadata `note` | text | what a person wrote about it |
//!
//! Format 1, which is still read, had JSON in place of `decant.*`, no annotations, and log times that were CLOCK_MONOTONIC.

use std::collections::BTreeMap;

use sha2::{Digest, Sha256};

use crate::control::is_short;
use crate::framing::Framing;
use crate::gaussian_curve::Curve;
use crate::messages::Doubt;

/// The longest time that a stream may flow unmeasured, s: the shipped configurations end a pour after it (`controller.stale_feature_ms`).
const UNMEASURED_MAX_S: f64 = 0.2;
/// Up to this commanded tilt the container is to be upright, degrees. Chosen by hand: no vessel pours there, and a controller's way back may leave some
/// tenths.
const UPRIGHT_DEG: f32 = 1.0;
/// A frame this near to a gap is beside it. Chosen by hand: the flow model takes as many zeros within the flow for a dropout.
const BESIDE: usize = 3;
/// The largest share of a stream's area that pictures may show which the stream leaves. Chosen by hand: where they lack a third of it, the sum of the areas
/// is then small by 1.7 %, as much as the fit expects the camera's gain to change from pour to pour.
pub const CUT_OFF_MAX: f64 = 0.05;
/// From this share of the largest area on a stream in the last frames runs on. Chosen by hand: beads at the lip, which stay, show less.
const RUNS_ON: f32 = 0.05;
/// What is wrong with an episode that ends before its stream, see [`Episode::runs_on`].
const RUNS_ON_WORDS: &str =
    "the stream was still running in the last frames, so more is on the scale than was seen: record until it has ended";
/// What is wrong with an episode of which the camera missed a part, see [`Episode::part_unseen`].
pub const PART_UNSEEN: &str = "the camera did not see part of this pour; its areas do not add up to its weight";

mod age;
mod format;
mod format_1;
mod number;
pub mod read;
mod records;
pub mod recover;
mod rewrite;
mod rows;
mod schema;
pub mod table;
pub mod weigh;
mod weight;
pub mod write;

pub use age::{Begun, by_age, oldest_first, oldest_first_of};
pub use number::{by_number, check_number, number_of, take_number, take_number_above};
pub use read::{EpisodeImage, EpisodeImages, beginning, each_once, episodes_so_far, find_episodes};
pub use records::EpisodeError;
pub use recover::recover;
pub use rewrite::{ChangeError, read_at_rest};
pub use rows::{EpisodeRow, EpisodeTrack};
pub use table::{TableError, read_table, write_table};
pub use weigh::{set_note, set_weight};
pub use weight::{WeightError, check_poured, check_reading};
pub(crate) use write::rfc3339;
pub use write::{EpisodeEnd, EpisodeStart, EpisodeWriter, FrameRow, WriteError};

/// Ticks between which others are missing and that are further apart than this do not tell the angles between them, ns: as long as a measured angle
/// counts.
const GAP_NS: u64 = 100_000_000;
/// Why an episode is incomplete that has such a gap.
pub const GAP: &str = "ticks of the controller are lost, because recorder or controller fell behind, so angles are not known";

/// Whether so many ticks are missing between two that follow each other, each with its number and its time, ns, that the angles between them are not known.
pub fn is_gap((before, before_ns): (u64, u64), (after, after_ns): (u64, u64)) -> bool {
    after > before.saturating_add(1) && after_ns.saturating_sub(before_ns) > GAP_NS
}

/// One experimental episode, without its images.
#[derive(Debug, Clone, PartialEq)]
pub struct Episode {
    /// The file's path, or the episode's name in a table.
    pub name: String,
    /// What was run.
    pub kind: EpisodeKind,
    /// One row for each frame that the camera exposed, in order of capture. Lost frames are there too, see [`EpisodeRow::lost`].
    pub rows: Vec<EpisodeRow>,
    /// `w_E`: weight on the scale afterwards, g (1 g of water is 1 ml); finite, at least 0; `None` until the scale is read.
    pub weight_g: Option<f64>,
    /// Whether the recorder closed the file in good order and nothing is missing at its end. Only complete episodes may be trained on,
    /// because in others the areas do not add up to the weight.
    pub complete: bool,
    /// Where it comes from and what went wrong on the way.
    pub info: EpisodeInfo,
}

/// What was run in an episode.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum EpisodeKind {
    /// The curve of eq. (1).
    Recording(Curve),
    /// A pour with the weight file's network.
    Pour {
        /// Goal volume V_G, ml.
        goal_ml: f32,
    },
    /// Unknown, because the episode comes from a table.
    Table,
}

/// Where an episode comes from and what went wrong on the way. Empty and 0 for tables.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct EpisodeInfo {
    /// Wall-clock time of the start in UTC, as RFC 3339 writes it.
    pub started_at_utc: String,
    /// First tick of the episode, CLOCK_MONOTONIC ns.
    pub started_at_ns: u64,
    /// The number that the controller gave it. A file that was copied may have another one in its name.
    pub number: Option<u64>,
    /// The cell's name.
    pub cell: String,
    /// SHA-256 of the configuration, hexadecimal.
    pub config_sha256: String,
    /// How the lip lay in its pictures, by that configuration.
    pub framing: Framing,
    /// Identity of the weights that the controller ran; empty if there were none.
    pub weights: String,
    /// How it ended, or what it lacks although it was closed in good order, in words; empty if the recorder was killed.
    pub ended: String,
    /// Whether it is incomplete only because the file lacks its own end, so that [`recover()`] makes a complete one of it.
    pub recoverable: bool,
    /// What a person wrote about it; mostly empty.
    pub note: String,
    /// The controller's own estimate of what was poured, at its last tick in the file, ml; `None` without a tick.
    pub poured_ml: Option<f32>,
    /// Number of the controller's ticks in the file.
    pub ticks: u64,
    /// Number of the controller's ticks that are missing between the first and the last.
    pub lost_ticks: u64,
    /// Number of images in the file.
    pub images: u64,
    /// Number of images that the recorder dropped; V_e of their frames is there.
    pub dropped_images: u64,
    /// Number of rows of [`Episode::rows`] whose frame was lost.
    pub lost_frames: u64,
}

impl Episode {
    /// What it lacks to be complete, in words; `None` if nothing.
    pub fn lacks(&self) -> Option<&str> {
        match self.info.ended.as_str() {
            _ if self.complete => None,
            "" => Some("its end is missing"),
            _ if self.info.recoverable => Some("only the file's own end is missing, and `feature-worker episodes recover` makes it whole"),
            ended => Some(ended),
        }
    }

    /// Hash of what the trainer sees: times, angles and areas, but not name, weight or file. Two episodes with the same hash are one and
    /// the same measurement, be it as a file or as a table.
    pub fn content_sha256(&self) -> [u8; 32] {
        let mut hash = Sha256::new();
        for row in &self.rows {
            hash.update(row.t_s.to_le_bytes());
            hash.update(row.alpha_commanded_deg.to_le_bytes());
            hash.update(if row.area_px2.is_nan() { f32::NAN } else { row.area_px2 }.to_le_bytes());
        }
        hash.finalize().into()
    }

    /// For each of `episodes` the index of the first one that holds the same measurement: its own, if none before it does.
    pub fn first_of_measurement(episodes: &[Episode]) -> Vec<usize> {
        let mut first_with = BTreeMap::new();
        let all = episodes.iter().enumerate();
        all.map(|(index, episode)| *first_with.entry(episode.content_sha256()).or_insert(index)).collect()
    }

    /// What a pour that ended before its goal had poured by the controller's own estimate, ml, whatever ended it: a stop, or a stream that was lost.
    /// `None` of one that came to its goal, and where there is no estimate.
    pub fn ended_early_ml(&self) -> Option<f32> {
        let EpisodeKind::Pour { goal_ml } = self.kind else { return None };
        self.info.poured_ml.filter(|poured_ml| is_short(goal_ml - poured_ml, goal_ml))
    }

    /// By how much a weighed pour missed its goal, ml: what the scale shows less the goal. `None` of one that ended early and gave less than its goal,
    /// because it tells nothing of how well a goal is met.
    pub fn error_ml(&self) -> Option<f64> {
        let EpisodeKind::Pour { goal_ml } = self.kind else { return None };
        let error_ml = self.weight_g? - f64::from(goal_ml);
        (error_ml > 0.0 || self.ended_early_ml().is_none()).then_some(error_ml)
    }

    /// Frames a second, from the median interval; 30 for an episode that has none.
    pub fn frame_rate_hz(&self) -> f64 {
        let mut steps: Vec<f64> = self.rows.windows(2).map(|w| w[1].t_s - w[0].t_s).filter(|s| *s > 0.0).collect();
        steps.sort_by(f64::total_cmp);
        let median = steps.get(steps.len() / 2).copied().unwrap_or(1.0 / 30.0);
        (1.0 / median * 10.0).round() / 10.0
    }

    /// Whether the camera missed a part of the stream: more than 0.2 s of frames in a row were not measured, at most three frames after or before one
    /// that shows flow (a lone zero beside a gap is a dropout), and not all of them while the container was to be upright, where only drops fall. A shorter gap is bridged by the area before it.
    pub fn part_unseen(&self) -> bool {
        let most = (UNMEASURED_MAX_S * self.frame_rate_hz()).round() as usize;
        let flows = |k: usize| self.rows.get(k).is_some_and(|row| row.area_px2 > 0.0);
        let mut end = 0;
        self.rows.chunk_by(|a, b| a.area_px2.is_nan() == b.area_px2.is_nan()).any(|run| {
            let first = end;
            end += run.len();
            let beside_flow = (first.saturating_sub(BESIDE)..first).chain(end..end + BESIDE).any(flows);
            run.len() > most && run[0].area_px2.is_nan() && beside_flow && run.iter().any(|row| row.alpha_commanded_deg > UPRIGHT_DEG)
        })
    }

    /// What is wrong with an episode in which too much of the stream was seen in pictures that it leaves, so that its areas are lower bounds. What counts is
    /// their share of the area and not of the frames: a stream leaves its pictures where it is strongest.
    pub fn cut_off(&self) -> Option<String> {
        let area_px2 = |counts: fn(&EpisodeRow) -> bool| {
            let areas = self.rows.iter().filter(|row| counts(row)).map(|row| f64::from(row.area_px2));
            areas.filter(|area_px2| *area_px2 > 0.0).sum::<f64>()
        };
        let share = area_px2(|row| row.doubt == Doubt::LeavesRegion) / area_px2(|_| true);
        (share > CUT_OFF_MAX).then(|| {
            format!(
                "{:.0} % of the stream's area were seen in pictures that it leaves, so more has flowed than was seen: enlarge [image] region_px and record it again",
                100.0 * share
            )
        })
    }

    /// Whether the stream still ran in the last frames: what flowed after them is on the scale and not in the areas. A robot that was stopped while it was
    /// tilted leaves such an episode.
    fn runs_on(&self) -> bool {
        // A frame that was not measured does not say that the stream has ended.
        let areas_px2 = || self.rows.iter().map(|row| row.area_px2).filter(|area_px2| area_px2.is_finite());
        let largest_px2 = areas_px2().fold(0.0, f32::max);
        areas_px2().count() > 3 && areas_px2().rev().take(3).all(|area_px2| area_px2 > RUNS_ON * largest_px2)
    }

    /// Why the areas of the episode do not add up to its weight, each reason in words: a part of the stream was not seen.
    pub fn stream_faults(&self) -> impl Iterator<Item = String> {
        let part_unseen = self.part_unseen().then(|| PART_UNSEEN.to_owned());
        let runs_on = self.runs_on().then(|| RUNS_ON_WORDS.to_owned());
        part_unseen.into_iter().chain(self.cut_off()).chain(runs_on)
    }

    /// Time from the first to the last frame, s; 0 without frames.
    pub fn seconds(&self) -> f64 {
        match (self.rows.first(), self.rows.last()) {
            (Some(first), Some(last)) => last.t_s - first.t_s,
            _ => 0.0,
        }
    }
}

/// Bytes as lower-case hexadecimal.
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}
