//! Clips that are no pour before a camera that is fixed to the container, in `feature-worker calibrate` run as a process: each is refused in
//! one clear line, and nothing is written. The scenes are drawn here; nothing in them knows how calibration works.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

mod drawn;

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use drawn::{HEIGHT, Outcome, WIDTH, board, dry, glass, lay_over, noisy, pour, pour_before, stream, water, write_config};
use feature_worker::vision::{Axes, ColourLearner, Extractor, Image};
use opencv::core::{self, CV_8UC3, Mat, Point2f, Rect, Scalar, Size, Vector};
use opencv::prelude::*;
use opencv::videoio::{CAP_FFMPEG, VideoWriter};
use opencv::{imgcodecs, imgproc};
use rand::RngExt;
use shared::config::{Config, LiquidMethod};
use shared::episode::{EpisodeEnd, EpisodeKind, EpisodeStart, EpisodeWriter, FrameRow};
use shared::messages::{Feature, LAYOUT_VERSION, PixelFormat, Telemetry};

const FRAMES: i32 = 40;

fn clip(path: &Path, picture: impl FnMut(i32) -> Result<Mat, opencv::Error>) -> Outcome {
    clip_of(path, FRAMES, picture)
}

fn clip_of(path: &Path, frames: i32, mut picture: impl FnMut(i32) -> Result<Mat, opencv::Error>) -> Outcome {
    let name = path.to_str().ok_or("path")?;
    let size = picture(0)?.size()?;
    let mut writer = VideoWriter::new_with_backend(name, CAP_FFMPEG, VideoWriter::fourcc('M', 'J', 'P', 'G')?, 30.0, size, true)?;
    for i in 0..frames {
        writer.write(&picture(i)?)?;
    }
    Ok(writer.release()?)
}

/// A directory with a configuration, in which calibration is tried.
struct Bench {
    directory: tempfile::TempDir,
    config: PathBuf,
}

impl Bench {
    fn new() -> Result<Self, Box<dyn std::error::Error>> {
        let directory = tempfile::tempdir()?;
        let (config, _) = write_config(directory.path(), "refuses", |_| {})?;
        Ok(Self { directory, config })
    }

    fn file(&self, name: &str) -> PathBuf {
        self.directory.path().join(name)
    }

    fn calibrate(&self, input: &[&Path], more: &[&str]) -> std::io::Result<Output> {
        let mut command = Command::new(env!("CARGO_BIN_EXE_feature-worker"));
        command.args(["calibrate", "--write", "--config"]).arg(&self.config).arg("--picture").arg(self.file("look.png"));
        command.args(more).args(input).output()
    }

    /// Asserts that a clip is refused in one line with one of `words`, and that nothing is written.
    fn refused(&self, what: &str, input: &[&Path], more: &[&str], words: &[&str]) -> Outcome {
        let before = std::fs::read(&self.config)?;
        let output = self.calibrate(input, more)?;
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(1), "{what}: {said}");
        assert!(said.lines().count() == 1 && said.starts_with("error:"), "{what}: {said}");
        assert!(words.iter().any(|w| said.contains(w)), "{what}: {words:?} in {said}");
        assert!(output.stdout.is_empty() && std::fs::read(&self.config)? == before && !self.file("look.png").exists(), "{what}");
        Ok(())
    }

    fn accepted(&self, what: &str, input: &[&Path], more: &[&str]) -> Result<(Config, String), Box<dyn std::error::Error>> {
        let output = self.calibrate(input, more)?;
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success(), "{what}: {said}");
        std::fs::remove_file(self.file("look.png"))?;
        Ok((Config::read(&self.config)?, said))
    }
}

