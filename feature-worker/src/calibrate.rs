//! `feature-worker calibrate`: finds the container's axes and the liquid's colour, and writes the `[image]` section.
//!
//! The container stands still in the image while the background turns and the liquid moves, so in the mean of many frames its
//! edges stay sharp and all else fades. The longest nearly horizontal and nearly vertical line there that meet at a corner are
//! the glass's top edge and its left side. A person checks the picture that is written, or corrects the corner and the
//! axes: with coordinates on the command line or with three clicks in a local page. An ordinary command-line program;
//! allocates; nothing is changed but the `[image]` table of the configuration, and that only with --write or a click.

use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

use opencv::core::{self, CV_8U, CV_32FC3, Mat, Scalar, Vec4i, Vector};
use opencv::prelude::*;
use opencv::{imgcodecs, imgproc};
use serde::Deserialize;
use shared::config::{CameraConfig, Config, ImageConfig, LiquidMethod};
use shared::exit::{self, Failure, OrExit as _, failure};
use shared::ipc::Cell;
use shared::messages::PixelFormat;
use shared::os;
use tiny_http::{Response, Server};

use crate::extract::{Axes, Extractor, Image};
use crate::inspect::{for_each_frame, to_bgr};
use crate::source::{Frame, FrameSource as _, NextFrame, ObserverSource};
use crate::view::{answer, draw, jpeg};

/// Frames kept for learning and for the picture.
const KEEP_FRAMES: usize = 150;

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  feature-worker calibrate --config config/cell.toml --seconds 20 --page   (live camera: pour once while it runs)\n  \
feature-worker calibrate pour.mp4 --write\n  feature-worker calibrate pour.mp4 --lip 215,250 --x-axis 600,250 --y-axis 215,470 --write\n\n\
Show one whole pour: dry, tilting, flowing, back. The section is printed; --write puts it into the configuration. Look at the picture that \
it names before you trust it: red must lie on the glass's top edge, green on its left side, white on the liquid's outline."
)]
pub struct Args {
    /// Images, a video or a pattern of one pour; without any, the configured camera (of a running worker: its frames).
    input: Vec<PathBuf>,
    /// The cell's configuration.
    #[arg(long, default_value = shared::config::DEFAULT_FILE)]
    config: PathBuf,
    /// How long to watch a live camera.
    #[arg(long, default_value_t = 15)]
    seconds: u64,
    /// The corner where top edge and left side meet, px: X,Y.
    #[arg(long, value_parser = parse_point)]
    lip: Option<[f32; 2]>,
    /// A point of the top edge, further into the mouth, px: X,Y.
    #[arg(long, value_parser = parse_point)]
    x_axis: Option<[f32; 2]>,
    /// A point of the left side, nearer to the foot, px: X,Y.
    #[arg(long, value_parser = parse_point)]
    y_axis: Option<[f32; 2]>,
    /// How the liquid is told from the background.
    #[arg(long, value_parser = ["colour", "clear"])]
    method: Option<String>,
    /// Write the section into the configuration.
    #[arg(long)]
    write: bool,
    /// Where the picture for the eye goes.
    #[arg(long, default_value = "out/calibration.png")]
    picture: PathBuf,
    /// Correct the axes by clicks in a page on this machine.
    #[arg(long)]
    page: bool,
    /// The page's port on 127.0.0.1; 0: any free one.
    #[arg(long, default_value_t = 8643)]
    port: u16,
}

fn parse_point(text: &str) -> Result<[f32; 2], String> {
    let parts: Vec<f32> = text.split(',').map_while(|p| p.trim().parse().ok()).collect();
    <[f32; 2]>::try_from(parts).map_err(|_| "two numbers: X,Y in px".into())
}

/// The three points that make the axes.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
pub struct Corner {
    /// Where top edge and left side meet, px.
    pub lip: [f32; 2],
    /// On the top edge, further into the mouth, px.
    pub rim: [f32; 2],
    /// On the left side, nearer to the foot, px.
    pub foot: [f32; 2],
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let config = Config::read(&args.config).or_exit(exit::BAD_INPUT)?;
    calibrate(args, config)
}

