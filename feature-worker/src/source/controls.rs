//! The controls of a V4L2 device that `[camera]` sets: exposure, gain, white balance, focus, and the mains' frequency.
//!
//! Called once at the start, on the thread that opens the camera; allocates. What is set is read back, and what differs is a refusal with its
//! reason. What is to be locked is first found by the camera's automatics, for which frames must flow. `decant doctor` compares and sets nothing. OpenCV
//! has no property for the mains' frequency and none for a control's range, so V4L2 is asked by way of `v4l2r`; the frames
//! stay OpenCV's.

use std::fs::File;
use std::time::{Duration, Instant};

use shared::config::{CameraConfig, SETTINGS, Setting};
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
/// Time between two looks at what the automatics have found, which is at least one frame. Chosen by hand: an automatic that works moves in a
/// third of a second.
const LOOK: Duration = Duration::from_millis(333);

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

/// The settings of [`KEYS`].
fn settings(camera: &CameraConfig) -> impl Iterator<Item = (&'static Key, Option<Setting>)> {
    KEYS.iter().zip([camera.exposure_ms, camera.gain, camera.white_balance_k, camera.focus])
}

/// Where the device's controls are not what `camera` names, a line each. Nothing is set.
pub fn compare(device: &impl Controls, camera: &CameraConfig) -> Vec<String> {
    let mut differ = Vec::new();
    for (key, setting) in settings(camera) {
        let (name, Some(setting)) = (key.name, setting) else { continue };
        if let Some((id, off)) = key.automatic
            && device.query(id).is_some()
            && device.get(id) != Ok(off)
        {
            differ.push(format!("camera.{name}: its automatic is on"));
        }
        let Setting::Value(value) = setting else { continue };
        let wanted = (value * key.factor).round() as i32;
        match (device.query(key.id), device.get(key.id)) {
            (None, _) => differ.push(format!("camera.{name}: the camera has no such control")),
            (Some(control), Ok(has)) if (has - wanted).abs() >= control.step.max(1) => {
                differ.push(format!("camera.{name} = {value}: the camera has {}", f64::from(has) / key.factor));
            }
            (Some(_), Ok(_)) => {}
            (Some(_), Err(e)) => differ.push(format!("camera.{name} cannot be read ({e})")),
        }
    }
    differ.extend(doubt_gain(device, camera));
    if let Some(Setting::Value(hertz)) = camera.mains_hz {
        match device.get(v4l2::V4L2_CID_POWER_LINE_FREQUENCY) {
            Ok(has) if mains_code(hertz) == has => {}
            Ok(has) => differ.push(format!("camera.mains_hz = {hertz}: the camera has {}", mains_word(has))),
            Err(e) => differ.push(format!("camera.mains_hz cannot be read ({e})")),
        }
    }
    differ
}

/// V4L2's number of a mains' frequency.
fn mains_code(hertz: f64) -> i32 {
    [0.0, 50.0, 60.0].iter().position(|hz| *hz == hertz).unwrap_or(0) as i32
}

/// The word for V4L2's number of a mains' frequency: off, 50 Hz, 60 Hz, automatic.
fn mains_word(code: i32) -> &'static str {
    ["0", "50", "60", "automatic"].get(code as usize).copied().unwrap_or("unknown")
}

/// What a camera's automatics have found.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Found {
    /// The keys of `[camera]` with their values; what the device has not, or refuses, is not among them.
    pub values: Vec<(&'static str, f64)>,
    /// What came of setting these.
    pub outcome: Outcome,
}

/// The keys that `camera` locks.
fn locked(camera: &CameraConfig) -> impl Iterator<Item = &'static Key> {
    settings(camera).filter(|(_, setting)| matches!(setting, Some(Setting::Locked(_)))).map(|(key, _)| key)
}

/// Waits until the automatics of what `camera` locks have found their values: two looks some time apart that agree, or at most `most`.
/// `grab` takes a frame, and its error ends the wait. `false` if they still move.
pub fn settle<E>(
    device: &impl Controls,
    camera: &CameraConfig,
    most: Duration,
    mut grab: impl FnMut() -> Result<(), E>,
) -> Result<bool, E> {
    let locked: Vec<&Key> = locked(camera).collect();
    let begin = Instant::now();
    let mut before: Option<Vec<_>> = None;
    while !locked.is_empty() {
        let look = Instant::now();
        loop {
            if begin.elapsed() >= most {
                return Ok(false);
            }
            grab()?;
            if look.elapsed() >= LOOK {
                break;
            }
        }
        let now: Vec<_> = locked.iter().map(|key| device.get(key.id)).collect();
        if before.replace(now.clone()) == Some(now) {
            break;
        }
    }
    Ok(true)
}

/// Sets the mains' frequency, and then switches all automatics on that the device has. The result is of the frequency.
pub fn start_automatics(device: &mut impl Controls, camera: &CameraConfig) -> Outcome {
    let mains = apply_mains(device, camera);
    switch_on(device, KEYS.iter());
    mains
}

/// Sets the mains' frequency, by which the automatic exposure goes, and what `camera` gives a value, and switches the automatics of what it locks on: whoever
/// locked it before left them off, and then they find nothing. A gain is then found for the exposure that is given, and not for another one.
pub fn start_locked(device: &mut impl Controls, camera: &CameraConfig) {
    // What came of it is said when all is set.
    let _ = apply_mains(device, camera);
    for (key, setting) in settings(camera) {
        if let Some(value @ Setting::Value(_)) = setting {
            let _ = set(device, key, value);
        }
    }
    switch_on(device, locked(camera));
}

