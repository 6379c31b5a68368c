//! What the trainer works on: weighed episodes as plain columns, read from MCAP files or CSV tables.
//!
//! Used by offline commands on an ordinary thread; it allocates. Bad data is refused with one line that names the episode ([`DataError`]).

use std::collections::BTreeMap;
use std::path::PathBuf;

use sha2::{Digest, Sha256};
use shared::episode::{self, Episode};
use shared::framing::Framing;
use shared::level::plain;
use shared::plural::counted;

use crate::servo;

/// Fewer frames than this are no whole curve: one second at 30 frames a second.
const FRAMES_MIN: usize = 30;
/// Frames a second that a camera may have: times in ms or us are far from it. Chosen by hand: half and twice what the controller allows.
const RATES_HZ: std::ops::RangeInclusive<f64> = 1.0..=240.0;
/// A larger angle is none that a joint turns to, degrees: a UR5's joints turn by a whole turn either way.
const ANGLE_MAX_DEG: f64 = 360.0;
/// A measured tilt that is further off the commanded one than this, at the best delay and lag, does not follow it, root mean square, degrees. Chosen by
/// hand: a joint that the controller lets pour stays within 2 degrees of where its commands were (`TOLERANCE_DEG` of the controller).
const FOLLOWS_DEG: f64 = 3.0;
/// A joint whose measured tilt follows the commanded one within this is none, s: the column was copied, or one of the two was written into both. Chosen by
/// hand: the joints of all tuning rigs are late by 0.06 s and more, and no robot moves before it has read its target.
const FOLLOWS_AT_ONCE_S: f64 = 0.005;
/// By how many frames the times of a stream may be off their numbers: times that jitter are off by one at either end.
const UNNUMBERED_FRAMES: f64 = 2.0;
/// By which share of its frames as well. Chosen by hand: its sum is then off by as much, and the controller ends a pour whose frames come at a rate that is
/// off by 2.5 %.
const UNNUMBERED_SHARE: f64 = 0.025;
/// Weights of one measurement that are further apart are two weights, g: a kitchen scale shows whole grams.
const WEIGHTS_APART_G: f64 = 0.5;
/// Frame rates of which one is further off the other than this share of it are different ones. Chosen by hand: a volume is then off by as much, and the
/// controller ends a pour whose frames come at a rate that is off by 2.5 %.
const RATES_APART: f64 = 0.02;
/// Rates are read off with this precision, frames a second, which is more than that share of a slow camera's.
const RATE_STEP_HZ: f64 = 0.1;

/// One experimental episode E = (L_E, w_E). Each camera frame is one row, and all columns have the same length.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainingEpisode {
    /// The episode's name: its file, or its name in a table.
    pub name: String,
    /// Frames a second.
    pub rate_hz: f64,
    /// Capture time, s, ascending.
    pub t_s: Vec<f64>,
    /// Commanded alpha at the capture time, degrees.
    pub alpha_deg: Vec<f64>,
    /// Measured alpha at the capture time, degrees; NaN where it is not known.
    pub alpha_measured_deg: Vec<f64>,
    /// V_e, px^2; NaN where the frame was lost or its measurement is doubtful.
    pub area_px2: Vec<f64>,
    /// w_E, g (1 g = 1 ml); NaN where the scale was not read.
    pub weight_g: f64,
    /// How the lip lay in the pictures; not known of tables.
    pub framing: Framing,
}

/// Why data is refused.
#[derive(Debug, thiserror::Error)]
pub enum DataError {
    /// A file cannot be read as an episode.
    #[error(transparent)]
    Episode(#[from] episode::EpisodeError),
    /// The weights of several tables in one, where one name may stand for several episodes.
    #[error(
        "--scale goes with one table of features: put the episodes into one, each under a name of its own, or train from the recordings"
    )]
    SeveralTables,
    /// A table cannot be read.
    #[error(transparent)]
    Table(#[from] episode::TableError),
    /// No episodes at all.
    #[error("no episodes found in {places}: record some with `rt-controller record`")]
    None {
        /// Where they were looked for.
        places: String,
    },
    /// The episodes are those of several cells, and nobody has said which count.
    #[error(
        "the episodes come from several cells ({cells}), and another camera sees another area of the same stream: give --cell NAME, once for each cell \
         whose episodes count"
    )]
    SeveralCells {
        /// The cells, and an episode of each.
        cells: String,
    },
    /// A cell was chosen of which there is no episode.
    #[error("no episode of these comes from cell {cell}; the cells that they name: {cells}")]
    NoSuchCell {
        /// The cell.
        cell: String,
        /// The cells, and an episode of each.
        cells: String,
    },
    /// One episode cannot be trained on.
    #[error("{name}: {what}")]
    Unusable {
        /// The episode.
        name: String,
        /// What is wrong and what to do.
        what: String,
    },
    /// There are too few for the method.
    #[error("usable episodes: {found}, and method {method} needs {needed}: record more")]
    TooFew {
        /// Number of usable episodes.
        found: usize,
        /// The method.
        method: String,
        /// The least number of episodes that it needs.
        needed: usize,
    },
}

