//! What the camera's controls are held to, with a camera in memory.
//!
//! Tests only: they allocate, and a fault of the controls fails them.

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
    frames: std::rc::Rc<std::cell::Cell<i32>>,
    /// What the light of now adds to the exposure that its automatic finds.
    light: i32,
    /// What its automatic gain finds is this over the exposure of the last frame.
    gain_finds: i32,
    /// The exposure before the last setting of it, and how many frames there were then.
    exposure_before: (i32, i32),
    /// Setting the first of these halves the value of the second, as far as its range goes.
    couples: Option<[u32; 2]>,
    /// What was set, in order.
    set: Vec<u32>,
}

impl Fake {
    /// What takes a frame every so many ms: the automatic exposure falls by 10 a frame for 25 frames.
    fn grab(&self, every_ms: u64) -> impl FnMut() -> Result<(), &'static str> + use<> {
        let frames = self.frames.clone();
        move || {
            std::thread::sleep(Duration::from_millis(every_ms));
            frames.set(frames.get() + 1);
            Ok(())
        }
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
        let (before, frames) = self.exposure_before;
        let exposure = || if self.frames.get() > frames { self.get(v4l2::V4L2_CID_EXPOSURE_ABSOLUTE).unwrap_or(1) } else { before.max(1) };
        if self.gain_finds > 0 && id == v4l2::V4L2_CID_GAIN && self.controls.get(&v4l2::V4L2_CID_AUTOGAIN).is_some_and(|c| c[0] == 1) {
            return Ok(self.gain_finds / exposure());
        }
        let moves = automatic && id == v4l2::V4L2_CID_EXPOSURE_ABSOLUTE && self.frames.get() > 0;
        Ok(if moves { 400 - 10 * self.frames.get().min(25) + self.light } else { value })
    }
    fn set(&mut self, id: u32, value: i32) -> Result<(), String> {
        if self.refuses.contains(&id) {
            return Err("busy".into());
        }
        self.set.push(id);
        if id == v4l2::V4L2_CID_EXPOSURE_ABSOLUTE {
            self.exposure_before = (self.get(id)?, self.frames.get());
        }
        let [at, least, most, step] = self.controls.get_mut(&id).ok_or("invalid")?;
        *at = (value.clamp(*least, *most) - *least) / *step * *step + *least;
        if let Some([_, other]) = self.couples.filter(|[first, _]| *first == id)
            && let Some(control) = self.controls.get_mut(&other)
        {
            control[0] /= 2;
        }
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
    assert!(outcome.said.iter().any(|s| s == "exposure_ms = 10") && outcome.said.iter().any(|s| s.starts_with("gain, focus left alone")));
}

/// Protects what is told as set: a value that another control's setting changed is refused, and so is a gain that the automatic exposure has.
#[test]
fn what_does_not_last_is_refused() {
    let (exposure_ms, gain) = (Some(Setting::Value(10.0)), Some(Setting::Value(64.0)));
    let both = CameraConfig { exposure_ms, gain, ..CameraConfig::default() };
    let mut device = Fake { couples: Some([v4l2::V4L2_CID_GAIN, v4l2::V4L2_CID_EXPOSURE_ABSOLUTE]), ..camera() };
    let refused = apply(&mut device, &both).refused;
    assert_eq!(refused, ["camera.exposure_ms: it was 10, and is 5 since other controls were set; leave one of them out"]);
    assert!(apply(&mut camera(), &both).refused.is_empty());
    let alone = CameraConfig { gain, ..CameraConfig::default() };
    let mut device = camera();
    let wanted = ["camera.gain: the automatic exposure may change it; set camera.exposure_ms too"];
    assert_eq!(
        (apply(&mut device, &alone).refused, compare(&device, &alone)),
        (wanted.map(String::from).to_vec(), wanted.map(String::from).to_vec())
    );
    device.controls.insert(v4l2::V4L2_CID_AUTOGAIN, [0, 0, 1, 1]);
    assert_eq!((apply(&mut device, &alone).refused, compare(&device, &alone)), (vec![], vec![]));
}

/// Longer than any automatic here moves on a busy machine.
const LONG: Duration = Duration::from_secs(60);

