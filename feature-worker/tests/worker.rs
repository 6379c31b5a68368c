//! `feature-worker run` and `view` as processes on a real cell's shared memory. The camera driver is this test, or the worker reads pictures
//! itself, as it reads a device.

mod drawn;

use std::io::{BufRead, BufReader, Read, Write};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use drawn::{HEIGHT, Outcome, WIDTH, pour, write_config};
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use opencv::prelude::*;
use shared::config::CameraSource;
use shared::ipc::{Cell, FrameNotifier};
use shared::messages::{Doubt, Feature, FrameHeader, LAYOUT_VERSION, PixelFormat};
use shared::os::now_ns;

type Ipc = iceoryx2::service::ipc::Service;

/// A child process that does not outlive the test.
struct Program(Child);

impl Program {
    fn start(command: &str, config: &Path, more: &[&str]) -> std::io::Result<Self> {
        let mut program = Command::new(env!("CARGO_BIN_EXE_feature-worker"));
        program.arg(command).arg("--config").arg(config).args(more).stdout(Stdio::piped()).stderr(Stdio::piped());
        Ok(Self(program.spawn()?))
    }

    fn signal(&self, signal: &str) -> std::io::Result<()> {
        Command::new("kill").args([signal, &self.0.id().to_string()]).status().map(|_| ())
    }