/// Protects who has a camera without colour: a liquid's colour is not learned from grey pictures, which no other command would measure by it.
#[test]
fn grey_pictures_teach_no_colour() -> Outcome {
    let bench = Bench::new()?;
    for i in 0..FRAMES {
        let mut grey = Mat::default();
        imgproc::cvt_color_def(&pour(i)?, &mut grey, imgproc::COLOR_BGR2GRAY)?;
        let path = bench.file(&format!("grey_{i:02}.pgm"));
        imgcodecs::imwrite(path.to_str().ok_or("path")?, &grey, &Vector::new())?;
    }
    bench.refused("grey pictures", &[&bench.file("grey_%02d.pgm")], &[], &["needs a colour camera"])
}

/// Protects from a calibration on nothing: one picture, the same picture many times, and a dry glass that tilts are refused with either
/// method.
#[test]
fn a_still_picture_and_a_dry_glass_are_refused() -> Outcome {
    let bench = Bench::new()?;
    let still = bench.file("still.png");
    imgcodecs::imwrite(&still, &pour(20)?, &Vector::new())?;
    let blinded = bench.file("blinded.avi");
    clip(&blinded, |i| {
        if (9..33).contains(&i) { pour(i) } else { noisy(&Mat::new_rows_cols_with_default(HEIGHT, WIDTH, CV_8UC3, Scalar::all(255.0))?, i) }
    })?;
    bench.refused("a pour that is blinded before and after", &[&blinded], &["--method", "colour"], &["never dry"])?;
    bench.refused("one picture", &[&still], &[], &["too few"])?;
    bench.refused("a picture again and again", &[still.as_path(); 30], &[], &["the same still picture"])?;
    let noise = bench.file("noise.avi");
    clip(&noise, |i| noisy(&pour(20)?, 50 + i))?;
    let clip_of_dry = bench.file("dry.avi");
    clip(&clip_of_dry, |i| dry(i as f32, i))?;
    for method in ["colour", "clear"] {
        bench.refused(
            "a still scene",
            &[&noise],
            &["--method", method],
            &["never dry", "stands still", "does not move", "nothing flows", "no liquid's colour", "nearly all"],
        )?;
        bench.refused("a dry glass", &[&clip_of_dry], &["--method", method], &["nothing flows", "no liquid's colour", "comes and goes"])?;
    }
    Ok(())
}

/// A camera that a hand holds: shift in px and turn in degrees of frame after frame.
fn shaken(by_px: f64) -> impl FnMut(&Mat) -> Result<Mat, opencv::Error> {
    let mut random = rand_pcg::Pcg32::new(7, 7);
    let (mut at, mut speed) = ([0.0f64; 3], [0.0f64; 3]);
    move |picture| {
        for (at, speed) in at.iter_mut().zip(&mut speed) {
            *speed = 0.85 * *speed - 0.05 * *at + random.random_range(-0.4..0.4);
            *at += *speed;
        }
        // The third number turns: a tenth of a degree for each px.
        let middle = Point2f::new(WIDTH as f32 / 2.0, HEIGHT as f32 / 2.0);
        let mut turn = imgproc::get_rotation_matrix_2d(middle, 0.1 * by_px * at[2], 1.0)?;
        *turn.at_2d_mut::<f64>(0, 2)? += by_px * at[0];
        *turn.at_2d_mut::<f64>(1, 2)? += by_px * at[1];
        let mut out = Mat::default();
        imgproc::warp_affine(
            picture,
            &mut out,
            &turn,
            Size::new(WIDTH, HEIGHT),
            imgproc::INTER_LINEAR,
            core::BORDER_REFLECT_101,
            Scalar::default(),
        )?;
        Ok(out)
    }
}

