//! `feature-worker calibrate`: finds the container's axes and the liquid's colour, and writes the `[image]` section.
//!
//! It shows the pictures of one pour to [`crate::vision::find_corner`] and [`ColourLearner`]. A person then checks the picture that is
//! written, or corrects the corner and the axes: with coordinates on the command line, or with three clicks in a local page. An ordinary
//! command-line program that allocates. It changes nothing but the `[image]` table of the configuration, and that only with --write or a
//! click.

use std::net::{IpAddr, TcpListener};
use std::path::PathBuf;
use std::sync::atomic::Ordering::Relaxed;
use std::time::{Duration, Instant};

use opencv::core::Mat;
use opencv::prelude::*;
use shared::config::{CameraConfig, Config, ImageConfig, LiquidMethod};
use shared::exit::{self, Failure, OrExit as _, failure};
use shared::ipc::Cell;
use shared::messages::PixelFormat;
use shared::os;
use shared::plural::counted;
use web::{Answer, Server, Settings};

use crate::commands::configuration;
use crate::drawing::{draw, jpeg, may_save, save};
use crate::source::{FrameSource, NextFrame, ObserverSource, WAIT};
use crate::vision::{
    Axes, AxesError, ColourError, ColourLearner, Corner, ExtractError, Extractor, Image, RoomBeside, find_corner, room_beside,
};
use crate::worker::lacks_room;

mod checks;
mod pour;
mod section;

use pour::{FILM_MOST, Pour};

/// The most pictures of one pose from which the colour is learned. Chosen by hand: as many as a turning background leaves in one pose.
const PICTURES_OF_A_POSE: usize = 4;
/// Farthest place of a point that is clicked or given, px: twice the largest picture's size.
const FAR_PX: f32 = 8192.0;
/// The region's left border, top, right border and bottom from the lip, px of a picture 640 px wide. Chosen by hand; no
/// measurement is recorded.
const REGION_PX: [f32; 4] = [-40.0, -236.0, 380.0, 50.0];

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  feature-worker calibrate --config config/cell.toml --seconds 20 --page   (live camera: pour once while it runs)\n  \
feature-worker calibrate pour.mp4 --write\n  feature-worker calibrate pour.mp4 --lip 215,250 --x-axis 600,250 --y-axis 215,470 --write\n\n\
Show one whole pour: dry, tilting, flowing, back. The section is printed; --write puts it into the configuration. Look at the picture that \
it names before you trust it: red must lie on the glass's top edge, green on its left side, white on the liquid's outline."
)]
pub struct Args {
    /// Images, a video, a file name pattern, or an episode (.mcap) of one pour. Without any, the configured camera is watched; if a worker is running, it is
    /// the worker's frames that are watched.
    input: Vec<PathBuf>,
    /// The cell's configuration.
    #[arg(long, env = shared::config::VARIABLE, default_value = shared::config::DEFAULT_FILE)]
    config: PathBuf,
    /// How long to watch a live camera.
    #[arg(long, default_value_t = 15, value_parser = clap::value_parser!(u64).range(1..))]
    seconds: u64,
    /// The corner where the top edge and the left side meet, px: X,Y.
    #[arg(long, value_parser = parse_point)]
    lip: Option<[f32; 2]>,
    /// A point of the top edge, further into the mouth, px: X,Y.
    #[arg(long, value_parser = parse_point)]
    x_axis: Option<[f32; 2]>,
    /// A point of the left side, nearer to the foot, px: X,Y.
    #[arg(long, value_parser = parse_point)]
    y_axis: Option<[f32; 2]>,
    /// How the liquid is told from the background. Without this, the configuration says how.
    #[arg(long, value_parser = ["colour", "clear"])]
    method: Option<String>,
    /// Take what is there of an input of which something is missing: a truncated video, a gap in a sequence, pictures that cannot be read.
    #[arg(long)]
    partial: bool,
    /// Write the section into the configuration.
    #[arg(long)]
    write: bool,
    /// Where to write the picture that a person checks.
    #[arg(long, default_value = "out/calibration.png")]
    picture: PathBuf,
    /// Correct the axes by clicks in a web page on this machine.
    #[arg(long)]
    page: bool,
    /// The page's port on 127.0.0.1. With 0 any free port is taken.
    #[arg(long, default_value_t = 8646)]
    port: u16,
    /// End when standard input ends, because the program that started this one has gone.
    #[arg(long, hide = true)]
    end_with_input: bool,
}

