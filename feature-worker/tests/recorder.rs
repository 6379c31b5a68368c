//! The recorder with real shared memory, images and files. Where it is killed or its disk is full, it runs in a process of its own.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use feature_worker::recorder::Recorder;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use opencv::core::{MatTraitConst, MatTraitConstManual, Vector};
use rand::Rng;
use rand_pcg::Pcg32;
use shared::config::{Config, ImageFormat};
use shared::episode::{Episode, EpisodeImages, EpisodeKind};
use shared::gaussian_curve::Curve;
use shared::ipc::Cell;
use shared::messages::{Feature, FrameHeader, LAYOUT_VERSION, Phase, PixelFormat, RecorderReport, RecorderState, Telemetry};

type Ipc = iceoryx2::service::ipc::Service;

const WIDTH: u32 = 160;
const HEIGHT: u32 = 120;
const PERIOD_NS: u64 = 33_333_333;
const CURVE: Curve = Curve { lambda_deg: 60.0, gamma_per_s2: 0.4, beta_s: 1.0 };

fn config(cell: &str, directory: &Path) -> Config {
    let mut config = Config::read(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/sim.toml")).unwrap();
    config.cell.name = format!("{cell}-{}", std::process::id());
    config.camera.width_px = WIDTH;
    config.camera.height_px = HEIGHT;
    config.recording.directory = directory.into();
    config.recording.queue_frames = 300;
    config
}

/// A controller and a camera for the recorder. The times in the data are those of 30 Hz; in real time it runs as fast as the recorder can.
struct Scene {
    recorder: Recorder,
    telemetry: Publisher<Ipc, Telemetry, ()>,
    reports: Subscriber<Ipc, RecorderReport, ()>,
    format: PixelFormat,
    base_ns: u64,
    tick: u64,
    sequence: u64,
    /// Makes pictures of noise, which do not compress.
    noise: Option<Pcg32>,
    _cell: Cell,
    _cleanup: Cleanup,
}

/// Removes what a cell leaves in shared memory, after everything else of a [`Scene`] is gone.
struct Cleanup(String);

impl Drop for Cleanup {
    fn drop(&mut self) {
        shared::ipc::remove_files(&self.0);
    }
}

impl Scene {
    fn new(config: &Config) -> Self {
        let cell = Cell::join(&config.cell.name).unwrap();
        let telemetry = cell.telemetry().unwrap().publisher_builder().create().unwrap();
        let reports = cell.recorder().unwrap().subscriber_builder().create().unwrap();
        let recorder = Recorder::start(config, |_, _| {}).unwrap();
        let base_ns = shared::os::now_ns();
        Self {
            recorder,
            telemetry,
            reports,
            format: PixelFormat::Bgr8,
            base_ns,
            tick: 0,
            sequence: 0,
            noise: None,
            _cell: cell,
            _cleanup: Cleanup(config.cell.name.clone()),
        }
    }

    /// One period: a tick of `episode`, and a frame that was captured 10 ms after the tick before.
    fn period(&mut self, episode: u64, phase: Phase) {
        let frame = self.feature();
        self.tick(episode, phase);
        self.offer(&frame, frame.sequence);
    }

    fn tick(&mut self, episode: u64, phase: Phase) {
        self.tick += 1;
        let at_ns = self.base_ns + self.tick * PERIOD_NS;
        let alpha_deg = self.tick as f32;
        self.telemetry
            .send_copy(Telemetry {
                version: LAYOUT_VERSION,
                phase: phase as u32,
                tick: self.tick,
                at_ns,
                robot_at_ns: at_ns,
                episode,
                weights_id: 0xabc,
                alpha_deg,
                alpha_measured_deg: alpha_deg - 2.0,
                goal_ml: if phase == Phase::Pouring { 75.0 } else { f32::NAN },
                lambda_deg: CURVE.lambda_deg,
                gamma_per_s2: CURVE.gamma_per_s2,
                beta_s: CURVE.beta_s,
                ..Default::default()
            })
            .unwrap();
        std::thread::sleep(Duration::from_millis(3));
    }

    fn feature(&mut self) -> Feature {
        self.sequence += 1;
        Feature {
            version: LAYOUT_VERSION,
            sequence: self.sequence,
            captured_at_ns: self.base_ns + self.tick * PERIOD_NS + 10_000_000,
            area_px2: self.sequence as f32 * 3.0,
            ..Default::default()
        }
    }

    /// Offers a frame whose grey level is its number.
    fn offer(&mut self, feature: &Feature, grey: u64) {
        let header = FrameHeader {
            version: LAYOUT_VERSION,
            format: self.format as u32,
            width_px: WIDTH,
            height_px: HEIGHT,
            sequence: feature.sequence,
            captured_at_ns: feature.captured_at_ns,
            published_at_ns: feature.captured_at_ns,
        };
        let pixel = match self.format {
            PixelFormat::Yuyv => [grey as u8, 128],
            _ => [grey as u8; 2],
        };
        let bytes = (WIDTH * HEIGHT) as usize * self.format.bytes_per_pixel();
        let mut pixels: Vec<u8> = pixel.into_iter().cycle().take(bytes).collect();
        if let Some(noise) = &mut self.noise {
            noise.fill_bytes(&mut pixels);
        }
        self.recorder.offer(&header, &pixels, feature);
    }

    /// The next report; gives up after a generous minute.
    fn report(&self) -> (RecorderState, RecorderReport) {
        let begin = Instant::now();
        while begin.elapsed() < Duration::from_secs(60) {
            if let Ok(Some(report)) = self.reports.receive() {
                return (RecorderState::from_code(report.state), *report);
            }
            std::thread::sleep(Duration::from_millis(2));
        }
        panic!("no report");
    }

    /// Some idle periods, then `periods` of an episode, then idle periods again.
    fn run(&mut self, episode: u64, phase: Phase, periods: u64) {
        for _ in 0..12 {
            self.period(0, Phase::Idle);
        }
        for _ in 0..periods {
            self.period(episode, phase);
        }
        for _ in 0..4 {
            self.period(0, Phase::Idle);
        }
    }

    fn complete(&self) -> (PathBuf, RecorderReport) {
        assert_eq!(self.report().0, RecorderState::Writing);
        let (state, report) = self.report();
        assert_eq!(state, RecorderState::Complete, "{}", report.text());
        (PathBuf::from(report.text()), report)
    }
}

/// Protects L_E: the file holds every frame of the episode with its image, its V_e and alpha at its capture time, and the curve's
/// parameters.
#[test]
fn a_recording_becomes_a_complete_episode() {
    let dir = tempfile::tempdir().unwrap();
    let mut scene = Scene::new(&config("whole", dir.path()));
    scene.run(4, Phase::Recording, 45);
    let (path, report) = scene.complete();
    assert!(path.is_absolute());
    assert_eq!((report.episode, report.dropped), (4, 0));

    let episode = Episode::read(&path).unwrap();
    assert!(episode.complete);
    assert_eq!(episode.kind, EpisodeKind::Recording(CURVE));
    assert_eq!((episode.info.ticks, episode.info.lost_ticks, episode.info.lost_frames), (45, 0, 0));
    assert_eq!(episode.info.weights, "0000000000000abc", "the weights that the controller runs");
    assert_eq!(episode.info.images, report.images);
    assert_eq!(episode.info.images as usize, episode.rows.len());
    // Ticks 13 to 57 are the episode, and tick 58 ends it. Frames 14 to 58 were captured in between.
    assert!(episode.rows[0].t_s < 0.0 && episode.rows[0].t_s >= -0.2, "a few frames from before");
    assert_eq!(episode.rows.last().unwrap().sequence, 58, "the last frame before the end");
    for f in &episode.rows {
        // Frame n is captured 10 ms after tick n - 1.
        let expected = (f.sequence - 1) as f32 + 0.3;
        assert!((f.alpha_commanded_deg - expected).abs() < 1e-3, "frame {}: {}", f.sequence, f.alpha_commanded_deg);
        assert!((f.alpha_measured_deg - expected + 2.0).abs() < 1e-3);
        assert_eq!(f.area_px2, f.sequence as f32 * 3.0);
    }
    for (image, frame) in EpisodeImages::open(&path).unwrap().zip(&episode.rows) {
        let image = image.unwrap();
        assert_eq!(image.captured_at_ns, frame.captured_at_ns);
        let bytes = Vector::<u8>::from(image.data);
        let picture = opencv::imgcodecs::imdecode(&bytes, opencv::imgcodecs::IMREAD_GRAYSCALE).unwrap();
        assert_eq!((picture.cols(), picture.rows()), (WIDTH as i32, HEIGHT as i32));
        let grey = f64::from(picture.data_bytes().unwrap()[0]);
        assert!((grey - frame.sequence as f64).abs() <= 2.0, "image {grey} belongs to frame {}", frame.sequence);
    }
}

/// Protects every pixel format and both compressions, and the file of an earlier episode from a later one.
#[test]
fn formats_and_compressions_are_recorded_and_nothing_is_overwritten() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("episode-0001.mcap"), "older").unwrap();
    let mut config = config("formats", dir.path());
    config.recording.image_format = ImageFormat::Png;
    let mut scene = Scene::new(&config);
    for (episode, format) in [(1, PixelFormat::Bgr8), (2, PixelFormat::Mono8), (3, PixelFormat::Yuyv)] {
        scene.format = format;
        scene.run(episode, Phase::Pouring, 10);
        let (path, _) = scene.complete();
        assert!(path.ends_with(format!("episode-000{}.mcap", episode + 1)), "{}", path.display());
        let read = Episode::read(&path).unwrap();
        assert!(read.complete);
        assert_eq!(read.kind, EpisodeKind::Pour { goal_ml: 75.0 });
        let image = EpisodeImages::open(&path).unwrap().last().unwrap().unwrap();
        assert_eq!(image.format, "png");
        let bytes = Vector::<u8>::from(image.data);
        let picture = opencv::imgcodecs::imdecode(&bytes, opencv::imgcodecs::IMREAD_GRAYSCALE).unwrap();
        let grey = f64::from(picture.data_bytes().unwrap()[5]);
        // The values of YUYV go from 16 to 235.
        let expected = f64::from(image.sequence);
        let expected = if format == PixelFormat::Yuyv { (expected - 16.0) * 255.0 / 219.0 } else { expected };
        assert!((grey - expected).abs() <= 2.0, "{format:?}: {grey}, expected {expected}");
    }
    assert_eq!(std::fs::read_to_string(dir.path().join("episode-0001.mcap")).unwrap(), "older");
}

