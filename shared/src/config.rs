//! The cell's configuration, one TOML file: `config/cell.toml` for the real cell, `config/sim.toml` for the simulated one.
//!
//! Every process reads it once at its start, in an ordinary thread, and that allocates. Unknown keys, wrong types and values out of range
//! are refused with a [`ConfigError`], which names the file, the key and what is allowed. Relative paths start at the directory of the file.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

pub use crate::config_camera::{CameraConfig, CameraSource, Locked, Refused, SETTINGS, Setting};
pub use crate::config_container::ContainerConfig;
use crate::config_paths;
use crate::limits::Limits;
use crate::regular_file;
use crate::robot_address::RobotAddress;

/// The environment variable that names the configuration where `--config` is not given.
pub const VARIABLE: &str = "DECANT_CONFIG";
/// The file that is read without `--config` and without [`VARIABLE`]: the simulated cell, so that a real robot only moves when its file is named.
pub const DEFAULT_FILE: &str = "config/sim.toml";

/// Largest configuration that is read, bytes. Chosen by hand: a hundred times the longest one that is known.
pub const FILE_MAX: u64 = 1 << 20;

/// The rule for a cell's name, in words; the name becomes part of file names.
pub(crate) const CELL_NAME_RULE: &str = "1 to 32 letters, digits, '-' or '_'";

/// Whether `name` is a legal name of a cell: 1 to 32 letters, digits, `-` or `_`.
pub fn is_cell_name(name: &str) -> bool {
    let legal = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
    (1..=32).contains(&name.len()) && name.chars().all(legal)
}

/// Why a configuration is refused.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("{file}: {what}")]
    Read {
        /// The file.
        file: String,
        /// The operating system's message.
        what: String,
    },
    /// The file is not TOML, or has an unknown key, a missing key or a wrong type.
    #[error("{file}: {what}")]
    Parse {
        /// The file.
        file: String,
        /// The line, the key and what was expected.
        what: String,
    },
    /// A value is outside its range.
    #[error("{file}: {key} = {value}: it must be {allowed}")]
    Range {
        /// The file.
        file: String,
        /// The key, with its table.
        key: String,
        /// The value that was given.
        value: String,
        /// The values that are allowed.
        allowed: String,
    },
}

/// The configuration, table by table.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Which cell this is.
    pub cell: CellConfig,
    /// Where frames come from.
    pub camera: CameraConfig,
    /// Where the lip is in the image, and how liquid is told from the background.
    pub image: ImageConfig,
    /// What is known of the vessel.
    #[serde(default)]
    pub container: ContainerConfig,
    /// The robot and its tilting joint.
    pub robot: RobotConfig,
    /// Limits on alpha.
    pub limits: Limits,
    /// The controller process.
    pub controller: ControllerConfig,
    /// The feature worker process.
    pub worker: WorkerConfig,
    /// Episodes.
    pub recording: RecordingConfig,
    /// The simulated cell's own table, which only `simulator` reads.
    #[serde(default)]
    pub simulator: Option<toml::Table>,
}

/// The table `[cell]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CellConfig {
    /// The name that sets this cell's shared memory apart: 1 to 32 letters, digits, '-' or '_'.
    pub name: String,
    /// The directory in which a directory of the cell's name holds its runtime files; without this key [`crate::runtime_dir`] chooses one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub runtime_dir: Option<PathBuf>,
}

/// How liquid is told from the background.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum LiquidMethod {
    /// By its colour, which `image.colour_hsv` gives.
    Colour,
    /// Clear water is told by what does not move with the background. It needs an even card behind the lip (docs/VISION.md).
    Clear,
}

/// The table `[image]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ImageConfig {
    /// How liquid is told from the background.
    pub method: LiquidMethod,
    /// The region at the lip that is looked at, px: x, y, width, height.
    pub region_px: [u32; 4],
    /// x-axis of Fig. 4: two points on the glass's top edge, px: x0, y0, x1, y1, from the lip's side into the mouth. The
    /// triangle lies between this direction and that of `y_axis_px`.
    pub x_axis_px: [f32; 4],
    /// y-axis of Fig. 4: two points on the container's left side, px: x0, y0, x1, y1, from its foot towards its rim.
    pub y_axis_px: [f32; 4],
    /// Colour range of the liquid in OpenCV's HSV: h_min, s_min, v_min, h_max, s_max, v_max (h 0-179, s and v 0-255;
    /// h_min > h_max wraps around red).
    pub colour_hsv: [u8; 6],
    /// The smallest area that counts as a stream, px^2.
    pub area_min_px2: f32,
}