/// A table with a glass on it before a board, both at rest, into which a hand pours blue from above: what people film. `i` is the frame.
fn poured_by_hand(i: i32, plain: bool) -> Result<Mat, opencv::Error> {
    let mut picture = if plain { Mat::new_rows_cols_with_default(HEIGHT, WIDTH, CV_8UC3, Scalar::all(165.0))? } else { board(12.0)? };
    let (down, flows) = ((i as f32 * 0.25).sin() * 25.0, (10..32).contains(&i));
    let level = if i < 10 { 470.0 } else { 470.0 - 5.0 * (i.min(32) - 10) as f32 };
    let blue = Scalar::new(150.0, 62.0, 20.0, 0.0);
    lay_over(&mut picture, &[vec![[215.0, level], [640.0, level], [640.0, 480.0], [215.0, 480.0]]], blue)?;
    if flows {
        let x = 300.0 + down;
        lay_over(&mut picture, &[vec![[x, 90.0], [x + 14.0, 90.0], [x + 10.0, level], [x + 4.0, level]]], blue)?;
    }
    let hand = [[330.0, 0.0], [480.0, 0.0], [400.0, 110.0], [310.0, 110.0]].map(|[x, y]| [x + down, y + down]);
    lay_over(&mut picture, &[hand.to_vec()], Scalar::new(90.0, 120.0, 170.0, 0.0))?;
    glass(&mut picture)?;
    noisy(&picture, i)
}

/// Protects from axes on the wrong object: clips that a hand films, steadily or not, of a pour by hand into a glass that stands on a table,
/// have corners, edges and a colour, and no lip that a camera is fixed to.
#[test]
fn a_pour_by_hand_is_refused() -> Outcome {
    let bench = Bench::new()?;
    let path = bench.file("hand.avi");
    for plain in [false, true] {
        for by_px in [0.0, 0.4, 1.0, 2.0, 4.0, 10.0] {
            let mut shake = shaken(by_px);
            clip(&path, |i| shake(&poured_by_hand(i, plain)?))?;
            for method in ["colour", "clear"] {
                let what = format!("shaken by {by_px}, {}, {method}", if plain { "before a wall" } else { "before a board" });
                let words = [
                    "stands still",
                    "do not stay",
                    "were not found",
                    "nothing flows",
                    "does not fit",
                    "no liquid's colour",
                    "comes and goes",
                    "nearly all",
                    "dry background",
                ];
                bench.refused(&what, &[&path], &["--method", method], &words)?;
            }
        }
    }
    Ok(())
}

/// Protects from a background that never moves, in which nothing but a small stream changes: edges at rest are no container's.
#[test]
fn a_background_at_rest_is_refused() -> Outcome {
    let bench = Bench::new()?;
    let path = bench.file("rest.avi");
    let still = |i: i32| -> Result<Mat, opencv::Error> {
        let mut picture = board(12.0)?;
        let share = (1.0 - (i - 20).abs() as f32 / 13.0).max(0.0);
        if share > 0.08 {
            let (a, b) = (50.0 * share, 45.0 * share);
            lay_over(&mut picture, &[vec![[215.0, 250.0], [215.0, 250.0 - b], [215.0 + a, 250.0]]], Scalar::new(150.0, 62.0, 20.0, 0.0))?;
        }
        glass(&mut picture)?;
        noisy(&picture, i)
    };
    clip(&path, still)?;
    bench.refused(
        "a background at rest",
        &[&path],
        &["--lip", "215,250", "--x-axis", "600,250", "--y-axis", "215,470"],
        &["does not move"],
    )?;
    // Something large that passes by hides each place for a while, so less of the background is the same in nearly all pictures.
    let passing = |i: i32| -> Result<Mat, opencv::Error> {
        let mut picture = board(12.0)?;
        let share = (1.0 - (i - 40).abs() as f32 / 18.0).max(0.0);
        if share > 0.08 {
            lay_over(&mut picture, &[stream(90.0 * share, 80.0 * share)], Scalar::new(150.0, 62.0, 20.0, 0.0))?;
        }
        let at = -320.0 + 48.0 * (i % 20) as f32;
        for k in 0..8 {
            let (from, to) = (at + 40.0 * k as f32, at + 40.0 * (k + 1) as f32);
            let grey = Scalar::all(if k % 2 == 0 { 60.0 } else { 170.0 });
            lay_over(&mut picture, &[vec![[0.0, from], [150.0, from + 30.0], [150.0, to + 30.0], [0.0, to]]], grey)?;
            if !(20..60).contains(&i) {
                lay_over(&mut picture, &[vec![[from, 0.0], [to, 0.0], [to + 60.0, 205.0], [from + 60.0, 205.0]]], grey)?;
            }
        }
        glass(&mut picture)?;
        noisy(&picture, i)
    };
    clip_of(&path, 80, passing)?;
    bench.refused(
        "a background at rest that something passes",
        &[&path],
        &["--lip", "215,250", "--x-axis", "600,250", "--y-axis", "215,470"],
        &["stands still"],
    )?;
    Ok(())
}