/// Protects the end of a pour when the next one begins at once: frames that were still under way belong to the first episode, and
/// the second has its own from the first tick on.
#[test]
fn back_to_back_episodes_lose_no_frame() {
    let dir = tempfile::tempdir().unwrap();
    let mut scene = Scene::new(&config("touching", dir.path()));
    for _ in 0..12 {
        scene.period(0, Phase::Idle);
    }
    for _ in 0..20 {
        scene.period(1, Phase::Recording);
    }
    // Two ticks of the next one are known before the last frame of the first comes.
    let last = scene.feature();
    scene.tick(2, Phase::Recording);
    let next = scene.feature();
    scene.tick(2, Phase::Recording);
    scene.offer(&last, 1);
    scene.offer(&next, 1);
    scene.run(2, Phase::Recording, 0);
    for _ in 0..30 {
        scene.period(0, Phase::Idle);
    }
    let (first, _) = scene.complete();
    let (second, _) = scene.complete();
    let (first, second) = (Episode::read(&first).unwrap(), Episode::read(&second).unwrap());
    assert!(first.complete && second.complete);
    assert_eq!((first.info.ticks, second.info.ticks), (20, 2));
    assert_eq!(first.rows.last().unwrap().sequence, last.sequence);
    assert!(second.rows.iter().any(|f| f.sequence == next.sequence));
}