/// The table `[robot]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RobotConfig {
    /// The UR controller's address, or its name.
    pub address: RobotAddress,
    /// The joint that tilts the container.
    pub joint: Joint,
    /// Angle of that joint when the container is upright (alpha = 0), degrees.
    pub start_joint_deg: f64,
    /// +1 or -1: the sign of the joint's motion when alpha grows.
    pub direction: f64,
    /// Largest distance from the start angle at which the program starts, degrees.
    pub start_tolerance_deg: f64,
    /// The first RTDE register that is used, 24 to 40; 0 to 23 belong to fieldbuses (RTDE guide).
    pub register_base: u8,
    /// Lookahead time of the robot's servoj command, s.
    pub lookahead_s: f64,
    /// Gain of the robot's servoj command.
    pub gain: f64,
    /// Mass of holder and full vessel that the robot is expected to have been told, kg; without this key any vessel's mass will do.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub payload_kg: Option<f64>,
}

/// A joint of the UR5, base to tool.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[allow(missing_docs)]
pub enum Joint {
    Base,
    Shoulder,
    Elbow,
    #[serde(rename = "wrist_1")]
    Wrist1,
    #[serde(rename = "wrist_2")]
    Wrist2,
    #[serde(rename = "wrist_3")]
    Wrist3,
}

impl Joint {
    /// Index in the robot's joint vectors, 0 to 5.
    pub fn index(self) -> usize {
        self as usize
    }
}

/// The table `[controller]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ControllerConfig {
    /// Ticks a second; 30 in the paper.
    pub rate_hz: f64,
    /// Number of the processor core that the loop is pinned to.
    pub core: usize,
    /// SCHED_FIFO priority of the loop, 1 to 99; 0 means ordinary scheduling.
    pub priority: u8,
    /// The weight file. It is watched, and when it changes it is taken between pours.
    pub weights: PathBuf,
    /// The journal, to which every tick's inputs are written for `rt-controller replay`; without this key there is none.
    #[serde(default)]
    pub journal: Option<PathBuf>,
    /// Largest age of the newest usable measurement during a pour, ms.
    pub stale_feature_ms: u32,
    /// The robot counts as lost when its newest state is older than this, ms.
    pub lost_robot_ms: u32,
    /// Largest number of frames of a pour.
    pub max_frames: u32,
    /// Number of frames without flow at the largest tilt after which the container counts as empty.
    pub empty_frames: u32,
    /// Largest goal that is accepted, ml: the receiving container's size, D_max of eq. (3).
    pub goal_max_ml: f32,
}

/// The table `[worker]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WorkerConfig {
    /// Number of the processor core that the extraction is pinned to.
    pub core: usize,
    /// SCHED_FIFO priority of the extraction, 1 to 99; 0 means ordinary scheduling.
    pub priority: u8,
}

/// Compression of recorded images.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[allow(missing_docs)]
pub enum ImageFormat {
    Jpeg,
    Png,
}

/// The table `[recording]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RecordingConfig {
    /// Directory of the episodes.
    pub directory: PathBuf,
    /// Compression of the images.
    pub image_format: ImageFormat,
    /// JPEG quality, 1 to 100.
    pub jpeg_quality: u8,
    /// Largest number of images that may wait to be written; further ones are dropped and counted.
    pub queue_frames: usize,
    /// Megabytes (1,000,000 bytes) that episodes may take in the directory before `feature-worker episodes prune` deletes some; 0 for no
    /// bound.
    #[serde(default)]
    pub budget_mb: u64,
    /// Number of episodes that may lie there before `feature-worker episodes prune` deletes some; 0 for no bound.
    #[serde(default)]
    pub budget_episodes: usize,
}

impl Config {
    /// Reads and checks `file`.
    pub fn read(file: &Path) -> Result<Self, ConfigError> {
        let name = file.display().to_string();
        let text = regular_file::read_text(file, FILE_MAX)
            .map_err(|e| ConfigError::Read { file: name.clone(), what: format!("{e}; give --config FILE") })?;
        let mut config = Self::parse(&text, &name)?;
        config.place_beside(file);
        config.check_paths(file)?;
        Ok(config)
    }

    /// Makes the paths absolute. Relative ones start at the directory of `file`.
    fn place_beside(&mut self, file: &Path) {
        let place = |path: &mut PathBuf| *path = config_paths::beside(file, path);
        place(&mut self.controller.weights);
        place(&mut self.recording.directory);
        self.controller.journal.iter_mut().for_each(place);
        self.cell.runtime_dir.iter_mut().for_each(place);
        if matches!(self.camera.source, CameraSource::Device | CameraSource::Video | CameraSource::Images) {
            self.camera.path = config_paths::beside(file, Path::new(&self.camera.path)).display().to_string();
        }
    }