impl TrainingEpisode {
    /// An episode without frames and without weight.
    pub fn empty(name: &str, rate_hz: f64) -> Self {
        let column = Vec::new;
        Self {
            name: name.into(),
            rate_hz,
            t_s: column(),
            alpha_deg: column(),
            alpha_measured_deg: column(),
            area_px2: column(),
            weight_g: f64::NAN,
            framing: Framing::default(),
        }
    }

    /// Adds a frame.
    pub fn push(&mut self, t_s: f64, alpha_deg: f64, alpha_measured_deg: f64, area_px2: f64) {
        self.t_s.push(t_s);
        self.alpha_deg.push(alpha_deg);
        self.alpha_measured_deg.push(alpha_measured_deg);
        self.area_px2.push(area_px2);
    }

    /// Number of frames.
    pub fn len(&self) -> usize {
        self.t_s.len()
    }

    /// Whether there are no frames.
    pub fn is_empty(&self) -> bool {
        self.t_s.is_empty()
    }

    /// The tilt of a frame, degrees: the measured one where there is one, else the commanded one.
    pub fn tilt_deg(&self, frame: usize) -> f64 {
        let measured_deg = self.alpha_measured_deg[frame];
        if measured_deg.is_finite() { measured_deg } else { self.alpha_deg[frame] }
    }

    /// The first frame that shows flow: one after which flow is measured again, as a lone area is a speck; without two such frames in a row, the first
    /// area above 0. `None` if there is none.
    pub fn first_flow(&self) -> Option<usize> {
        let measured: Vec<usize> = (0..self.len()).filter(|k| !self.area_px2[*k].is_nan()).collect();
        let flows = |k: usize| self.area_px2[k] > 0.0;
        let lasting = measured.windows(2).find(|two| two.iter().all(|k| flows(*k))).map(|two| two[0]);
        lasting.or_else(|| (0..self.len()).find(|k| flows(*k)))
    }

