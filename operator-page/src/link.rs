//! The link to the cell: the one part of the page that touches shared memory, in a process of its own, which the page starts and restarts.
//!
//! If the cell's shared memory is full, cut or taken away, this process may hang or end; the page and its Stop do not. Three ordinary threads:
//! one takes telemetry, features and the recorder's reports, one asks the controller, one takes pictures while somebody looks. They allocate
//! and write what they have to standard output. The process ends when its standard input ends, or with one line that says why. If the page dies
//! while a pour is held, nobody holds it any more: then the link stops it before it ends.

use std::collections::VecDeque;
use std::io::{Stdout, stdin};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed, Ordering::SeqCst};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::{Duration, Instant};

use feature_worker::drawing::{jpeg, shrunk, to_bgr};
use feature_worker::source::{FrameSource as _, NextFrame, SharedMemory, WAIT};
use rt_controller::client::{Client, ClientError};
use rt_controller::stop_client::Target;
use shared::config::Config;
use shared::control::Request;
use shared::exit::{self, Failure, OrExit as _, failure};
use shared::ipc::{Cell, InService as _, IpcError};
use shared::messages::{Feature, PixelFormat, RecorderReport, RecorderState, Telemetry};
use shared::os;
use shared::regular_file;
use shared::runtime_dir::Place;

use crate::wire::{self, FromLink, Measured, Picture, Point, Recorded, ToLink};

/// Pause between two looks at telemetry and features. Chosen by hand: below two frames, and cheap.
const BEAT: Duration = Duration::from_millis(25);
/// Pause between two questions for the state. Chosen by hand: a person sees no difference, and the controller's service thread is free.
const STATUS: Duration = Duration::from_millis(500);
/// Least time between two pictures: below 15 a second.
const PICTURE: Duration = Duration::from_millis(70);
/// Longest wait for what the worker says of a picture. Chosen by hand: it takes some milliseconds.
const MEASURED: Duration = Duration::from_millis(60);
/// Without a frame for this long the camera is called silent. Chosen by hand: as `feature-worker view`.
const SILENT: Duration = Duration::from_secs(1);
/// Number of the worker's measurements that are kept for pictures: two seconds of them.
const KEPT: usize = 64;
/// Largest width of a picture for the page, px. Chosen by hand: a phone shows less, and a wider one costs time.
const WIDTH_MAX: i32 = 960;

/// Largest file with the name of the cell's shared memory that is read, bytes. Chosen by hand: it has some digits.
const TOKEN_MAX: u64 = 64;

/// The newest measurements of the worker.
type Newest = Mutex<VecDeque<Measured>>;

/// Whether a pour is held: it ends with the page and with this process.
static HELD: AtomicBool = AtomicBool::new(false);
/// The cell's place, for the end of a held pour.
static PLACE: OnceLock<Place> = OnceLock::new();

/// Runs the link until standard input ends.
pub fn run(file: &Path) -> Result<(), Failure> {
    let config = Config::read(file).or_exit(exit::BAD_INPUT)?;
    exit::explain_panics("operator-page link");
    let place = Place::from(&config.cell);
    let _ = PLACE.set(place.clone());
    // A signal to all processes of a terminal or a service ends the page first, which then closes standard input.
    let _stopped = os::stop_at_signals().or_exit(exit::FAILED)?;
    let token = place.path().join("token");
    opencv_threads()?;
    let (look, newest) = (Arc::new(AtomicBool::new(false)), Arc::new(Newest::default()));
    let (asks, asked) = channel();
    let spawn = |name: &str, work: Box<dyn FnOnce() + Send>| std::thread::Builder::new().name(name.into()).spawn(work).map(drop);
    let (of_telemetry, of_asker, of_camera) = (place.clone(), place.clone(), place.clone());
    let (measured, looking, seen) = (Arc::clone(&newest), Arc::clone(&look), newest);
    spawn("telemetry", Box::new(move || end_with(telemetry(&of_telemetry, &token, &measured)))).or_exit(exit::FAILED)?;
    spawn("asker", Box::new(move || asker(&of_asker, &asked))).or_exit(exit::FAILED)?;
    spawn("camera", Box::new(move || camera(&of_camera, &looking, &seen))).or_exit(exit::FAILED)?;
    let mut input = stdin().lock();
    while let Ok(message) = wire::read::<ToLink>(&mut input) {
        match message {
            ToLink::Look(on) => look.store(on, Relaxed),
            ToLink::Hold(on) => HELD.store(on, SeqCst),
            ToLink::Ask(number, request) => {
                if asks.send((number, request)).is_err() {
                    break;
                }
            }
        }
    }
    end_held();
    Ok(())
}