/// Protects V_e from the recorder's limits: without a free buffer the image is lost and counted, and the measurement is kept. Frames that
/// come twice or late are left out, and frames that never came are shown as lost.
#[test]
fn dropped_images_and_lost_frames_are_counted_and_lose_no_measurement() {
    let dir = tempfile::tempdir().unwrap();
    let mut config = config("drops", dir.path());
    config.recording.queue_frames = 2;
    let mut scene = Scene::new(&config);
    for _ in 0..12 {
        scene.period(0, Phase::Idle);
    }
    scene.tick(1, Phase::Recording);
    // A burst that no thread could take: 400 frames, 1 ms apart in the data's time, for 2 + 8 buffers.
    let mut offered = Vec::new();
    for i in 0..400 {
        let mut f = scene.feature();
        f.captured_at_ns += i * 1_000_000;
        scene.offer(&f, 1);
        offered.push(f.sequence);
    }
    let dropped = scene.recorder.dropped();
    assert!(dropped > 0);
    // After the burst comes its last frame again, and then a gap of two.
    let mut again = scene.feature();
    again.captured_at_ns += 399_000_000;
    again.sequence = *offered.last().unwrap();
    scene.offer(&again, 1);
    scene.sequence = *offered.last().unwrap() + 2;
    for _ in 0..20 {
        scene.tick(1, Phase::Recording);
    }
    scene.run(1, Phase::Recording, 10);
    let (path, report) = scene.complete();
    let episode = Episode::read(&path).unwrap();
    assert!(episode.complete);
    assert_eq!(report.dropped, episode.info.dropped_images);
    assert!(episode.info.dropped_images > 0);
    assert_eq!(episode.info.images + episode.info.dropped_images + episode.info.lost_frames, episode.rows.len() as u64);
    assert_eq!(episode.info.lost_frames, 2);
    for sequence in offered {
        let frame = episode.rows.iter().find(|f| f.sequence == sequence).unwrap();
        assert_eq!(frame.area_px2, sequence as f32 * 3.0);
    }
}

