//! `feature-worker camera`: lists the cameras of this machine, what each can do, who uses it, and how it is set.
//!
//! An ordinary command-line program that allocates. Without `--find` it sets nothing, and does not disturb a camera that streams. With a
//! configuration it says after the list what is wrong with the camera that is named there, by the exit code too. Only root sees which programs
//! of other users have a camera. With `--find` it writes into the configuration's `[camera]` table what the camera's automatics find, and fails
//! with nothing written where another program has the camera.

use std::path::{Path, PathBuf};

use serde_json::{Value, json};
use shared::config::{CameraConfig, CameraSource, Config};
use shared::exit::{self, Failure, OrExit as _, failure};

use super::configuration;
use crate::source::Capture;
use crate::source::controls::{self, Control, Found};
use crate::source::devices::{self, Device, Trouble};

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  feature-worker camera\n  feature-worker camera --json\n  feature-worker camera --config config/cell.toml   (is \
that camera usable? exit code 2: permission, metadata node, or no camera; 3: missing, its driver fails, or another program streams from it)\n\nSettings are written into [camera]: exposure_ms, gain, \
white_balance_k, focus and mains_hz, each a value or \"locked\". `run` sets them and reads them back. --find lets the automatics of a camera that sees \
the cell in its light find the first four once, and writes them down.\n\n\
The programs of other users that have a camera are seen by root alone."
)]
pub struct Args {
    /// Also judge the camera that this configuration names.
    #[arg(long, env = shared::config::VARIABLE)]
    config: Option<PathBuf>,
    /// Let that camera's automatics find exposure, gain, white balance and focus for two seconds, and write them into [camera].
    #[arg(long, requires = "config", conflicts_with = "json")]
    find: bool,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let mut found = Vec::new();
    for mut device in devices::list(Path::new("/")) {
        let controls = device.ask().map(|file| controls::list(&file)).unwrap_or_default();
        found.push((device, controls));
    }
    if args.json {
        println!("{:#}", json!({ "cameras": found.iter().map(|(device, controls)| as_json(device, controls)).collect::<Vec<_>>() }));
    } else {
        found.iter().for_each(|(device, controls)| print(device, controls));
        println!("{} devices", found.len());
    }
    // The list comes first: a configuration that is named once for all, and not there yet, is written from it.
    let config = args.config.as_ref().map(|file| Config::read(file).or_exit(exit::BAD_INPUT)).transpose()?;
    match (config, &args.config) {
        (Some(config), Some(file)) if config.camera.source == CameraSource::Device => {
            let path = Path::new(&config.camera.path);
            let free = |device| devices::free(&device, Path::new("/"), path);
            devices::open(path).and_then(free).map_err(|e| failure(e.exit_code(), e))?;
            if args.find { find(&config.camera, file) } else { Ok(()) }
        }
        _ if args.find => {
            Err(failure(exit::BAD_INPUT, "[camera] names no device whose settings could be found; set camera.source to \"device\""))
        }
        _ => Ok(()),
    }
}

/// Lets the automatics of `camera` find its settings, and writes them into `file`.
fn find(camera: &CameraConfig, file: &Path) -> Result<(), Failure> {
    let Found { values, outcome } = Capture::find(camera).map_err(|e| failure(e.exit_code(), e))?;
    outcome.refused.iter().for_each(|line| eprintln!("camera: warning: {line}"));
    if values.is_empty() {
        return Err(failure(exit::FAILED, "the camera has none of these settings, or refuses them; nothing is written"));
    }
    let keys: Vec<(&str, String)> = values.iter().map(|(name, value)| (*name, format!("{value:?}"))).collect();
    configuration::change(file, "camera", |before| set_keys(before, &keys), |_| Ok(()))?;
    outcome.said.iter().for_each(|line| println!("{line}"));
    eprintln!("camera: wrote these into [camera] of {}", file.display());
    Ok(())
}