fn parse_point(text: &str) -> Result<[f32; 2], String> {
    let parts: Vec<f32> = text.split(',').map_while(|p| p.trim().parse().ok()).collect();
    let point = <[f32; 2]>::try_from(parts).ok().filter(|point| point.iter().all(|px| px.abs() <= FAR_PX));
    point.ok_or_else(|| "give two numbers, X,Y in px".into())
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    if args.end_with_input {
        std::thread::spawn(|| {
            // However its input ends, nobody is left who asks.
            let _ = std::io::copy(&mut std::io::stdin(), &mut std::io::sink());
            std::process::exit(exit::FAILED.into())
        });
    }
    let config = Config::read(&args.config).or_exit(exit::BAD_INPUT)?;
    // What cannot be written is said before anybody pours. The page shows the picture too.
    if args.write {
        configuration::may_change(&args.config)?;
    }
    if !args.page {
        may_save(&args.picture).map_err(|e| unsaved(args, &e)).or_exit(exit::BAD_INPUT)?;
    }
    calibrate(args, config)
}

/// A table that passed all checks.
struct Proposal {
    image: ImageConfig,
    /// What was seen, a line each.
    remarks: Vec<String>,
}

fn calibrate(args: &Args, mut config: Config) -> Result<(), Failure> {
    let bad = |e: String| failure(exit::BAD_INPUT, e);
    // A port that is taken is said before anybody pours.
    let port = if args.page { Some(Server::bind(IpAddr::from([127, 0, 0, 1]), args.port)?) } else { None };
    let pour = if args.input.is_empty() {
        watch(args, &config)?
    } else {
        let (pour, missing) = Pour::read(&args.input, config.camera.fps, args.partial).map_err(bad)?;
        missing.iter().for_each(|line| eprintln!("calibrate: {line}"));
        pour
    };
    let Some(first) = pour.pictures.first() else { return Err(bad("there is no frame in the input; show one whole pour".into())) };
    (config.camera.width_px, config.camera.height_px) = (first.cols() as u32, first.rows() as u32);
    config.image.method = match args.method.as_deref() {
        Some("clear") => LiquidMethod::Clear,
        Some(_) => LiquidMethod::Colour,
        None => config.image.method,
    };
    checks::moves(&pour).map_err(|e| failure(exit::FAILED, e))?;
    let corner = choose_corner(args, &pour, [first.cols() as f32, first.rows() as f32])?;
    let given = args.x_axis.is_some() && args.y_axis.is_some();
    let proposal = match propose(&config, (corner, given), &pour) {
        Ok(proposal) => Some(proposal),
        // In the page the corner can still be corrected.
        Err(e) if args.page => {
            eprintln!("calibrate: {e}");
            None
        }
        Err(e) => return Err(failure(exit::FAILED, e)),
    };
    if let Some(Proposal { image, remarks }) = &proposal {
        config.image = image.clone();
        println!("{}", section::text(&config.image));
        remarks.iter().for_each(|line| eprintln!("calibrate: {line}"));
        match save_picture(args, &config, &pour.pictures) {
            // The page shows the picture too, and another pour would be needed for it.
            Err(e) if args.page => eprintln!("calibrate: {}", e.what),
            saved => {
                saved?;
                eprintln!("calibrate: look at {}", args.picture.display());
            }
        }
        if args.write {
            section::write(&args.config, &config)?;
        }
    }
    port.map_or(Ok(()), |port| serve(args, port, (config, corner), &pour, proposal.is_some()))
}

