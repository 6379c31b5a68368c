//! `feature-worker inspect`: writes what is measured in images or a video, as pictures and a CSV file.
//!
//! An ordinary command-line program that allocates. An input that cannot be read, or has another size than configured, ends it with one
//! line that says what to do. Table and pictures in a directory are always of one run: those of an earlier one go with the first frame, and
//! an error takes the pictures that were written before it. A list beside the pictures names them, each before it is written, so that those of a
//! run that was killed go as well. No picture is deleted or written over that the list does not name.

use std::fs::File;
use std::io::{ErrorKind, Write as _};
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
/// How the list of its pictures begins: only one that begins so is read and replaced.
const LIST_BEGINS: &[u8] = b"inspect: pictures\n";
/// Most bytes of such a list: 17 each for ten million pictures, which is days of video.
const LIST_BYTES_MAX: u64 = 170_000_000;

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  feature-worker inspect pour.mp4 --config config/cell.toml --out out/inspect\n  feature-worker inspect a.png b.png \
--json\n  feature-worker inspect 'frames/frame_%04d.png' --every 10\n\nWrites features.csv (frame, t_s, area_px2, confidence, doubt, triangle; times \
are the file's own, and pictures without times are camera.fps apart) and a picture of every N-th frame with region, axes, outline, edge points, line and triangle drawn on it. pictures.txt names these \
pictures: the next run deletes them, and no others."
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

/// The list of the pictures in the directory `out`.
fn list_of(out: &Path) -> PathBuf {
    out.join("pictures.txt")
}

/// The number of the picture that has this name.
fn number_of(name: &str) -> Option<u64> {
    let number = name.strip_prefix("frame_")?.strip_suffix(".png")?.parse().ok()?;
    (picture_of(Path::new(""), number) == Path::new(name)).then_some(number)
}

/// Removes table, pictures and list of an earlier run from `out`. Its pictures are those that its list names; all others are somebody else's.
fn remove_earlier(out: &Path) -> std::io::Result<()> {
    let gone = |path: &Path| match std::fs::remove_file(path) {
        Err(e) if e.kind() != ErrorKind::NotFound => Err(e),
        _ => Ok(()),
    };
    let list = list_of(out);
    let names = match regular_file::read_text(&list, LIST_BYTES_MAX) {
        Err(e) if e.kind() == ErrorKind::NotFound => String::new(),
        names => names?,
    };
    names.lines().filter_map(number_of).try_for_each(|number| gone(&picture_of(out, number)))?;
    gone(&out.join("features.csv"))?;
    gone(&list)
}

/// The pictures of this run: each is on the list before it is there.
struct Pictures {
    out: PathBuf,
    list: Option<File>,
}

impl Pictures {
    /// Names the picture of the frame with this number, and gives its path.
    fn name(&mut self, number: u64) -> std::io::Result<PathBuf> {
        let path = picture_of(&self.out, number);
        if path.symlink_metadata().is_ok() {
            return Err(std::io::Error::new(ErrorKind::AlreadyExists, "is there already, and is not of an earlier run"));
        }
        let list = match &mut self.list {
            Some(list) => list,
            none => {
                whole_file::replace_soon(&list_of(&self.out), LIST_BEGINS, LIST_BEGINS)?;
                none.insert(File::options().append(true).open(list_of(&self.out))?)
            }
        };
        writeln!(list, "frame_{number:06}.png")?;
        Ok(path)
    }
}

/// Whether `input` names pictures that a run with a picture of every `every`-th frame may write over in the directory `out`.
fn is_in_the_way(input: &Path, out: &Path, every: u64) -> bool {
    let named = input.file_name().and_then(|name| name.to_str()).is_some_and(|name| number_of(&name.replace("%06d", "000001")).is_some());
    let directory = input.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
    // Without pictures of its own, a run still deletes those on the list.
    let is_written = every > 0 || list_of(out).exists();
    is_written && named && directory.canonicalize().ok().is_some_and(|directory| out.canonicalize().ok() == Some(directory))
}

fn inspect(args: &Args, config: &Config) -> Result<(), Failure> {
    let mut extractor = Extractor::new(&config.camera, &config.image).or_exit(exit::BAD_INPUT)?;
    let unwritten = |path: &Path, e: &dyn std::fmt::Display| format!("{}: {e}; make room, or give another --out", path.display());
    std::fs::create_dir_all(&args.out).map_err(|e| unwritten(&args.out, &e)).or_exit(exit::FAILED)?;
    let table = args.out.join("features.csv");
    if let Some(input) = args.input.iter().find(|input| is_in_the_way(input, &args.out, args.every)) {
        let what =
            format!("{}: its pictures have the names of those that are written into this directory; give another --out", input.display());
        return Err(failure(exit::BAD_INPUT, what));
    }
    // What may not be replaced is known before the work. The table is kept until it is whole: some hundred bytes a frame.
    for (path, begins) in [(&table, TABLE_BEGINS), (&list_of(&args.out), LIST_BEGINS)] {
        whole_file::check(path, begins).map_err(|e| unwritten(path, &e)).or_exit(exit::BAD_INPUT)?;
    }
    let mut csv = csv::Writer::from_writer(Vec::new());
    csv.write_record(["frame", "t_s", "area_px2", "confidence", "doubt", "x0", "y0", "x1", "y1", "x2", "y2"]).or_exit(exit::FAILED)?;
    let mut code = exit::BAD_INPUT;
    let bar = ProgressBar::new_spinner().with_message("frames");
    let mut totals = Totals::default();
    let mut pictures = Pictures { out: args.out.clone(), list: None };
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
            let number = frame.header.sequence;
            let saved = pictures.name(number).map_err(words).and_then(|path| save(&picture, &path));
            saved.map_err(|e| {
                code = exit::FAILED;
                unwritten(&picture_of(&args.out, number), &e)
            })?;
        }
        bar.inc(1);
        Ok(())
    });
    let begun = totals.frames > 0;
    // Nobody needs pictures without their table. It does no harm if one cannot be removed: it stays on the list.
    let undo = |failed: Failure| {
        let _ = if begun { remove_earlier(&args.out) } else { Ok(()) };
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
    let measured = extractor.measure_at(image, time).map_err(|e| format!("frame {}: {e}", header.sequence))?;
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
