//! The simulated cell in real time: UR5 controller, a container on its wrist, camera, kitchen scale, operator.
//!
//! Threads: the UR controller has its own (see [`crate::ur`]); "physics" moves the liquid every 4 ms with the tilt that the simulated
//! joint really has; "camera" renders and publishes frames; the main thread serves the operator's socket. All of them allocate. The cell
//! offers what a real one offers: RTDE and script ports, and camera frames in shared memory. The truth leaves it only as pixels, as joint
//! angles and, after a pour, as the scale's reading. An error at the start is one line. When the camera fails later, the process ends, so
//! that nobody measures half a cell.

use std::io::{BufRead, BufReader, Write};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use serde::{Deserialize, Serialize};
use shared::config::Config;
use shared::ipc::Cell;
use shared::messages::{FrameHeader, LAYOUT_VERSION, PixelFormat};
use shared::os;
use shared::runtime_dir::Place;

use crate::camera::{Renderer, Scene, View};
use crate::physics::container::Container;
use crate::physics::rig::Rig;
use crate::ur;

/// SCHED_FIFO priority of the liquid, where permitted: a real liquid does not wait for the machine's other work. It is below the
/// priorities of the programs under test in `config/sim.toml`.
const LIQUID_PRIORITY: u8 = 60;
/// SCHED_FIFO priority of the camera, where permitted: below the liquid's, because a late picture does less harm than a late liquid.
const CAMERA_PRIORITY: u8 = 50;
/// Step of the liquid, ns: half of a CB3's control period, and short against the film's time constant.
const PHYSICS_NS: u64 = 4_000_000;

/// The table `[simulator]` of the configuration.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimulatorConfig {
    /// Draws the rig (container, lip, liquid and camera, see [`Rig::seeded`]) and all noise.
    pub seed: u64,
    /// Which UR controller: `cb3` (3.15, 125 Hz) or `e-series` (5.x, 500 Hz).
    pub series: ur::Series,
    /// Container: `cylinder`, `cone-in`, `cone-out`, `bottle` or `jug`.
    pub container: String,
    /// Volume in the container at the start, ml.
    pub fill_ml: f64,
    /// Time from the middle of the exposure until the frame is published, ms.
    pub camera_delay_ms: u32,
    /// Share of frames that the camera loses.
    pub camera_loss: f64,
    /// The camera's view.
    pub view: View,
}

impl Default for SimulatorConfig {
    fn default() -> Self {
        Self {
            seed: 1,
            series: ur::Series::Cb3,
            container: "cylinder".into(),
            fill_ml: 300.0,
            camera_delay_ms: 25,
            camera_loss: 0.002,
            view: View::default(),
        }
    }
}

impl SimulatorConfig {
    /// Reads and checks the table `[simulator]`.
    ///
    /// # Errors
    /// One line for the operator, when the table is missing or a value is not allowed.
    pub fn new(config: &Config) -> Result<Self, String> {
        let table = config.simulator.clone().ok_or("no table [simulator]: this is not a simulated cell's configuration")?;
        let this: Self = toml::Value::Table(table).try_into().map_err(|e: toml::de::Error| format!("[simulator]: {}", e.message()))?;
        let rules = [
            ("fill_ml", this.fill_ml, 0.0, 2000.0),
            ("camera_delay_ms", this.camera_delay_ms.into(), 0.0, 200.0),
            ("camera_loss", this.camera_loss, 0.0, 0.5),
            ("view.px_per_mm", this.view.px_per_mm, 1.0, 50.0),
        ];
        for (key, value, low, high) in rules {
            if !(value >= low && value <= high) {
                return Err(format!("simulator.{key} = {value}: allowed is {low} to {high}"));
            }
        }
        if Rig::seeded(this.seed).with_container(&this.container).is_none() {
            return Err(format!("simulator.container = '{}': allowed is cylinder, cone-in, cone-out, bottle or jug", this.container));
        }
        let size = (this.view.width_px, this.view.height_px);
        if size != (config.camera.width_px, config.camera.height_px) {
            return Err(format!(
                "simulator.view is {} x {} px, but [camera] says {} x {}; give both the same size",
                size.0, size.1, config.camera.width_px, config.camera.height_px
            ));
        }
        Ok(this)
    }

    /// The rig that the seed and the container's name stand for.
    pub fn rig(&self) -> Rig {
        Rig::seeded(self.seed).with_container(&self.container).unwrap_or_else(|| Rig::seeded(self.seed))
    }
}

/// Path of the operator's socket of the cell `place`.
pub fn operator_socket(place: impl Into<Place>) -> PathBuf {
    place.into().path().join("operator")
}

