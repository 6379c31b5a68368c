//! Experimental episodes `E = (L_E, w_E)` (section 3.1 of the paper): MCAP files and CSV tables, in and out.
//!
//! One self-describing MCAP file each ([`mod@write`]); [`read`] gives the plain [`Episode`] that the trainer works on, and the
//! images on demand; [`weigh`] adds the weight afterwards; [`table`] reads and writes the CSV pair for people who have their
//! own vision. Used by ordinary threads only: allocates, reads and writes files. A damaged file is an error with one line
//! that names the file; a file whose recorder was killed reads up to its last whole chunk and says `complete: false`.
//!
//! What is in the file (times are CLOCK_MONOTONIC ns, so that they match every other message of the cell):
//!
//! | topic or metadata | encoding | what |
//! |---|---|---|
//! | `/camera/image/compressed` | protobuf, `foxglove.CompressedImage` | `Image_i`, JPEG or PNG |
//! | `/feature` | JSON, `decant.Feature` | what the feature worker measured in each frame, with all its times |
//! | `/telemetry` | JSON, `decant.Telemetry` | each tick of the controller: alpha, phase, d, v, poured |
//! | `/sample` | JSON, `decant.Sample` | one row a frame: alpha(i) commanded and measured at the capture time, V_e, doubt |
//! | metadata `episode` | text | kind, lambda, gamma, beta or goal, cell, hashes of configuration and weights, wall-clock start |
//! | metadata `config` | text | the whole configuration |
//! | metadata `end` | text | how it ended and what was dropped; missing if the recorder was killed |
//! | metadata `weight` | text | `w_E` in g; missing until it is read from the scale |

use sha2::{Digest, Sha256};

use crate::gaussian_curve::Curve;
use crate::messages::Doubt;

mod format;
pub mod read;
pub mod table;
pub mod weigh;
pub mod write;

pub use read::{EpisodeError, EpisodeImage, EpisodeImages, find_episodes};
pub use table::{TableError, read_table, write_table};
pub use weigh::{WeighError, set_weight};
pub use write::{EpisodeEnd, EpisodeStart, EpisodeWriter, FrameRow, WriteError};

/// One experimental episode, without its images.
#[derive(Debug, Clone, PartialEq)]
pub struct Episode {
    /// The file's path, or the episode's name in a table.
    pub name: String,
    /// What was run.
    pub kind: EpisodeKind,
    /// All frames in order of capture, one for each that the camera exposed: the lost ones are there, see [`EpisodeRow::lost`].
    pub rows: Vec<EpisodeRow>,
    /// `w_E`: weight on the scale afterwards, g (= ml of water); finite, >= 0; `None` until somebody read the scale.
    pub weight_g: Option<f64>,
    /// The recorder closed the file in good order and no tick or frame of the end is missing. Only complete episodes may be
    /// trained on: in others the areas do not add up to the weight.
    pub complete: bool,
    /// Where it comes from and what went wrong on the way.
    pub info: EpisodeInfo,
}

/// What was run in an episode.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum EpisodeKind {
    /// The curve of eq. (1).
    Recording(Curve),
    /// A pour by the policy.
    Pour {
        /// Goal volume V_G, ml.
        goal_ml: f32,
    },
    /// Unknown, from a table.
    Table,
}

/// One camera frame of an episode: a row of `L_E` with V_e in the image's place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EpisodeRow {
    /// The camera's frame number; consecutive within an episode.
    pub sequence: u64,
    /// Middle of the exposure, CLOCK_MONOTONIC ns; interpolated for a lost frame; 0 in tables.
    pub captured_at_ns: u64,
    /// Middle of the exposure, s since the episode's first tick; the few frames from before are negative.
    pub t_s: f64,
    /// Commanded alpha at that time, degrees; finite.
    pub alpha_commanded_deg: f32,
    /// Measured alpha at that time, degrees; NaN if the robot did not say. In tables the same as commanded.
    pub alpha_measured_deg: f32,
    /// V_e, px^2, >= 0; NaN if the frame was lost or its doubt makes it unusable ([`Doubt::usable`]).
    pub area_px2: f32,
    /// Why the area is doubtful.
    pub doubt: Doubt,
    /// Nobody measured this frame (dropped by camera or worker).
    pub lost: bool,
}

/// Where an episode comes from and what went wrong on the way; empty and 0 for tables.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct EpisodeInfo {
    /// Wall clock at the start, RFC 3339, UTC.
    pub started_at_utc: String,
    /// First tick of the episode, CLOCK_MONOTONIC ns.
    pub started_at_ns: u64,
    /// The cell's name.
    pub cell: String,
    /// SHA-256 of the configuration, hexadecimal.
    pub config_sha256: String,
    /// Identity of the weights that the controller ran; empty if there were none.
    pub weights: String,
    /// How it ended, in words; empty if the recorder was killed.
    pub ended: String,
    /// Ticks of the controller in the file.
    pub ticks: u64,
    /// Ticks of the controller missing between the first and the last.
    pub lost_ticks: u64,
    /// Images in the file.
    pub images: u64,
    /// Images that the recorder dropped; their V_e is there.
    pub dropped_images: u64,
    /// Frames of [`Episode::rows`] that nobody measured.
    pub lost_frames: u64,
}

impl Episode {
    /// Hash of what the trainer sees (times, angles, areas), not of name, weight or file: two episodes with the
    /// same hash are the same measurement twice, be it as a file or as a table.
    pub fn content_sha256(&self) -> [u8; 32] {
        let mut hash = Sha256::new();
        for f in &self.rows {
            hash.update(f.t_s.to_le_bytes());
            hash.update(f.alpha_commanded_deg.to_le_bytes());
            hash.update(if f.area_px2.is_nan() { f32::NAN } else { f.area_px2 }.to_le_bytes());
        }
        hash.finalize().into()
    }

    /// Pairs (earlier, later) of indices of `episodes` with the same content.
    pub fn duplicates(episodes: &[Episode]) -> Vec<(usize, usize)> {
        let mut seen = std::collections::BTreeMap::new();
        let mut pairs = Vec::new();
        for (index, episode) in episodes.iter().enumerate() {
            match seen.entry(episode.content_sha256()) {
                std::collections::btree_map::Entry::Occupied(first) => pairs.push((*first.get(), index)),
                std::collections::btree_map::Entry::Vacant(free) => {
                    free.insert(index);
                }
            }
        }
        pairs
    }

    /// Duration from the first to the last frame, s.
    pub fn seconds(&self) -> f64 {
        match (self.rows.first(), self.rows.last()) {
            (Some(first), Some(last)) => last.t_s - first.t_s,
            _ => 0.0,
        }
    }
}

/// Bytes as lower-case hexadecimal.
fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}