fn switch_on(device: &mut impl Controls, keys: impl Iterator<Item = &'static Key>) {
    for (id, off, on) in keys.filter_map(|key| key.automatic.map(|(id, off)| (id, off, key.on))) {
        if device.query(id).is_some() && device.get(id) == Ok(off) {
            // One that cannot be switched on leaves the value that is there, which is found as well.
            let _ = on.iter().find(|on| device.set(id, **on).is_ok() && device.get(id) == Ok(**on));
        }
    }
}

/// Sets what the automatics have found as values, and reads them back.
pub fn keep_found(device: &mut impl Controls) -> Found {
    let (mut found, mut kept) = (Found::default(), Vec::new());
    for key in KEYS.iter().filter(|key| device.query(key.id).is_some_and(|control| !control.read_only)).collect::<Vec<_>>() {
        let Ok(value) = device.get(key.id) else { continue };
        let value = f64::from(value) / key.factor;
        if let Some((_, [low, high])) = SETTINGS.iter().find(|(name, range)| *name == key.name && !(range[0]..=range[1]).contains(&value)) {
            found.outcome.refused.push(format!("camera.{} = {value}: the configuration takes {low} to {high}; left as it is", key.name));
            continue;
        }
        match set(device, key, Setting::Value(value)) {
            Ok(said) => kept.push((key, device.get(key.id), value, said)),
            Err(refused) => found.outcome.refused.push(refused),
        }
    }
    for (key, got, value, said) in kept {
        match since_changed(device, key, &got) {
            Some(refused) => found.outcome.refused.push(refused),
            None => {
                found.values.push((key.name, value));
                found.outcome.said.push(said);
            }
        }
    }
    found
}

/// Why a value that was read back as `got` does not last, if the device has another one now: setting one control may change another.
fn since_changed(device: &impl Controls, key: &Key, got: &Result<i32, String>) -> Option<String> {
    let now = device.get(key.id);
    let shown = |v: &Result<i32, String>| v.as_ref().map_or("no value".into(), |v| (f64::from(*v) / key.factor).to_string());
    (now != *got).then(|| {
        format!("camera.{}: it was {}, and is {} since other controls were set; leave one of them out", key.name, shown(got), shown(&now))
    })
}

/// Sets the controls that `camera` names, and reads them back.
pub fn apply(device: &mut impl Controls, camera: &CameraConfig) -> Outcome {
    let mut outcome = Outcome::default();
    let (mut alone, mut kept) = (Vec::new(), Vec::new());
    for (key, setting) in settings(camera) {
        match setting {
            Some(setting) => match set(device, key, setting) {
                Ok(said) => {
                    kept.push((key, device.get(key.id)));
                    outcome.said.push(said);
                }
                Err(refused) => outcome.refused.push(refused),
            },
            None => alone.push(key.name),
        }
    }
    if camera.mains_hz.is_none() {
        alone.push("mains_hz");
    }
    let mains = apply_mains(device, camera);
    outcome.said.extend(mains.said);
    outcome.refused.extend(mains.refused);
    outcome.refused.extend(kept.iter().filter_map(|(key, got)| since_changed(device, key, got)));
    if let Some(doubt) = doubt_gain(device, camera) {
        outcome.refused.push(doubt);
    }
    if !alone.is_empty() {
        outcome.said.push(format!("{} left alone: the camera may change them during a pour", alone.join(", ")));
    }
    outcome
}

/// Why a gain that is set may not last: where the gain has no automatic of its own, that of the exposure is wont to change it.
fn doubt_gain(device: &impl Controls, camera: &CameraConfig) -> Option<String> {
    let own = device.query(v4l2::V4L2_CID_AUTOGAIN).is_some();
    let automatic = device.get(v4l2::V4L2_CID_EXPOSURE_AUTO).is_ok_and(|mode| EXPOSURE_AUTOMATIC.contains(&mode));
    let named = camera.gain.is_some() && camera.exposure_ms.is_none();
    let doubted = named && !own && automatic && device.query(v4l2::V4L2_CID_GAIN).is_some();
    doubted.then(|| "camera.gain: the automatic exposure may change it; set camera.exposure_ms too".into())
}

/// Sets the mains' frequency, if `camera` names it, and reads it back. The automatic exposure goes by it.
fn apply_mains(device: &mut impl Controls, camera: &CameraConfig) -> Outcome {
    let mut outcome = Outcome::default();
    match camera.mains_hz.map(|setting| set_mains(device, setting)) {
        Some(Ok(said)) => outcome.said.push(said),
        Some(Err(refused)) => outcome.refused.push(refused),
        None => {}
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
    let read = |device: &mut dyn FnMut() -> Result<i32, String>| device().map_err(|e| format!("camera.mains_hz cannot be read back ({e})"));
    let wanted = match setting {
        Setting::Value(value) => mains_code(value),
        Setting::Locked(_) => read(&mut || device.get(id))?,
    };
    if matches!(setting, Setting::Locked(_)) && wanted == 3 {
        return Err("camera.mains_hz = \"locked\": it is automatic now; write 50 or 60".into());
    }
    device.set(id, wanted).map_err(|e| format!("camera.mains_hz = {}: refused ({e})", mains_word(wanted)))?;
    let got = read(&mut || device.get(id))?;
    if got != wanted {
        return Err(format!("camera.mains_hz = {}: the camera took {} instead", mains_word(wanted), mains_word(got)));
    }
    Ok(format!("mains_hz = {}", mains_word(got)))
}

#[cfg(test)]
mod tests;