/// Watches the configured camera for a while.
fn watch(args: &Args, config: &Config) -> Result<Pour, Failure> {
    let reach = |e: String| failure(exit::UNREACHABLE, e);
    let cell = Cell::join(&config.cell)?;
    let mut source = ObserverSource::open(&config.camera, &cell).map_err(|e| failure(e.exit_code(), e))?;
    eprintln!("calibrate: watching the camera for {} s; pour once now", args.seconds);
    let (pour, cut) = watch_for(&mut source, Duration::from_secs(args.seconds), Pour::live(FILM_MOST))?;
    cut.iter().for_each(|line| eprintln!("calibrate: {line}"));
    if pour.count == 0 { Err(reach("no frame came from the camera; is its driver running?".into())) } else { Ok(pour) }
}

/// Adds to `pour` what `source` shows `within` this time. Gives also what to say if that was cut short, because no more of it can be kept.
fn watch_for(source: &mut impl FrameSource, within: Duration, mut pour: Pour) -> Result<(Pour, Option<String>), Failure> {
    let begin = Instant::now();
    while begin.elapsed() < within {
        if pour.is_full() {
            let (seen_s, of_s) = (begin.elapsed().as_secs_f64(), within.as_secs());
            let line = format!(
                "only the first {seen_s:.0} s of {of_s} s were watched ({}), because the memory for pictures is full: what came later is not in it; if \
                 that was a part of the pour, start again and pour at once, or with a smaller picture",
                counted(pour.count, "frame")
            );
            return Ok((pour, Some(line)));
        }
        match source.next_frame(WAIT).or_exit(exit::UNREACHABLE)? {
            NextFrame::Frame(frame) => pour.add(&frame).map_err(|e| failure(exit::UNREACHABLE, e))?,
            NextFrame::Nothing => {}
            NextFrame::End => break,
        }
    }
    Ok((pour, None))
}

/// The corner. What the command line leaves open is found in the pictures, which are `width` by `height` px.
fn choose_corner(args: &Args, pour: &Pour, [width, height]: [f32; 2]) -> Result<Corner, Failure> {
    if let (Some(lip), Some(rim), Some(foot)) = (args.lip, args.x_axis, args.y_axis) {
        return Ok(Corner { lip, rim, foot });
    }
    let found = pour.poses().map_err(AxesError::from).and_then(|(_, _, mean)| find_corner(&mean));
    match found {
        Ok(found) => Ok(Corner {
            lip: args.lip.unwrap_or(found.lip),
            rim: args.x_axis.unwrap_or(found.rim),
            foot: args.y_axis.unwrap_or(found.foot),
        }),
        Err(e) if args.page => {
            eprintln!("calibrate: {e}; click the corner in the page");
            let lip = [0.35 * width, 0.5 * height];
            Ok(Corner { lip, rim: [0.9 * width, 0.5 * height], foot: [0.35 * width, 0.9 * height] })
        }
        Err(e) => Err(failure(exit::FAILED, e)),
    }
}

/// The `[image]` table for a corner and whether its axes were given, after all checks: the region over the mouth, the axes, and the colour learned from the
/// pictures.
fn propose(config: &Config, (corner, given): (Corner, bool), pour: &Pour) -> Result<Proposal, String> {
    let mut remarks = Vec::new();
    let camera = &config.camera;
    let (poses, chosen, mean) = pour.poses().map_err(|e| e.message)?;
    remarks.extend(checks::axes_stay(&corner, given, &chosen, &mean)?);
    let mut image = table(camera, corner, &config.image);
    if let RoomBeside::Wanted(region_px) = room_beside(camera, &image) {
        // The camera is turned about its own axis, so that what is beside the lip lies lower or higher.
        image.region_px = region_px;
    }
    if image.method == LiquidMethod::Colour {
        // The worker would refuse such pictures.
        if pour.is_grey {
            return Err(ExtractError::NoColour.to_string());
        }
        let mut learner = ColourLearner::new(Axes::new(&image));
        let words = |e: ColourError| e.to_string();
        // The background of a pose in which the container rests must not be taken for something that stays at the lip.
        poses.balanced(PICTURES_OF_A_POSE).into_iter().try_for_each(|i| learner.add(&pour.pictures[i])).map_err(words)?;
        image.colour_hsv = learner.range().map_err(words)?;
        remarks.push(checks::background_differs(learner.near_background(image.colour_hsv))?);
    }
    remarks.extend(checks::something_flows(pour, camera, &image)?);
    remarks.extend(lacks_room(camera, &image));
    Ok(Proposal { image, remarks })
}