/// Protects from axes that wander: the pour that is accepted from a camera on the container is refused as soon as a hand holds that camera, also
/// when the corner is given on the command line.
#[test]
fn a_shaken_camera_is_refused() -> Outcome {
    let bench = Bench::new()?;
    let path = bench.file("shaken.avi");
    let given = ["--lip", "215,250", "--x-axis", "600,250", "--y-axis", "215,470"];
    clip(&path, pour)?;
    bench.accepted("a camera at rest", &[&path], &[])?;
    bench.accepted("a camera at rest, corner given", &[&path], &given)?;
    for by_px in [3.0, 8.0, 20.0] {
        let mut shake = shaken(by_px);
        clip(&path, |i| shake(&pour(i)?))?;
        bench.refused(&format!("shaken by {by_px}"), &[&path], &[], &["do not stay", "were not found"])?;
        bench.refused(&format!("shaken by {by_px}, corner given"), &[&path], &given, &["do not stay"])?;
    }
    Ok(())
}

/// Protects from colours that the background has too: milk before white squares and before a white wall is refused, and the share is said. Milk
/// before a dark wall is learned.
#[test]
fn milk_before_white_is_refused() -> Outcome {
    let bench = Bench::new()?;
    let path = bench.file("milk.avi");
    let milk = Scalar::new(190.0, 194.0, 196.0, 0.0);
    let wall = |level: f64| Mat::new_rows_cols_with_default(HEIGHT, WIDTH, CV_8UC3, Scalar::all(level));
    clip(&path, |i| pour_before(i, board(i as f32)?, milk))?;
    bench.refused(
        "milk before white squares",
        &[&path],
        &[],
        &["of the dry background lies inside", "no liquid's colour", "nearly all pictures"],
    )?;
    clip(&path, |i| pour_before(i, wall(188.0)?, milk))?;
    bench.refused(
        "milk before a white wall",
        &[&path],
        &[],
        &["of the dry background lies inside", "no liquid's colour", "nearly all pictures"],
    )?;
    clip(&path, |i| pour_before(i, wall(90.0)?, milk))?;
    let (config, said) = bench.accepted("milk before a dark wall", &[&path], &[])?;
    assert!(said.contains("0 % of the dry background"), "{said}");
    // The background limits a grey liquid's range as it does a coloured one's: half way at most.
    assert!(config.image.colour_hsv[2] > 100, "{:?}", config.image.colour_hsv);
    Ok(())
}

/// `picture` as a camera of 1280 x 720 px shows it: its middle, at twice the size.
fn large(picture: &Mat) -> Result<Mat, opencv::Error> {
    let (mut twice, mut middle) = (Mat::default(), Mat::default());
    imgproc::resize(picture, &mut twice, Size::new(2 * WIDTH, 2 * HEIGHT), 0.0, 0.0, imgproc::INTER_LINEAR)?;
    Mat::roi(&twice, Rect::new(0, 120, 2 * WIDTH, 720))?.copy_to(&mut middle)?;
    Ok(middle)
}

