//! The weight file: everything that the controller needs to pour, as postcard bytes with a CRC.
//!
//! Ordinary threads read and write it, which allocates; the loop only sees [`Weights`] that were checked here. A file that is truncated,
//! damaged, of another format version, of another shape or not finite is refused with one line that says which of these it is
//! ([`WeightsError`]). Writing is atomic: a temporary file in the same directory is synced and then renamed.
//!
//! ```text
//! offset  bytes  what
//!      0      8  "decant-w"
//!      8      4  format version, little endian
//!     12      8  shape: inputs, hidden 1, hidden 2, actions, 2 bytes each, little endian
//!     20      4  length of the rest, little endian
//!     24      n  postcard of `Weights`, then its CRC-32 (ISO-HDLC), 4 bytes
//! ```

use std::path::Path;

use crc::{CRC_32_ISO_HDLC, Crc};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::actions::{ACTIONS, BACK_DEG_PER_FRAME, Selection, nearest_action};
use crate::estimator::Calibration;
use crate::estimator::flow::WayBack;
use crate::estimator::fused::FusedModel;
use crate::framing::Framing;
use crate::mlp::{HIDDEN, INPUTS, InputScale, Mlp};
use crate::{regular_file, whole_file};

mod ranges;
mod way_back;

pub use way_back::check_way_back;

/// Version of the file format; files of other versions are refused.
pub const FORMAT_VERSION: u32 = 6;

/// The first bytes of every weight file.
const MAGIC: &[u8; 8] = b"decant-w";
/// Number of bytes before the payload.
const HEADER: usize = 24;
/// Number of neurons in each layer, inputs first.
const SHAPE: [usize; 4] = [INPUTS, HIDDEN, HIDDEN, ACTIONS];
/// Largest payload, bytes. Chosen by hand: a usual one has about 24 kB.
const PAYLOAD_MAX: usize = 64 * 1024;
/// Largest file, bytes.
const FILE_MAX: u64 = (HEADER + PAYLOAD_MAX) as u64;
/// How the checksum at the payload's end is computed.
const CRC: Crc<u32> = Crc::<u32>::new(&CRC_32_ISO_HDLC);

/// Everything that the controller needs to pour, and where it comes from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Weights {
    /// The network.
    pub network: Mlp,
    /// Angle of each action, degrees a frame, ascending: those of Fig. 5, or only two different ones.
    pub actions_deg: [f32; ACTIONS],
    /// How the network's outputs become an action.
    pub selection: Selection,
    /// How observations become the network's inputs.
    pub scale: InputScale,
    /// How an area in px^2 becomes a volume in ml.
    pub calibration: Calibration,
    /// How the poured volume is estimated.
    pub estimator: Estimator,
    /// Frames a second that the network was trained for.
    pub rate_hz: f32,
    /// Where the weights come from.
    pub origin: Origin,
    /// Seed of the training, and of [`Selection::Sampled`].
    pub seed: u64,
}

/// How the poured volume is estimated.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[expect(clippy::large_enum_variant, reason = "there is one of it in a process, and a box would be one more allocation")]
pub enum Estimator {
    /// The paper's plain sum of the frames' volumes.
    Sum,
    /// What the camera shows and what the container's geometry says, fused by a filter on the flow model.
    Fused {
        /// The fitted models.
        model: FusedModel,
        /// How the controller tilts back, which decides how much still flows then.
        back: WayBack,
    },
}

impl Estimator {
    /// Refuses a value that is outside its range, and names it.
    fn check(&self) -> Result<(), String> {
        match self {
            Self::Sum => Ok(()),
            Self::Fused { model, back } => ranges::check_fused(model, *back),
        }
    }
}

/// Where weights come from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Origin {
    /// How the network was trained.
    pub method: Method,
    /// Number of actions that were trained, 2 or 21.
    pub actions: u8,
    /// Number of episodes that it was trained on.
    pub episodes: u32,
    /// SHA-256 of the training data as the trainer hashes it.
    pub data_sha256: [u8; 32],
    /// How the lip lay in the pictures of the episodes; not known of tables.
    pub framing: Framing,
}