/// The file's text with these keys of its `[camera]` table at these values: a key that is there keeps its place and its comment, and another
/// one stands behind the last. None if it has no such table.
fn set_keys(before: &str, keys: &[(&str, String)]) -> Option<String> {
    let mut lines: Vec<String> = before.lines().map(String::from).collect();
    let header = |line: &String| line.trim_start().strip_prefix('[').map(|rest| rest.split(']').next().unwrap_or(rest).trim().to_owned());
    let begin = lines.iter().position(|line| header(line).as_deref() == Some("camera"))? + 1;
    let mut end = begin + lines[begin..].iter().take_while(|line| header(line).is_none()).count();
    let is_key = |line: &String| !line.trim().is_empty() && !line.trim_start().starts_with('#');
    for (name, value) in keys {
        let names = |line: &String| line.split('=').next().is_some_and(|key| key.trim() == *name);
        if let Some(at) = (begin..end).find(|at| is_key(&lines[*at]) && names(&lines[*at])) {
            let comment = lines[at].find('#').map_or(String::new(), |from| format!("   {}", &lines[at][from..]));
            lines[at] = format!("{name} = {value}{comment}");
        } else {
            let last = (begin..end).rev().find(|at| is_key(&lines[*at])).map_or(begin, |at| at + 1);
            lines.insert(last, format!("{name} = {value}"));
            end += 1;
        }
    }
    Some(lines.join("\n") + "\n")
}

fn as_json(device: &Device, controls: &[(Control, Result<i32, String>)]) -> Value {
    let controls: Vec<Value> = controls
        .iter()
        .map(|(c, value)| {
            json!({ "name": c.name, "value": value.as_ref().ok(), "least": c.least, "most": c.most, "step": c.step, "inactive": c.inactive,
            "read_only": c.read_only })
        })
        .collect();
    let mut value = json!(device);
    value["controls"] = controls.into();
    value
}

/// A trouble in words.
fn words(device: &Device) -> String {
    match device.trouble {
        None => "a camera".into(),
        Some(Trouble::Missing) => "missing: the kernel knows it, and its node is not there".into(),
        Some(Trouble::Permission) => format!("permission denied: group '{}' may open it", device.group),
        Some(Trouble::Busy) => "busy".into(),
        Some(Trouble::Metadata) => "a metadata node, without pictures".into(),
        Some(Trouble::NotACamera) => "no camera".into(),
        Some(Trouble::Failing) => "its driver cannot open it".into(),
    }
}

fn print(device: &Device, controls: &[(Control, Result<i32, String>)]) {
    println!("{}: {}: {}", device.path.display(), device.card, words(device));
    for name in &device.names {
        println!("  name     {}", name.display());
    }
    for user in &device.users {
        println!("  used by  {user}");
    }
    for format in &device.formats {
        println!("  format   {format}");
    }
    for (Control { name, least, most, step, inactive, read_only, .. }, value) in controls {
        let value = value.as_ref().map_or_else(|e| format!("cannot be read ({e})"), i32::to_string);
        println!(
            "  control  {name} = {value} ({least} to {most}, step {step}){}{}",
            if *read_only { ", read only" } else { "" },
            if *inactive { ", automatic now" } else { "" }
        );
    }
}

#[cfg(test)]
mod tests {
    use shared::config::Setting;

    use super::*;

    /// Protects the rest of a configuration: what was found stands in `[camera]`, in the place of what was there, and all else stays as it was.
    #[test]
    fn found_settings_are_written_into_their_table() {
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("cell.toml");
        let text = include_str!("../../../config/cell.toml");
        let before = text.replace("fps = 30.0 ", "gain = \"locked\"   # as found\nfps = 30.0 ");
        std::fs::write(&file, &before).unwrap();
        let keys = [("exposure_ms", "15.6".into()), ("gain", "64.0".into())];
        configuration::change(&file, "camera", |text| set_keys(text, &keys), |_| Ok(())).unwrap();
        let after = std::fs::read_to_string(&file).unwrap();
        let changed = before.replace("gain = \"locked\"   # as found", "gain = 64.0   # as found");
        let at = after.find("exposure_ms = 15.6\n").unwrap();
        assert_eq!(after.replacen("exposure_ms = 15.6\n", "", 1), changed);
        assert!(at > after.find("fps = 30.0").unwrap() && at < after.find("# Set at the start").unwrap(), "{after}");
        let read = Config::read(&file).unwrap().camera;
        assert_eq!((read.exposure_ms, read.gain), (Some(Setting::Value(15.6)), Some(Setting::Value(64.0))));
        std::fs::write(&file, "[cell]\n").unwrap();
        assert!(configuration::change(&file, "camera", |text| set_keys(text, &keys), |_| Ok(())).is_err());
    }
}