/// The `[image]` table for a corner, without the colour.
fn table(camera: &CameraConfig, corner: Corner, before: &ImageConfig) -> ImageConfig {
    let scale = camera.width_px as f32 / 640.0;
    let [x, y] = corner.lip;
    let clamp = |v: f32, most: u32| v.clamp(0.0, most as f32) as u32;
    let [left, top, right, bottom] = REGION_PX.map(|v| v * scale);
    let (left, top) = (clamp(x + left, camera.width_px), clamp(y + top, camera.height_px));
    let (right, bottom) = (clamp(x + right, camera.width_px), clamp(y + bottom, camera.height_px));
    ImageConfig {
        region_px: [left, top, right.saturating_sub(left), bottom.saturating_sub(top)],
        x_axis_px: [x, y, corner.rim[0], corner.rim[1]],
        y_axis_px: [corner.foot[0], corner.foot[1], x, y],
        ..before.clone()
    }
}

/// The picture with most flow, with what is measured drawn on it.
fn best_picture(config: &Config, pictures: &[Mat]) -> Result<Mat, String> {
    let mut extractor = Extractor::new(&config.camera, &config.image).map_err(|e| e.to_string())?;
    let mut best: Option<(f32, Mat)> = None;
    for picture in pictures {
        let pixels = picture.data_bytes().map_err(|e| e.message)?;
        let (width_px, height_px) = (picture.cols() as u32, picture.rows() as u32);
        let measured = extractor.measure(Image { width_px, height_px, format: PixelFormat::Bgr8, pixels }).map_err(|e| e.to_string())?;
        if best.as_ref().is_none_or(|(area, _)| measured.area_px2 > *area) {
            let mut drawn = picture.clone();
            draw(&mut drawn, &extractor, &measured).map_err(|e| e.message)?;
            best = Some((measured.area_px2, drawn));
        }
    }
    best.map(|(_, drawn)| drawn).ok_or_else(|| "there is no picture to draw on".into())
}

fn save_picture(args: &Args, config: &Config, pictures: &[Mat]) -> Result<(), Failure> {
    let picture = best_picture(config, pictures).map_err(|e| format!("{}: {e}", args.picture.display())).or_exit(exit::FAILED)?;
    let made = args.picture.parent().map_or(Ok(()), |parent| std::fs::create_dir_all(parent).map_err(|e| e.to_string()));
    made.and_then(|()| save(&picture, &args.picture)).map_err(|e| unsaved(args, &e)).or_exit(exit::FAILED)
}

fn unsaved(args: &Args, e: &str) -> String {
    format!("{}: {e}; give another --picture", args.picture.display())
}