impl Origin {
    /// Whether the weights were trained on episodes of which nobody knows the pictures. Those that were made by hand were trained on none.
    pub fn pictures_unknown(&self) -> bool {
        self.episodes > 0 && !self.framing.is_known()
    }
}

/// How a network was trained.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Method {
    /// The paper's eq. (5)-(8), as printed.
    Literal,
    /// Eq. (8) with positive weights only.
    Paper,
    /// Behaviour cloning.
    Cloning,
    /// A flow model is fitted, a control law is searched in it, and the law is distilled into the network.
    Best,
    /// Made by hand, for tests and examples.
    Handmade,
}

/// Why a weight file is refused or could not be written.
#[derive(Debug, thiserror::Error)]
pub enum WeightsError {
    /// The file cannot be read.
    #[error("{file}: {what}")]
    Read {
        /// The file.
        file: String,
        /// The operating system's message.
        what: String,
    },
    /// The file cannot be written; what was there before is still there.
    #[error("{file}: cannot be written: {what}")]
    Write {
        /// The file.
        file: String,
        /// The operating system's message.
        what: String,
    },
    /// The file is not a weight file.
    #[error("{file}: not a weight file of Decant; train one with `trainer train`")]
    Foreign {
        /// The file.
        file: String,
    },
    /// The file has another version of the format.
    #[error("{file}: format version {found}, but this program reads {FORMAT_VERSION}; train again with this version")]
    Version {
        /// The file.
        file: String,
        /// The version in the file.
        found: u32,
    },
    /// The file holds a network of another shape.
    #[error("{file}: a network of shape {found:?}, but this program runs {SHAPE:?}; train again with this version")]
    Shape {
        /// The file.
        file: String,
        /// The shape in the file, neurons of each layer.
        found: [usize; 4],
    },
    /// The file is shorter or longer than its header says.
    #[error("{file}: truncated or too long: it has {found} bytes where its header says {expected}; copy it again")]
    Length {
        /// The file.
        file: String,
        /// Number of bytes in the file.
        found: usize,
        /// Number of bytes that the header announces.
        expected: usize,
    },
    /// The checksum does not match, or the contents make no sense.
    #[error("{file}: damaged (checksum or contents do not match); copy it again or train again")]
    Damaged {
        /// The file.
        file: String,
    },
    /// A value is not finite or out of its range.
    #[error("{file}: {what}; train again")]
    Value {
        /// The file.
        file: String,
        /// Which value, and what is allowed.
        what: String,
    },
}

impl Weights {
    /// Index of the action that tilts back: the one nearest to [`BACK_DEG_PER_FRAME`].
    pub fn back_action(&self) -> usize {
        nearest_action(&self.actions_deg, BACK_DEG_PER_FRAME)
    }

    /// The file's bytes. The same weights give the same bytes.
    pub fn to_bytes(&self) -> Result<Vec<u8>, WeightsError> {
        let mut buffer = vec![0; PAYLOAD_MAX];
        let refused = |e: postcard::Error| WeightsError::Write { file: "weights".into(), what: e.to_string() };
        let payload = postcard::to_slice_crc32(self, &mut buffer, CRC.digest()).map_err(refused)?;
        let mut bytes = Vec::with_capacity(HEADER + payload.len());
        bytes.extend_from_slice(MAGIC);
        bytes.extend_from_slice(&FORMAT_VERSION.to_le_bytes());
        for n in SHAPE {
            bytes.extend_from_slice(&(n as u16).to_le_bytes());
        }
        bytes.extend_from_slice(&(payload.len() as u32).to_le_bytes());
        bytes.extend_from_slice(payload);
        Ok(bytes)
    }

