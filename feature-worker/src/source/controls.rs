//! The controls of a V4L2 device that `[camera]` sets: exposure, gain, white balance, focus, and the mains' frequency.
//!
//! Called once at the start, on the thread that opens the camera; allocates. What is set is read back, and what differs is a refusal with its
//! reason. What is to be locked is first found by the camera's automatics, for which frames must flow. OpenCV has no property for the mains' frequency and none for a control's range, so V4L2 is asked by way of `v4l2r`; the frames
//! stay OpenCV's.

use std::fs::File;
use std::time::{Duration, Instant};

use shared::config::{CameraConfig, Setting};
use v4l2r::bindings as v4l2;
use v4l2r::ioctl::{CtrlId, QueryCtrlFlags, g_ctrl, queryctrl, s_ctrl};

/// The exposure's unit in V4L2, ms: V4L2_CID_EXPOSURE_ABSOLUTE counts in 100 us.
const EXPOSURE_UNIT_MS: f64 = 0.1;
/// V4L2's "manual mode" of the automatic exposure. (An enumeration of the kernel's interface.)
const EXPOSURE_MANUAL: i32 = 1;
/// V4L2's automatic modes of the exposure: with a fixed aperture, as webcams have it, and with both automatic. (An enumeration of the kernel's
/// interface.)
const EXPOSURE_AUTOMATIC: [i32; 2] = [3, 0];
/// The longest that automatics are waited for. Chosen by hand: those of webcams take a second.
pub const SETTLE_MOST: Duration = Duration::from_secs(2);
/// Frames between two looks at what the automatics have found. Chosen by hand: an automatic that works moves in a third of a second.
const LOOK_FRAMES: u32 = 10;

/// What a device says of one control.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Control {
    /// V4L2's number of the control.
    pub id: u32,
    /// The driver's name for it.
    pub name: String,
    /// Least value.
    pub least: i32,
    /// Largest value.
    pub most: i32,
    /// Step from value to value.
    pub step: i32,
    /// Whether another control, as its automatic, has it now: the driver may take a value, and not use it.
    pub inactive: bool,
    /// Whether nobody can set it.
    pub read_only: bool,
}

/// A device with controls.
pub trait Controls {
    /// What the device says of a control; `None` if it has none.
    fn query(&self, id: u32) -> Option<Control>;
    /// The control's value; the error is the system's words.
    fn get(&self, id: u32) -> Result<i32, String>;
    /// Sets the control's value; the error is the system's words.
    fn set(&mut self, id: u32, value: i32) -> Result<(), String>;
}

/// A control as V4L2 tells it.
struct Queried(v4l2::v4l2_queryctrl);

impl From<v4l2::v4l2_queryctrl> for Queried {
    fn from(raw: v4l2::v4l2_queryctrl) -> Self {
        Self(raw)
    }
}

impl Queried {
    fn control(&self) -> Control {
        let raw = &self.0;
        let name: Vec<u8> = raw.name.iter().take_while(|c| **c != 0).copied().collect();
        Control {
            id: raw.id,
            name: String::from_utf8_lossy(&name).into_owned(),
            least: raw.minimum,
            most: raw.maximum,
            step: raw.step,
            inactive: raw.flags & v4l2::V4L2_CTRL_FLAG_INACTIVE != 0,
            read_only: raw.flags & v4l2::V4L2_CTRL_FLAG_READ_ONLY != 0,
        }
    }
}

impl Controls for File {
    fn query(&self, id: u32) -> Option<Control> {
        let queried: Queried = queryctrl(self, CtrlId::new(id).ok()?, QueryCtrlFlags::empty()).ok()?;
        Some(queried.control()).filter(|_| queried.0.flags & v4l2::V4L2_CTRL_FLAG_DISABLED == 0)
    }

    fn get(&self, id: u32) -> Result<i32, String> {
        g_ctrl(self, id).map_err(|e| e.to_string())
    }

    fn set(&mut self, id: u32, value: i32) -> Result<(), String> {
        s_ctrl(self, id, value).map(|_| ()).map_err(|e| e.to_string())
    }
}