    /// What makes this episode unusable, and what to do about it; `None` if it can be trained on.
    pub fn fault(&self) -> Option<String> {
        let n = self.len();
        if [self.alpha_deg.len(), self.alpha_measured_deg.len(), self.area_px2.len()].iter().any(|l| *l != n) {
            return Some(format!(
                "columns of unequal lengths ({n} times, {} angles, {} areas): export the table again",
                self.alpha_deg.len(),
                self.area_px2.len()
            ));
        }
        if n < FRAMES_MIN {
            return Some(format!("only {}: an episode needs a whole curve, at least {FRAMES_MIN}", counted(n, "frame")));
        }
        if let Some(k) = self.t_s.iter().chain(&self.alpha_deg).position(|v| !v.is_finite()) {
            return Some(format!("frame {}: time or angle is not finite: export the table again", k % n));
        }
        let angles_deg = self.alpha_deg.iter().chain(&self.alpha_measured_deg);
        if let Some((k, deg)) = angles_deg.enumerate().find(|(_, deg)| deg.abs() > ANGLE_MAX_DEG) {
            return Some(format!("frame {}: an angle of {deg:.0} degrees: angles are in degrees from upright", k % n));
        }
        if let Some(k) = self.t_s.windows(2).position(|t| t[1] <= t[0]) {
            return Some(format!("frame {}: time does not go forward: sort the frames", k + 1));
        }
        if !RATES_HZ.contains(&self.rate_hz) {
            return Some(format!("{} frames a second: t_s must be in seconds", self.rate_hz));
        }
        if let Some(k) = self.area_px2.iter().position(|a| a.is_infinite() || *a < 0.0) {
            return Some(format!("frame {k}: area {} is not a number >= 0: check the vision", self.area_px2[k]));
        }
        if let Some((frames, periods)) = self.unnumbered() {
            return Some(format!(
                "its stream lasts {periods:.0} frames by their times and {frames} by their numbers: give each frame the number and the time at which \
                 the camera took it, so that a lost one leaves its number out"
            ));
        }
        if self.weight_g.is_nan() {
            return Some(
                "no weight: read the scale and enter it with `feature-worker episodes weigh FILE --weight G`, or in scale.csv".into(),
            );
        }
        if let Err(e) = episode::check_poured(self.weight_g) {
            return Some(format!("weight {} g: {e}", self.weight_g));
        }
        if !self.area_px2.iter().any(|a| *a > 0.0) {
            return Some(format!("no stream was ever seen, but the scale shows {} g: check the vision or the weight", self.weight_g));
        }
        if self.measured_is_commanded() {
            return Some(
                "the measured tilt is the commanded one, which no joint follows at once: give what the robot measured, or leave alpha_measured_deg out; \
                 alpha_deg is the commanded tilt"
                    .into(),
            );
        }
        let off_deg = servo::off_deg((&self.alpha_deg, &self.alpha_measured_deg), self.rate_hz);
        (off_deg > FOLLOWS_DEG).then(|| {
            format!(
                "the measured tilt follows the commanded one at no delay, and is off by {off_deg:.0} degrees (rms): alpha_measured_deg is in degrees, with \
                 the sign, the zero and the times of alpha_deg; of a recording, look at the joint"
            )
        })
    }

    /// How many frames there are from the first of the stream to the last, and how many there were by their times, where the two are not the same: lost
    /// frames whose numbers were given to others. What flowed in them is in the weight alone.
    fn unnumbered(&self) -> Option<(usize, f64)> {
        let (first, last) = (self.first_flow()?, self.area_px2.iter().rposition(|a| *a > 0.0)?);
        let mut steps_s: Vec<f64> = self.t_s.windows(2).map(|t| t[1] - t[0]).collect();
        steps_s.sort_by(f64::total_cmp);
        let period_s = *steps_s.get(steps_s.len() / 2)?;
        let frames = last.saturating_sub(first);
        let periods = (self.t_s[last] - self.t_s[first]) / period_s;
        let apart = (periods - frames as f64).abs();
        (apart > UNNUMBERED_FRAMES && apart > UNNUMBERED_SHARE * frames as f64).then_some((frames, periods))
    }

    /// Whether the measured tilt says nothing of its own, wherever both move.
    fn measured_is_commanded(&self) -> bool {
        let (mut apart, mut moved) = (0.0, 0.0);
        for (commanded, measured) in self.alpha_deg.windows(2).zip(self.alpha_measured_deg.iter().skip(1)).filter(|(_, m)| m.is_finite()) {
            apart += (measured - commanded[1]).powi(2);
            moved += ((commanded[1] - commanded[0]) * self.rate_hz * FOLLOWS_AT_ONCE_S).powi(2);
        }
        moved > 0.0 && apart <= moved
    }

    fn from_episode(e: &Episode) -> Self {
        let mut own = Self::empty(&e.name, e.frame_rate_hz());
        for f in &e.rows {
            own.push(f.t_s, f64::from(f.alpha_commanded_deg), f64::from(f.alpha_measured_deg), f64::from(f.area_px2));
        }
        own.weight_g = e.weight_g.unwrap_or(f64::NAN);
        own.framing = e.info.framing;
        own
    }
}

