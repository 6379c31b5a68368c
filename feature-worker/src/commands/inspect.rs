//! `feature-worker inspect`: writes what is measured in images or a video, as pictures and a CSV file.
//!
//! An ordinary command-line program that allocates. An input that cannot be read, or has another size than configured, ends it with one
//! line that says what to do. Table and pictures in a directory are always of one run: those of an earlier one go with the first frame, and
//! an error takes the pictures that were written before it.

use std::path::{Path, PathBuf};

use indicatif::ProgressBar;
use shared::config::{CameraConfig, Config};
use shared::exit::{self, Failure, OrExit as _, failure};
use shared::messages::{Doubt, FrameHeader, PixelFormat};
use shared::plural::counted;
use shared::{regular_file, whole_file};

use crate::drawing::{draw, save, to_bgr};
use crate::source::{Frame, for_each_frame};
use crate::vision::{Extractor, Image, Measurement, PictureTime};

/// How its table begins: only one that begins so is replaced.
const TABLE_BEGINS: &[u8] = b"frame,";

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  feature-worker inspect pour.mp4 --config config/cell.toml --out out/inspect\n  feature-worker inspect a.png b.png \
--json\n  feature-worker inspect 'frames/frame_%04d.png' --every 10\n\nWrites features.csv (frame, t_s, area_px2, confidence, doubt, triangle; times \
are the file's own, and pictures without times are camera.fps apart) and a picture of every N-th frame with region, axes, outline, edge points, line and triangle drawn on it."
)]
pub struct Args {
    /// Images, videos, file name patterns of image sequences, or episodes (.mcap).
    #[arg(required = true)]
    input: Vec<PathBuf>,
    /// The cell's configuration. Its [image] table is what is tried.
    #[arg(long, env = shared::config::VARIABLE, default_value = shared::config::DEFAULT_FILE)]
    config: PathBuf,
    /// Directory for the pictures and the CSV.
    #[arg(long, default_value = "out/inspect")]
    out: PathBuf,
    /// Write the picture of every N-th frame. With 0 none is written.
    #[arg(long, default_value_t = 1)]
    every: u64,
    /// Take what is there of an input of which something is missing: a truncated video, a gap in a sequence, pictures that cannot be read.
    #[arg(long)]
    partial: bool,
    /// Print a summary as JSON.
    #[arg(long)]
    json: bool,
}

/// What was measured in all frames together.
#[derive(Default)]
struct Totals {
    /// Frames that were measured.
    frames: u64,
    /// Frames with a stream.
    flowing: u64,
    /// Frames with a doubt.
    doubtful: u64,
    /// Sum of V_e, px^2.
    sum_px2: f64,
}

impl Totals {
    fn add(&mut self, measured: &Measurement) {
        self.frames += 1;
        self.flowing += u64::from(measured.area_px2 > 0.0);
        self.doubtful += u64::from(measured.doubt != Doubt::None);
        self.sum_px2 += f64::from(measured.area_px2);
    }
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let config = Config::read(&args.config).or_exit(exit::BAD_INPUT)?;
    inspect(args, &config)
}

fn words(e: impl std::fmt::Display) -> String {
    e.to_string()
}

/// The picture of the frame with this number in the directory `out`.
fn picture_of(out: &Path, number: u64) -> PathBuf {
    out.join(format!("frame_{number:06}.png"))
}

/// Removes table and pictures of an earlier run from `out`. Its pictures are those of the frames in its table; all others are somebody else's.
fn remove_earlier(out: &Path) -> std::io::Result<()> {
    let table = out.join("features.csv");
    let file = match regular_file::open(&table) {
        Ok((file, _)) => file,
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(()),
        Err(e) => return Err(e),
    };
    for row in csv::Reader::from_reader(file).records().map_while(Result::ok) {
        let Some(number) = row.get(0).and_then(|number| number.parse().ok()) else { continue };
        match std::fs::remove_file(picture_of(out, number)) {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => return Err(e),
            _ => {}
        }
    }
    std::fs::remove_file(table)
}

/// Whether `input` names pictures that this run may write over in the directory `out`.
fn is_in_the_way(input: &Path, out: &Path) -> bool {
    let named = input.file_name().is_some_and(|name| {
        let name = name.to_string_lossy().to_lowercase();
        name.starts_with("frame_") && name.ends_with(".png")
    });
    let directory = input.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
    named && directory.canonicalize().ok().is_some_and(|directory| out.canonicalize().ok() == Some(directory))
}

