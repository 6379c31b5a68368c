//! Whole pours through cameras with faults: the same rendered pictures pass through every fault, each before an extraction of its own.
//!
//! Any thread; allocates. The same seed gives the same figures.

use std::collections::BTreeMap;

use feature_worker::vision::{Extractor, Image};
use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use shared::messages::PixelFormat;
use simulator::camera::faults::{CameraFault, FaultKind, FaultyCamera};
use simulator::camera::{Background, Renderer, View};

use super::cases::Case;
use super::figures::Comparison;
use super::scenes::whole_pours;
use crate::camera_setup::{CameraError, camera_config, image_config, learn_colour};

/// The faults of the table with their strengths: those that people reported, and some stronger ones.
const FAULTS: [(FaultKind, f64); 26] = [
    (FaultKind::Banding, 0.1),
    (FaultKind::Banding, 0.15),
    (FaultKind::Banding, 0.2),
    (FaultKind::Banding, 0.3),
    (FaultKind::WhiteBalance, 0.03),
    (FaultKind::WhiteBalance, 0.05),
    (FaultKind::WhiteBalance, 0.1),
    (FaultKind::WhiteBalance, 0.2),
    (FaultKind::ExposureHunting, 1.6),
    (FaultKind::ExposureHunting, 2.5),
    (FaultKind::ExposureStep, 1.35),
    (FaultKind::GreyBelow, 1.0),
    (FaultKind::GreyBelow, 0.6),
    (FaultKind::GreenBelow, 1.0),
    (FaultKind::ShiftedBelow, 32.0),
    (FaultKind::ShiftedBelow, 16.0),
    (FaultKind::Torn, 1.0),
    (FaultKind::Torn, 0.6),
    (FaultKind::Repeated, 2.0),
    (FaultKind::Repeated, 4.0),
    (FaultKind::Highlight, 1.0),
    (FaultKind::WarmLight, 0.15),
    (FaultKind::WarmLight, 0.3),
    (FaultKind::SwappedColours, 1.0),
    (FaultKind::Grey, 1.0),
    (FaultKind::LimitedRange, 1.0),
];
/// Light of the cell in which red saturates, relative to a good exposure: a window behind the operator.
const BRIGHT: f64 = 1.5;
/// Blue, green and red of orange juice, as in the other cells.
const ORANGE_BGR: [u8; 3] = [24, 130, 240];

/// What else may be hard for an eye, beside a camera's faults.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Hardship {
    /// A dark curtain stands behind.
    Curtain,
    /// A hand holds camera and container in an untidy room.
    Hand,
    /// Drops hang on the container's glass.
    WetGlass,
    /// A third of the liquid's surface is foam.
    Foam,
}

impl Hardship {
    /// The view with this hardship.
    fn on(self, view: View) -> View {
        match self {
            Self::Curtain => View { background: Background::Curtain, ..view },
            Self::Hand => View { background: Background::Clutter, hand_px: 4.0, ..view },
            Self::WetGlass => View { glass_drops: 24, ..view },
            Self::Foam => View { foam: 0.33, ..view },
        }
    }
}

/// Which rows are measured, and how.
#[derive(Debug, Clone, Copy)]
pub struct Chosen<'a> {
    /// Only the faults whose name begins so.
    pub only: Option<&'a str>,
    /// How much longer than usual an end has to be seen, see [`Extractor::with_patience`].
    pub patience: f32,
    /// What else is hard in all cells.
    pub hardship: Option<Hardship>,
}

/// Frames of one fault before one kind of ground, by the row's name.
pub type FaultFrames = BTreeMap<String, Vec<Comparison>>;

/// A fault's name in the table.
fn name(fault: Option<(FaultKind, f64)>) -> String {
    fault.map_or_else(|| "none".into(), |(kind, strength)| format!("{kind:?} {strength}"))
}