/// Protects from colours of a background that comes late, also in large pictures, which have more pixels than one could keep: a poster in the
/// liquid's colour that the container turns to after the pour is refused. Without it the same pour is learned.
#[test]
fn a_poster_that_comes_late_is_refused() -> Outcome {
    let bench = Bench::new()?;
    let text = std::fs::read_to_string(&bench.config)?;
    std::fs::write(&bench.config, text.replace("width_px = 640", "width_px = 1280").replace("height_px = 480", "height_px = 720"))?;
    let path = bench.file("large.avi");
    let poster = vec![[330.0, 90.0], [430.0, 90.0], [430.0, 190.0], [330.0, 190.0]];
    let picture = |i: i32, shown: bool| -> Result<Mat, opencv::Error> {
        let mut picture = board(i as f32)?;
        if shown && i > 50 {
            lay_over(&mut picture, std::slice::from_ref(&poster), Scalar::new(150.0, 62.0, 20.0, 0.0))?;
        }
        large(&pour_before(i, picture, Scalar::new(150.0, 62.0, 20.0, 0.0))?)
    };
    clip_of(&path, 70, |i| picture(i, true))?;
    bench.refused("a late poster", &[&path], &[], &["of the dry background lies inside", "no liquid's colour"])?;
    clip_of(&path, 70, |i| picture(i, false))?;
    bench.accepted("a large pour", &[&path], &[])?;
    Ok(())
}

/// Protects the area where light is reflected: a highlight on a dark liquid is learned as liquid, when no background looks like it.
#[test]
fn highlights_are_learned() -> Outcome {
    let bench = Bench::new()?;
    let path = bench.file("highlight.avi");
    let cola = Scalar::new(18.0, 30.0, 72.0, 0.0);
    let light = Scalar::new(120.0, 160.0, 215.0, 0.0);
    let shiny = |i: i32| -> Result<Mat, opencv::Error> {
        let mut picture = pour_before(i, board(i as f32)?, cola)?;
        if (12..30).contains(&i) {
            lay_over(&mut picture, &[drawn::disc(224.0, 239.0, 7.0)], light)?;
        }
        Ok(picture)
    };
    clip(&path, shiny)?;
    let (config, _) = bench.accepted("cola with a highlight", &[&path], &[])?;
    assert!(config.image.colour_hsv[5] == 255, "{:?}", config.image.colour_hsv);
    let mut extractor = Extractor::new(&config.camera, &config.image)?;
    let frame = shiny(20)?;
    let measured = extractor.measure(Image { width_px: 640, height_px: 480, format: PixelFormat::Bgr8, pixels: frame.data_bytes()? })?;
    assert!((measured.area_px2 / 3600.0 - 1.0).abs() < 0.08, "{measured:?}");
    Ok(())
}

/// Protects clear water: a pour before an even wall is accepted, and its dry half is refused.
#[test]
fn clear_water_must_flow() -> Outcome {
    let bench = Bench::new()?;
    let path = bench.file("water.avi");
    let share = |i: i32| (1.0 - (i - 20).abs() as f32 / 13.0).max(0.0);
    clip(&path, |i| water(if share(i) > 0.08 { share(i) } else { 0.0 }, None, i))?;
    let (config, said) = bench.accepted("a pour of water", &[&path], &["--method", "clear"])?;
    assert!(config.image.method == LiquidMethod::Clear && said.contains("frames show a stream"), "{said}");
    clip(&path, |i| water(0.0, None, i))?;
    bench.refused("no water", &[&path], &["--method", "clear"], &["nothing flows"])?;
    Ok(())
}

/// Protects a configuration's comments: those behind `[image]` stay, also when it is the last table. A file without such a line is refused.
#[test]
fn comments_behind_the_last_table_stay() -> Outcome {
    let bench = Bench::new()?;
    let path = bench.file("pour.avi");
    clip(&path, pour)?;
    let text = std::fs::read_to_string(&bench.config)?;
    let at = text.find("[image]").ok_or("no [image]")?;
    let end = text[at + 1..].find("\n[").map_or(text.len(), |e| at + 1 + e + 1);
    let moved = format!("{}{}\n{}\n# the lamp stands left\n# camera 2 is spare\n", &text[..at], &text[end..], text[at..end].trim_end());
    std::fs::write(&bench.config, &moved)?;
    bench.accepted("[image] last", &[&path], &[])?;
    let after = std::fs::read_to_string(&bench.config)?;
    assert!(after.ends_with("# the lamp stands left\n# camera 2 is spare\n"), "{after}");
    bench.accepted("again", &[&path], &[])?;
    assert_eq!(std::fs::read_to_string(&bench.config)?, after, "writing twice changes nothing");
    Ok(())
}