/// Ends a pour that is held, because this process or the page ends.
fn end_held() {
    if let (true, Some(place)) = (HELD.swap(false, SeqCst), PLACE.get()) {
        Target::from(place.clone()).ask("abort");
    }
}

/// Ends the process, and with it a pour that is held.
fn leave(code: u8) -> ! {
    end_held();
    std::process::exit(code.into())
}

fn opencv_threads() -> Result<(), Failure> {
    feature_worker::drawing::one_thread().map_err(|e| failure(exit::FAILED, e))
}

/// Sends a message to the page. Without a page there is nothing left to do.
fn send(message: &FromLink, around_bytes: usize) {
    let mut output: std::io::StdoutLock<'_> = Stdout::lock(&std::io::stdout());
    if wire::write(&mut output, message, around_bytes).is_err() {
        leave(exit::FAILED);
    }
}

/// Ends the process if what a thread did cannot go on.
fn end_with(result: Result<(), IpcError>) {
    if let Err(e) = result {
        send(&FromLink::Broken(e.to_string()), 0);
        leave(exit::UNREACHABLE);
    }
}

/// Takes telemetry, features and reports. It ends when the cell's shared memory is no longer the one that was joined.
fn telemetry(place: &Place, token: &Path, newest: &Newest) -> Result<(), IpcError> {
    let cell = Cell::join(place)?;
    let ticks = cell.telemetry()?.subscriber_builder().create().in_service("telemetry")?;
    let features = cell.features()?.subscriber_builder().create().in_service("feature")?;
    let reports = cell.recorder()?.subscriber_builder().create().in_service("recorder")?;
    cell.reserve()?;
    let joined = regular_file::read(token, TOKEN_MAX).ok();
    let mut doubts: VecDeque<Measured> = VecDeque::new();
    let mut looked = Instant::now();
    loop {
        while let Ok(Some(feature)) = features.receive() {
            doubts.push_back(measured(&feature));
            if doubts.len() > KEPT {
                doubts.pop_front();
            }
        }
        newest.lock().unwrap_or_else(PoisonError::into_inner).clone_from(&doubts);
        let mut points = Vec::new();
        while let Ok(Some(tick)) = ticks.receive() {
            points.push(point(&tick, &doubts));
        }
        if !points.is_empty() {
            send(&FromLink::Points(points), 0);
        }
        while let Ok(Some(report)) = reports.receive() {
            recorded(&report);
        }
        if looked.elapsed() > SILENT {
            looked = Instant::now();
            if regular_file::read(token, TOKEN_MAX).ok() != joined {
                send(&FromLink::Broken("the cell's shared memory was made anew".into()), 0);
                leave(exit::UNREACHABLE);
            }
        }
        std::thread::sleep(BEAT);
    }
}

fn measured(f: &Feature) -> Measured {
    let Feature { doubt, sequence, area_px2, confidence, triangle_px, .. } = *f;
    Measured { sequence, area_px2, confidence, doubt, triangle_px }
}

fn point(t: &Telemetry, doubts: &VecDeque<Measured>) -> Point {
    let doubt = doubts.iter().rev().find(|m| m.sequence == t.feature_sequence).map_or(0, |m| m.doubt);
    Point {
        tick: t.tick,
        at_ns: t.at_ns,
        phase: t.phase,
        episode: t.episode,
        alpha_deg: t.alpha_deg,
        alpha_measured_deg: t.alpha_measured_deg,
        area_px2: t.area_px2,
        d_ml: t.d_ml,
        goal_ml: t.goal_ml,
        poured_ml: t.poured_ml,
        poured_sd_ml: t.poured_sd_ml,
        doubt,
    }
}

fn recorded(report: &RecorderReport) {
    let text = report.text().to_string();
    let file = match RecorderState::from_code(report.state) {
        RecorderState::Writing => return,
        RecorderState::Complete => Ok(text),
        RecorderState::Failed => Err(text),
    };
    send(&FromLink::Recorded(Recorded { episode: report.episode, file }), 0);
}

