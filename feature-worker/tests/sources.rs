//! Real videos and image sequences in `feature-worker inspect`, run as a process: good ones and broken ones. Also the numbers, times and
//! rates of a device's frames.

mod drawn;

use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use drawn::{HEIGHT, Outcome, WIDTH, image_config, pour, water, write_config};
use feature_worker::source::{Numbering, check_rate};
use opencv::core::{Mat, Size, Vector};
use opencv::prelude::*;
use opencv::{imgcodecs, imgproc, videoio};
use shared::config::LiquidMethod;

fn inspect(config: &Path, input: &Path, out: &Path, every: &str) -> std::io::Result<Output> {
    let mut command = Command::new(env!("CARGO_BIN_EXE_feature-worker"));
    command.args(["inspect", "--json", "--every", every, "--config"]).arg(config).arg("--out").arg(out).arg(input).output()
}

fn text(output: &Output) -> String {
    format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
}

/// Asserts one clear line that holds all `words`, and the exit code of bad input.
fn refused(output: &Output, words: &[&str]) {
    let said = text(output);
    assert_eq!(output.status.code(), Some(2), "{said}");
    assert!(said.lines().filter(|l| l.starts_with("error:")).count() == 1, "{said}");
    assert!(words.iter().all(|w| said.contains(w)), "{words:?} in {said}");
}

/// Protects people with their own recordings: an MJPEG video of a pour is read to its end and gives a CSV and pictures, with flow where there
/// is flow. A truncated video gives what is left of it or a clear line. A file that is no video at all is refused by name.
#[test]
fn videos_whole_truncated_and_wrong() -> Outcome {
    let directory = tempfile::tempdir()?;
    let (config, _) = write_config(directory.path(), "sources", |_| {})?;
    let path = directory.path().join("pour.avi");
    let mut writer =
        videoio::VideoWriter::new(&path, videoio::VideoWriter::fourcc('M', 'J', 'P', 'G')?, 30.0, Size::new(WIDTH, HEIGHT), true)?;
    for i in 0..36 {
        writer.write(&pour(i)?)?;
    }
    writer.release()?;
    let out = directory.path().join("out");
    let whole = inspect(&config, &path, &out, "12")?;
    assert!(whole.status.success(), "{}", text(&whole));
    let report: serde_json::Value = serde_json::from_slice(&whole.stdout)?;
    assert_eq!(report["frames"], 36);
    let mut rows = csv::Reader::from_path(out.join("features.csv"))?;
    let areas: Vec<f64> = rows.records().map(|r| Ok(r?[2].parse()?)).collect::<Result<_, Box<dyn std::error::Error>>>()?;
    assert_eq!(areas.len(), 36);
    assert!(areas[..7].iter().chain(&areas[33..]).all(|a| *a == 0.0), "{areas:?}");
    assert!((areas[20] / 3600.0 - 1.0).abs() < 0.04, "{}", areas[20]);
    assert!(areas[10] > 0.0 && areas[10] < areas[14] && areas[14] < areas[18], "{areas:?}");
    let picture = imgcodecs::imread(out.join("frame_000013.png"), imgcodecs::IMREAD_COLOR)?;
    assert_eq!((picture.cols(), picture.rows()), (WIDTH, HEIGHT));
    assert_eq!(std::fs::read_dir(&out)?.count(), 5, "three pictures, their list and the table");

    let (bytes, png) = (std::fs::read(&path)?, std::fs::read(out.join("frame_000013.png"))?);
    for share in [2, 3, 50] {
        let cut = directory.path().join(format!("cut{share}.avi"));
        std::fs::write(&cut, &bytes[..bytes.len() / share])?;
        let output = inspect(&config, &cut, &out, "0")?;
        if output.status.success() {
            let report: serde_json::Value = serde_json::from_slice(&output.stdout)?;
            assert!(report["frames"].as_u64().is_some_and(|f| f > 0 && f < 36), "{}", text(&output));
        } else {
            refused(&output, &["truncated", "cut"]);
        }
    }
    let wrong = directory.path().join("wrong.mp4");
    std::fs::write(&wrong, "this is no video")?;
    refused(&inspect(&config, &wrong, &out, "0")?, &["wrong.mp4"]);
    refused(&inspect(&config, &directory.path().join("missing.mp4"), &out, "0")?, &["missing.mp4", "no such file"]);
    let broken = directory.path().join("broken.png");
    std::fs::write(&broken, &png[..30])?;
    refused(&inspect(&config, &broken, &out, "0")?, &["broken.png"]);
    Ok(())
}