/// Takes out the episodes whose frame rate is not that of most others: a delay and a flow in frames mean something else in them. Of two rates that
/// are as frequent, that of the newest episode counts.
fn keep_one_rate(found: &mut UsableEpisodes) {
    let are_alike = |a_hz: f64, b_hz: f64| (a_hz - b_hz).abs() <= (RATES_APART * b_hz).max(1.01 * RATE_STEP_HZ);
    let alike = |a: &TrainingEpisode, b: &TrainingEpisode| are_alike(a.rate_hz, b.rate_hz);
    let frequent = found.episodes.iter().max_by_key(|e| found.episodes.iter().filter(|other| alike(e, other)).count());
    let Some(rate_hz) = frequent.map(|e| e.rate_hz) else { return };
    let (kept, others): (Vec<_>, Vec<_>) = std::mem::take(&mut found.episodes).into_iter().partition(|e| are_alike(e.rate_hz, rate_hz));
    found.episodes = kept;
    found.left_out.extend(others.into_iter().map(|e| {
        let what = format!("{} frames a second, and the others have {rate_hz}: train on one frame rate only", e.rate_hz);
        (e.name, what)
    }));
}

/// Takes out the episodes whose pictures show the lip otherwise than those of most others: an area may be another volume in them. Of two kinds that are as
/// frequent, the one of the newest episode counts. Episodes that do not say it stay.
fn keep_one_framing(found: &mut UsableEpisodes) {
    let known = || found.episodes.iter().map(|e| e.framing).filter(Framing::is_known);
    let alike = |framing: &Framing| known().filter(|other| framing.difference(other).is_none()).count();
    let Some(framing) = known().max_by_key(alike) else { return };
    found.episodes.retain(|e| {
        let difference = e.framing.difference(&framing);
        found.left_out.extend(difference.map(|what| {
            (
                e.name.clone(),
                format!("{what}, as the others have it: an area may be another volume there; train on episodes of one picture only"),
            )
        }));
        difference.is_none()
    });
}

/// How the lip lies in the pictures of a data set: of the newest episode that says it, and not known if none does. Those that do not say it are named as
/// doubtful.
pub fn framing(episodes: &[TrainingEpisode]) -> Framing {
    episodes.iter().rev().map(|e| e.framing).find(Framing::is_known).unwrap_or_default()
}

/// Frames a second of a data set: those of its first episode, or 30 of an empty set.
pub fn rate_hz(episodes: &[TrainingEpisode]) -> f64 {
    episodes.first().map_or(30.0, |e| e.rate_hz)
}

/// Where a command's episodes are.
#[derive(Debug, clap::Args)]
pub struct EpisodeSource {
    /// Episodes (.mcap) or directories of them, recordings as well as pours; with --scale, the table of features.
    #[arg(required = true)]
    episodes: Vec<PathBuf>,
    /// Table of weights (`episode, weight_g`); the episodes are then read from a table too.
    #[arg(long)]
    scale: Option<PathBuf>,
    /// Cells whose episodes count, once for each; without it, all must come from one cell.
    #[arg(long = "cell", value_name = "NAME")]
    cells: Vec<String>,
}

impl EpisodeSource {
    /// Reads the episodes. That they can be read and come from the chosen cells, or from one, is all that is checked here. Recordings come in the order of
    /// their age ([`episode::oldest_first`]), because the newest ones count where something has changed; tables keep their order.
    pub fn read(&self) -> Result<Vec<Episode>, DataError> {
        let mut episodes = Vec::new();
        if let Some(scale) = &self.scale {
            let [features] = self.episodes.as_slice() else { return Err(DataError::SeveralTables) };
            episodes = episode::read_table(features, scale)?;
        } else {
            for file in episode::find_episodes(&self.episodes)? {
                episodes.push(Episode::read(&file)?);
            }
            episodes = episode::oldest_first(episodes);
        }
        if episodes.is_empty() {
            let places: Vec<String> = self.episodes.iter().map(|p| p.display().to_string()).collect();
            return Err(DataError::None { places: places.join(", ") });
        }
        self.keep_cells(&mut episodes)?;
        Ok(episodes)
    }

    /// Keeps the episodes of the chosen cells. Where none is chosen, those that name their cell must name the same one: the episodes of two would be
    /// explained by one camera, whose gain then is that of neither or of the newer ones. No majority decides, as it might be that of the wrong cell.
    fn keep_cells(&self, episodes: &mut Vec<Episode>) -> Result<(), DataError> {
        let mut named: BTreeMap<&str, Vec<&Episode>> = BTreeMap::new();
        for e in episodes.iter().filter(|e| !e.info.cell.is_empty()) {
            named.entry(&e.info.cell).or_default().push(e);
        }
        let cells: Vec<String> =
            named.iter().map(|(cell, of)| format!("{cell}: {}, as {}", counted(of.len(), "episode"), of[0].name)).collect();
        let cells = cells.join("; ");
        if let Some(cell) = self.cells.iter().find(|cell| !named.contains_key(cell.as_str())) {
            let cells = if named.is_empty() { "none".into() } else { cells };
            return Err(DataError::NoSuchCell { cell: cell.clone(), cells });
        }
        if self.cells.is_empty() && named.len() > 1 {
            return Err(DataError::SeveralCells { cells });
        }
        if !self.cells.is_empty() {
            say_without_cell(episodes);
            episodes.retain(|e| self.cells.contains(&e.info.cell));
        }
        Ok(())
    }
}