    /// Refuses a configuration in which two keys mean one file, or a key means `file` itself.
    fn check_paths(&self, file: &Path) -> Result<(), ConfigError> {
        let mut paths = vec![("the configuration", file.to_path_buf()), ("controller.weights", self.controller.weights.clone())];
        if let Some(journal) = &self.controller.journal {
            paths.push(("controller.journal", journal.clone()));
            paths.push(("the journal before, controller.journal", journal.with_extension("before.bin")));
        }
        paths.push(("recording.directory", self.recording.directory.clone()));
        if !self.camera.path.is_empty() {
            paths.push(("camera.path", PathBuf::from(&self.camera.path)));
        }
        let own = self.cell.runtime_dir.as_ref().map(|base| base.join(&self.cell.name));
        paths.extend(self.cell.runtime_dir.clone().map(|base| ("cell.runtime_dir", base)));
        let refused = |key: &str, allowed: String| {
            let value = paths.iter().find(|(k, _)| *k == key).map_or(String::new(), |(_, path)| path.display().to_string());
            ConfigError::Range { file: file.display().to_string(), key: key.into(), value, allowed }
        };
        // What tells other programs of a path tells it as text.
        if let Some((key, _)) = paths.iter().find(|(_, path)| path.to_str().is_none()) {
            return Err(refused(key, "text in UTF-8: give its directory another name".into()));
        }
        if let Some((key, _)) = own.and_then(|own| paths.iter().find(|(_, path)| config_paths::is_in(&own, path))) {
            return Err(refused(key, "outside of the cell's runtime directory, where other files could take its name".into()));
        }
        match config_paths::clash(&paths) {
            Some((first, second)) => Err(refused(second, format!("another path than {first}: they would overwrite each other"))),
            None => Ok(()),
        }
    }

    /// Parses and checks `text`; `file` is named in errors.
    pub fn parse(text: &str, file: &str) -> Result<Self, ConfigError> {
        let config: Self = toml::from_str(text).map_err(|e| {
            let start = e.span().map_or(0, |s| s.start);
            let line = text[..start].matches('\n').count();
            let key = text.lines().nth(line).and_then(|l| l.split_once('=')).map_or(String::new(), |(k, _)| format!(", {}", k.trim()));
            ConfigError::Parse { file: file.into(), what: format!("line {}{key}: {}", line + 1, e.message().replace('\n', " ")) }
        })?;
        config.check(file)?;
        Ok(config)
    }

    fn check(&self, file: &str) -> Result<(), ConfigError> {
        let check = Check { file };
        check.rule("cell.name", &self.cell.name, is_cell_name(&self.cell.name), CELL_NAME_RULE)?;
        check.range("controller.rate_hz", self.controller.rate_hz, 10.0, 125.0)?;
        check.camera(&self.camera, self.controller.rate_hz)?;
        check.image(&self.image, &self.camera)?;
        check.robot(&self.robot, &self.limits)?;
        check.way_back(&self.limits, self.controller.rate_hz)?;
        if let Some((key, value, allowed)) = self.container.fault() {
            check.rule(key, &value.to_string(), false, &allowed)?;
        }
        check.processes(&self.controller, &self.worker, &self.recording)
    }
}

/// Checks values, and names `file` where one is refused.
pub(crate) struct Check<'a> {
    file: &'a str,
}