/// Protects from results of two recordings side by side: a second run leaves none of the first one's pictures and no table of another, also when it
/// fails on the way or was killed; files of somebody else stay, and are not written over. An input that cannot be opened costs nothing, nor does one that has the results' own names.
#[test]
fn a_directory_holds_one_run() -> Outcome {
    let dir = tempfile::tempdir()?;
    let (config, _) = write_config(dir.path(), "one-run", |_| {})?;
    let (out, input) = (dir.path().join("out"), dir.path().join("f_%03d.png"));
    let save = |i: i32, picture: &Mat| imgcodecs::imwrite(dir.path().join(format!("f_{i:03}.png")), picture, &Vector::new());
    for i in 0..6 {
        save(i, &pour(i)?)?;
    }
    let names = || -> Result<Vec<String>, std::io::Error> {
        let mut names: Vec<String> =
            std::fs::read_dir(&out)?.map(|entry| Ok(entry?.file_name().to_string_lossy().into_owned())).collect::<std::io::Result<_>>()?;
        names.sort();
        Ok(names)
    };
    let first = inspect(&config, &input, &out, "2")?;
    assert!(first.status.success(), "{}", text(&first));
    let whole = ["features.csv", "frame_000001.png", "frame_000003.png", "frame_000005.png", "pictures.txt"];
    assert_eq!(names()?, whole);
    refused(&inspect(&config, &dir.path().join("none.mp4"), &out, "1")?, &["none.mp4"]);
    assert_eq!(names()?, whole);
    for every in ["1", "0"] {
        refused(&inspect(&config, &out.join("frame_%06d.png"), &out, every)?, &["frame_%06d.png", "another --out"]);
    }
    assert_eq!(names()?, whole);
    // Somebody's own, whose frame is in the table.
    std::fs::copy(out.join("frame_000003.png"), out.join("frame_000002.png"))?;
    // A run that is killed has no table.
    std::fs::remove_file(out.join("features.csv"))?;
    let second = inspect(&config, &dir.path().join("f_001.png"), &out, "1")?;
    assert!(second.status.success(), "{}", text(&second));
    assert_eq!(names()?, ["features.csv", "frame_000001.png", "frame_000002.png", "pictures.txt"]);
    let over = inspect(&config, &input, &out, "1")?;
    assert!(over.status.code() == Some(1) && text(&over).contains("frame_000002.png: is there already"), "{}", text(&over));
    assert_eq!(names()?, ["frame_000002.png"]);
    assert!(inspect(&config, &out.join("frame_000002.png"), &out, "0")?.status.success(), "pictures that no run writes are an input");
    assert_eq!(names()?, ["features.csv", "frame_000002.png"]);
    let mut small = Mat::default();
    imgproc::resize(&pour(3)?, &mut small, Size::new(320, 240), 0.0, 0.0, imgproc::INTER_AREA)?;
    save(3, &small)?;
    refused(&inspect(&config, &input, &out, "2")?, &["frame 4", "320 x 240"]);
    assert_eq!(names()?, ["frame_000002.png"]);
    std::fs::write(out.join("pictures.txt"), "frame_000002.png\n")?;
    refused(&inspect(&config, &dir.path().join("f_001.png"), &out, "0")?, &["pictures.txt", "another kind"]);
    assert_eq!(names()?, ["frame_000002.png", "pictures.txt"], "a list of somebody else is none");
    Ok(())
}