/// What the threads of the cell share.
struct CellState {
    container: Mutex<Container>,
    rig: Rig,
    robot: ur::Controller,
    config: Config,
    simulated: SimulatorConfig,
    stop: Arc<AtomicBool>,
}

impl CellState {
    fn container(&self) -> MutexGuard<'_, Container> {
        self.container.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The container's actual tilt in degrees, and its rate in degrees/s.
    fn tilt(&self) -> (f64, f64) {
        let robot = &self.config.robot;
        let (joints, i) = (self.robot.joints(), robot.joint.index());
        let alpha_deg = robot.direction * (joints.actual_q[i].to_degrees() - robot.start_joint_deg);
        (alpha_deg, robot.direction * joints.actual_qd[i].to_degrees())
    }
}

/// Whether this cell is being simulated already.
pub fn runs(place: impl Into<Place>) -> bool {
    UnixStream::connect(operator_socket(place)).is_ok()
}

/// Runs the cell until it is asked to stop or its camera fails.
///
/// # Errors
/// When the robot's ports, the cell's shared memory or the operator's socket cannot be had, or the camera fails.
pub fn simulate(config: Config, simulated: SimulatorConfig) -> Result<(), Box<dyn std::error::Error>> {
    let stop = os::stop_at_signals()?;
    let address = config.robot.address.resolve()?;
    let mut start_q_rad = [0.0, -1.571, 1.571, -1.571, -1.571, 0.0];
    start_q_rad[config.robot.joint.index()] = config.robot.start_joint_deg.to_radians();
    let robot =
        ur::Controller::start(ur::ControllerOptions { series: simulated.series, start_q_rad, ..ur::ControllerOptions::new(address) })?;
    let rig = simulated.rig();
    let state = CellState { container: Mutex::new(rig.container(simulated.fill_ml)), rig, robot, config, simulated, stop };

    let lost = "simulator: shared memory vanished: /dev/shm is full, or a file there was cut. The simulated cell ends";
    os::explain_bus_errors(lost, shared::exit::FAILED, Arc::clone(&state.stop));
    let cell = Cell::join(&state.config.cell)?;
    let view = &state.simulated.view;
    // The driver has room for 17 frames.
    cell.check_space(18 * u64::from(view.width_px) * u64::from(view.height_px) * PixelFormat::Bgr8.bytes_per_pixel() as u64)?;
    let socket = operator_socket(&state.config.cell);
    let _ = std::fs::remove_file(&socket);
    let listener = UnixListener::bind(&socket)?;
    listener.set_nonblocking(true)?;
    eprintln!("simulator: cell '{}' is up, UR5 controller on {}", state.config.cell.name, state.config.robot.address);

    let result = std::thread::scope(|scope| {
        scope.spawn(|| move_liquid(&state));
        let camera = scope.spawn(|| {
            let result = film(&state);
            state.stop.store(true, Relaxed);
            result
        });
        serve_operator(&state, &listener);
        camera.join().unwrap_or_else(|_| Err("the camera thread failed".into()))
    });
    let _ = std::fs::remove_file(&socket);
    drop(cell);
    result.map_err(Into::into)
}

/// The time one period after `at_ns`. If that is more than a second ago, it is the present time: the process was suspended, and no
/// time passed in the cell.
fn after(at_ns: u64, period_ns: u64) -> u64 {
    let next_ns = at_ns + period_ns;
    let now_ns = os::now_ns();
    if now_ns > next_ns + 1_000_000_000 { now_ns } else { next_ns }
}

/// The thread "physics".
fn move_liquid(state: &CellState) {
    if let Err(line) = os::prioritise(LIQUID_PRIORITY) {
        eprintln!("simulator: {line}");
    }
    let mut next_ns = os::now_ns();
    while !state.stop.load(Relaxed) {
        next_ns = after(next_ns, PHYSICS_NS);
        os::sleep_until_ns(next_ns);
        let (alpha_deg, _) = state.tilt();
        state.container().step(PHYSICS_NS as f64 / 1e9, alpha_deg);
    }
}