impl Check<'_> {
    pub(crate) fn rule(&self, key: &str, value: &str, holds: bool, allowed: &str) -> Result<(), ConfigError> {
        if holds {
            return Ok(());
        }
        Err(ConfigError::Range { file: self.file.into(), key: key.into(), value: value.into(), allowed: allowed.into() })
    }

    pub(crate) fn range(&self, key: &str, value: f64, low: f64, high: f64) -> Result<(), ConfigError> {
        self.rule(key, &value.to_string(), value >= low && value <= high, &format!("{low} to {high}"))
    }

    fn image(&self, image: &ImageConfig, camera: &CameraConfig) -> Result<(), ConfigError> {
        let [x, y, w, h] = image.region_px.map(f64::from);
        let inside = w >= 8.0 && h >= 8.0 && x + w <= f64::from(camera.width_px) && y + h <= f64::from(camera.height_px);
        self.rule(
            "image.region_px",
            &format!("{:?}", image.region_px),
            inside,
            &format!("x, y, width, height of at least 8 x 8 inside {} x {}", camera.width_px, camera.height_px),
        )?;
        let direction = |a: [f32; 4]| (f64::from(a[2] - a[0]), f64::from(a[3] - a[1]));
        for (key, axis) in [("image.x_axis_px", image.x_axis_px), ("image.y_axis_px", image.y_axis_px)] {
            let (dx, dy) = direction(axis);
            let fine = axis.iter().all(|v| v.is_finite()) && dx.hypot(dy) >= 2.0;
            self.rule(key, &format!("{axis:?}"), fine, "x0, y0, x1, y1 of two points at least 2 px apart")?;
        }
        let ((ax, ay), (bx, by)) = (direction(image.x_axis_px), direction(image.y_axis_px));
        let sine = (ax * by - ay * bx).abs() / (ax.hypot(ay) * bx.hypot(by));
        self.rule(
            "image.y_axis_px",
            &format!("{:?}", image.y_axis_px),
            sine > 0.17,
            "an axis at least 10 degrees from image.x_axis_px (these are nearly parallel)",
        )?;
        let [h0, s0, v0, h1, s1, v1] = image.colour_hsv;
        let colour_ok = h0 <= 179 && h1 <= 179 && s0 < s1 && v0 < v1;
        self.rule(
            "image.colour_hsv",
            &format!("{:?}", image.colour_hsv),
            colour_ok,
            "h_min, s_min, v_min, h_max, s_max, v_max with h 0 to 179, s_min < s_max, v_min < v_max",
        )?;
        self.range("image.area_min_px2", image.area_min_px2.into(), 0.0, 1e5)
    }

    fn robot(&self, robot: &RobotConfig, limits: &Limits) -> Result<(), ConfigError> {
        self.range("robot.start_joint_deg", robot.start_joint_deg, -360.0, 360.0)?;
        self.rule("robot.direction", &robot.direction.to_string(), robot.direction.abs() == 1.0, "1 or -1")?;
        self.range("robot.start_tolerance_deg", robot.start_tolerance_deg, 0.1, 10.0)?;
        self.range("robot.register_base", robot.register_base.into(), 24.0, 40.0)?;
        self.range("robot.lookahead_s", robot.lookahead_s, 0.03, 0.2)?;
        self.range("robot.gain", robot.gain, 100.0, 2000.0)?;
        self.range("robot.payload_kg", robot.payload_kg.unwrap_or(0.0), 0.0, 5.0)?;

        self.range("limits.alpha_min_deg", limits.alpha_min_deg.into(), -20.0, 0.0)?;
        self.range("limits.alpha_max_deg", limits.alpha_max_deg.into(), 10.0, 180.0)?;
        self.range("limits.step_deg", limits.step_deg.into(), 0.1, 6.0)?;
        self.range("limits.rate_deg_s", limits.rate_deg_s.into(), 1.0, 180.0)?;
        self.range("limits.acceleration_deg_s2", limits.acceleration_deg_s2.into(), 10.0, 2290.0)?;
        self.range("limits.return_rate_deg_s", limits.return_rate_deg_s.into(), 1.0, 180.0)?;

        let ends = [limits.alpha_min_deg, limits.alpha_max_deg].map(|a| robot.start_joint_deg + robot.direction * f64::from(a));
        self.rule(
            "robot.start_joint_deg",
            &robot.start_joint_deg.to_string(),
            ends.iter().all(|e| e.abs() <= 360.0),
            "an angle from which limits.alpha_min_deg and limits.alpha_max_deg stay within the joint's -360 to 360",
        )
    }

    /// What still flows on the way back is foreseen for its rate, which a small step of each tick would not reach.
    fn way_back(&self, limits: &Limits, rate_hz: f64) -> Result<(), ConfigError> {
        let rate_deg_s = limits.return_rate_deg_s.min(limits.rate_deg_s);
        let least_deg = f64::from(rate_deg_s) / rate_hz;
        self.rule(
            "limits.step_deg",
            &limits.step_deg.to_string(),
            f64::from(limits.step_deg) >= least_deg - 1e-3,
            &format!(
                "at least {least_deg:.2}: the way upright has {rate_deg_s} degrees/s, the smaller of limits.rate_deg_s and return_rate_deg_s, at \
                 controller.rate_hz = {rate_hz}; where that is above 6, make these rates smaller"
            ),
        )
    }

    fn processes(&self, controller: &ControllerConfig, worker: &WorkerConfig, recording: &RecordingConfig) -> Result<(), ConfigError> {
        self.range("controller.core", controller.core as f64, 0.0, 1023.0)?;
        self.range("controller.priority", controller.priority.into(), 0.0, 99.0)?;
        self.range("controller.stale_feature_ms", controller.stale_feature_ms.into(), 50.0, 1000.0)?;
        self.range("controller.lost_robot_ms", controller.lost_robot_ms.into(), 20.0, 1000.0)?;
        self.range("controller.max_frames", controller.max_frames.into(), 30.0, 100_000.0)?;
        self.range("controller.empty_frames", controller.empty_frames.into(), 5.0, 1000.0)?;
        self.range("controller.goal_max_ml", controller.goal_max_ml.into(), 1.0, 5000.0)?;
        self.range("worker.core", worker.core as f64, 0.0, 1023.0)?;
        self.range("worker.priority", worker.priority.into(), 0.0, 99.0)?;
        self.range("recording.jpeg_quality", recording.jpeg_quality.into(), 1.0, 100.0)?;
        self.range("recording.queue_frames", recording.queue_frames as f64, 2.0, 1000.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIM: &str = include_str!("../../config/sim.toml");
    const CELL: &str = include_str!("../../config/cell.toml");

    fn refusal(from: &str, to: &str) -> String {
        assert!(CELL.contains(from), "{from}");
        Config::parse(&CELL.replace(from, to), "cell.toml").expect_err("must be refused").to_string()
    }

    /// Protects the shipped files: both are valid, and only the simulated cell has a simulator.
    #[test]
    fn the_shipped_files_are_valid() {
        assert!(Config::parse(SIM, "sim.toml").expect("valid").simulator.is_some());
        assert!(Config::parse(CELL, "cell.toml").expect("valid").simulator.is_none());
    }

    /// Protects the operator from typing errors: each refusal names the file, the key and what is allowed.
    #[test]
    fn mistakes_are_refused_with_file_key_and_range() {
        for (from, to, words) in [
            ("rate_hz = 30.0", "rate_hz = 3.0", ["controller.rate_hz = 3", "10 to 125"]),
            ("start_joint_deg = 0.0", "start_joint_deg = 300.0", ["robot.start_joint_deg = 300", "limits.alpha_max_deg"]),
            ("rate_hz = 30.0", "rate_hz = \"fast\"", ["rate_hz", "invalid type"]),
            ("rate_hz = 30.0", "rate_hz = nan", ["controller.rate_hz", "10 to 125"]),
            ("gain = 600.0", "gian = 600.0", ["gian", "expected one of"]),
            ("gain = 600.0", "gain = 5000.0", ["robot.gain", "100 to 2000"]),
            ("joint = \"wrist_3\"", "joint = \"wrist_4\"", ["wrist_4", "wrist_3"]),
            ("direction = 1.0", "direction = 0.5", ["robot.direction", "1 or -1"]),
            ("name = \"lab\"", "name = \"../x\"", ["cell.name", "letters"]),
            ("path = \"/dev/video0\"", "path = \"\"", ["camera.path", "device"]),
            ("fps = 30.0", "fps = 30.0\nmains_hz = 55", ["camera.mains_hz = 55", "50, 60, 0"]),
            ("fps = 30.0", "fps = 241.0", ["camera.fps = 241", "1 to 240, and at most 4 for each tick"]),
            ("fps = 30.0", "fps = 121.0", ["camera.fps = 121", "at most 4 for each tick"]),
            ("fps = 30.0", "fps = 30.0\nexposure_ms = 0", ["camera.exposure_ms = 0", "0.01 to 1000"]),
            ("fps = 30.0", "fps = 30.0\ngain = \"auto\"", ["gain", "Setting"]),
            ("width_px = 640", "width_px = 320", ["image.region_px", "inside 320"]),
            ("register_base = 24", "register_base = 3", ["robot.register_base", "24 to 40"]),
            ("step_deg = 5.0", "step_deg = 1.0", ["limits.step_deg = 1", "at least 2.00"]),
        ] {
            let said = refusal(from, to);
            for word in ["cell.toml"].iter().chain(&words) {
                assert!(said.contains(word), "'{said}' does not say '{word}'");
            }
            assert_eq!(said.lines().count(), 1, "{said}");
        }
    }

    /// Protects V_e: axes that do not cross give no triangle, so they are refused.
    #[test]
    fn parallel_axes_are_refused() {
        let x_axis = CELL.lines().find_map(|l| l.strip_prefix("x_axis_px = ")).expect("there");
        let y_axis = CELL.lines().find_map(|l| l.strip_prefix("y_axis_px = ")).expect("there");
        let said = refusal(&format!("y_axis_px = {y_axis}"), &format!("y_axis_px = {x_axis}"));
        assert!(said.contains("image.y_axis_px") && said.contains("parallel"), "{said}");
    }
}