/// What was seen of one pour: evenly spread frames and the mean of all.
struct Seen {
    frames: Vec<Mat>,
    sum: Mat,
    count: u64,
    stride: u64,
}

impl Seen {
    fn add(&mut self, frame: &Frame) -> Result<(), String> {
        let words = |e: opencv::Error| e.message;
        let bgr = to_bgr(frame).map_err(words)?;
        if self.count == 0 {
            self.sum = Mat::new_rows_cols_with_default(bgr.rows(), bgr.cols(), CV_32FC3, Scalar::default()).map_err(words)?;
        } else if self.sum.size().map_err(words)? != bgr.size().map_err(words)? {
            return Err(format!("frame {} has another size than those before", self.count + 1));
        }
        imgproc::accumulate(&bgr, &mut self.sum, &core::no_array()).map_err(words)?;
        if self.count.is_multiple_of(self.stride) {
            self.frames.push(bgr);
        }
        if self.frames.len() > KEEP_FRAMES {
            // Every second one, and from now on half as many.
            let mut index = 0;
            self.frames.retain(|_| {
                index += 1;
                index % 2 == 1
            });
            self.stride *= 2;
        }
        self.count += 1;
        Ok(())
    }
}

fn calibrate(args: &Args, mut config: Config) -> Result<(), Failure> {
    let bad = |e: String| failure(exit::BAD_INPUT, e);
    let mut seen = Seen { frames: Vec::new(), sum: Mat::default(), count: 0, stride: 1 };
    if args.input.is_empty() {
        watch(args, &config, &mut seen)?;
    } else {
        for_each_frame(&args.input, &config.camera, |frame| seen.add(&frame)).map_err(bad)?;
    }
    let Some(first) = seen.frames.first() else { return Err(bad("no frame came".into())) };
    (config.camera.width_px, config.camera.height_px) = (first.cols() as u32, first.rows() as u32);
    let method = match args.method.as_deref() {
        Some("clear") => LiquidMethod::Clear,
        Some(_) => LiquidMethod::Colour,
        None => config.image.method,
    };
    let corner = match (args.lip, args.x_axis, args.y_axis) {
        (Some(lip), Some(rim), Some(foot)) => Corner { lip, rim, foot },
        (lip, rim, foot) => {
            let mut mean = Mat::default();
            let scaled = seen.sum.convert_to(&mut mean, CV_8U, 1.0 / seen.count as f64, 0.0);
            let found = scaled.map_err(CalibrateError::from).and_then(|()| find_corner(&mean));
            match found {
                Ok(found) => Corner { lip: lip.unwrap_or(found.lip), rim: rim.unwrap_or(found.rim), foot: foot.unwrap_or(found.foot) },
                Err(e) if args.page => {
                    eprintln!("calibrate: {e}; click the corner in the page");
                    let (w, h) = (first.cols() as f32, first.rows() as f32);
                    Corner { lip: [0.35 * w, 0.5 * h], rim: [0.9 * w, 0.5 * h], foot: [0.35 * w, 0.9 * h] }
                }
                Err(e) => return Err(failure(exit::FAILED, e)),
            }
        }
    };
    let found = propose(&config.camera, corner, method, &config.image, &seen.frames);
    match found {
        Ok(image) => config.image = image,
        // In the page the corner can still be corrected.
        Err(e) if args.page => eprintln!("calibrate: {e}"),
        Err(e) => return Err(failure(exit::FAILED, e)),
    }
    save_picture(args, &config, &seen.frames)?;
    println!("{}", section(&config.image));
    eprintln!("calibrate: look at {}", args.picture.display());
    if args.write {
        write(&args.config, &config)?;
    }
    if args.page { page(args, config, corner, &seen.frames) } else { Ok(()) }
}