/// Protects from a first picture that is locked: the automatic finds its value before it is switched off, and one that never rests is waited
/// for no longer than said. What is not to be locked is not waited for. A camera that is gone is no restless one.
#[test]
fn the_automatic_finds_before_it_is_locked() {
    let locked = CameraConfig { exposure_ms: Some(Setting::Locked(Locked::Locked)), ..CameraConfig::default() };
    let mut device = camera();
    assert_eq!(settle(&device, &locked, LONG, device.grab(2)), Ok(true));
    assert!(apply(&mut device, &locked).refused.is_empty());
    assert_eq!(device.get(v4l2::V4L2_CID_EXPOSURE_ABSOLUTE), Ok(150));
    let restless = camera();
    assert_eq!(settle(&restless, &locked, Duration::from_millis(50), restless.grab(5)), Ok(false));
    assert_eq!(settle(&camera(), &locked, LONG, || Err("gone")), Err("gone"));
    let value = CameraConfig { gain: Some(Setting::Value(1.0)), ..CameraConfig::default() };
    let other = camera();
    assert!(settle(&other, &value, LONG, other.grab(0)) == Ok(true) && other.frames.get() == 0);
}

/// Protects the second start: it locks what the automatic finds in the light of now, under lamps of the configured mains, and leaves the automatics of other
/// keys as they are.
#[test]
fn each_start_finds_anew() {
    let (exposure_ms, mains_hz) = (Some(Setting::Locked(Locked::Locked)), Some(Setting::Value(50.0)));
    let locked = CameraConfig { exposure_ms, mains_hz, ..CameraConfig::default() };
    let mut device = camera();
    device.controls.insert(v4l2::V4L2_CID_AUTO_WHITE_BALANCE, [0, 0, 1, 1]);
    for (light, found) in [(0, 150), (40, 190)] {
        device.light = light;
        start_locked(&mut device, &locked);
        assert_eq!(device.get(v4l2::V4L2_CID_POWER_LINE_FREQUENCY), Ok(1), "before the automatic finds anything");
        assert_eq!(settle(&device, &locked, LONG, device.grab(2)), Ok(true));
        assert!(apply(&mut device, &locked).refused.is_empty());
        let at =
            [v4l2::V4L2_CID_EXPOSURE_AUTO, v4l2::V4L2_CID_EXPOSURE_ABSOLUTE, v4l2::V4L2_CID_AUTO_WHITE_BALANCE].map(|id| device.get(id));
        assert_eq!(at, [Ok(1), Ok(found), Ok(0)]);
    }
}

/// Protects the colours from start to start: a gain that is locked is found for the exposure that is given, and not for what an automatic had before.
#[test]
fn a_locked_gain_is_found_for_the_given_exposure() {
    let (exposure_ms, gain) = (Some(Setting::Value(8.0)), Some(Setting::Locked(Locked::Locked)));
    let config = CameraConfig { exposure_ms, gain, ..CameraConfig::default() };
    for before in [33, 330, 80] {
        let mut device = Fake { gain_finds: 8000, ..camera() };
        device.controls.insert(v4l2::V4L2_CID_AUTOGAIN, [0, 0, 1, 1]);
        device.controls.insert(v4l2::V4L2_CID_EXPOSURE_ABSOLUTE, [before, 3, 2047, 1]);
        start_locked(&mut device, &config);
        assert_eq!(settle(&device, &config, LONG, device.grab(2)), Ok(true));
        assert!(apply(&mut device, &config).refused.is_empty());
        assert_eq!([v4l2::V4L2_CID_EXPOSURE_ABSOLUTE, v4l2::V4L2_CID_GAIN].map(|id| device.get(id)), [Ok(80), Ok(100)], "{before}");
    }
}

/// Protects slow cameras: two looks at a value that rests take a few of their frames, however long these are.
#[test]
fn a_slow_camera_comes_to_rest() {
    let locked = CameraConfig { gain: Some(Setting::Locked(Locked::Locked)), ..CameraConfig::default() };
    let device = camera();
    assert_eq!(settle(&device, &locked, LONG, device.grab(150)), Ok(true));
    assert!(device.frames.get() <= 6, "{} frames", device.frames.get());
}