    /// Exit code and standard error, after a generous minute at most.
    fn end(&mut self) -> std::io::Result<(Option<i32>, String)> {
        let begin = Instant::now();
        while self.0.try_wait()?.is_none() && begin.elapsed() < Duration::from_secs(60) {
            std::thread::sleep(Duration::from_millis(10));
        }
        let code = self.0.try_wait()?.and_then(|s| s.code());
        let mut said = String::new();
        if code.is_some()
            && let Some(errors) = &mut self.0.stderr
        {
            errors.read_to_string(&mut said)?;
        }
        Ok((code, said))
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Removes what the cell leaves in shared memory, when it is dropped after everything else of the cell.
struct Cleanup(String);

impl Drop for Cleanup {
    fn drop(&mut self) {
        shared::ipc::remove_files(&self.0);
    }
}

/// A camera driver in this process.
struct Driver {
    publisher: Publisher<Ipc, [u8], FrameHeader>,
    notifier: FrameNotifier,
    features: Subscriber<Ipc, Feature, ()>,
    _cell: Cell,
    _cleanup: Cleanup,
}

type Failure = Box<dyn std::error::Error>;

impl Driver {
    fn new(cell: &str) -> Result<Self, Failure> {
        let cleanup = Cleanup(cell.into());
        let cell = Cell::join(cell)?;
        let publisher = cell.frames()?.publisher_builder().initial_max_slice_len((WIDTH * HEIGHT * 3) as usize).create()?;
        let features = cell.features()?.subscriber_builder().create()?;
        Ok(Self { publisher, notifier: cell.frame_notifier()?, features, _cell: cell, _cleanup: cleanup })
    }

    fn publish(&self, sequence: u64, captured_at_ns: u64, format: u32, size: [u32; 2], pixels: &[u8]) -> Result<(), Failure> {
        let mut loan = self.publisher.loan_slice_uninit(pixels.len())?;
        *loan.user_header_mut() = FrameHeader {
            version: LAYOUT_VERSION,
            format,
            width_px: size[0],
            height_px: size[1],
            sequence,
            captured_at_ns,
            published_at_ns: now_ns(),
        };
        loan.write_from_slice(pixels).send()?;
        self.notifier.notify()?;
        Ok(())
    }

    /// Frame `i` of the drawn pour with this sequence number.
    fn pour(&self, sequence: u64, i: i32) -> Result<u64, Failure> {
        let at_ns = now_ns();
        self.publish(sequence, at_ns, PixelFormat::Bgr8 as u32, [WIDTH as u32, HEIGHT as u32], pour(i)?.data_bytes()?)?;
        Ok(at_ns)
    }

    /// The next feature; none if it does not come within `patience`.
    fn feature(&self, patience: Duration) -> Result<Option<Feature>, Failure> {
        let begin = Instant::now();
        while begin.elapsed() < patience {
            if let Some(feature) = self.features.receive()? {
                return Ok(Some(*feature));
            }
            std::thread::sleep(Duration::from_millis(2));
        }
        Ok(None)
    }

    /// Publishes until the worker answers, because it may still be starting.
    fn wake(&self) -> Result<Feature, Failure> {
        for sequence in 1..600 {
            self.pour(sequence, 0)?;
            if let Some(feature) = self.feature(Duration::from_millis(200))? {
                return Ok(feature);
            }
        }
        Err("the worker measures nothing".into())
    }
}

/// How long a test waits for what must come.
const PATIENCE: Duration = Duration::from_secs(30);

/// Protects the controller, which sees through the worker alone. Every frame gives one feature with its number, its times and the right area.
/// Frames that come twice or out of order give none. Frames of another size, format or layout give a doubt and no crash. A driver that
/// restarts is followed. SIGTERM ends the worker with success. That the region has no room beside the lip is said, with one that has.
#[test]
fn every_frame_becomes_one_feature() -> Outcome {
    let directory = tempfile::tempdir()?;
    let (path, config) = write_config(directory.path(), "worker", |_| {})?;
    let driver = Driver::new(&config.cell.name)?;
    let mut worker = Program::start("run", &path, &[])?;
    let first = driver.wake()?;
    assert!(first.sequence > 0 && first.worker_epoch_ns > 0);
    while driver.feature(Duration::from_millis(300))?.is_some() {}

    let mut sequence = 1000;
    for i in 12..=20 {
        sequence += 1;
        let at_ns = driver.pour(sequence, i)?;
        let feature = driver.feature(PATIENCE)?.ok_or("no feature")?;
        assert_eq!((feature.sequence, feature.captured_at_ns, feature.version), (sequence, at_ns, LAYOUT_VERSION));
        assert_eq!(feature.worker_epoch_ns, first.worker_epoch_ns);
        assert!(at_ns <= feature.received_at_ns && feature.received_at_ns <= feature.published_at_ns);
        let truth = 3600.0 * (1.0 - (20 - i) as f32 / 13.0).powi(2);
        assert!((feature.area_px2 / truth - 1.0).abs() < 0.06, "frame {i}: {feature:?} instead of {truth}");
    }
    // The same number again, with an older time.
    driver.publish(sequence, now_ns() - 1_000_000_000, 0, [WIDTH as u32, HEIGHT as u32], pour(20)?.data_bytes()?)?;
    assert_eq!(driver.feature(Duration::from_millis(500))?, None);
    let bgr = PixelFormat::Bgr8 as u32;
    for (format, size, bytes) in [(bgr, [320, 240], 320 * 240 * 3), (99, [WIDTH as u32, HEIGHT as u32], 100), (bgr, [640, 480], 7)] {
        sequence += 1;
        driver.publish(sequence, now_ns(), format, size, &vec![90; bytes])?;
        let feature = driver.feature(PATIENCE)?.ok_or("no feature")?;
        assert_eq!((Doubt::from_code(feature.doubt), feature.area_px2), (Doubt::WrongFormat, 0.0));
    }
    // A driver that begins at 1 again sends younger frames with smaller numbers.
    for restarted in 1..4 {
        driver.pour(restarted, 20 + restarted as i32)?;
        let feature = driver.feature(PATIENCE)?.ok_or("no feature")?;
        assert!(feature.sequence == restarted && feature.area_px2 > 0.0, "{feature:?}");
    }
    // A driver whose camera has stopped, and which sends its last frame again and again, shows nothing.
    let (begin, at_ns, stopped) = (Instant::now(), now_ns(), pour(20)?);
    while begin.elapsed() < Duration::from_secs(3) {
        driver.publish(4, at_ns, bgr, [WIDTH as u32, HEIGHT as u32], stopped.data_bytes()?)?;
        std::thread::sleep(Duration::from_millis(50));
    }
    worker.signal("-TERM")?;
    let (code, said) = worker.end()?;
    assert_eq!(code, Some(0), "{said}");
    assert_eq!(said.matches("no new frames for a second").count(), 1, "{said}");
    assert!(said.contains("image.region_px = [191, 16, 420, 270]") && said.contains("write region_px = [179, 16, 432, 282]"), "{said}");
    Ok(())
}

/// Protects the controller from two workers that disagree: a second one is refused with a reason while the first goes on.
#[test]
fn a_second_worker_is_refused() -> Outcome {
    let directory = tempfile::tempdir()?;
    let (path, config) = write_config(directory.path(), "second", |_| {})?;
    let driver = Driver::new(&config.cell.name)?;
    let _first = Program::start("run", &path, &[])?;
    driver.wake()?;
    let mut second = Program::start("run", &path, &[])?;
    let (code, said) = second.end()?;
    assert_eq!(code, Some(5), "as a second controller: {said}");
    assert!(said.contains("another feature worker"), "{said}");
    while driver.feature(Duration::from_millis(300))?.is_some() {}
    driver.pour(5000, 20)?;
    assert!(driver.feature(PATIENCE)?.is_some());
    Ok(())
}

/// Sends GET or POST over a plain socket. Returns the head, status line included, and the body.
fn http(address: &str, request: &str, path: &str, body: &str) -> Result<(String, Vec<u8>), Failure> {
    let mut stream = std::net::TcpStream::connect(address)?;
    stream.set_read_timeout(Some(PATIENCE))?;
    let of_body = if request == "POST" { format!("Content-Type: application/json\r\nOrigin: http://{address}\r\n") } else { String::new() };
    let head =
        format!("{request} {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n{of_body}Content-Length: {}\r\n\r\n", body.len());
    write!(stream, "{head}{body}")?;
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer)?;
    let split = answer.windows(4).position(|w| w == b"\r\n\r\n").ok_or("no head")?;
    Ok((String::from_utf8_lossy(&answer[..split]).into_owned(), answer[split + 4..].to_vec()))
}

/// Writes a pour of [`PICTURES`] frames again and again for five minutes, as a camera that the worker reads itself. Returns the pattern.
fn write_pictures(directory: &Path) -> Result<String, Failure> {
    for i in 0..9000 {
        let file = |i: u64| directory.join(format!("f_{i:05}.png"));
        if i < PICTURES {
            let fast = opencv::core::Vector::from_slice(&[opencv::imgcodecs::IMWRITE_PNG_COMPRESSION, 1]);
            opencv::imgcodecs::imwrite(file(i), &pour(i as i32)?, &fast)?;
        } else {
            std::fs::hard_link(file(i % PICTURES), file(i))?;
        }
    }
    Ok(directory.join("f_%05d.png").display().to_string())
}

/// Different pictures of the drawn pour.
const PICTURES: u64 = 36;

/// KiB that the cell holds in shared memory. Pages that were never written do not count.
fn held_kib(cell: &str) -> std::io::Result<u64> {
    use std::os::unix::fs::MetadataExt as _;
    let directory = shared::runtime_dir::Place::from(cell).path();
    let prefix = format!("decant-{}_", std::fs::read_to_string(directory.join("token"))?);
    let files = std::fs::read_dir("/dev/shm")?.flatten().filter(|f| f.file_name().to_string_lossy().starts_with(&prefix));
    Ok(files.map(|f| f.metadata().map_or(0, |m| m.blocks() / 2)).sum())
}

/// Protects people who watch beside a worker that reads the camera itself, since only one process can stream from a device: each frame comes
/// after its feature, with the camera's number and time and the very pixels that were measured. It also protects the pour from them: without
/// a subscriber no frame is copied, and a subscriber that does not read costs no feature and gets the newest frames when it reads again.
#[test]
fn a_worker_with_its_own_camera_shares_its_frames() -> Outcome {
    let directory = tempfile::tempdir()?;
    let pattern = write_pictures(directory.path())?;
    let (path, config) = write_config(directory.path(), "shares", |c| {
        (c.camera.source, c.camera.path) = (CameraSource::Images, pattern.clone());
    })?;
    let _cleanup = Cleanup(config.cell.name.clone());
    let cell = Cell::join(&config.cell.name)?;
    let features = cell.features()?.subscriber_builder().buffer_size(64).create()?;
    let _worker = Program::start("run", &path, &[])?;
    let feature = || -> Result<Feature, Failure> {
        let begin = Instant::now();
        while begin.elapsed() < PATIENCE {
            if let Some(feature) = features.receive()? {
                return Ok(*feature);
            }
            std::thread::sleep(Duration::from_millis(2));
        }
        Err("no feature".into())
    };
    let mut newest = feature()?;
    let mut follow = |count: usize| -> Result<Vec<Feature>, Failure> {
        let mut seen = Vec::new();
        while seen.len() < count {
            let feature = feature()?;
            assert_eq!(feature.sequence, newest.sequence + 1, "no frame is lost");
            newest = feature;
            seen.push(feature);
        }
        Ok(seen)
    };
    let mut known = follow(30)?;
    let alone_kib = held_kib(&config.cell.name)?;
    let frame_kib = (WIDTH * HEIGHT * 3 / 1024) as u64;
    assert!(alone_kib < frame_kib, "{alone_kib} KiB in shared memory: frames are copied for nobody");

    let frames = cell.frames()?.subscriber_builder().create()?;
    let mut compared = 0;
    while compared < 20 {
        known.extend(follow(1)?);
        while let Some(frame) = frames.receive()? {
            let header = *frame.user_header();
            // Frames come after their features, so the feature of this frame has come or comes at once.
            while known.last().is_none_or(|f| f.sequence < header.sequence) {
                known.extend(follow(1)?);
            }
            let feature = known.iter().find(|f| f.sequence == header.sequence).ok_or("a frame that was not measured")?;
            let bgr = PixelFormat::Bgr8 as u32;
            assert_eq!((header.version, header.format, header.width_px, header.height_px), (LAYOUT_VERSION, bgr, 640, 480));
            assert_eq!(header.captured_at_ns, feature.captured_at_ns);
            assert!(header.published_at_ns >= feature.published_at_ns, "the feature first");
            let drawn = pour(((header.sequence - 1) % PICTURES) as i32)?;
            assert!(frame.payload() == drawn.data_bytes()?, "other pixels in frame {}", header.sequence);
            compared += 1;
        }
    }
    let listener = cell.frame_listener()?;
    let mut woken = 0;
    listener.timed_wait(|_| woken += 1, PATIENCE)?;
    assert!(woken > 0, "a reader is woken by a frame");
    // The reader stops reading frames and events, and holds one frame.
    let _held = frames.receive()?;
    while frames.receive()?.is_some() {}
    let last = follow(40)?.last().map_or(0, |f| f.sequence);
    let waiting = std::iter::from_fn(|| frames.receive().ok().flatten()).next().ok_or("no frame waits")?;
    assert!(waiting.user_header().sequence + 4 >= last, "the oldest were lost: {} of {last}", waiting.user_header().sequence);
    Ok(())
}

/// Protects people who watch a real cell: the view opens the camera itself while there is no worker. It leaves the camera to a worker that
/// starts and shows that worker's frames, says so when they end (here the worker is killed), and goes on with the next worker.
#[test]
fn the_view_follows_a_worker_with_its_own_camera() -> Outcome {
    let directory = tempfile::tempdir()?;
    let pattern = write_pictures(directory.path())?;
    let (path, config) = write_config(directory.path(), "follows", |c| {
        (c.camera.source, c.camera.path) = (CameraSource::Images, pattern.clone());
    })?;
    let _cleanup = Cleanup(config.cell.name.clone());
    let cell = Cell::join(&config.cell.name)?;
    let features = cell.features()?.subscriber_builder().buffer_size(64).create()?;
    let view_at = |path: &Path| -> Result<(Program, String), Failure> {
        let mut view = Program::start("view", path, &["--port", "0"])?;
        let mut line = String::new();
        BufReader::new(view.0.stdout.take().ok_or("no output")?).read_line(&mut line)?;
        let address = line.trim().strip_prefix("http://").ok_or("no address")?.to_string();
        Ok((view, address))
    };
    let until = |address: &str, what: &str, seen: &dyn Fn(&serde_json::Value) -> Result<bool, Failure>| -> Outcome {
        let begin = Instant::now();
        loop {
            let state: serde_json::Value = serde_json::from_slice(&http(address, "GET", "/state.json", "")?.1)?;
            if seen(&state)? {
                return Ok(());
            }
            if begin.elapsed() > PATIENCE {
                return Err(format!("not seen: {what}; frame {}, silent {}", state["sequence"], state["silent"]).into());
            }
            std::thread::sleep(Duration::from_millis(5));
        }
    };
    // The numbers tell whose frames are shown, because each process counts the pictures from its own start.
    let measured = std::cell::RefCell::new(Vec::<Feature>::new());
    let is_the_workers = |state: &serde_json::Value| -> Result<bool, Failure> {
        while let Some(feature) = features.receive()? {
            measured.borrow_mut().push(*feature);
        }
        let measured = measured.borrow();
        let newest = measured.last().map_or(0, |f| f.sequence);
        let shown = state["sequence"].as_u64().unwrap_or(0);
        let near = measured.iter().rev().take(60).find(|f| f.sequence == shown && newest < shown + 15);
        Ok(near.is_some_and(|f| f.area_px2 > 0.0 && state["area_px2"].as_f64().map(|a| a as f32) == Some(f.area_px2)))
    };
    let (mut view, address) = view_at(&path)?;
    until(&address, "the view's own frames", &|s| Ok(s["sequence"].as_u64() > Some(60)))?;
    let mut worker = Program::start("run", &path, &[])?;
    until(&address, "the worker's frames", &is_the_workers)?;
    worker.0.kill()?;
    worker.0.wait()?;
    until(&address, "that no frames come", &|s| Ok(s["silent"] == true))?;
    measured.borrow_mut().clear();
    let second = Program::start("run", &path, &[])?;
    until(&address, "the second worker's frames", &|s| Ok(is_the_workers(s)? && s["silent"] == false))?;
    // A view that starts later takes the worker's frames at once.
    let (_later, address_of_later) = view_at(&path)?;
    until(&address_of_later, "the worker's frames in a second view", &is_the_workers)?;
    second.signal("-TERM")?;
    until(&address, "that no frames come", &|s| Ok(s["silent"] == true))?;
    view.signal("-INT")?;
    let (code, said) = view.end()?;
    assert_eq!(code, Some(0), "{said}");
    assert!(said.contains("a worker starts in this cell") && said.matches("no frames for a second").count() == 2, "{said}");
    Ok(())
}

/// Protects people who watch: the view serves its page, the newest picture as a JPEG of the camera's size, and the state as JSON with a
/// history that follows the flow. It answers 404 for everything else. It reads beside a running worker and takes nothing from it.
#[test]
fn the_view_shows_what_the_worker_measures() -> Outcome {
    let directory = tempfile::tempdir()?;
    let (path, config) = write_config(directory.path(), "view", |_| {})?;
    let driver = Driver::new(&config.cell.name)?;
    let _worker = Program::start("run", &path, &[])?;
    driver.wake()?;
    let mut view = Program::start("view", &path, &["--port", "0"])?;
    let mut line = String::new();
    BufReader::new(view.0.stdout.take().ok_or("no output")?).read_line(&mut line)?;
    let address = line.trim().strip_prefix("http://").ok_or("no address")?.to_string();
    let state = || -> Result<serde_json::Value, Failure> { Ok(serde_json::from_slice(&http(&address, "GET", "/state.json", "")?.1)?) };
    while driver.feature(Duration::from_millis(300))?.is_some() {}
    for i in 8..=20 {
        driver.pour(2000 + i as u64, i)?;
        let feature = driver.feature(PATIENCE)?.ok_or("no feature")?;
        assert_eq!(feature.sequence, 2000 + i as u64, "the worker misses no frame");
        let begin = Instant::now();
        while state()?["sequence"] != 2000 + i && begin.elapsed() < PATIENCE {
            std::thread::sleep(Duration::from_millis(5));
        }
        let shown = state()?;
        assert_eq!(shown["area_px2"].as_f64().map(|a| a as f32), Some(feature.area_px2), "{shown}");
    }
    let history = state()?["history"].as_array().cloned().unwrap_or_default();
    assert!(history.len() >= 13 && history.last().and_then(|v| v.as_f64()) > history.first().and_then(|v| v.as_f64()), "{history:?}");
    let (head, body) = http(&address, "GET", "/picture.jpg?7", "")?;
    assert!(head.contains("200") && head.contains("image/jpeg"), "{head}");
    let picture = opencv::imgcodecs::imdecode(&opencv::core::Vector::<u8>::from_slice(&body), opencv::imgcodecs::IMREAD_COLOR)?;
    assert_eq!((picture.cols(), picture.rows()), (WIDTH, HEIGHT));
    let (head, body) = http(&address, "GET", "/", "")?;
    assert!(head.contains("text/html") && String::from_utf8_lossy(&body).contains("view.js"), "{head}");
    assert!(String::from_utf8_lossy(&http(&address, "GET", "/view.js", "")?.1).contains("state.json"));
    assert!(http(&address, "GET", "/etc/passwd", "")?.0.contains("404"));
    view.signal("-INT")?;
    assert_eq!(view.end()?.0, Some(0));
    Ok(())
}

/// Protects calibration in the page: it shows what was found, takes clicks, refuses what cannot be, and writes the file.
#[test]
fn the_calibration_page_takes_clicks_and_writes() -> Outcome {
    let directory = tempfile::tempdir()?;
    let (path, _) = write_config(directory.path(), "clicks", |c| c.image.colour_hsv = [0, 0, 0, 10, 20, 20])?;
    for i in 0..40 {
        let file = directory.path().join(format!("f_{i:03}.png"));
        opencv::imgcodecs::imwrite(file, &pour(i)?, &opencv::core::Vector::new())?;
    }
    let pattern = directory.path().join("f_%03d.png");
    let picture = directory.path().join("look.png");
    let (pattern, picture) = (pattern.display().to_string(), picture.display().to_string());
    let mut page = Program::start("calibrate", &path, &["--page", "--port", "0", "--picture", &picture, &pattern])?;
    let mut errors = BufReader::new(page.0.stderr.take().ok_or("no output")?);
    let address = loop {
        let mut line = String::new();
        assert!(errors.read_line(&mut line)? > 0, "it ended");
        if let Some((_, rest)) = line.split_once("open http://") {
            break rest.split_whitespace().next().unwrap_or("").to_string();
        }
    };
    assert!(http(&address, "GET", "/", "")?.0.contains("text/html"));
    assert!(http(&address, "GET", "/picture.jpg", "")?.0.contains("image/jpeg"));
    let state: serde_json::Value = serde_json::from_slice(&http(&address, "GET", "/state.json", "")?.1)?;
    assert!((state["lip"][0].as_f64().unwrap_or(0.0) - 215.0).abs() < 4.0, "found by itself: {state}");
    let click = |body: &str| -> Result<String, Failure> { Ok(String::from_utf8(http(&address, "POST", "/corner", body)?.1)?) };
    let mut stranger = std::net::TcpStream::connect(&address)?;
    write!(
        stranger,
        "POST /write HTTP/1.1\r\nHost: {address}\r\nOrigin: http://elsewhere.example\r\nContent-Type: application/json\r\nContent-Length: \
         2\r\nConnection: close\r\n\r\n{{}}"
    )?;
    let mut answer = String::new();
    stranger.read_to_string(&mut answer)?;
    assert!(answer.starts_with("HTTP/1.1 403"), "another site's page writes no configuration: {answer}");
    let said = click("nonsense")?;
    assert!(said.contains("expected"), "{said}");
    assert!(!click(r#"{"lip":[639,2],"rim":[639,479],"foot":[0,0]}"#)?.starts_with("measured again"));
    assert!(click(r#"{"lip":[215,250],"rim":[600,250],"foot":[215,470]}"#)?.starts_with("measured again"));
    // A page that shows something else, or does not say what it shows, writes nothing.
    for body in ["", r#"{"section":"[image]"}"#] {
        assert!(String::from_utf8(http(&address, "POST", "/write", body)?.1)?.contains("changed since it was shown"));
    }
    let state: serde_json::Value = serde_json::from_slice(&http(&address, "GET", "/state.json", "")?.1)?;
    let shown = serde_json::json!({ "section": state["section"] }).to_string();
    assert!(String::from_utf8(http(&address, "POST", "/write", &shown)?.1)?.contains("written to"));
    assert_eq!(page.end()?.0, Some(0));
    let written = shared::config::Config::read(&path)?;
    assert_eq!(written.image.x_axis_px, [215.0, 250.0, 600.0, 250.0]);
    let [h0, .., h1, _, _] = written.image.colour_hsv;
    assert!(h0 < 110 && h1 > 110, "the liquid's hue is 110: {:?}", written.image.colour_hsv);
    Ok(())
}