/// Watches the configured camera for a while.
fn watch(args: &Args, config: &Config, seen: &mut Seen) -> Result<(), Failure> {
    let reach = |e: String| failure(exit::UNREACHABLE, e);
    let cell = Cell::join(&config.cell.name).map_err(|e| reach(e.to_string()))?;
    let mut source = ObserverSource::open(&config.camera, &cell).map_err(|e| reach(e.to_string()))?;
    eprintln!("calibrate: watching the camera for {} s; pour once now", args.seconds);
    let end = std::time::Instant::now() + Duration::from_secs(args.seconds);
    while std::time::Instant::now() < end {
        match source.next_frame(Duration::from_millis(200)).map_err(|e| reach(e.to_string()))? {
            NextFrame::Frame(frame) => seen.add(&frame).map_err(reach)?,
            NextFrame::Nothing => {}
            NextFrame::End => break,
        }
    }
    if seen.count == 0 { Err(reach("no frame came from the camera; is its driver running?".into())) } else { Ok(()) }
}

/// Finds the corner in the mean of many frames, see the module's text.
pub fn find_corner(mean: &Mat) -> Result<Corner, CalibrateError> {
    let (width, height) = (mean.cols() as f32, mean.rows() as f32);
    let (mut grey, mut edges) = (Mat::default(), Mat::default());
    imgproc::cvt_color_def(mean, &mut grey, imgproc::COLOR_BGR2GRAY)?;
    imgproc::canny(&grey, &mut edges, 14.0, 42.0, 3, true)?;
    let mut lines = Vector::<Vec4i>::new();
    let (step, votes) = (std::f64::consts::PI / 720.0, (0.08 * width) as i32);
    imgproc::hough_lines_p(&edges, &mut lines, 1.0, step, votes, f64::from(0.15 * height), f64::from(0.04 * height))?;
    // The strongest few of either direction, as (left or upper end, other end, length).
    let mut level: Vec<([f32; 2], [f32; 2], f32)> = Vec::new();
    let mut upright = Vec::new();
    for line in &lines {
        let [x0, y0, x1, y1] = line.0.map(|v| v as f32);
        let (dx, dy) = (x1 - x0, y1 - y0);
        let length = dx.hypot(dy);
        if dy.abs() < 0.4 * dx.abs() {
            level.push(if dx > 0.0 { ([x0, y0], [x1, y1], length) } else { ([x1, y1], [x0, y0], length) });
        } else if dx.abs() < 0.4 * dy.abs() {
            upright.push(if dy > 0.0 { ([x0, y0], [x1, y1], length) } else { ([x1, y1], [x0, y0], length) });
        }
    }
    let mut best: Option<(f32, Corner)> = None;
    for (left, right, along) in &level {
        for (upper, lower, down) in &upright {
            let (a, b) = ([right[0] - left[0], right[1] - left[1]], [lower[0] - upper[0], lower[1] - upper[1]]);
            let cross = a[0] * b[1] - a[1] * b[0];
            let t = ((upper[0] - left[0]) * b[1] - (upper[1] - left[1]) * b[0]) / cross;
            let lip = [left[0] + t * a[0], left[1] + t * a[1]];
            // Both must begin near the corner and leave it to the right and downwards.
            let gap = (left[0] - lip[0]).hypot(left[1] - lip[1]) + (upper[0] - lip[0]).hypot(upper[1] - lip[1]);
            let inside = lip[0] > 0.03 * width && lip[0] < 0.8 * width && lip[1] > 0.1 * height && lip[1] < 0.9 * height;
            let score = along + down - 2.5 * gap;
            if inside && gap < 0.15 * height && best.is_none_or(|(s, _)| score > s) {
                best = Some((score, Corner { lip, rim: *right, foot: *lower }));
            }
        }
    }
    let (_, Corner { lip, rim, foot }) = best.ok_or(CalibrateError::NoCorner)?;
    // A bright rim or wall has an edge on either side: the axes go through their middle.
    let near = 0.012 * height;
    let (rim_shift, side_shift) = (middle(lip, rim, &level, near), middle(lip, foot, &upright, near));
    let moved = |p: [f32; 2], shifts: &[[f32; 2]]| shifts.iter().fold(p, |p, s| [p[0] + s[0], p[1] + s[1]]);
    Ok(Corner { lip: moved(lip, &[rim_shift, side_shift]), rim: moved(rim, &[rim_shift]), foot: moved(foot, &[side_shift]) })
}