/// Serves the page on `port` until "Write" or Ctrl-C. `good` tells whether the configuration passed all checks; nothing else is written.
fn serve(args: &Args, port: TcpListener, start: (Config, Corner), pour: &Pour, mut good: bool) -> Result<(), Failure> {
    let (mut config, mut corner) = start;
    let stop = os::stop_at_signals().or_exit(exit::FAILED)?;
    let server = Server::on(port, Settings::default())?;
    let pictures = &pour.pictures;
    // Drawing measures every picture of the pour, so it is done once for each corner, however often it is asked for.
    let mut drawn: Option<Vec<u8>> = None;
    eprintln!("calibrate: open http://{} on this machine, click lip, top edge and left side, then Write", server.address());
    server.serve(&stop, |request| match (request.post, request.path.as_str()) {
        (false, "/") => Answer::html(include_str!("calibrate.html")),
        (false, "/calibrate.js") => Answer::bytes("text/javascript", include_str!("calibrate.js")),
        (false, "/calibrate.css") => Answer::bytes("text/css", include_str!("calibrate.css")),
        (false, "/picture.jpg") => {
            let draw = || {
                let picture = best_picture(&config, pictures).or_else(|_| pictures.first().cloned().ok_or_else(String::new));
                jpeg(&picture.unwrap_or_default())
            };
            Answer::jpeg(drawn.get_or_insert_with(draw).clone())
        }
        (false, "/state.json") => Answer::json(&serde_json::json!({ "width": config.camera.width_px, "height": config.camera.height_px,
            "lip": corner.lip, "rim": corner.rim, "foot": corner.foot, "section": section::text(&config.image) })),
        (true, "/corner") => Answer::text(match try_corner(&config, &request.body, pour) {
            Ok((tried, clicked, remarks)) => {
                (config, corner, good, drawn) = (tried, clicked, true, None);
                format!("measured again: {}", remarks.join("; "))
            }
            Err(e) => e,
        }),
        (true, "/write") if !good => {
            Answer::text("nothing is written: no corner has passed the checks yet; click lip, top edge and left side")
        }
        (true, "/write") if !section::is_shown(&config.image, &request.body) => {
            Answer::text("nothing is written: what was found has changed since it was shown; look at it, and write again")
        }
        (true, "/write") => {
            let result = save_picture(args, &config, pictures).and_then(|()| section::write(&args.config, &config));
            stop.store(result.is_ok(), Relaxed);
            Answer::text(result.err().map_or_else(|| format!("written to {}", args.config.display()), |failed| failed.what))
        }
        _ => Answer::not_here(),
    });
    Ok(())
}

/// The configuration for a corner that was clicked, if it passes all checks, and what was seen.
fn try_corner(config: &Config, clicked: &[u8], pour: &Pour) -> Result<(Config, Corner, Vec<String>), String> {
    let corner = serde_json::from_slice::<Corner>(clicked).map_err(|e| e.to_string())?;
    let Proposal { image, remarks } = propose(config, (corner, true), pour)?;
    Ok((Config { image, ..config.clone() }, corner, remarks))
}

#[cfg(test)]
mod tests {
    use shared::messages::FrameHeader;

    use super::*;
    use crate::source::{Frame, SourceError};

    /// A camera that shows noise, which no JPEG makes small.
    struct Noise(Vec<u8>, u32);

    impl FrameSource for Noise {
        fn next_frame(&mut self, _: Duration) -> Result<NextFrame<'_>, SourceError> {
            for byte in &mut self.0 {
                self.1 = self.1.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                *byte = (self.1 >> 24) as u8;
            }
            let header = FrameHeader { width_px: 64, height_px: 48, format: PixelFormat::Bgr8 as u32, ..Default::default() };
            Ok(NextFrame::Frame(Frame { header, pixels: &self.0 }))
        }
    }

    /// Protects who pours before a camera for a minute from a calibration of the first seconds that says nothing of it: a watch that ends because no
    /// more can be kept says how long it was, of how long.
    #[test]
    fn a_watch_that_is_cut_short_says_so() {
        let mut camera = Noise(vec![0; 64 * 48 * 3], 1);
        let (pour, cut) = watch_for(&mut camera, Duration::from_secs(3600), Pour::live(100_000)).unwrap();
        let line = cut.unwrap();
        assert!(pour.count > 3 && line.contains(&format!("0 s of 3600 s were watched ({} frames)", pour.count)), "{line}");
        let (_, cut) = watch_for(&mut camera, Duration::ZERO, Pour::live(100_000)).unwrap();
        assert_eq!(cut, None);
    }
}