/// Protects people whose camera changes its size in mid-stream, or who use a grey camera with the colour method: both get a line that says
/// what to do.
#[test]
fn changed_size_and_grey_pictures_say_what_to_do() -> Outcome {
    let directory = tempfile::tempdir()?;
    let (config, _) = write_config(directory.path(), "sizes", |_| {})?;
    for i in 0..4 {
        let mut picture = pour(i)?;
        if i == 3 {
            let mut small = Mat::default();
            imgproc::resize(&picture, &mut small, Size::new(320, 240), 0.0, 0.0, imgproc::INTER_AREA)?;
            picture = small;
        }
        imgcodecs::imwrite(directory.path().join(format!("f_{i:03}.png")), &picture, &Vector::new())?;
    }
    let out = directory.path().join("out");
    let output = inspect(&config, &directory.path().join("f_%03d.png"), &out, "0")?;
    refused(&output, &["frame 4", "320 x 240", "640 x 480", "width_px"]);
    let mut grey = Mat::default();
    imgproc::cvt_color_def(&pour(20)?, &mut grey, imgproc::COLOR_BGR2GRAY)?;
    let path = directory.path().join("mono.png");
    imgcodecs::imwrite(&path, &grey, &Vector::new())?;
    refused(&inspect(&config, &path, &out, "0")?, &["image.method", "clear"]);
    let (config, _) = write_config(directory.path(), "sizes", |c| c.image.method = shared::config::LiquidMethod::Clear)?;
    assert!(inspect(&config, &path, &out, "0")?.status.success());
    Ok(())
}

/// Protects the start: a configuration that cannot work ends every command at once with the file, the key and a hint.
#[test]
fn bad_configurations_are_refused_with_key_and_hint() -> Outcome {
    let directory = tempfile::tempdir()?;
    let good = std::fs::read_to_string(drawn::sim_config())?;
    for (from, to, words) in [
        ("y_axis_px = [215.0, 470.0, 215.0, 250.0]", "y_axis_px = [600.0, 252.0, 215.0, 250.0]", ["image.y_axis_px", "10 degrees"]),
        ("region_px = [175, 16, 435, 284]", "region_px = [175, 16, 520, 284]", ["image.region_px", "inside 640 x 480"]),
        ("region_px = [175, 16, 435, 284]", "region_px = [300, 16, 300, 284]", ["image.region_px", "axes cross"]),
        ("colour_hsv = [98, 90, 25, 124, 255, 255]", "colour_hsv = [98, 200, 25, 124, 90, 255]", ["image.colour_hsv", "s_min < s_max"]),
        ("source = \"shared-memory\"", "source = \"video\"\npath = \"no-such.mp4\"", ["no-such.mp4", "no such file"]),
        ("source = \"shared-memory\"", "source = \"images\"\npath = \"no/f_%03d.png\"", ["no/f_%03d.png", "pattern"]),
    ] {
        assert!(good.contains(from), "{from}");
        let path = directory.path().join("bad.toml");
        let text = good.replace(from, to).replace("name = \"sim\"", &format!("name = \"bad-{}\"", std::process::id()));
        std::fs::write(&path, text)?;
        let output = Command::new(env!("CARGO_BIN_EXE_feature-worker")).args(["run", "--config"]).arg(&path).output()?;
        refused(&output, &words);
    }
    shared::ipc::remove_files(&format!("bad-{}", std::process::id()));
    Ok(())
}

/// Protects who looks for the fault: a device that is not there and a file that is no camera are told apart, by their words and exit codes.
#[test]
fn a_missing_device_and_no_camera_are_told_apart() -> Outcome {
    let directory = tempfile::tempdir()?;
    let file = directory.path().join("video0");
    std::fs::write(&file, "no device")?;
    for (path, code, words) in [(Path::new("/dev/no-such-camera"), 3, "no such device"), (&file, 2, "this is no camera")] {
        let (config, written) = write_config(directory.path(), "devices", |c| {
            (c.camera.source, c.camera.path) = (shared::config::CameraSource::Device, path.display().to_string());
        })?;
        let command = |name: &str| {
            let mut command = Command::new(env!("CARGO_BIN_EXE_feature-worker"));
            command.args([name, "--config"]).arg(&config).stderr(Stdio::piped());
            command
        };
        for name in ["run", "view", "camera"] {
            if (name, code) == ("run", 3) {
                // A worker waits for a camera that is not there, and says so.
                let mut worker = command(name).spawn()?;
                let mut said = BufReader::new(worker.stderr.take().ok_or("no standard error")?).lines().map_while(Result::ok);
                let line = said.find(|line| line.contains("waited for")).ok_or("nothing is waited for")?;
                assert!(line.contains(words) && line.contains(&path.display().to_string()), "{line}");
                Command::new("kill").arg(worker.id().to_string()).status()?;
                assert!(worker.wait()?.success());
                continue;
            }
            let output = command(name).output()?;
            let said = text(&output);
            assert_eq!(output.status.code(), Some(code), "{name}: {said}");
            assert!(said.contains(words) && said.contains(&path.display().to_string()), "{name}: {said}");
        }
        shared::ipc::remove_files(&written.cell.name);
    }
    let output = Command::new(env!("CARGO_BIN_EXE_feature-worker")).args(["camera", "--json"]).output()?;
    let listed: serde_json::Value = serde_json::from_slice(&output.stdout)?;
    assert!(output.status.success() && listed["cameras"].is_array(), "{}", text(&output));
    Ok(())
}