/// All controls of a device that hold a number, with their values.
pub fn list(device: &File) -> Vec<(Control, Result<i32, String>)> {
    let mut found = Vec::new();
    let mut last = 0;
    while let Ok(id) = CtrlId::new(last) {
        let Ok(queried) = queryctrl::<Queried>(device, id, QueryCtrlFlags::NEXT) else { break };
        if queried.0.id <= last {
            break;
        }
        last = queried.0.id;
        let numbers = [
            v4l2::v4l2_ctrl_type_V4L2_CTRL_TYPE_INTEGER,
            v4l2::v4l2_ctrl_type_V4L2_CTRL_TYPE_BOOLEAN,
            v4l2::v4l2_ctrl_type_V4L2_CTRL_TYPE_MENU,
            v4l2::v4l2_ctrl_type_V4L2_CTRL_TYPE_INTEGER_MENU,
        ];
        if numbers.contains(&queried.0.type_) && queried.0.flags & v4l2::V4L2_CTRL_FLAG_DISABLED == 0 {
            found.push((queried.control(), device.get(last)));
        }
    }
    found
}

/// One key of `[camera]`: its control, the automatic that must be off for it, and how its unit becomes V4L2's.
struct Key {
    name: &'static str,
    id: u32,
    /// The automatic's control, and its value for "off".
    automatic: Option<(u32, i32)>,
    /// The automatic's values for "on", the usual one first.
    on: &'static [i32],
    /// V4L2's value of a unit of the configuration.
    factor: f64,
}

/// The keys of `[camera]` that set controls.
const KEYS: [Key; 4] = [
    Key {
        name: "exposure_ms",
        id: v4l2::V4L2_CID_EXPOSURE_ABSOLUTE,
        automatic: Some((v4l2::V4L2_CID_EXPOSURE_AUTO, EXPOSURE_MANUAL)),
        on: &EXPOSURE_AUTOMATIC,
        factor: 1.0 / EXPOSURE_UNIT_MS,
    },
    Key { name: "gain", id: v4l2::V4L2_CID_GAIN, automatic: Some((v4l2::V4L2_CID_AUTOGAIN, 0)), on: &[1], factor: 1.0 },
    Key {
        name: "white_balance_k",
        id: v4l2::V4L2_CID_WHITE_BALANCE_TEMPERATURE,
        automatic: Some((v4l2::V4L2_CID_AUTO_WHITE_BALANCE, 0)),
        on: &[1],
        factor: 1.0,
    },
    Key { name: "focus", id: v4l2::V4L2_CID_FOCUS_ABSOLUTE, automatic: Some((v4l2::V4L2_CID_FOCUS_AUTO, 0)), on: &[1], factor: 1.0 },
];

/// What came of setting the controls, a line each.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Outcome {
    /// What was set and read back, or left alone.
    pub said: Vec<String>,
    /// What the device refused, and why.
    pub refused: Vec<String>,
}

/// What a camera's automatics have found.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Found {
    /// The keys of `[camera]` with their values; what the device has not, or refuses, is not among them.
    pub values: Vec<(&'static str, f64)>,
    /// What came of setting these.
    pub outcome: Outcome,
}

/// What `camera` says of each of [`KEYS`].
fn settings(camera: &CameraConfig) -> [Option<Setting>; KEYS.len()] {
    [camera.exposure_ms, camera.gain, camera.white_balance_k, camera.focus]
}

/// Waits until the automatics of what `camera` locks have found their values: two looks some frames apart that agree, or at most `most`.
/// `grab` takes a frame, and says whether one came. `false` if they still move.
pub fn settle(device: &impl Controls, camera: &CameraConfig, most: Duration, mut grab: impl FnMut() -> bool) -> bool {
    let locked: Vec<&Key> =
        KEYS.iter().zip(settings(camera)).filter(|(_, setting)| matches!(setting, Some(Setting::Locked(_)))).map(|(key, _)| key).collect();
    let begin = Instant::now();
    let mut before: Option<Vec<_>> = None;
    while !locked.is_empty() {
        for _ in 0..LOOK_FRAMES {
            if begin.elapsed() >= most || !grab() {
                return false;
            }
        }
        let now: Vec<_> = locked.iter().map(|key| device.get(key.id)).collect();
        if before.replace(now.clone()) == Some(now) {
            break;
        }
    }
    true
}

/// Switches all automatics on that the device has.
pub fn start_automatics(device: &mut impl Controls) {
    for (id, off, on) in KEYS.iter().filter_map(|key| key.automatic.map(|(id, off)| (id, off, key.on))) {
        if device.query(id).is_some() && device.get(id) == Ok(off) {
            // One that cannot be switched on leaves the value that is there, which is found as well.
            let _ = on.iter().find(|on| device.set(id, **on).is_ok() && device.get(id) == Ok(**on));
        }
    }
}