/// Protects people from half an episode: one that began before the recorder, whose controller was restarted, or whose worker was stopped in
/// the middle is not called complete.
#[test]
fn half_an_episode_is_never_complete() {
    let dir = tempfile::tempdir().unwrap();
    let mut scene = Scene::new(&config("half", dir.path()));
    for _ in 0..10 {
        scene.period(9, Phase::Recording);
    }
    let (state, report) = scene.report();
    assert_eq!((state, report.episode), (RecorderState::Failed, 9));
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0);

    for _ in 0..5 {
        scene.period(0, Phase::Idle);
    }
    for _ in 0..10 {
        scene.period(10, Phase::Recording);
    }
    scene.tick = 5;
    scene.period(0, Phase::Idle);
    assert_eq!(scene.report().0, RecorderState::Writing);
    let (state, report) = scene.report();
    assert_eq!(state, RecorderState::Failed);
    assert!(report.text().contains("restarted"), "{}", report.text());

    scene.tick = 1000;
    for _ in 0..10 {
        scene.period(11, Phase::Recording);
    }
    assert_eq!(scene.report().0, RecorderState::Writing);
    let Scene { recorder, reports, _cell, _cleanup, .. } = scene;
    recorder.stop();
    let report = reports.receive().unwrap().unwrap();
    assert_eq!(RecorderState::from_code(report.state), RecorderState::Failed);
    assert!(report.text().contains("stopped"), "{}", report.text());
    for entry in std::fs::read_dir(dir.path()).unwrap() {
        let episode = Episode::read(&entry.unwrap().path()).unwrap();
        assert!(!episode.complete && !episode.info.ended.is_empty());
    }
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 2);
}

/// Protects training from angles that were made up: where the recorder fell behind so far that the controller's ticks are lost, the file is not called
/// complete, be it in the middle of an episode, at its beginning or at its end. Two lost ticks are bridged.
#[test]
fn an_episode_whose_ticks_are_lost_is_never_complete() {
    const RECORDING: (u64, Phase) = (1, Phase::Recording);
    let dir = tempfile::tempdir().unwrap();
    let mut scene = Scene::new(&config("behind", dir.path()));
    for (lost, before, after) in
        [(70, RECORDING, RECORDING), (70, (0, Phase::Idle), RECORDING), (70, RECORDING, (0, Phase::Idle)), (2, RECORDING, RECORDING)]
    {
        let first = scene.tick;
        let periods = |scene: &mut Scene, (of, phase): (u64, Phase)| (0..12).for_each(|_| scene.period(of * (first + 1), phase));
        periods(&mut scene, (0, Phase::Idle));
        periods(&mut scene, before);
        scene.tick += lost;
        periods(&mut scene, after);
        periods(&mut scene, (0, Phase::Idle));
        assert_eq!(scene.report().0, RecorderState::Writing);
        let (state, report) = scene.report();
        if lost > 2 {
            assert_eq!(state, RecorderState::Failed, "{before:?} {after:?}");
            assert!(report.text().contains("fell behind"), "{}", report.text());
        } else {
            assert_eq!(state, RecorderState::Complete, "{}", report.text());
        }
    }
    let complete =
        std::fs::read_dir(dir.path()).unwrap().filter(|entry| Episode::read(&entry.as_ref().unwrap().path()).unwrap().complete).count();
    assert_eq!(complete, 1);
}