/// Protects the count of lost frames of a V4L2 device: a frame that the driver dropped leaves a gap in the numbers. Jitter, a busy kernel
/// that stamps late and a camera that is 1 % slow or fast leave none. Without timestamps the frames themselves are counted.
#[test]
fn a_lost_frame_leaves_a_gap() {
    let mut numbering = Numbering::new(30.0, 0);
    let stamps = [1000.0, 1033.0, 1068.0, 1099.0, 1166.5, 1200.0, 1333.3];
    assert_eq!(stamps.map(|ms| numbering.next(Some(ms), u64::MAX).0), [1, 2, 3, 4, 6, 7, 11]);
    assert_eq!(numbering.next(None, u64::MAX).0, 12);
    for rate in [0.99, 1.0, 1.01] {
        let mut numbering = Numbering::new(25.0, 0);
        let late_ms = |i: u64| [0.0, 25.0, 0.0, 0.0, 20.0, 5.0, 25.0][i as usize % 7];
        let lost = |i: u64| i % 100 == 50;
        for i in (0..2000).filter(|i| !lost(*i)) {
            let at_ms = 1000.0 + i as f64 * 40.0 * rate + late_ms(i);
            assert_eq!(numbering.next(Some(at_ms), u64::MAX).0, i + 1, "rate {rate}");
        }
    }
}

/// Protects the age of a frame, which decides whether it is stale and which angle it belongs to. A frame that waited in the driver keeps the
/// driver's time. Timestamps of another clock (the wall clock, one that counts from the device's start, one that jumps back) are not
/// believed, and no two frames have the same time.
#[test]
fn a_frame_is_as_old_as_its_driver_says() {
    let ns = |ms: u64| ms * 1_000_000;
    let mut monotonic = Numbering::new(30.0, ns(50_000));
    let frames = [(50_100.5, 50_102), (50_134.0, 50_140), (50_167.0, 50_900), (50_200.0, 50_901), (50_934.0, 50_936)];
    let dated = frames.map(|(at_ms, now)| monotonic.next(Some(at_ms), ns(now)).1);
    assert_eq!(dated, [50_100_500_000, 50_134_000_000, 50_167_000_000, 50_200_000_000, 50_934_000_000]);
    assert_eq!(monotonic.next(Some(50_900.0), ns(50_970)).1, ns(50_970), "a jump back");
    assert_eq!(monotonic.next(None, ns(51_000)).1, ns(51_000), "no timestamp");
    for from_ms in [0.0, 49_000.0, 1.7e12] {
        let mut other = Numbering::new(30.0, ns(50_000));
        for now in (50_100..53_000).step_by(33) {
            let at_ms = from_ms + (now - 50_000) as f64;
            assert_eq!(other.next(Some(at_ms), ns(now)).1, ns(now), "clock from {from_ms} ms");
        }
    }
}

/// Protects the count of frames: a camera that runs at another rate than configured is refused with key and hint. A device that does not
/// report its rate is accepted.
#[test]
fn another_rate_is_refused() {
    assert!(check_rate(30.0, 0.0).is_ok() && check_rate(30.0, 30.0).is_ok() && check_rate(30.0, 29.97).is_ok());
    let said = check_rate(30.0, 15.0).expect_err("accepted").to_string();
    assert!(said.contains("camera.fps = 30") && said.contains("camera.fps = 15") && said.lines().count() == 1, "{said}");
}