/// The shift, square to it, from the line through `from` and `to` to the middle of the outermost of all `lines` within `near` px.
fn middle(from: [f32; 2], to: [f32; 2], lines: &[([f32; 2], [f32; 2], f32)], near: f32) -> [f32; 2] {
    let length = (to[0] - from[0]).hypot(to[1] - from[1]);
    let normal = [-(to[1] - from[1]) / length, (to[0] - from[0]) / length];
    let offset = |p: [f32; 2]| normal[0] * (p[0] - from[0]) + normal[1] * (p[1] - from[1]);
    // Several pieces of one edge count once: the outermost on either side.
    let offsets = lines.iter().map(|(a, b, _)| (offset(*a), offset(*b))).filter(|(a, b)| a.abs() < near && b.abs() < near);
    let (low, high) = offsets.map(|(a, b)| (a + b) / 2.0).fold((0.0f32, 0.0f32), |(low, high), v| (low.min(v), high.max(v)));
    normal.map(|n| n * (low + high) / 2.0)
}

/// The `[image]` table for a corner: region over the mouth, axes, colour learned from the frames.
pub fn propose(
    camera: &CameraConfig,
    corner: Corner,
    method: LiquidMethod,
    before: &ImageConfig,
    frames: &[Mat],
) -> Result<ImageConfig, CalibrateError> {
    let scale = camera.width_px as f32 / 640.0;
    let [x, y] = corner.lip;
    let clamp = |v: f32, most: u32| v.clamp(0.0, most as f32) as u32;
    let (left, top) = (clamp(x - 40.0 * scale, camera.width_px), clamp(y - 236.0 * scale, camera.height_px));
    let (right, bottom) = (clamp(x + 380.0 * scale, camera.width_px), clamp(y + 50.0 * scale, camera.height_px));
    let mut image = ImageConfig {
        method,
        region_px: [left, top, right.saturating_sub(left), bottom.saturating_sub(top)],
        x_axis_px: [x, y, corner.rim[0], corner.rim[1]],
        y_axis_px: [corner.foot[0], corner.foot[1], x, y],
        ..before.clone()
    };
    if method == LiquidMethod::Colour {
        let mut learner = ColourLearner::new(Axes::new(&image));
        for frame in frames {
            learner.add(frame)?;
        }
        image.colour_hsv = learner.range()?;
    }
    Ok(image)
}

