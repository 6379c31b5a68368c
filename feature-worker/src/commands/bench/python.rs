//! The yardstick of `bench`: the same pipeline, written with Python's OpenCV, on the same bytes.
//!
//! Python and its OpenCV go into a virtual environment, which is made and kept in a directory that the caller names. It runs on the calling
//! thread, allocates, starts processes and writes files there. Without network or Python there is no yardstick, and the error says why in
//! one line.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Command;

use opencv::core::Mat;
use opencv::prelude::*;
use shared::config::{CameraConfig, ImageConfig};

/// Median time that Python needs for one of `frames`, us, in `rounds` measurements. The frames are BGR pictures of the camera's size.
pub fn median_us(venv: &Path, camera: &CameraConfig, image: &ImageConfig, frames: &[Mat], rounds: usize) -> Result<f64, String> {
    let interpreter = environment(venv)?;
    let directory = venv.join("bench");
    let io = |e: std::io::Error| format!("{}: {e}", directory.display());
    std::fs::create_dir_all(&directory).map_err(io)?;
    std::fs::write(directory.join("bench.py"), include_str!("bench.py")).map_err(io)?;
    let mut raw = std::fs::File::create(directory.join("frames.bgr")).map_err(io)?;
    for frame in frames {
        raw.write_all(frame.data_bytes().map_err(|e| e.message)?).map_err(io)?;
    }
    let task = serde_json::json!({ "width": camera.width_px, "height": camera.height_px, "frames": rounds, "region": image.region_px,
        "x_axis": image.x_axis_px, "y_axis": image.y_axis_px, "hsv": image.colour_hsv });
    std::fs::write(directory.join("task.json"), task.to_string()).map_err(io)?;
    let output = Command::new(interpreter).arg(directory.join("bench.py")).arg(&directory).output().map_err(io)?;
    String::from_utf8_lossy(&output.stdout).trim().parse().map_err(|_| format!("bench.py: {}", last_line(&output.stderr, "no answer")))
}

/// The interpreter of the virtual environment that has OpenCV in it. Makes the environment when it is not there.
fn environment(venv: &Path) -> Result<PathBuf, String> {
    let interpreter = venv.join("bin/python");
    let works = || Command::new(&interpreter).args(["-c", "import cv2, numpy"]).output().is_ok_and(|o| o.status.success());
    if works() {
        return Ok(interpreter);
    }
    eprintln!("bench: installing Python's OpenCV into {}", venv.display());
    let install = ["-m", "pip", "install", "--quiet", "numpy", "opencv-python-headless<5"];
    complete(Command::new("python3").args(["-m", "venv"]).arg(venv))?;
    complete(Command::new(&interpreter).args(install))?;
    if works() { Ok(interpreter) } else { Err(format!("OpenCV cannot be imported; delete {} and try again", venv.display())) }
}

/// Runs a command to its end; what it says last is the error when it fails.
fn complete(command: &mut Command) -> Result<(), String> {
    let output = command.output().map_err(|e| format!("{}: {e}", command.get_program().to_string_lossy()))?;
    if output.status.success() { Ok(()) } else { Err(last_line(&output.stderr, "failed")) }
}

fn last_line(output: &[u8], otherwise: &str) -> String {
    String::from_utf8_lossy(output).lines().last().unwrap_or(otherwise).trim().to_string()
}