/// Protects who lets the camera find its settings once: automatics that were off are on while it looks, with the mains' frequency set, and what they found is set as values with
/// the automatics off. What the camera has not, or keeps under an automatic, is not among them.
#[test]
fn what_the_automatics_find_is_kept() {
    let mut device = camera();
    device.controls.insert(v4l2::V4L2_CID_EXPOSURE_AUTO, [EXPOSURE_MANUAL, 0, 3, 1]);
    device.inactive = vec![v4l2::V4L2_CID_GAIN];
    let mains = CameraConfig { mains_hz: Some(Setting::Value(50.0)), ..CameraConfig::default() };
    assert_eq!(start_automatics(&mut device, &mains).said, ["mains_hz = 50"]);
    assert_eq!(device.set, [v4l2::V4L2_CID_POWER_LINE_FREQUENCY, v4l2::V4L2_CID_EXPOSURE_AUTO], "the mains come first");
    assert_eq!(device.get(v4l2::V4L2_CID_EXPOSURE_AUTO), Ok(3));
    let mut grab = device.grab(0);
    (0..60).for_each(|_| assert!(grab().is_ok()));
    let Found { values, outcome } = keep_found(&mut device);
    assert_eq!(values, [("exposure_ms", 15.0), ("white_balance_k", 4000.0)]);
    assert!(outcome.refused.len() == 1 && outcome.refused[0].contains("camera.gain"), "{outcome:?}");
    let at = [v4l2::V4L2_CID_EXPOSURE_AUTO, v4l2::V4L2_CID_EXPOSURE_ABSOLUTE, v4l2::V4L2_CID_AUTO_WHITE_BALANCE].map(|id| device.get(id));
    assert_eq!(at, [Ok(1), Ok(150), Ok(0)]);
}

/// Protects the next start from settings that it would refuse: a value that another one's setting changed, or that the configuration does not take, is not
/// among what was found.
#[test]
fn what_does_not_last_is_not_found() {
    let mut coupled = Fake { couples: Some([v4l2::V4L2_CID_GAIN, v4l2::V4L2_CID_EXPOSURE_ABSOLUTE]), ..camera() };
    let Found { values, outcome } = keep_found(&mut coupled);
    assert_eq!(values, [("gain", 64.0), ("white_balance_k", 4000.0)]);
    assert!(outcome.refused.len() == 1 && outcome.refused[0].starts_with("camera.exposure_ms: it was 15.6, and is 7.8"), "{outcome:?}");
    let mut strange = camera();
    strange.controls.insert(v4l2::V4L2_CID_WHITE_BALANCE_TEMPERATURE, [0, 0, 7, 1]);
    let Found { values, outcome } = keep_found(&mut strange);
    assert_eq!(values, [("exposure_ms", 15.6), ("gain", 64.0)]);
    assert_eq!(outcome.refused, ["camera.white_balance_k = 0: the configuration takes 1000 to 20000; left as it is"]);
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

/// Protects the colours that were learned: whoever looks before a pour is told where the camera's controls are not the configured ones, and nothing is
/// set. After the worker has set them there is nothing to tell.
#[test]
fn what_differs_is_told_and_left() {
    let value = |v: f64| Some(Setting::Value(v));
    let config = CameraConfig {
        exposure_ms: value(10.0),
        gain: value(64.0),
        white_balance_k: Some(Setting::Locked(Locked::Locked)),
        mains_hz: value(50.0),
        ..CameraConfig::default()
    };
    let mut device = camera();
    let told = compare(&device, &config);
    let expected = [
        "camera.exposure_ms: its automatic is on",
        "camera.exposure_ms = 10: the camera has 15.6",
        "camera.white_balance_k: its automatic is on",
        "camera.mains_hz = 50: the camera has 60",
    ];
    assert_eq!(told, expected);
    assert_eq!(device.controls, camera().controls, "nothing is set");
    assert!(apply(&mut device, &config).refused.is_empty());
    assert_eq!(compare(&device, &config), [""; 0]);
    let focus = CameraConfig { focus: value(3.0), ..CameraConfig::default() };
    assert_eq!(compare(&device, &focus), ["camera.focus: the camera has no such control"]);
}