fn inspect(args: &Args, config: &Config) -> Result<(), Failure> {
    let mut extractor = Extractor::new(&config.camera, &config.image).or_exit(exit::BAD_INPUT)?;
    let unwritten = |path: &Path, e: &dyn std::fmt::Display| format!("{}: {e}; make room, or give another --out", path.display());
    std::fs::create_dir_all(&args.out).map_err(|e| unwritten(&args.out, &e)).or_exit(exit::FAILED)?;
    let table = args.out.join("features.csv");
    if let Some(input) = args.input.iter().find(|input| is_in_the_way(input, &args.out)) {
        let what =
            format!("{}: its pictures have the names of those that are written into this directory; give another --out", input.display());
        return Err(failure(exit::BAD_INPUT, what));
    }
    // What may not be replaced is known before the work. The table is kept until it is whole: some hundred bytes a frame.
    whole_file::check(&table, TABLE_BEGINS).map_err(|e| unwritten(&table, &e)).or_exit(exit::BAD_INPUT)?;
    let mut csv = csv::Writer::from_writer(Vec::new());
    csv.write_record(["frame", "t_s", "area_px2", "confidence", "doubt", "x0", "y0", "x1", "y1", "x2", "y2"]).or_exit(exit::FAILED)?;
    let mut code = exit::BAD_INPUT;
    let bar = ProgressBar::new_spinner().with_message("frames");
    let mut totals = Totals::default();
    let mut written = Vec::new();
    let contents = for_each_frame(&args.input, config.camera.fps, args.partial, |frame| {
        let measured = measure(&mut extractor, &config.camera, &frame)?;
        if totals.frames == 0 {
            remove_earlier(&args.out).map_err(|e| {
                code = exit::FAILED;
                unwritten(&table, &e)
            })?;
        }
        totals.add(&measured);
        csv.write_record(row(&frame.header, &measured)).map_err(words)?;
        if args.every > 0 && (frame.header.sequence - 1) % args.every == 0 {
            let mut picture = to_bgr(&frame).map_err(words)?;
            draw(&mut picture, &extractor, &measured).map_err(words)?;
            let path = picture_of(&args.out, frame.header.sequence);
            save(&picture, &path).map_err(|e| {
                code = exit::FAILED;
                unwritten(&path, &e)
            })?;
            written.push(path);
        }
        bar.inc(1);
        Ok(())
    });
    // Nobody needs pictures without their table, and it does no harm if one cannot be removed.
    let undo = |failed: Failure| {
        written.iter().for_each(|path| drop(std::fs::remove_file(path)));
        failed
    };
    let contents = contents.map_err(|what| undo(failure(code, what)))?;
    let rows = csv.into_inner().map_err(|e| e.to_string()).or_exit(exit::FAILED)?;
    whole_file::replace(&table, &rows, TABLE_BEGINS).map_err(|e| undo(failure(exit::FAILED, unwritten(&table, &e))))?;
    bar.finish_and_clear();
    let Totals { frames, flowing, doubtful, sum_px2 } = totals;
    contents.missing.iter().for_each(|line| eprintln!("inspect: {line}"));
    if args.json {
        let report = serde_json::json!({ "frames": frames, "flowing": flowing, "doubtful": doubtful, "sum_area_px2": sum_px2,
            "missing": contents.missing, "csv": table });
        println!("{report}");
    } else {
        println!(
            "{}, {flowing} with flow, {doubtful} doubtful, sum of V_e {sum_px2:.0} px^2; see {}",
            counted(frames, "frame"),
            table.display()
        );
    }
    Ok(())
}

/// Measures one frame. A frame of another size than configured is an error.
fn measure(extractor: &mut Extractor, camera: &CameraConfig, frame: &Frame) -> Result<Measurement, String> {
    let header = frame.header;
    let format = PixelFormat::from_code(header.format).unwrap_or(PixelFormat::Bgr8);
    let image = Image { width_px: header.width_px, height_px: header.height_px, format, pixels: frame.pixels };
    let time = PictureTime { sequence: header.sequence, captured_at_ns: header.captured_at_ns };
    let measured = extractor.measure_at(image, time).map_err(words)?;
    if measured.doubt == Doubt::WrongFormat {
        return Err(format!(
            "frame {} is {} x {} px, but [camera] says {} x {}; set width_px and height_px to the input's size and calibrate",
            header.sequence, header.width_px, header.height_px, camera.width_px, camera.height_px
        ));
    }
    Ok(measured)
}

/// One row of the CSV.
fn row(header: &FrameHeader, measured: &Measurement) -> Vec<String> {
    let t_s = header.captured_at_ns as f64 / 1e9;
    let mut row = vec![header.sequence.to_string(), format!("{t_s:.4}"), format!("{:.2}", measured.area_px2)];
    row.extend([format!("{:.3}", measured.confidence), measured.doubt.words().to_string()]);
    row.extend(measured.triangle_px.iter().map(|v| format!("{v:.2}")));
    row
}