/// The thread "camera".
fn film(state: &CellState) -> Result<(), String> {
    let words = |e: &dyn std::fmt::Debug| format!("camera: {e:?}");
    let _ = os::prioritise(CAMERA_PRIORITY); // If that is not permitted, the liquid's thread has said so.
    let cell = Cell::join(&state.config.cell).map_err(|e| e.to_string())?;
    let topic = cell.frames().map_err(|e| e.to_string())?;
    let view = &state.simulated.view;
    let bytes = view.width_px as usize * view.height_px as usize * PixelFormat::Bgr8.bytes_per_pixel();
    let publisher = topic.publisher_builder().initial_max_slice_len(bytes).create().map_err(|e| words(&e))?;
    let notifier = cell.frame_notifier().map_err(|e| e.to_string())?;
    let mut renderer = Renderer::new(view, state.simulated.seed).map_err(|e| e.to_string())?;
    let mut random = Pcg64Mcg::seed_from_u64(state.simulated.seed ^ 0xCA_3E_2A);
    let mut pixels = vec![0; bytes];
    let period_ns = (1e9 / state.config.camera.fps) as u64;
    let delay_ns = u64::from(state.simulated.camera_delay_ms) * 1_000_000;
    let (mut sequence, mut captured_at_ns) = (0, os::now_ns());
    while !state.stop.load(Relaxed) {
        captured_at_ns = after(captured_at_ns, period_ns);
        sequence += 1;
        // A camera that is not done in time loses frames instead of sending them later and later. After a suspension none are lost, because
        // `after` began anew.
        while captured_at_ns + delay_ns + period_ns < os::now_ns() {
            captured_at_ns += period_ns;
            sequence += 1;
        }
        os::sleep_until_ns(captured_at_ns);
        let (alpha_deg, rate_deg_s) = state.tilt();
        let scene = Scene::of(&state.container(), captured_at_ns as f64 / 1e9, alpha_deg, rate_deg_s);
        renderer.render(&scene, &mut pixels).map_err(|e| e.to_string())?;
        if random.random::<f64>() < state.simulated.camera_loss {
            continue;
        }
        os::sleep_until_ns(captured_at_ns + delay_ns);
        let mut loan = publisher.loan_slice_uninit(bytes).map_err(|e| words(&e))?;
        *loan.user_header_mut() = FrameHeader {
            version: LAYOUT_VERSION,
            format: PixelFormat::Bgr8 as u32,
            width_px: view.width_px,
            height_px: view.height_px,
            sequence,
            captured_at_ns,
            published_at_ns: os::now_ns(),
        };
        loan.write_from_slice(&pixels).send().map_err(|e| words(&e))?;
        notifier.notify().map_err(|e| words(&e))?;
    }
    Ok(())
}

/// The main thread: reads one line of words and answers with one line of JSON; see [`crate::commands::operator`].
fn serve_operator(state: &CellState, listener: &UnixListener) {
    let mut noise = Pcg64Mcg::seed_from_u64(state.simulated.seed ^ 0x5C_A1_E0);
    while !state.stop.load(Relaxed) {
        match listener.accept() {
            Ok((stream, _)) => {
                let _ = answer(state, &mut noise, &stream);
            }
            Err(_) => std::thread::sleep(Duration::from_millis(20)),
        }
    }
}

fn answer(state: &CellState, noise: &mut Pcg64Mcg, mut stream: &UnixStream) -> std::io::Result<()> {
    stream.set_nonblocking(false)?;
    stream.set_read_timeout(Some(Duration::from_secs(1)))?;
    let mut line = String::new();
    BufReader::new(stream).read_line(&mut line)?;
    let reply = match obey(state, noise, line.trim()) {
        Ok(value) => value,
        Err(error) => serde_json::json!({ "error": error }),
    };
    writeln!(stream, "{reply}")
}

fn obey(state: &CellState, noise: &mut Pcg64Mcg, line: &str) -> Result<serde_json::Value, String> {
    let (verb, rest) = line.split_once(' ').unwrap_or((line, ""));
    match verb {
        "fill" => {
            let volume_ml: f64 = rest.parse().map_err(|_| format!("'{rest}' is no volume in ml"))?;
            let mut container = state.container();
            if !(volume_ml >= 0.0 && volume_ml <= container.fill_max_ml()) {
                return Err(format!("{volume_ml} ml: this container takes 0 to {:.0} ml", container.fill_max_ml()));
            }
            *container = state.rig.container(volume_ml);
            Ok(serde_json::json!({ "filled_ml": volume_ml }))
        }
        "scale" => {
            // A kitchen scale has an error of about half a gram and shows whole grams.
            let error_g = 0.5 * noise.sample::<f64, _>(rand_distr::StandardNormal);
            Ok(serde_json::json!({ "weight_g": (state.container().poured_ml() + error_g).round().max(0.0) }))
        }
        _ => Err(format!("'{verb}' is nothing that an operator can do here; use fill or scale")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects a cell that was suspended from catching up: the camera shows the present, and nothing flows in a time that nobody saw.
    #[test]
    fn a_suspended_cell_goes_on_from_now() {
        let now_ns = os::now_ns();
        assert_eq!(after(now_ns, 33), now_ns + 33);
        assert_eq!(after(now_ns - 500_000_000, 33), now_ns - 500_000_000 + 33, "a late wake-up is caught up");
        assert!(after(now_ns - 5_000_000_000, 33) >= now_ns);
    }
}
