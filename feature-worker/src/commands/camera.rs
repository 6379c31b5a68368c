//! `feature-worker camera`: lists the cameras of this machine, what each can do, who uses it, and how it is set.
//!
//! An ordinary command-line program that allocates. It sets nothing, and does not disturb a camera that streams. With a configuration it
//! says after the list what is wrong with the camera that is named there, by the exit code too. Only root sees which programs of other users
//! have a camera.

use std::path::{Path, PathBuf};

use serde_json::{Value, json};
use shared::config::{CameraSource, Config};
use shared::exit::{self, Failure, OrExit as _, failure};

use crate::source::controls::{self, Control};
use crate::source::devices::{self, Device, Trouble};

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  feature-worker camera\n  feature-worker camera --json\n  feature-worker camera --config config/cell.toml   (is \
that camera usable? exit code 2: permission, metadata node, or no camera; 3: missing, or another program has it)\n\nSettings are written into [camera]: exposure_ms, gain, \
white_balance_k, focus and mains_hz, each a value or \"locked\". `run` sets them and reads them back.\n\n\
The programs of other users that have a camera are seen by root alone."
)]
pub struct Args {
    /// Also judge the camera that this configuration names.
    #[arg(long, env = shared::config::VARIABLE)]
    config: Option<PathBuf>,
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
    match config {
        Some(config) if config.camera.source == CameraSource::Device => {
            let path = Path::new(&config.camera.path);
            devices::open(path).and_then(|_| devices::free(Path::new("/"), path)).map_err(|e| failure(e.exit_code(), e))
        }
        _ => Ok(()),
    }
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