    /// Checks and reads a file's bytes; `file` is named in errors.
    pub fn from_bytes(bytes: &[u8], file: &str) -> Result<Self, WeightsError> {
        let file = || file.to_owned();
        if bytes.len() < HEADER {
            return Err(if MAGIC.starts_with(bytes) || bytes.starts_with(MAGIC) {
                WeightsError::Length { file: file(), found: bytes.len(), expected: HEADER }
            } else {
                WeightsError::Foreign { file: file() }
            });
        }
        if !bytes.starts_with(MAGIC) {
            return Err(WeightsError::Foreign { file: file() });
        }
        let u16_at = |at: usize| usize::from(u16::from_le_bytes([bytes[at], bytes[at + 1]]));
        let u32_at = |at: usize| u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]]);
        let version = u32_at(8);
        if version != FORMAT_VERSION {
            return Err(WeightsError::Version { file: file(), found: version });
        }
        let shape = [u16_at(12), u16_at(14), u16_at(16), u16_at(18)];
        if shape != SHAPE {
            return Err(WeightsError::Shape { file: file(), found: shape });
        }
        let expected = HEADER.saturating_add(u32_at(20) as usize);
        if bytes.len() != expected {
            return Err(WeightsError::Length { file: file(), found: bytes.len(), expected });
        }
        let weights: Self =
            postcard::from_bytes_crc32(&bytes[HEADER..], CRC.digest()).map_err(|_| WeightsError::Damaged { file: file() })?;
        weights.check().map_err(|what| WeightsError::Value { file: file(), what })?;
        Ok(weights)
    }

    /// Reads and checks a weight file.
    pub fn read(path: &Path) -> Result<Self, WeightsError> {
        Self::from_file(path, regular_file::read(path, FILE_MAX))
    }

    /// Reads and checks a weight file that nobody but this user, root and `trusted` (a user number) may have written.
    pub fn read_of_owner(path: &Path, trusted: Option<u32>) -> Result<Self, WeightsError> {
        Self::from_file(path, regular_file::read_of_owner(path, FILE_MAX, trusted))
    }

    fn from_file(path: &Path, bytes: std::io::Result<Vec<u8>>) -> Result<Self, WeightsError> {
        let file = path.display().to_string();
        Self::from_bytes(&bytes.map_err(|e| WeightsError::Read { file: file.clone(), what: e.to_string() })?, &file)
    }

    /// Checks and writes a weight file, atomically: a reader sees the old file or the new one, whole.
    pub fn write(&self, path: &Path) -> Result<(), WeightsError> {
        let file = path.display().to_string();
        self.check().map_err(|what| WeightsError::Value { file: file.clone(), what })?;
        let bytes = self.to_bytes()?;
        whole_file::replace(path, &bytes, MAGIC).map_err(|e| WeightsError::Write { file, what: e.to_string() })
    }

    /// Whether [`Weights::write`] may put a file at `path`: what is there is a weight file, or empty.
    pub fn may_write(path: &Path) -> Result<(), WeightsError> {
        whole_file::check(path, MAGIC).map_err(|e| WeightsError::Write { file: path.display().to_string(), what: e.to_string() })
    }

    /// The identity: the first 8 bytes of the SHA-256 of the file's bytes, as a big-endian number; 0 if there are no such bytes.
    pub fn id(&self) -> u64 {
        self.to_bytes().map_or(0, |bytes| Sha256::digest(&bytes)[..8].iter().fold(0, |id, b| id << 8 | u64::from(*b)))
    }

    /// The identity as people and files write it: [`Weights::id`] as 16 hexadecimal digits.
    pub fn identity(&self) -> String {
        format!("{:016x}", self.id())
    }

    /// Refuses weights that must not reach the robot, and names the first wrong value.
    fn check(&self) -> Result<(), String> {
        if let Some(k) = self.network.parameters().position(|p| !p.is_finite()) {
            return Err(format!("parameter {k} of the network is not finite"));
        }
        let ascending = self.actions_deg.windows(2).all(|w| w[0] <= w[1]);
        if !ascending || self.actions_deg.iter().any(|a| !a.is_finite() || a.abs() > 10.0) {
            return Err("the action table is not ascending within +-10 degrees".into());
        }
        let InputScale { v_per_ml, d_ml, gain } = self.scale;
        let positive = [("input scale of v", v_per_ml), ("input scale of d", d_ml), ("input gain", gain), ("frame rate", self.rate_hz)];
        for (name, value) in positive {
            if !(value.is_finite() && value > 0.0) {
                return Err(format!("{name} is {value}, not a positive number"));
            }
        }
        if !self.origin.framing.is_finite() {
            return Err("the framing of the episodes is not finite".into());
        }
        ranges::check_calibration(&self.calibration)?;
        self.estimator.check()
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::actions::action_table;
    use crate::estimator::filter::UNKNOWNS;
    use crate::estimator::flow::FlowModel;
    use crate::estimator::fused::Explanation;
    use crate::estimator::verdict::Bounds;
    use proptest::prelude::*;

    /// Valid weights whose network has arbitrary parameters, made by hand.
    pub(crate) fn example() -> Weights {
        let mut network = Mlp::ZERO;
        for (k, p) in network.parameters_mut().enumerate() {
            *p = (k as f32 * 0.7).sin() * 0.1;
        }
        Weights {
            network,
            actions_deg: action_table(),
            selection: Selection::Argmax,
            scale: InputScale::default(),
            calibration: Calibration { volume_at_1_px2_ml: 0.002, area_exponent: 1.15, log_tilt_slope: 0.05, hold_above_px2: 60.0 },
            estimator: Estimator::Sum,
            rate_hz: 30.0,
            origin: Origin { method: Method::Handmade, actions: 21, episodes: 0, data_sha256: [7; 32], framing: Framing::default() },
            seed: 1,
        }
    }

    /// A fused model of the default vessel, made by hand.
    pub(crate) fn fused_model() -> FusedModel {
        let mut unknowns = [[0.0; UNKNOWNS]; UNKNOWNS];
        for (k, row) in unknowns.iter_mut().enumerate() {
            row[k] = [0.15f64, 0.04, 0.3].get(k).copied().unwrap_or(0.02).powi(2);
        }
        let calibration = Calibration { volume_at_1_px2_ml: 0.002, area_exponent: 1.15, log_tilt_slope: 0.05, hold_above_px2: 60.0 };
        let explanation = Explanation { model: FlowModel::default(), calibration, unknowns };
        FusedModel {
            explanations: [explanation; 2],
            tight_share: 0.9,
            camera: [[0.04, -0.006], [-0.006, 0.001]],
            gain_sd: 0.015,
            bounds: Bounds { most_px2: 5000.0, dry_deg: 90.0 },
        }
    }

    /// The same with the fused estimate.
    pub(crate) fn fused_example() -> Weights {
        Weights { estimator: Estimator::Fused { model: fused_model(), back: WayBack { rate_deg: 2.0, change_deg: 1.67 } }, ..example() }
    }

    /// Protects the swap: what is written is what is read, with the same identity, and no temporary file is left.
    #[test]
    fn a_written_file_reads_back_the_same() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("w.bin");
        let weights = example();
        weights.write(&path).unwrap();
        weights.write(&path).unwrap();
        let read = Weights::read(&path).unwrap();
        assert_eq!(read, weights);
        assert_eq!(read.identity(), weights.identity());
        assert_eq!(read.identity().len(), 16);
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1);
    }

    /// Protects the robot: a file that is cut at any byte is refused, and reading it never panics.
    #[test]
    fn every_truncation_is_refused() {
        let bytes = example().to_bytes().unwrap();
        for n in 0..bytes.len() {
            let error = Weights::from_bytes(&bytes[..n], "w").unwrap_err();
            assert!(matches!(error, WeightsError::Length { .. }), "{n}: {error}");
        }
        let mut long = bytes;
        long.push(0);
        assert!(matches!(Weights::from_bytes(&long, "w"), Err(WeightsError::Length { .. })));
    }

    /// Protects the robot: a single flipped bit anywhere is refused.
    #[test]
    fn every_flipped_bit_is_refused() {
        let bytes = example().to_bytes().unwrap();
        for bit in 0..bytes.len() * 8 {
            let mut bad = bytes.clone();
            bad[bit / 8] ^= 1 << (bit % 8);
            assert!(Weights::from_bytes(&bad, "w").is_err(), "bit {bit}");
        }
    }

    proptest! {
        /// Protects the service thread: no bytes, however wild, make it panic.
        #[test]
        fn any_bytes_are_refused_calmly(bytes in prop::collection::vec(any::<u8>(), 0..200), keep in 0usize..30) {
            let mut mixed = example().to_bytes().unwrap();
            mixed.truncate(keep);
            mixed.extend(&bytes);
            prop_assert!(Weights::from_bytes(&mixed, "w").is_err());
        }
    }

    /// Protects the operator: each refusal names its own reason.
    #[test]
    fn refusals_say_which() {
        let good = example().to_bytes().unwrap();
        let say = |bytes: &[u8]| Weights::from_bytes(bytes, "w.bin").unwrap_err().to_string();
        assert!(say(b"GIF89a, a picture and no weights").contains("not a weight file"));
        let mut other = good.clone();
        other[8] = 9;
        assert!(say(&other).contains("format version 9"));
        let mut shape = good.clone();
        shape[14] = 64;
        assert!(say(&shape).contains("shape [4, 64, 32, 21]"));
        assert!(say(&good[..100]).contains("truncated"));
        let mut flipped = good.clone();
        flipped[200] ^= 4;
        assert!(say(&flipped).contains("damaged"));
        for (what, change) in [
            ("parameter 5", (|w: &mut Weights| w.network.w1[0][5] = f32::NAN) as fn(&mut Weights)),
            ("action table", |w| w.actions_deg[3] = 7.0),
            ("calibration c", |w| w.calibration.volume_at_1_px2_ml = f32::INFINITY),
            ("exponent", |w| w.calibration.area_exponent = f32::NAN),
            ("change with the tilt", |w| w.calibration.log_tilt_slope = f32::NAN),
            ("frame rate", |w| w.rate_hz = 0.0),
            ("hold", |w| w.calibration.hold_above_px2 = f32::NAN),
            ("estimator: delay", |w| {
                *w = fused_example();
                if let Estimator::Fused { model, .. } = &mut w.estimator {
                    model.explanations[1].model.delay_frames = f64::NAN;
                }
            }),
            ("estimator: variance of log c", |w| {
                *w = fused_example();
                if let Estimator::Fused { model, .. } = &mut w.estimator {
                    model.camera[0][0] = f64::NAN;
                }
            }),
            ("the covariance of log c and q", |w| {
                *w = fused_example();
                if let Estimator::Fused { model, .. } = &mut w.estimator {
                    // Each is within its range, and together they would make a mixture of the two vary by less than nothing.
                    model.camera = [[0.04, -0.02], [-0.02, 0.001]];
                }
            }),
            ("the covariance of log c and q", |w| {
                *w = fused_example();
                if let Estimator::Fused { model, .. } = &mut w.estimator {
                    model.camera[1][0] = 0.0;
                }
            }),
            ("the covariance of the unknowns", |w| {
                *w = fused_example();
                if let Estimator::Fused { model, .. } = &mut w.estimator {
                    // Each pair is possible by itself, and the three together are not.
                    let unknowns = &mut model.explanations[1].unknowns;
                    for (j, k, correlation) in [(0usize, 1usize, 0.9), (1, 2, 0.9), (0, 2, -0.9)] {
                        unknowns[j][k] = correlation * (unknowns[j][j] * unknowns[k][k]).sqrt();
                        unknowns[k][j] = unknowns[j][k];
                    }
                }
            }),
        ] {
            let mut weights = example();
            change(&mut weights);
            let line = say(&weights.to_bytes().unwrap());
            assert!(line.contains(what) && line.starts_with("w.bin: "), "{line}");
            assert!(weights.write(Path::new("never-written.bin")).is_err());
        }
        let missing = Weights::read(Path::new("/nonexistent/w.bin")).unwrap_err().to_string();
        assert!(missing.starts_with("/nonexistent/w.bin: "));
        assert!(example().write(Path::new("/nonexistent/w.bin")).unwrap_err().to_string().contains("cannot be written"));
    }
}
