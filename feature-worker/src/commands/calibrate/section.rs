//! The `[image]` table as text, and its place in the configuration's file.
//!
//! Runs on the calling thread and allocates. A configuration that would be refused is not written; every failure names the file.

use std::path::Path;

use shared::config::{Config, ImageConfig, LiquidMethod};
use shared::exit::Failure;

use crate::commands::configuration;

/// The `[image]` table as text.
pub(super) fn text(image: &ImageConfig) -> String {
    let method = if image.method == LiquidMethod::Colour { "colour" } else { "clear" };
    let round = |a: [f32; 4]| a.map(|v| (v * 10.0).round() / 10.0);
    format!(
        "[image]\nmethod = \"{method}\"\nregion_px = {:?}            # x, y, width, height: the lip and the space over the glass's mouth\n\
         x_axis_px = {:?}   # glass's top edge, from the lip's side into the mouth\n\
         y_axis_px = {:?}   # container's left side, from its foot towards its rim\n\
         colour_hsv = {:?}   # h_min s_min v_min h_max s_max v_max, OpenCV's HSV\n\
         area_min_px2 = {:?}            # less is no stream\n",
        image.region_px,
        round(image.x_axis_px),
        round(image.y_axis_px),
        image.colour_hsv,
        image.area_min_px2
    )
}

/// What a page sends when somebody writes.
#[derive(serde::Deserialize)]
struct Shown {
    section: String,
}

/// Whether a page that writes shows this table: what a person has not seen is not written.
pub(super) fn is_shown(image: &ImageConfig, body: &[u8]) -> bool {
    serde_json::from_slice::<Shown>(body).is_ok_and(|shown| shown.section == text(image))
}

/// Puts the `[image]` table of `config` into the file in one step. The other tables stay as they are.
pub(super) fn write(path: &Path, config: &Config) -> Result<(), Failure> {
    let (width, height) = (config.camera.width_px, config.camera.height_px);
    let same_size = |checked: &Config| {
        let size = (checked.camera.width_px, checked.camera.height_px);
        if size == (width, height) {
            return Ok(());
        }
        Err(format!(
            "[camera] says {} x {} px, but these frames are {width} x {height}; correct width_px and height_px first",
            size.0, size.1
        ))
    };
    configuration::change(path, "image", |before| replace(before, &text(&config.image)), same_size)?;
    eprintln!("calibrate: wrote [image] of {}", path.display());
    Ok(())
}

/// The file's text with another `[image]` table; none if it has no such table.
fn replace(before: &str, section: &str) -> Option<String> {
    let mut after = String::new();
    // Comments and empty lines behind the table's last key belong to the next table, or to the file's end.
    let mut between = String::new();
    let (mut inside, mut replaced) = (false, false);
    for line in before.lines() {
        let trimmed = line.trim_start();
        let header = trimmed.split(']').next().filter(|_| trimmed.starts_with('['));
        if header.is_some_and(|name| name[1..].trim() == "image") {
            (inside, replaced) = (true, true);
            after.push_str(section);
        } else if inside && header.is_none() {
            if !trimmed.is_empty() && !trimmed.starts_with('#') {
                between.clear();
            } else {
                between.push_str(line);
                between.push('\n');
            }
        } else {
            if std::mem::take(&mut inside) {
                after.push_str(if between.is_empty() { "\n" } else { &between });
                between.clear();
            }
            after.push_str(line);
            after.push('\n');
        }
    }
    after.push_str(&between);
    replaced.then_some(after)
}