/// Sets what the automatics have found as values, and reads them back.
pub fn keep_found(device: &mut impl Controls) -> Found {
    let mut found = Found::default();
    for key in KEYS.iter().filter(|key| device.query(key.id).is_some_and(|control| !control.read_only)).collect::<Vec<_>>() {
        let Ok(value) = device.get(key.id) else { continue };
        let value = f64::from(value) / key.factor;
        match set(device, key, Setting::Value(value)) {
            Ok(said) => {
                found.values.push((key.name, value));
                found.outcome.said.push(said);
            }
            Err(refused) => found.outcome.refused.push(refused),
        }
    }
    found
}

/// Sets the controls that `camera` names, and reads them back.
pub fn apply(device: &mut impl Controls, camera: &CameraConfig) -> Outcome {
    let mut outcome = Outcome::default();
    let mut alone = Vec::new();
    for (key, setting) in KEYS.iter().zip(settings(camera)) {
        match setting {
            Some(setting) => match set(device, key, setting) {
                Ok(said) => outcome.said.push(said),
                Err(refused) => outcome.refused.push(refused),
            },
            None => alone.push(key.name),
        }
    }
    match camera.mains_hz {
        Some(setting) => match set_mains(device, setting) {
            Ok(said) => outcome.said.push(said),
            Err(refused) => outcome.refused.push(refused),
        },
        None => alone.push("mains_hz"),
    }
    if !alone.is_empty() {
        outcome.said.push(format!("{} left alone: the camera may change them during a pour", alone.join(", ")));
    }
    outcome
}

/// Switches a key's automatic off, sets its value and reads both back.
fn set(device: &mut impl Controls, key: &Key, setting: Setting) -> Result<String, String> {
    let name = key.name;
    let before = device.get(key.id);
    let automatic = key.automatic.filter(|(id, _)| device.query(*id).is_some());
    if let Some((id, off)) = automatic {
        device.set(id, off).map_err(|e| format!("camera.{name}: its automatic cannot be switched off ({e})"))?;
        let now = device.get(id).map_err(|e| format!("camera.{name}: its automatic cannot be read back ({e})"))?;
        if now != off {
            return Err(format!("camera.{name}: its automatic stays on"));
        }
    }
    let Some(control) = device.query(key.id) else {
        return match (setting, automatic) {
            (Setting::Locked(_), Some(_)) => Ok(format!("{name}: its automatic is off")),
            _ => Err(format!("camera.{name}: the camera has no such control; leave the key out")),
        };
    };
    let wanted = match setting {
        Setting::Value(value) => (value * key.factor).round() as i32,
        Setting::Locked(_) => before.map_err(|e| format!("camera.{name} cannot be read ({e})"))?,
    };
    let range = || {
        let unit = |v: i32| f64::from(v) / key.factor;
        format!("{} to {}, in steps of {}", unit(control.least), unit(control.most), unit(control.step))
    };
    device
        .set(key.id, wanted)
        .map_err(|e| format!("camera.{name} = {}: refused ({e}); it takes {}", f64::from(wanted) / key.factor, range()))?;
    let got = device.get(key.id).map_err(|e| format!("camera.{name} cannot be read back ({e})"))?;
    // A value between two steps is rounded by the driver.
    if (got - wanted).abs() >= control.step.max(1) {
        let unit = |v: i32| f64::from(v) / key.factor;
        return Err(format!("camera.{name} = {}: the camera took {} instead; it takes {}", unit(wanted), unit(got), range()));
    }
    // A driver may keep the value of an inactive control, and read it back, while the automatic goes on.
    if device.query(key.id).is_none_or(|control| control.inactive) {
        return Err(format!("camera.{name}: the camera keeps it under an automatic that cannot be switched off here; leave the key out"));
    }
    Ok(format!("{name} = {}", f64::from(got) / key.factor))
}