/// The `[image]` table as text.
fn section(image: &ImageConfig) -> String {
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

/// Puts the table into the configuration in one step; the rest of the file stays as it is.
fn write(path: &Path, config: &Config) -> Result<(), Failure> {
    let fail = |e: String| failure(exit::FAILED, format!("{}: {e}", path.display()));
    let text = std::fs::read_to_string(path).map_err(|e| fail(e.to_string()))?;
    let mut written = String::new();
    // What stands between the table's last key and the next table belongs to that one.
    let mut between = String::new();
    let mut inside = false;
    for line in text.lines() {
        let trimmed = line.trim_start();
        if trimmed.starts_with("[image]") {
            inside = true;
            written.push_str(&section(&config.image));
        } else if inside && !trimmed.starts_with('[') {
            if !trimmed.is_empty() && !trimmed.starts_with('#') {
                between.clear();
            } else {
                between.push_str(line);
                between.push('\n');
            }
        } else {
            if std::mem::take(&mut inside) {
                written.push_str(if between.is_empty() { "\n" } else { &between });
            }
            written.push_str(line);
            written.push('\n');
        }
    }
    // A configuration that is refused is not written.
    let checked = Config::parse(&written, &path.display().to_string()).or_exit(exit::FAILED)?;
    let size = (checked.camera.width_px, checked.camera.height_px);
    if size != (config.camera.width_px, config.camera.height_px) {
        let (w, h) = (config.camera.width_px, config.camera.height_px);
        return Err(fail(format!(
            "[camera] says {} x {} px, but these frames are {w} x {h}; correct width_px and height_px first",
            size.0, size.1
        )));
    }
    let beside = path.with_extension("toml.new");
    std::fs::write(&beside, &written).and_then(|()| std::fs::rename(&beside, path)).map_err(|e| fail(e.to_string()))?;
    eprintln!("calibrate: wrote [image] of {}", path.display());
    Ok(())
}

/// The frame with most flow, with what is measured drawn on it.
fn best_picture(config: &Config, frames: &[Mat]) -> Result<Mat, String> {
    let mut extractor = Extractor::new(&config.camera, &config.image).map_err(|e| e.to_string())?;
    let mut best: Option<(f32, Mat)> = None;
    for frame in frames {
        let pixels = frame.data_bytes().map_err(|e| e.message)?;
        let (width_px, height_px) = (frame.cols() as u32, frame.rows() as u32);
        let measured = extractor.measure(Image { width_px, height_px, format: PixelFormat::Bgr8, pixels }).map_err(|e| e.to_string())?;
        if best.as_ref().is_none_or(|(area, _)| measured.area_px2 > *area) {
            let mut picture = frame.clone();
            draw(&mut picture, &extractor, &measured).map_err(|e| e.message)?;
            best = Some((measured.area_px2, picture));
        }
    }
    best.map(|(_, picture)| picture).ok_or_else(|| "no frame".into())
}

fn save_picture(args: &Args, config: &Config, frames: &[Mat]) -> Result<(), Failure> {
    let fail = |e: String| failure(exit::FAILED, format!("{}: {e}", args.picture.display()));
    let picture = best_picture(config, frames).map_err(fail)?;
    if let Some(parent) = args.picture.parent() {
        std::fs::create_dir_all(parent).map_err(|e| fail(e.to_string()))?;
    }
    let written = imgcodecs::imwrite(&args.picture, &picture, &Vector::new()).map_err(|e| fail(e.message))?;
    if written { Ok(()) } else { Err(fail("cannot be written".into())) }
}

/// Serves the page until "Write" or Ctrl-C.
fn page(args: &Args, mut config: Config, mut corner: Corner, frames: &[Mat]) -> Result<(), Failure> {
    let stop = os::stop_at_signals().or_exit(exit::FAILED)?;
    let server = Server::http(("127.0.0.1", args.port))
        .map_err(|e| failure(exit::FAILED, format!("port {} on 127.0.0.1: {e}; give another --port", args.port)))?;
    eprintln!("calibrate: open http://{} on this machine, click lip, top edge and left side, then Write", server.server_addr());
    while !stop.load(Relaxed) {
        let Ok(Some(mut request)) = server.recv_timeout(Duration::from_millis(100)) else { continue };
        let path = request.url().split('?').next().unwrap_or("/").to_string();
        // A browser that went away is no fault of ours.
        let _ = match path.as_str() {
            "/" => request.respond(answer(include_str!("calibrate.html").as_bytes().to_vec(), "text/html; charset=utf-8")),
            "/picture.jpg" => {
                let picture =
                    best_picture(&config, frames).or_else(|_| frames.first().cloned().ok_or_else(String::new)).unwrap_or_default();
                request.respond(answer(jpeg(&picture), "image/jpeg"))
            }
            "/state.json" => {
                let state = serde_json::json!({ "width": config.camera.width_px, "height": config.camera.height_px,
                    "lip": corner.lip, "rim": corner.rim, "foot": corner.foot, "section": section(&config.image) });
                request.respond(answer(state.to_string().into_bytes(), "application/json"))
            }
            "/corner" => {
                let mut body = String::new();
                let clicked = std::io::Read::read_to_string(&mut request.as_reader(), &mut body)
                    .map_err(|e| e.to_string())
                    .and_then(|_| serde_json::from_str::<Corner>(&body).map_err(|e| e.to_string()));
                let result = clicked.and_then(|clicked| {
                    let image = propose(&config.camera, clicked, config.image.method, &config.image, frames).map_err(|e| e.to_string())?;
                    let tried = Config { image, ..config.clone() };
                    best_picture(&tried, frames)?;
                    (config, corner) = (tried, clicked);
                    Ok(())
                });
                let text = result.err().unwrap_or_else(|| "measured again".into());
                request.respond(answer(text.into_bytes(), "text/plain; charset=utf-8"))
            }
            "/write" => {
                let result = save_picture(args, &config, frames).and_then(|()| write(&args.config, &config));
                stop.store(result.is_ok(), Relaxed);
                let text = result.err().map_or_else(|| format!("written to {}", args.config.display()), |failed| failed.what);
                request.respond(answer(text.into_bytes(), "text/plain; charset=utf-8"))
            }
            _ => request.respond(Response::from_data("not here").with_status_code(404)),
        };
    }
    Ok(())
}

/// Why a calibration fails.
#[derive(Debug, thiserror::Error)]
pub enum CalibrateError {
    /// No lines that meet like top edge and left side.
    #[error("the container's top edge and left side were not found: give --lip, --x-axis and --y-axis, or click them with --page")]
    NoCorner,
    /// No colour stands out at the lip.
    #[error("no liquid's colour stands out at the lip: show one whole pour, check the axes, or use --method clear for water")]
    NoColour,
    /// OpenCV refused.
    #[error("OpenCV: {0}")]
    OpenCv(#[from] opencv::Error),
}

/// Hue, saturation and value bins of the first look.
const BINS: [usize; 3] = [18, 8, 8];

/// Learns the liquid's colour from the frames of one pour: what is often right over the lip and seldom far from it.
///
/// The background turns behind the container, so what belongs to it is seen in both places; only the liquid stays at the lip.
pub struct ColourLearner {
    axes: Axes,
    near: Vec<[u8; 3]>,
    near_bins: Vec<u32>,
    far_bins: Vec<u32>,
    far: Vec<[u8; 3]>,
    hsv: Mat,
}

impl ColourLearner {
    /// Most pixels that are kept.
    const KEEP: usize = 400_000;

    /// A learner for a container with these axes.
    pub fn new(axes: Axes) -> Self {
        let bins = BINS.iter().product();
        Self { axes, near: Vec::new(), near_bins: vec![0; bins], far_bins: vec![0; bins], far: Vec::new(), hsv: Mat::default() }
    }

    fn bin([h, s, v]: [u8; 3]) -> usize {
        let bin = |value: u8, most: usize, bins: usize| usize::from(value) * bins / most;
        (bin(h, 180, BINS[0]) * BINS[1] + bin(s, 256, BINS[1])) * BINS[2] + bin(v, 256, BINS[2])
    }

    /// Adds one BGR frame of the pour, dry ones included.
    pub fn add(&mut self, bgr: &impl core::ToInputArray) -> Result<(), CalibrateError> {
        imgproc::cvt_color_def(bgr, &mut self.hsv, imgproc::COLOR_BGR2HSV)?;
        let (rows, columns) = (self.hsv.rows(), self.hsv.cols());
        let pixels = self.hsv.data_typed::<core::Vec3b>()?;
        let scale = columns as f32 / 640.0;
        let [lip_x, lip_y] = self.axes.lip_px;
        let reach = 220.0 * scale;
        for y in ((lip_y - reach).max(0.0) as i32)..((lip_y + reach) as i32).min(rows) {
            for x in ((lip_x - reach).max(0.0) as i32)..((lip_x + reach) as i32).min(columns) {
                let at = [x as f32, y as f32];
                let distance = (at[0] - lip_x).hypot(at[1] - lip_y);
                let (near, far) = (distance < 20.0 * scale, distance > 110.0 * scale && (x + y) % 5 == 0);
                // The rim's own light is near the lip in every frame; axes that are off by a few px shall not make it liquid.
                if !(near || far) || self.axes.between(at) < 4.0 * scale {
                    continue;
                }
                let hsv = pixels[(y * columns + x) as usize].0;
                if far {
                    if self.far.len() < Self::KEEP {
                        self.far_bins[Self::bin(hsv)] += 1;
                        self.far.push(hsv);
                    }
                } else if self.near.len() < Self::KEEP {
                    self.near_bins[Self::bin(hsv)] += 1;
                    self.near.push(hsv);
                }
            }
        }
        Ok(())
    }

    /// The range h_min, s_min, v_min, h_max, s_max, v_max for `[image] colour_hsv`.
    pub fn range(&self) -> Result<[u8; 6], CalibrateError> {
        let (near, far) = (self.near.len().max(1) as f32, self.far.len().max(1) as f32);
        let liquid = |hsv: &[u8; 3]| {
            let bin = Self::bin(*hsv);
            let (n, f) = (self.near_bins[bin] as f32 / near, self.far_bins[bin] as f32 / far);
            n > 0.004 && n > 4.0 * f
        };
        let seen: Vec<[u8; 3]> = self.near.iter().filter(|p| liquid(p)).copied().collect();
        if (seen.len() as f32) < 0.1 * near {
            return Err(CalibrateError::NoColour);
        }
        // Hue is an angle: everything about it relative to its mean direction.
        let (mut sin, mut cos) = (0.0f32, 0.0f32);
        for [h, s, _] in &seen {
            let (a, b) = (f32::from(*h) * std::f32::consts::TAU / 180.0).sin_cos();
            (sin, cos) = (sin + a * f32::from(*s), cos + b * f32::from(*s));
        }
        let mean = sin.atan2(cos) * 180.0 / std::f32::consts::TAU;
        let quantiles = |value: &dyn Fn(&[u8; 3]) -> f32| {
            let mut values: Vec<f32> = seen.iter().map(value).collect();
            values.sort_by(f32::total_cmp);
            let at = |share: f32| values[((values.len() - 1) as f32 * share) as usize];
            (at(0.02), at(0.5), at(0.98))
        };
        let (h_low, _, h_high) = quantiles(&|p| (f32::from(p[0]) - mean + 270.0).rem_euclid(180.0) - 90.0);
        let (s_low, s_mid, s_high) = quantiles(&|p| p[1].into());
        let (v_low, _, v_high) = quantiles(&|p| p[2].into());
        let byte = |v: f32| v.round().clamp(0.0, 255.0) as u8;
        if s_mid < 45.0 || h_high - h_low > 80.0 {
            // Grey liquids (milk, cola in shadow) have no hue.
            return Ok([0, byte(s_low - 30.0), byte(v_low - 30.0), 179, byte(s_high + 30.0), byte(v_high + 30.0)]);
        }
        // Shadow and exposure move value most and saturation more than hue. Where background of like colour comes nearer than
        // these margins, the limit is half way between the two.
        let relative_hue = |p: &[u8; 3]| (f32::from(p[0]) - mean + 270.0).rem_euclid(180.0) - 90.0;
        let between = |loose: f32, liquid: f32, alike: &dyn Fn(&[u8; 3]) -> Option<f32>| {
            let mut values: Vec<f32> =
                self.far.iter().filter_map(alike).filter(|v| (v - loose).signum() != (v - liquid).signum()).collect();
            values.extend(self.far.iter().filter_map(alike).filter(|v| (loose < liquid) == (*v < loose)).map(|_| loose));
            if (values.len() as f32) < 0.002 * far {
                return loose;
            }
            // The most liquid-like 2 % of it are noise.
            values.sort_by(|a, b| if loose < liquid { b.total_cmp(a) } else { a.total_cmp(b) });
            let nearest = values[values.len() / 50];
            if (nearest - loose).signum() == (nearest - liquid).signum() { loose } else { (nearest + liquid) / 2.0 }
        };
        let v_min = v_low * 0.3 - 5.0;
        let v_max = if v_high > 150.0 { 255.0 } else { v_high * 1.7 + 10.0 };
        let near_hue = |p: &[u8; 3]| (h_low - 12.0..=h_high + 12.0).contains(&relative_hue(p));
        let s_min = between(s_low * 0.75 - 10.0, s_low, &|p| near_hue(p).then_some(f32::from(p[1])));
        let alike = |p: &[u8; 3]| (f32::from(p[1]) >= s_min).then(|| relative_hue(p)).filter(|h| h.abs() < 40.0);
        let h_min = between(h_low - 6.0, h_low, &|p| alike(p).filter(|h| *h < 0.0));
        let h_max = between(h_high + 6.0, h_high, &|p| alike(p).filter(|h| *h > 0.0));
        let hue = |v: f32| (mean + v).rem_euclid(180.0).round().min(179.0) as u8;
        Ok([hue(h_min), byte(s_min), byte(v_min), hue(h_max), 255, byte(v_max)])
    }
}