/// Says which episodes do not name their cell, and so are of none that was chosen: nobody has said that these do not count.
fn say_without_cell(episodes: &[Episode]) {
    let unnamed: Vec<&str> = episodes.iter().filter(|e| e.info.cell.is_empty()).map(|e| e.name.as_str()).collect();
    if !unnamed.is_empty() {
        let (n, names) = (counted(unnamed.len(), "episode"), unnamed.join(", "));
        let what = format!("{n} without the name of a cell, and --cell takes only those that name theirs: {names}");
        eprintln!("left out: {}", plain(&what));
    }
}

/// The episodes of a data set that can be trained on, and the others.
#[derive(Debug, Clone, Default)]
pub struct UsableEpisodes {
    /// Episodes to train on.
    pub episodes: Vec<TrainingEpisode>,
    /// Name of each episode that was left out, and why.
    pub left_out: Vec<(String, String)>,
}

/// Keeps the episodes that can be trained on: complete, weighed and sound ones of one frame rate, whose stream the camera saw whole and all the way, and each
/// measurement once.
pub fn usable(episodes: &[Episode]) -> UsableEpisodes {
    let mut result = UsableEpisodes::default();
    let first = Episode::first_of_measurement(episodes);
    for (k, e) in episodes.iter().enumerate() {
        let own = TrainingEpisode::from_episode(e);
        // What is incomplete is no measurement.
        let same = |k| same(&first, k).filter(|other| episodes[*other].complete);
        let fault = if let Some(what) = e.lacks() {
            Some(format!("the recording is incomplete: {what}"))
        } else if let Some(other) = same(k).find(|other| weights_differ(e, &episodes[*other])) {
            Some(format!("the same measurement as {}, with another weight: correct one of them, or leave it out", episodes[other].name))
        } else if let Some(other) = same(k).find(|other| *other < k && episodes[*other].weight_g.is_some()) {
            Some(format!("the same measurement as {}: leave one of them out", episodes[other].name))
        } else {
            own.fault().or_else(|| e.stream_faults().next())
        };
        match fault {
            Some(what) => result.left_out.push((e.name.clone(), what)),
            None => result.episodes.push(own),
        }
    }
    keep_one_rate(&mut result);
    keep_one_framing(&mut result);
    result
}

/// The other episodes that hold the same measurement as the `k`-th; `first` is that of [`Episode::first_of_measurement`].
fn same(first: &[usize], k: usize) -> impl Iterator<Item = usize> {
    (0..first.len()).filter(move |other| *other != k && first[*other] == first[k])
}

/// Whether both are weighed, and differently.
fn weights_differ(a: &Episode, b: &Episode) -> bool {
    a.weight_g.zip(b.weight_g).is_some_and(|(a_g, b_g)| (a_g - b_g).abs() > WEIGHTS_APART_G)
}

/// SHA-256 of what is trained on: times, commanded angles, areas and weights of all episodes in order, and the measured angles of those that
/// have any. Their names do not matter.
pub fn hash(episodes: &[TrainingEpisode]) -> [u8; 32] {
    let mut hash = Sha256::new();
    for e in episodes {
        hash.update((e.len() as u64).to_le_bytes());
        let measured = e.alpha_measured_deg.iter().any(|a| a.is_finite()).then_some(&e.alpha_measured_deg);
        for v in [&e.t_s, &e.alpha_deg, &e.area_px2].into_iter().chain(measured).flatten() {
            hash.update(if v.is_nan() { f64::NAN } else { *v }.to_le_bytes());
        }
        hash.update(e.weight_g.to_le_bytes());
    }
    hash.finalize().into()
}