/// Starts this test binary's [`child`] in a process of its own, after the shell words `before`.
fn start_child(before: &str, cell: &str, directory: &Path) -> Child {
    Command::new("sh")
        .arg("-c")
        .arg(format!("{before} exec \"$0\" --exact child --ignored --nocapture"))
        .arg(std::env::current_exe().unwrap())
        .env("RECORDER_TEST_CELL", cell)
        .env("RECORDER_TEST_DIRECTORY", directory)
        .stdout(Stdio::null())
        .spawn()
        .unwrap()
}

/// Not a test, but the process that the tests below start: records until it is killed or the episode has failed.
#[test]
#[ignore = "run by the tests below in a process of its own"]
fn child() {
    let Ok(cell) = std::env::var("RECORDER_TEST_CELL") else { return };
    let directory = PathBuf::from(std::env::var("RECORDER_TEST_DIRECTORY").unwrap());
    let mut config = config(&cell, &directory.join("episodes"));
    config.cell.name = cell;
    let mut scene = Scene::new(&config);
    scene.noise = Some(Pcg32::new(1, 1));
    for _ in 0..5 {
        scene.period(0, Phase::Idle);
    }
    let mut reported = String::new();
    for _ in 0..10_000 {
        scene.period(1, Phase::Recording);
        while let Ok(Some(report)) = scene.reports.receive() {
            reported = format!("{} {}", report.state, report.text());
        }
        if reported.starts_with(&format!("{} ", RecorderState::Failed as u32)) {
            std::fs::write(directory.join("failed.txt"), &reported).unwrap();
            return;
        }
    }
}

/// Protects recordings from the out-of-memory killer, a pulled plug and an impatient person: what was written can be read and says that it
/// is not everything.
#[test]
fn a_killed_recorder_leaves_a_file_that_reads_and_says_so() {
    let dir = tempfile::tempdir().unwrap();
    let cell = format!("killed-{}", std::process::id());
    let mut child = start_child("", &cell, dir.path());
    let file = dir.path().join("episodes/episode-0001.mcap");
    let begin = Instant::now();
    while std::fs::metadata(&file).map_or(0, |m| m.len()) < 1_500_000 {
        assert!(begin.elapsed() < Duration::from_secs(120), "the child records nothing");
        std::thread::sleep(Duration::from_millis(5));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    shared::ipc::remove_files(&cell);
    let episode = Episode::read(&file).unwrap();
    assert!(!episode.complete);
    assert_eq!(episode.info.ended, "");
    assert!(episode.rows.len() > 10, "{} frames", episode.rows.len());
    assert_eq!(EpisodeImages::open(&file).unwrap().filter(Result::is_ok).count() as u64, episode.info.images);
    assert_eq!(episode.info.images as usize, episode.rows.len(), "the cut is between two frames");
}

/// Protects the operator from silence when the disk is full: the reason is reported, the worker goes on, and what was written can be read.
#[test]
fn a_full_disk_is_reported_and_what_fits_is_kept() {
    let dir = tempfile::tempdir().unwrap();
    let cell = format!("full-{}", std::process::id());
    // The largest file is 8192 * 512 bytes, which is enough for the shared memory, and no signal tells of it: writing fails as on a full
    // disk.
    let status = start_child("trap '' XFSZ; ulimit -f 8192;", &cell, dir.path()).wait().unwrap();
    shared::ipc::remove_files(&cell);
    assert!(status.success());
    let failed = std::fs::read_to_string(dir.path().join("failed.txt")).unwrap();
    assert!(failed.contains("episode-0001.mcap") && failed.contains("check free space"), "{failed}");
    let episode = Episode::read(&dir.path().join("episodes/episode-0001.mcap")).unwrap();
    assert!(!episode.complete && !episode.rows.is_empty());
}

/// Protects the start: a directory that cannot be made is refused with the key and in one line.
#[test]
fn a_directory_that_cannot_be_made_is_refused_at_the_start() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("file");
    std::fs::write(&file, "").unwrap();
    let error = Recorder::start(&config("nodir", &file.join("inside")), |_, _| {}).err().unwrap().to_string();
    assert!(error.starts_with("recording.directory") && !error.contains('\n'), "{error}");
}