/// Protects who has episodes and no video: calibration takes the project's own MCAP.
#[test]
fn an_episode_is_enough() -> Outcome {
    let bench = Bench::new()?;
    let config = Config::read(&bench.config)?;
    let start = EpisodeStart {
        episode: 1,
        kind: EpisodeKind::Pour { goal_ml: 50.0 },
        started_at_ns: 1_000_000_000,
        wall_clock: std::time::UNIX_EPOCH,
        config: &config,
        weights: "",
    };
    let mut writer = EpisodeWriter::create(bench.directory.path(), &start)?;
    for i in 0..FRAMES {
        let at_ns = 1_000_000_000 + i as u64 * 33_333_333;
        writer.telemetry(&Telemetry { version: LAYOUT_VERSION, tick: i as u64 + 1, at_ns, robot_at_ns: at_ns, ..Default::default() })?;
        let mut bytes = Vector::<u8>::new();
        imgcodecs::imencode_def(".jpg", &pour(i)?, &mut bytes)?;
        let image = bytes.to_vec();
        let feature = Feature { version: LAYOUT_VERSION, sequence: i as u64 + 1, captured_at_ns: at_ns + 5_000_000, ..Default::default() };
        writer.frame(&FrameRow { feature: &feature, alpha_commanded_deg: 0.0, alpha_measured_deg: 0.0, image: Some(("jpeg", &image)) })?;
    }
    let path = writer.finish(&EpisodeEnd { complete: true, reason: "over", disordered_frames: 0 })?;
    let (config, _) = bench.accepted("an episode", &[&path], &[])?;
    let axes = Axes::new(&config.image);
    assert!((axes.lip_px[0] - 215.0).abs() < 2.0 && (axes.lip_px[1] - 250.0).abs() < 2.0, "{axes:?}");
    Ok(())
}

/// Protects a pour that somebody makes for the camera: a place where nothing can be written is known before it, here before an input that is not there.
#[test]
fn a_picture_without_a_place_is_refused_before_the_pour() -> Outcome {
    let bench = Bench::new()?;
    let config = bench.config.to_str().ok_or("text")?;
    std::fs::write(bench.file("notes.png"), "mine")?;
    for (picture, words) in [
        (format!("{config}/look.png"), "no file can be made in"),
        (format!("{config}/below/look.png"), "give another --picture"),
        (bench.file("look.xyz").display().to_string(), "is no ending of a picture"),
        (bench.file("notes.png").display().to_string(), "is a file of another kind"),
    ] {
        let mut command = Command::new(env!("CARGO_BIN_EXE_feature-worker"));
        let output = command.args(["calibrate", "none.mp4", "--config", config, "--picture", &picture]).output()?;
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.code() == Some(2) && said.lines().count() == 1 && said.contains(words), "{picture}: {said}");
    }
    Ok(())
}

/// Protects the share that is said: of a background that is learned as liquid it is nearly all, of another one nothing.
#[test]
fn the_share_of_the_background_is_right() -> Outcome {
    let mut learner = ColourLearner::new(Axes::new(&drawn::image_config(LiquidMethod::Colour)));
    for i in 0..FRAMES {
        learner.add(&pour(i)?)?;
    }
    let blue = learner.dry_background(learner.range()?);
    assert!(blue.inside < 0.002 && blue.dry_pictures > 0.3 && blue.dry_pictures < 0.6, "{blue:?}");
    // The board's dark squares are half of it.
    let dark = learner.dry_background([0, 0, 0, 179, 60, 130]);
    assert!((0.3..0.7).contains(&dark.inside), "{dark:?}");
    Ok(())
}