/// Protects scripts: a configuration, from the environment too, or an input that cannot be read is exit code 2 of `bench` and `camera` as of every command.
#[test]
fn bench_and_camera_refuse_what_cannot_be_read() {
    let run = |words: &[&str], config: &str| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_feature-worker"));
        command.args(words).env(shared::config::VARIABLE, config).output().unwrap().status.code()
    };
    let cell = concat!(env!("CARGO_MANIFEST_DIR"), "/../config/sim.toml");
    assert_eq!(run(&["camera"], "nowhere.toml"), Some(2));
    // The list is what a new configuration is written from.
    let listed = Command::new(env!("CARGO_BIN_EXE_feature-worker")).arg("camera").env(shared::config::VARIABLE, "nowhere.toml").output();
    assert!(String::from_utf8_lossy(&listed.unwrap().stdout).trim_end().ends_with("devices"));
    assert_eq!(run(&["bench", "--input", "nowhere.mp4"], "nowhere.toml"), Some(2));
    assert_eq!(run(&["bench", "--no-python", "--input", "nowhere.mp4"], cell), Some(2));
}

/// Protects the second of two recordings from what the first one showed: it is a new beginning for the eye, a second after it. Pictures that are named
/// one by one follow each other at the camera's rate.
#[test]
fn each_recording_is_a_new_beginning() -> Outcome {
    let dir = tempfile::tempdir()?;
    let (config, _) = write_config(dir.path(), "begins", |config| config.image = image_config(LiquidMethod::Clear))?;
    let name = |i: i32| dir.path().join(format!("f_{i:03}.png"));
    for i in 0..8 {
        imgcodecs::imwrite(name(i), &water(0.0, None, i)?, &Vector::new())?;
    }
    let (out, pattern) = (dir.path().join("out"), dir.path().join("f_%03d.png"));
    let rows = |input: &[PathBuf]| -> Result<Vec<(f64, String)>, Box<dyn std::error::Error>> {
        let mut command = Command::new(env!("CARGO_BIN_EXE_feature-worker"));
        let output = command.args(["inspect", "--every", "0", "--config"]).arg(&config).arg("--out").arg(&out).args(input).output()?;
        assert!(output.status.success(), "{}", text(&output));
        let mut table = csv::Reader::from_path(out.join("features.csv"))?;
        table.records().map(|row| row.map_err(Into::into).and_then(|row| Ok((row[1].parse()?, row[4].to_owned())))).collect()
    };
    let twice = rows(&[pattern.clone(), pattern])?;
    assert!((twice[8].0 - twice[7].0 - 1.0 - 1.0 / 30.0).abs() < 1e-3, "{twice:?}");
    let doubted: Vec<usize> = (0..16).filter(|i| twice[*i].1 != "none").collect();
    assert!(doubted.contains(&0) && doubted.contains(&8) && !doubted.contains(&7) && !doubted.contains(&15), "{twice:?}");
    let one_by_one = rows(&(0..8).map(name).collect::<Vec<_>>())?;
    assert!((one_by_one[7].0 - 7.0 / 30.0).abs() < 1e-3 && one_by_one[7].1 == "none", "{one_by_one:?}");
    Ok(())
}

/// Protects the time of whoever inspects a pour on a slow disk: its pictures are not waited for one by one, but its table is.
#[test]
fn pictures_are_not_waited_for() -> Outcome {
    let dir = tempfile::tempdir()?;
    let (config, _) = write_config(dir.path(), "soon", |_| {})?;
    for i in 0..20 {
        imgcodecs::imwrite(dir.path().join(format!("f_{i:03}.png")), &pour(i)?, &Vector::new())?;
    }
    let (log, out) = (dir.path().join("log"), dir.path().join("out"));
    let mut command = Command::new("strace");
    command.args(["-f", "-e", "trace=fsync,fdatasync", "-o"]).arg(&log).arg(env!("CARGO_BIN_EXE_feature-worker"));
    command.args(["inspect", "--config"]).arg(&config).arg("--out").arg(&out).arg(dir.path().join("f_%03d.png"));
    let output = command.output().map_err(|e| format!("strace is installed (scripts/install strace): {e}"))?;
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let waits = std::fs::read_to_string(&log)?.matches("sync(").count();
    assert_eq!(
        (std::fs::read_dir(&out)?.count(), waits),
        (22, 2),
        "20 pictures and their list; the table and its directory are put on the disk"
    );
    Ok(())
}