/// Asks the controller what the page wants to know, and for its state twice a second. A connection that gave no answer is made anew.
fn asker(place: &Place, asked: &Receiver<(u64, Request)>) {
    let mut client = None;
    let mut due = Instant::now();
    loop {
        let ask = match asked.recv_timeout(due.saturating_duration_since(Instant::now())) {
            Ok((number, request)) => Some((number, request)),
            Err(RecvTimeoutError::Timeout) => None,
            Err(RecvTimeoutError::Disconnected) => return,
        };
        let request = ask.as_ref().map_or(&Request::Status, |(_, request)| request);
        let answer = connected(&mut client, place).and_then(|c| c.ask(request));
        if matches!(answer, Err(ClientError::NoAnswer { .. } | ClientError::Ipc(_))) {
            client = None;
        }
        let answer = answer.map_err(|e| e.to_string());
        match (ask, answer) {
            (Some((number, _)), answer) => send(&FromLink::Answer(number, answer), 0),
            (None, Ok(shared::control::Reply::Status(status))) => send(&FromLink::Status(status), 0),
            (None, Ok(_)) => send(&FromLink::NoStatus(ClientError::Version.to_string()), 0),
            (None, Err(e)) => send(&FromLink::NoStatus(e), 0),
        }
        if due <= Instant::now() {
            due = Instant::now() + STATUS;
        }
    }
}

/// The connection to the controller, which is made if there is none.
fn connected<'a>(client: &'a mut Option<Client>, place: &Place) -> Result<&'a Client, ClientError> {
    if client.is_none() {
        *client = Some(Client::connect(place)?);
    }
    client.as_ref().ok_or(ClientError::NoAnswer { cell: place.name.clone() })
}

/// Takes pictures while somebody looks, and lets go of the frames when nobody does, so that the worker need not publish them.
fn camera(place: &Place, look: &AtomicBool, newest: &Newest) {
    loop {
        if look.load(Relaxed)
            && let Err(e) = pictures(place, look, newest)
        {
            send(&FromLink::NoPicture(e), 0);
        }
        std::thread::sleep(WAIT);
    }
}

fn pictures(place: &Place, look: &AtomicBool, newest: &Newest) -> Result<(), String> {
    let cell = Cell::join(place).map_err(|e| e.to_string())?;
    let mut source = SharedMemory::open(&cell).map_err(|e| e.to_string())?;
    let (mut last, mut sent) = (Instant::now(), Instant::now());
    while look.load(Relaxed) {
        match source.next_frame(WAIT).map_err(|e| e.to_string())? {
            NextFrame::Frame(frame) => {
                last = Instant::now();
                if sent.elapsed() < PICTURE {
                    continue;
                }
                sent = last;
                let header = frame.header;
                let bytes = PixelFormat::from_code(header.format).map_or(0, PixelFormat::bytes_per_pixel);
                if frame.pixels.len() != header.width_px as usize * header.height_px as usize * bytes {
                    return Err("the camera's frames have another format than they say: look at the camera's driver".into());
                }
                let small = to_bgr(&frame).and_then(|bgr| shrunk(&bgr, WIDTH_MAX)).map_err(|e| e.message)?;
                let jpeg = jpeg(&small);
                let around = jpeg.len();
                let size_px = (header.width_px, header.height_px);
                let measured = said_of(header.sequence, newest);
                send(&FromLink::Picture(Picture { sequence: header.sequence, size_px, measured, jpeg }), around);
            }
            NextFrame::Nothing if last.elapsed() > SILENT => {
                last = Instant::now();
                let what = "no frames for a second: is the camera connected, and does `feature-worker run` run?";
                send(&FromLink::NoPicture(what.into()), 0);
            }
            NextFrame::Nothing => {}
            NextFrame::End => return Ok(()),
        }
    }
    Ok(())
}

/// What the worker says of a frame; none if it says nothing in time.
fn said_of(sequence: u64, newest: &Newest) -> Option<Measured> {
    let until = Instant::now() + MEASURED;
    loop {
        {
            let newest = newest.lock().unwrap_or_else(PoisonError::into_inner);
            if let Some(found) = newest.iter().rev().find(|m| m.sequence == sequence) {
                return Some(*found);
            }
            if newest.back().is_some_and(|m| m.sequence > sequence) {
                return None;
            }
        }
        if Instant::now() > until {
            return None;
        }
        std::thread::sleep(Duration::from_millis(5));
    }
}
