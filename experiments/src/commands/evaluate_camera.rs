//! `experiments evaluate-camera`: measures the feature extraction against rendered truth.
//!
//! Each scene is another cell: container, lip, camera pose, liquid, background, light, noise and blur drawn from a seed; its
//! liquid's colour is learned from one rendered pour as `feature-worker calibrate` does. Then 24 frames of a pour (or of a dry
//! container that tilts) are rendered and measured. The renderer's truth is the line along the outline that it drew; it shares
//! nothing with the extraction. Whole pours, one after the other as in a cell, show what a short scene cannot: whether a stream is
//! seen at a glass at rest, and whether the extraction stays right for half a minute. One thread; allocates freely. Further down, frames
//! that nobody should trust show whether each doubt is raised.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use feature_worker::drawing;
use feature_worker::vision::{Axes, ColourLearner, Extractor, Image, Measurement};
use indicatif::ProgressBar;
use opencv::core::{Mat, Point, Scalar, Vec3b, Vector};
use opencv::prelude::*;
use opencv::{imgcodecs, imgproc};
use rand::seq::IndexedRandom;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use serde::Serialize;
use shared::config::{CameraConfig, CameraSource, ImageConfig, LiquidMethod};
use shared::exit::{self, OrExit as _};
use shared::messages::{Doubt, PixelFormat};

use simulator::camera::{Background, Renderer, Scene, Truth, View};
use simulator::physics::rig::Rig;

/// Areas from here on count for error and missed flow, px^2.
const MEASURED_PX2: f64 = 200.0;
/// Frames of a scene.
const FRAMES: usize = 24;
/// Pours in a row of a run of whole pours.
const POURS: usize = 3;
/// Worst frames that are saved.
const WORST: usize = 20;

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  experiments evaluate-camera\n  experiments evaluate-camera --frames 9600 --seed 2 --json out/camera.json\n  \
experiments evaluate-camera --frames 48 --runs 16 --method clear\n\n\
Prints the error of V_e for areas above 200 px^2 (median and 95th percentile of its size, bias), false flow on dry frames, missed flow \
(unnoticed: without a doubt) and the share of frames with a doubt, all by condition and over whole pours, and saves the worst 20 frames."
)]
pub struct Args {
    /// Frames of short scenes, half of them with coloured liquid and half with clear water.
    #[arg(long, default_value_t = 4800)]
    frames: usize,
    /// Runs of three whole pours, half of them with clear water, the backgrounds in turn (about 900 frames each).
    #[arg(long, default_value_t = 8)]
    runs: usize,
    /// Seed of everything that is drawn.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Write all figures to this file.
    #[arg(long)]
    json: Option<PathBuf>,
    /// Directory of the worst frames.
    #[arg(long, default_value = "out/evaluate-camera")]
    out: PathBuf,
    /// Only this method.
    #[arg(long)]
    method: Option<String>,
}

/// Figures of one condition.
#[derive(Debug, Default, Serialize)]
pub struct Figures {
    frames: usize,
    /// Frames with a truth above [`MEASURED_PX2`] that were measured.
    measured: usize,
    median_error_percent: f64,
    p95_error_percent: f64,
    bias_percent: f64,
    dry: usize,
    /// Of the frames without a stream, those on which one was seen.
    pub false_flow_percent: f64,
    wet: usize,
    /// Of the frames with a truth above 200 px^2, those on which no stream was seen.
    pub missed_flow_percent: f64,
    /// Of the frames with a stream, those on which none was seen and no doubt was raised.
    unnoticed_percent: f64,
    doubt_percent: f64,
}

/// One measured frame.
#[derive(Debug, Clone, Copy)]
struct Sample {
    truth_px2: f64,
    area_px2: f64,
    doubt: Doubt,
}

impl Sample {
    /// Signed error, per cent.
    fn error_percent(self) -> f64 {
        100.0 * (self.area_px2 / self.truth_px2 - 1.0)
    }