/// Measures one whole pour of the `i`-th cell through every fault, or those that are `chosen`, and adds
/// its frames to `frames`. The backgrounds come in turn. With a
/// coloured liquid, every fifth cell has an orange one before bright wood; with clear water, every second has an even wall.
///
/// # Errors
/// When a picture cannot be drawn or measured.
pub fn measure_cell(
    clear: bool,
    i: u64,
    seed: u64,
    Chosen { only, patience, hardship }: Chosen,
    frames: &mut FaultFrames,
) -> Result<(), CameraError> {
    let seed = seed.wrapping_mul(1_000_003).wrapping_add(500_000 + 2 * i + u64::from(clear));
    let mut random = Pcg64Mcg::seed_from_u64(seed);
    let orange = !clear && i % 5 == 4;
    let background = match (clear, i as usize) {
        (true, i) if i % 2 == 0 => Background::Plain,
        (true, i) => [Background::Chess, Background::Wood, Background::Clutter][i / 2 % 3],
        (false, _) if orange => Background::Wood,
        (false, i) => Background::ALL[i % 5],
    };
    let mut case = Case::draw(&mut random, clear, Some(background), seed)?;
    if orange {
        case.view = View { liquid_bgr: Some(ORANGE_BGR), light: BRIGHT, ..case.view };
        case.image = image_config(&case.view);
        case.image.colour_hsv = learn_colour(&View { light: 1.0, noise: 3.0, blur_px: 0.3, ..case.view.clone() }, &case.image, seed)?;
    }
    if let Some(hardship) = hardship {
        case.view = hardship.on(case.view);
        if !clear {
            // A person calibrates before the same background, but not with foam.
            let view = View { light: 1.0, noise: 3.0, blur_px: 0.3, foam: 0.0, ..case.view.clone() };
            case.image.colour_hsv = learn_colour(&view, &case.image, seed)?;
        }
    }
    let ground = match (clear, background) {
        (false, _) if orange => "orange, bright wood",
        (false, _) => "colour",
        (true, Background::Plain) => "clear, even wall",
        (true, _) => "clear, pattern",
    };
    let ground = hardship.map_or(ground.into(), |hardship| format!("{} {hardship:?}", if clear { "clear" } else { "colour" }));
    let scenes = whole_pours(&mut random, seed, 1);
    let view = &case.view;
    let size = [view.width_px as usize, view.height_px as usize];
    let mut renderer = Renderer::new(view, seed)?;
    let mut cameras = Vec::new();
    let chosen = |fault: &Option<(FaultKind, f64)>| only.is_none_or(|only| name(*fault).starts_with(only));
    for fault in std::iter::once(None).chain(FAULTS.into_iter().map(Some)).filter(chosen) {
        let camera = fault.map(|(kind, strength)| FaultyCamera::new(CameraFault { kind, strength, seed }, size, view.lip_px));
        let extractor = Extractor::new(&camera_config(view), &case.image)?;
        cameras.push((format!("{ground}: {}", name(fault)), camera, extractor.with_patience(patience)));
    }
    let mut clean = vec![0; size[0] * size[1] * 3];
    let mut given = clean.clone();
    for (number, scene) in scenes.iter().enumerate() {
        let truth = renderer.render(scene, &mut clean)?;
        for (row, camera, extractor) in &mut cameras {
            given.copy_from_slice(&clean);
            if let Some(camera) = camera {
                camera.pass(number as u64, &mut given);
            }
            let picture = Image { width_px: view.width_px, height_px: view.height_px, format: PixelFormat::Bgr8, pixels: &given };
            let measured = extractor.measure(picture)?;
            frames.entry(row.clone()).or_default().push(Comparison::new(number, truth.area_px2, &measured));
        }
    }
    Ok(())
}

/// The frames of all faults together, by kind of ground.
pub fn by_ground(frames: &FaultFrames) -> BTreeMap<String, Vec<Comparison>> {
    let mut all: BTreeMap<String, Vec<Comparison>> = BTreeMap::new();
    for (row, frames) in frames {
        let ground = row.split(':').next().unwrap_or(row);
        all.entry(format!("{ground}, all faults")).or_default().extend(frames);
    }
    all
}

/// Prints a line for each fault, in the order of the names.
pub fn print(frames: &FaultFrames) {
    println!(
        "{:<34}{:>6}{:>9}{:>8}{:>9}{:>8}{:>9}{:>9}{:>9}{:>10}{:>10}{:>9}  doubts on frames with a stream / without",
        "fault", "wet", "median %", "p95 %", "silent %", "wrong %", "doubt %", "false %", "dry d. %", "undist. %", "settled %", "dry s"
    );
    for (row, all) in frames {
        let f = super::figures::figures(all);
        println!(
            "{row:<34}{:>6}{:>9.2}{:>8.1}{:>9.2}{:>8.2}{:>9.2}{:>9.2}{:>9.2}{:>10.2}{:>10.2}{:>9.2}  {}",
            f.wet,
            f.median_error_percent,
            f.p95_error_percent,
            f.unnoticed_percent,
            f.wrong_percent,
            f.wet_unusable_percent,
            f.false_flow_percent,
            f.dry_doubt_percent,
            f.undisturbed_doubt_percent,
            f.settled_doubt_percent,
            f.dry_after_p95_s,
            f.doubts
        );
    }
}

/// Writes every frame of every row to a CSV file.
///
/// # Errors
/// When the file cannot be written.
pub fn write_frames(frames: &FaultFrames, path: &std::path::Path) -> Result<(), CameraError> {
    let mut text = String::from("row,frame,truth_px2,area_px2,confidence,doubt,usable\n");
    for (row, all) in frames {
        for f in all {
            let doubt = f.doubt.words();
            text += &format!("\"{row}\",{},{:.1},{:.1},{:.3},{doubt},{}\n", f.number, f.truth_px2, f.area_px2, f.confidence, f.usable);
        }
    }
    std::fs::write(path, text).map_err(|e| format!("{}: {e}", path.display()).into())
}