/// Sets the mains' frequency, and reads it back.
fn set_mains(device: &mut impl Controls, setting: Setting) -> Result<String, String> {
    let id = v4l2::V4L2_CID_POWER_LINE_FREQUENCY;
    if device.query(id).is_none() {
        return Err("camera.mains_hz: the camera has no such control; leave the key out".into());
    }
    // V4L2's menu: off, 50 Hz, 60 Hz, automatic.
    let hertz = ["0", "50", "60", "automatic"];
    let read = |device: &mut dyn FnMut() -> Result<i32, String>| device().map_err(|e| format!("camera.mains_hz cannot be read back ({e})"));
    let wanted = match setting {
        Setting::Value(value) => [0.0, 50.0, 60.0].iter().position(|hz| *hz == value).unwrap_or(0) as i32,
        Setting::Locked(_) => read(&mut || device.get(id))?,
    };
    let word = |v: i32| hertz.get(v as usize).copied().unwrap_or("unknown");
    if matches!(setting, Setting::Locked(_)) && wanted == 3 {
        return Err("camera.mains_hz = \"locked\": it is automatic now; write 50 or 60".into());
    }
    device.set(id, wanted).map_err(|e| format!("camera.mains_hz = {}: refused ({e})", word(wanted)))?;
    let got = read(&mut || device.get(id))?;
    if got != wanted {
        return Err(format!("camera.mains_hz = {}: the camera took {} instead", word(wanted), word(got)));
    }
    Ok(format!("mains_hz = {}", word(got)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use shared::config::Locked;
    use std::collections::BTreeMap;

    /// A camera in memory: value, least, most and step of each control, and which controls are refused.
    #[derive(Default)]
    struct Fake {
        controls: BTreeMap<u32, [i32; 4]>,
        refuses: Vec<u32>,
        inactive: Vec<u32>,
        /// Frames so far, in which its automatics work.
        frames: std::cell::Cell<i32>,
    }

    impl Fake {
        /// Takes a frame: the automatic exposure falls by 10 a frame for 25 frames.
        fn grab(&self) -> bool {
            self.frames.set(self.frames.get() + 1);
            true
        }
    }

    impl Controls for Fake {
        fn query(&self, id: u32) -> Option<Control> {
            let [_, least, most, step] = *self.controls.get(&id)?;
            Some(Control { id, name: String::new(), least, most, step, inactive: self.inactive.contains(&id), read_only: false })
        }
        fn get(&self, id: u32) -> Result<i32, String> {
            let value = self.controls.get(&id).map(|c| c[0]).ok_or("invalid")?;
            let automatic = self.controls.get(&v4l2::V4L2_CID_EXPOSURE_AUTO).is_some_and(|c| c[0] != EXPOSURE_MANUAL);
            let moves = automatic && id == v4l2::V4L2_CID_EXPOSURE_ABSOLUTE && self.frames.get() > 0;
            Ok(if moves { 400 - 10 * self.frames.get().min(25) } else { value })
        }
        fn set(&mut self, id: u32, value: i32) -> Result<(), String> {
            if self.refuses.contains(&id) {
                return Err("busy".into());
            }
            let [at, least, most, step] = self.controls.get_mut(&id).ok_or("invalid")?;
            *at = (value.clamp(*least, *most) - *least) / *step * *step + *least;
            Ok(())
        }
    }

    fn camera() -> Fake {
        let controls = BTreeMap::from([
            (v4l2::V4L2_CID_EXPOSURE_AUTO, [3, 0, 3, 1]),
            (v4l2::V4L2_CID_EXPOSURE_ABSOLUTE, [156, 3, 2047, 1]),
            (v4l2::V4L2_CID_GAIN, [64, 0, 255, 1]),
            (v4l2::V4L2_CID_AUTO_WHITE_BALANCE, [1, 0, 1, 1]),
            (v4l2::V4L2_CID_WHITE_BALANCE_TEMPERATURE, [4000, 2800, 6500, 10]),
            (v4l2::V4L2_CID_POWER_LINE_FREQUENCY, [2, 0, 2, 1]),
        ]);
        Fake { controls, ..Fake::default() }
    }

    /// Protects the settings: values are set in V4L2's units with the automatic off, "locked" keeps what was there, and what the configuration
    /// does not name is left alone and said.
    #[test]
    fn what_is_set_is_read_back_and_the_rest_is_said() {
        let mut device = camera();
        let config = CameraConfig {
            exposure_ms: Some(Setting::Value(10.0)),
            white_balance_k: Some(Setting::Locked(Locked::Locked)),
            mains_hz: Some(Setting::Value(50.0)),
            ..CameraConfig::default()
        };
        let outcome = apply(&mut device, &config);
        assert!(outcome.refused.is_empty(), "{outcome:?}");
        assert_eq!(device.get(v4l2::V4L2_CID_EXPOSURE_AUTO), Ok(1));
        assert_eq!(device.get(v4l2::V4L2_CID_EXPOSURE_ABSOLUTE), Ok(100));
        assert_eq!(device.get(v4l2::V4L2_CID_AUTO_WHITE_BALANCE), Ok(0));
        assert_eq!(device.get(v4l2::V4L2_CID_WHITE_BALANCE_TEMPERATURE), Ok(4000));
        assert_eq!(device.get(v4l2::V4L2_CID_POWER_LINE_FREQUENCY), Ok(1));
        assert_eq!(device.get(v4l2::V4L2_CID_GAIN), Ok(64));
        assert!(
            outcome.said.iter().any(|s| s == "exposure_ms = 10") && outcome.said.iter().any(|s| s.starts_with("gain, focus left alone"))
        );
    }

    /// Protects from a first picture that is locked: the automatic finds its value before it is switched off, and one that never rests is waited
    /// for no longer than said. What is not to be locked is not waited for.
    #[test]
    fn the_automatic_finds_before_it_is_locked() {
        let locked = CameraConfig { exposure_ms: Some(Setting::Locked(Locked::Locked)), ..CameraConfig::default() };
        let mut device = camera();
        assert!(settle(&device, &locked, SETTLE_MOST, || device.grab()));
        assert!(apply(&mut device, &locked).refused.is_empty());
        assert_eq!(device.get(v4l2::V4L2_CID_EXPOSURE_ABSOLUTE), Ok(150));
        let restless = camera();
        assert!(!settle(&restless, &locked, Duration::from_millis(50), || {
            std::thread::sleep(Duration::from_millis(5));
            restless.grab()
        }));
        let value = CameraConfig { gain: Some(Setting::Value(1.0)), ..CameraConfig::default() };
        let other = camera();
        assert!(settle(&other, &value, SETTLE_MOST, || other.grab()) && other.frames.get() == 0);
    }

    /// Protects who lets the camera find its settings once: automatics that were off are on while it looks, and what they found is set as values with
    /// the automatics off. What the camera has not, or keeps under an automatic, is not among them.
    #[test]
    fn what_the_automatics_find_is_kept() {
        let mut device = camera();
        device.controls.insert(v4l2::V4L2_CID_EXPOSURE_AUTO, [EXPOSURE_MANUAL, 0, 3, 1]);
        device.inactive = vec![v4l2::V4L2_CID_GAIN];
        start_automatics(&mut device);
        assert_eq!(device.get(v4l2::V4L2_CID_EXPOSURE_AUTO), Ok(3));
        (0..60).for_each(|_| assert!(device.grab()));
        let Found { values, outcome } = keep_found(&mut device);
        assert_eq!(values, [("exposure_ms", 15.0), ("white_balance_k", 4000.0)]);
        assert!(outcome.refused.len() == 1 && outcome.refused[0].contains("camera.gain"), "{outcome:?}");
        let at =
            [v4l2::V4L2_CID_EXPOSURE_AUTO, v4l2::V4L2_CID_EXPOSURE_ABSOLUTE, v4l2::V4L2_CID_AUTO_WHITE_BALANCE].map(|id| device.get(id));
        assert_eq!(at, [Ok(1), Ok(150), Ok(0)]);
    }

    /// Protects from a camera that does something else: a control that it lacks, refuses, or sets to another value is a refusal that names
    /// the key, the value and the range.
    #[test]
    fn a_refusal_names_the_key() {
        let said = |device: &mut Fake, config: CameraConfig| apply(device, &config).refused.join("\n");
        let value = |v: f64| Some(Setting::Value(v));
        let much = said(&mut camera(), CameraConfig { exposure_ms: value(500.0), ..CameraConfig::default() });
        assert!(much.contains("camera.exposure_ms = 500") && much.contains("204.7 instead") && much.contains("0.3 to 204.7"), "{much}");
        let none = said(&mut camera(), CameraConfig { focus: value(10.0), ..CameraConfig::default() });
        assert!(none.contains("camera.focus") && none.contains("no such control"), "{none}");
        let mut busy = camera();
        busy.refuses = vec![v4l2::V4L2_CID_EXPOSURE_AUTO, v4l2::V4L2_CID_GAIN];
        let both = said(&mut busy, CameraConfig { exposure_ms: value(10.0), gain: value(20.0), ..CameraConfig::default() });
        assert!(both.contains("automatic cannot be switched off (busy)") && both.contains("camera.gain = 20: refused (busy)"), "{both}");
        let mut kept = camera();
        kept.inactive = vec![v4l2::V4L2_CID_GAIN];
        let gain = said(&mut kept, CameraConfig { gain: value(20.0), ..CameraConfig::default() });
        assert!(gain.contains("camera.gain") && gain.contains("under an automatic"), "a value that is kept and not used: {gain}");
        let mut automatic = camera();
        automatic.controls.insert(v4l2::V4L2_CID_POWER_LINE_FREQUENCY, [3, 0, 3, 1]);
        let locked = Some(Setting::Locked(Locked::Locked));
        let mains = said(&mut automatic, CameraConfig { mains_hz: locked, ..CameraConfig::default() });
        assert!(mains.contains("write 50 or 60"), "{mains}");
    }
}