    /// How bad it is, for the list of worst frames.
    fn badness(self) -> f64 {
        if self.truth_px2 == 0.0 {
            // False flow is worse than any error of the same size.
            if self.area_px2 > 0.0 { 200.0 + self.area_px2 / 10.0 } else { 0.0 }
        } else if self.truth_px2 >= MEASURED_PX2 {
            self.error_percent().abs()
        } else {
            0.0
        }
    }
}

/// A cell with the names of its conditions.
struct Case {
    view: View,
    image: ImageConfig,
    labels: Vec<String>,
    seed: u64,
    dry: bool,
}

type Failure = Box<dyn std::error::Error>;

/// Runs the command.
pub fn run(args: &Args) -> Result<(), exit::Failure> {
    evaluate(args).or_exit(exit::FAILED)
}

/// The `[camera]` table of a view.
pub fn camera_config(view: &View) -> CameraConfig {
    CameraConfig { source: CameraSource::SharedMemory, path: String::new(), width_px: view.width_px, height_px: view.height_px, fps: 30.0 }
}

/// The configuration that a careful person would write for this view: axes as they are, the region over the mouth.
pub fn image_config(view: &View) -> ImageConfig {
    let (width, height) = (f64::from(view.width_px), f64::from(view.height_px));
    let [x, y] = view.lip_px;
    let (sin, cos) = view.roll_deg.to_radians().sin_cos();
    let at = |u: f64, w: f64| [(x + u * cos + w * sin) as f32, (y + u * sin - w * cos) as f32];
    let ([x0, y0], [x1, y1], [x2, y2]) = (at(0.0, 0.0), at(200.0, 0.0), at(0.0, -150.0));
    let (left, top) = ((x - 45.0).max(0.0), (y - 236.0).max(0.0));
    let (right, bottom) = ((x + 375.0).min(width), (y + 60.0).min(height));
    ImageConfig {
        method: if view.liquid_bgr.is_some() { LiquidMethod::Colour } else { LiquidMethod::Clear },
        region_px: [left as u32, top as u32, (right - left) as u32, (bottom - top) as u32],
        x_axis_px: [x0, y0, x1, y1],
        y_axis_px: [x2, y2, x0, y0],
        colour_hsv: [0, 0, 0, 179, 255, 255],
        area_min_px2: 30.0,
    }
}

const LIQUIDS: [(&str, [u8; 3]); 6] = [
    ("blue", [150, 62, 20]),
    ("red", [40, 36, 180]),
    ("green", [60, 150, 40]),
    ("orange", [24, 130, 240]),
    ("violet", [140, 40, 110]),
    ("cola", [18, 30, 62]),
];

fn name(background: Background) -> String {
    format!("{background:?}").to_lowercase()
}

/// A cell drawn by `random`, also before a given `background`: the dice are thrown anyway.
fn draw_case(random: &mut Pcg64Mcg, clear: bool, background: Option<Background>, seed: u64) -> Result<Case, Failure> {
    let mut pick = |levels: &[(&'static str, f64)]| levels.choose(random).copied().unwrap_or(levels[0]);
    let (light_name, light) = pick(&[("dim", 0.45), ("normal", 1.0), ("bright", 1.4)]);
    let (noise_name, noise) = pick(&[("low", 1.5), ("middle", 4.0), ("high", 8.0)]);
    let (blur_name, blur_px) = pick(&[("none", 0.0), ("slight", 0.8), ("strong", 1.6)]);
    let drawn = *Background::ALL.choose(random).unwrap_or(&Background::Chess);
    let background = background.unwrap_or(drawn);
    let (liquid_name, colour) = *LIQUIDS.choose(random).unwrap_or(&LIQUIDS[0]);
    let placed = View::placed(random);
    let view = View {
        liquid_bgr: (!clear).then_some(colour),
        opacity: random.random_range(0.8..0.97),
        background,
        light,
        noise,
        blur_px,
        ..placed
    };
    let mut image = image_config(&view);
    if !clear {
        // The person calibrates under good light, with the same background.
        image.colour_hsv = learn_colour(&View { light: 1.0, noise: 3.0, blur_px: 0.3, ..view.clone() }, &image, seed)?;
    }
    let background_name = name(background);
    let labels = vec![
        format!("liquid {}", if clear { "clear water" } else { liquid_name }),
        format!("background {background_name}"),
        format!("light {light_name}"),
        format!("noise {noise_name}"),
        format!("blur {blur_name}"),
        format!("lip {}", if view.spout_deg < 67.0 { "narrow" } else { "wide" }),
    ];
    Ok(Case { view, image, labels, seed, dry: random.random::<f64>() < 0.25 })
}

/// The liquid's colour in one rendered pour.
pub(crate) fn learn_colour(view: &View, image: &ImageConfig, seed: u64) -> Result<[u8; 6], Failure> {
    let mut renderer = Renderer::new(view, seed)?;
    let mut learner = ColourLearner::new(Axes::new(image));
    let mut pixels = vec![0; (view.width_px * view.height_px * 3) as usize];
    for i in 0..16 {
        let t = f64::from(i) / 16.0;
        let flow_ml_s = 14.0 * (std::f64::consts::PI * t).sin() - 2.0;
        renderer.render(&Scene { at_s: 2.0 * t, alpha_deg: 35.0 + 50.0 * t, rate_deg_s: 20.0, flow_ml_s, level_mm: -4.0 }, &mut pixels)?;
        learner.add(&Mat::new_rows_cols_with_bytes::<Vec3b>(view.height_px as i32, view.width_px as i32, &pixels)?)?;
    }
    Ok(learner.range()?)
}

/// Scenes of a pour (or of a dry container that tilts) at 30 fps.
fn scenes(random: &mut Pcg64Mcg, dry: bool) -> Vec<Scene> {
    let (start_deg, rate_deg_s) = (random.random_range(25.0..95.0f64), random.random_range(-25.0..35.0));
    let peak_ml_s = 10f64.powf(random.random_range(0.0..1.62));
    let level_mm = random.random_range(-30.0..-1.0);
    (0..FRAMES)
        .map(|i| {
            let t = i as f64 / 30.0;
            // 4 dry frames, growth, 8 frames near the peak, decay, drops.
            let share = match i {
                0..4 => 0.0,
                4..9 => (i as f64 - 3.0) / 5.0,
                9..17 => 1.0 + 0.1 * (t * 9.0).sin(),
                17..20 => (20.0 - i as f64) / 4.0,
                _ => 0.0,
            };
            Scene {
                at_s: t,
                alpha_deg: (start_deg + rate_deg_s * t).clamp(0.0, 108.0),
                rate_deg_s,
                flow_ml_s: if dry { 0.0 } else { peak_ml_s * share },
                level_mm,
            }
        })
        .collect()
}

/// Scenes of `pours` pours in a row at 30 fps, each as an operator sees it: a filled glass upright, tilted to its spill angle, poured
/// from, turned back, at rest. The liquid follows the container's physics.
fn whole_pours(random: &mut Pcg64Mcg, seed: u64, pours: usize) -> Vec<Scene> {
    const STEPS: usize = 8;
    let mut container = Rig::seeded(seed).container(300.0);
    let spill_deg = container.spill_angle_deg();
    let (mut scenes, mut alpha_deg) = (Vec::new(), 0.0f64);
    for _ in 0..pours {
        container.refill(300.0);
        let before_deg = spill_deg - 3.0;
        let top_deg = spill_deg + random.random_range(6.0..14.0);
        let [fast, slow, back] = [(13.5, 40.0), (5.0, 14.0), (2.0, 8.0)].map(|(from, to)| random.random_range(from..to));
        let hold_s = random.random_range(0.2..0.8);
        // Seconds, and the tilt's rate, degrees/s.
        let legs = [
            (1.5, 0.0),
            (before_deg / fast, fast),
            ((top_deg - before_deg) / slow, slow),
            (hold_s, 0.0),
            (1.0, -back),
            ((top_deg - back) / 60.0, -60.0),
            (2.5, 0.0),
        ];
        for (seconds, rate_deg_s) in legs {
            for _ in 0..(seconds * 30.0f64).round() as usize {
                for _ in 0..STEPS {
                    let dt_s = 1.0 / (30.0 * STEPS as f64);
                    alpha_deg = (alpha_deg + rate_deg_s * dt_s).max(0.0);
                    container.step(dt_s, alpha_deg);
                }
                scenes.push(Scene::of(&container, scenes.len() as f64 / 30.0, alpha_deg, rate_deg_s));
            }
        }
    }
    scenes
}

/// Figures of `pours` whole pours in a row before one camera.
pub fn measure_pours(view: &View, seed: u64, pours: usize) -> Result<Figures, Failure> {
    let mut samples = Vec::new();
    let scenes = whole_pours(&mut Pcg64Mcg::seed_from_u64(seed), seed, pours);
    measure(view, &image_config(view), seed, &scenes, |sample, _| {
        samples.push(sample);
        Ok(())
    })?;
    Ok(figures(&samples))
}

/// A measured frame: its number, pixels, the extractor, what it measured, and the truth.
type Frame<'a> = (usize, &'a [u8], &'a Extractor, &'a Measurement, &'a Truth);

/// Renders and measures `scenes` one after the other.
fn measure(
    view: &View,
    image: &ImageConfig,
    seed: u64,
    scenes: &[Scene],
    mut done: impl FnMut(Sample, Frame) -> Result<(), Failure>,
) -> Result<(), Failure> {
    let mut renderer = Renderer::new(view, seed)?;
    let mut extractor = Extractor::new(&camera_config(view), image)?;
    let mut pixels = vec![0; (view.width_px * view.height_px * 3) as usize];
    for (k, scene) in scenes.iter().enumerate() {
        let truth = renderer.render(scene, &mut pixels)?;
        let frame = Image { width_px: view.width_px, height_px: view.height_px, format: PixelFormat::Bgr8, pixels: &pixels };
        let measured = extractor.measure(frame)?;
        let sample = Sample { truth_px2: truth.area_px2, area_px2: measured.area_px2.into(), doubt: measured.doubt };
        done(sample, (k, &pixels, &extractor, &measured, &truth))?;
    }
    Ok(())
}

/// A frame kept because it was among the worst.
struct Kept {
    badness: f64,
    name: String,
    picture: Mat,
}

fn evaluate(args: &Args) -> Result<(), Failure> {
    let short = args.frames.div_ceil(FRAMES).max(2);
    let bar = ProgressBar::new((short + args.runs) as u64).with_message("scenes");
    let mut groups: BTreeMap<String, Vec<Sample>> = BTreeMap::new();
    let mut worst: Vec<Kept> = Vec::new();
    let mut frames = 0;
    for i in 0..short + args.runs {
        let clear = i % 2 == 1;
        let method = if clear { "clear" } else { "colour" };
        if args.method.as_deref().is_some_and(|m| m != method) {
            bar.inc(1);
            continue;
        }
        let seed = args.seed.wrapping_mul(1_000_003).wrapping_add(i as u64);
        let mut random = Pcg64Mcg::seed_from_u64(seed);
        let run = i.checked_sub(short);
        let case = draw_case(&mut random, clear, run.map(|run| Background::ALL[run / 2 % Background::ALL.len()]), seed)?;
        let (scenes, labels) = match run {
            Some(_) => {
                let labels = vec!["whole pours".into(), format!("whole pours, {}", name(case.view.background))];
                (whole_pours(&mut random, seed, POURS), labels)
            }
            None => (scenes(&mut random, case.dry), [case.labels.clone(), vec!["all".into()]].concat()),
        };
        frames += scenes.len();
        measure(&case.view, &case.image, seed, &scenes, |sample, (k, pixels, extractor, measured, truth)| {
            for label in &labels {
                groups.entry(format!("{method}: {label}")).or_default().push(sample);
            }
            let least = if worst.len() < WORST { 0.0 } else { worst.last().map_or(0.0, |w| w.badness) };
            if sample.badness() > least {
                let picture = explain(pixels, &case, extractor, measured, truth, &scenes[k])?;
                worst.push(Kept { badness: sample.badness(), name: format!("{method}-{}-{k:02}", case.seed), picture });
                worst.sort_by(|a, b| b.badness.total_cmp(&a.badness));
                worst.truncate(WORST);
            }
            Ok(())
        })?;
        bar.inc(1);
    }
    bar.finish_and_clear();
    save_worst(&args.out, &worst)?;

    let figures: BTreeMap<&str, Figures> = groups.iter().map(|(name, samples)| (name.as_str(), figures(samples))).collect();
    println!(
        "{:<32}{:>7}{:>9}{:>8}{:>8}{:>8}{:>9}{:>12}{:>8}",
        "condition", "frames", "median %", "p95 %", "bias %", "false %", "missed %", "unnoticed %", "doubt %"
    );
    for (name, f) in &figures {
        println!(
            "{name:<32}{:>7}{:>9.2}{:>8.2}{:>8.2}{:>8.2}{:>9.2}{:>12.2}{:>8.2}",
            f.frames,
            f.median_error_percent,
            f.p95_error_percent,
            f.bias_percent,
            f.false_flow_percent,
            f.missed_flow_percent,
            f.unnoticed_percent,
            f.doubt_percent
        );
    }
    let doubts = doubts(args.seed)?;
    println!("\nframes that nobody should trust, and the share for which the doubt was raised:");
    for (name, percent) in &doubts {
        println!("  {name:<24}{percent:>6.1} %");
    }
    println!("\nworst frames: {}", args.out.display());
    if let Some(path) = &args.json {
        let report = serde_json::json!({ "frames": frames, "seed": args.seed, "conditions": figures, "doubts_raised_percent": doubts });
        std::fs::write(path, serde_json::to_string_pretty(&report)?).map_err(|e| format!("{}: {e}", path.display()))?;
    }
    Ok(())
}

fn figures(samples: &[Sample]) -> Figures {
    let wet: Vec<&Sample> = samples.iter().filter(|s| s.truth_px2 > MEASURED_PX2).collect();
    let mut errors: Vec<f64> = wet.iter().filter(|s| s.area_px2 > 0.0).map(|s| s.error_percent()).collect();
    let bias_percent = errors.iter().sum::<f64>() / errors.len().max(1) as f64;
    errors.iter_mut().for_each(|e| *e = e.abs());
    errors.sort_by(f64::total_cmp);
    let quantile = |share: f64| errors.get(((errors.len().max(1) - 1) as f64 * share).round() as usize).copied().unwrap_or(f64::NAN);
    let dry: Vec<&Sample> = samples.iter().filter(|s| s.truth_px2 == 0.0).collect();
    let percent = |part: usize, whole: usize| 100.0 * part as f64 / whole.max(1) as f64;
    Figures {
        frames: samples.len(),
        measured: errors.len(),
        median_error_percent: quantile(0.5),
        p95_error_percent: quantile(0.95),
        bias_percent,
        dry: dry.len(),
        false_flow_percent: percent(dry.iter().filter(|s| s.area_px2 > 0.0).count(), dry.len()),
        wet: wet.len(),
        missed_flow_percent: percent(wet.iter().filter(|s| s.area_px2 == 0.0).count(), wet.len()),
        unnoticed_percent: percent(wet.iter().filter(|s| s.area_px2 == 0.0 && s.doubt == Doubt::None).count(), wet.len()),
        doubt_percent: percent(samples.iter().filter(|s| s.doubt != Doubt::None).count(), samples.len()),
    }
}

/// The frame with what was seen (yellow, white) and the truth (magenta) drawn on it, and its conditions below.
fn explain(
    pixels: &[u8],
    case: &Case,
    extractor: &Extractor,
    measured: &Measurement,
    truth: &Truth,
    scene: &Scene,
) -> Result<Mat, Failure> {
    let (rows, columns) = (case.view.height_px as i32, case.view.width_px as i32);
    let mut picture = Mat::new_rows_cols_with_bytes::<Vec3b>(rows, columns, pixels)?.try_clone()?;
    drawing::draw(&mut picture, extractor, measured)?;
    let at = |k: usize| Point::new((truth.triangle_px[k][0] * 16.0) as i32, (truth.triangle_px[k][1] * 16.0) as i32);
    if truth.area_px2 > 0.0 {
        imgproc::line(&mut picture, at(1), at(2), Scalar::new(255.0, 0.0, 255.0, 0.0), 1, imgproc::LINE_AA, 4)?;
    }
    let text = format!("truth {:.0} px^2, alpha {:.0}, {:.1} ml/s", truth.area_px2, scene.alpha_deg, scene.flow_ml_s);
    drawing::caption(&mut picture, &text, 1)?;
    drawing::caption(&mut picture, &case.labels.join(", "), 2)?;
    Ok(picture)
}

fn save_worst(directory: &Path, worst: &[Kept]) -> Result<(), Failure> {
    let fail = |e: std::io::Error| format!("{}: {e}; give another --out", directory.display());
    std::fs::create_dir_all(directory).map_err(fail)?;
    for entry in std::fs::read_dir(directory).map_err(fail)? {
        let path = entry.map_err(fail)?.path();
        if path.extension().is_some_and(|e| e == "png") {
            std::fs::remove_file(path).map_err(fail)?;
        }
    }
    for (rank, kept) in worst.iter().enumerate() {
        let path = directory.join(format!("{:02}-{}.png", rank + 1, kept.name));
        imgcodecs::imwrite(&path, &kept.picture, &Vector::new())?;
    }
    Ok(())
}

/// For each doubt: frames that deserve it, and how many got it, per cent.
fn doubts(seed: u64) -> Result<BTreeMap<&'static str, f64>, Failure> {
    let base = View::default();
    // The doubt, the view, the flow, and whether the region is cut short.
    let bad = [
        (Doubt::TooDark, View { light: 0.06, ..base.clone() }, 8.0, false),
        (
            Doubt::BlownOut,
            View { light: 1.98, background: Background::Plain, liquid_bgr: Some([250, 240, 180]), ..base.clone() },
            8.0,
            false,
        ),
        (Doubt::Blurred, View { blur_px: 4.5, ..base.clone() }, 12.0, false),
        (Doubt::LeavesRegion, base.clone(), 12.0, true),
    ];
    let mut raised = BTreeMap::new();
    for (doubt, view, flow_ml_s, cut_short) in bad {
        let mut image = ImageConfig { colour_hsv: learn_colour(&base, &image_config(&base), seed)?, ..image_config(&base) };
        if cut_short {
            let [x, y] = base.lip_px.map(|v| v as u32);
            image.region_px = [x - 20, y - 50, 120, 60];
        }
        let scenes: Vec<Scene> = (0..30)
            .map(f64::from)
            .map(|i| Scene { at_s: i / 30.0, alpha_deg: 40.0 + i, rate_deg_s: 30.0, flow_ml_s, level_mm: 0.0 })
            .collect();
        let mut hits = 0;
        measure(&view, &image, seed, &scenes, |sample, _| {
            hits += u32::from(sample.doubt == doubt);
            Ok(())
        })?;
        raised.insert(doubt.words(), f64::from(hits) / 0.3);
    }
    // The same picture twice.
    let image = ImageConfig { colour_hsv: learn_colour(&base, &image_config(&base), seed)?, ..image_config(&base) };
    let mut renderer = Renderer::new(&base, seed)?;
    let mut extractor = Extractor::new(&camera_config(&base), &image)?;
    let mut pixels = vec![0; (base.width_px * base.height_px * 3) as usize];
    let mut hits = 0;
    for i in 0..30 {
        let scene = Scene { at_s: f64::from(i) / 30.0, alpha_deg: 60.0, flow_ml_s: f64::from(i % 10), ..Scene::default() };
        renderer.render(&scene, &mut pixels)?;
        let frame = Image { width_px: base.width_px, height_px: base.height_px, format: PixelFormat::Bgr8, pixels: &pixels };
        extractor.measure(frame)?;
        hits += u32::from(extractor.measure(frame)?.doubt == Doubt::Frozen);
    }
    raised.insert(Doubt::Frozen.words(), f64::from(hits) / 0.3);
    Ok(raised)
}
