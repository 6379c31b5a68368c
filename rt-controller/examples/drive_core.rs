//! Drives the controller's core from a simulator of your own: no sockets, no shared memory, no robot.
//!
//! You learn from it what [`Core::step`] needs in each tick, which is the time, the newest measurements and the robot's state, and what
//! it answers, which is the angle to command and the result of a pour that has ended. The simulator below is a cylinder that leaks the
//! faster the further it is tilted, a robot that follows at once, and a camera that sees a stream's area. Replace it with your own.
//!
//! Run it with `cargo run --release -p rt-controller --example drive_core`.

use rt_controller::core::{Core, Input, Order, Robot, Settings};
use shared::actions::{Selection, action_table};
use shared::agent::Agent;
use shared::control::Outcome;
use shared::estimator::Calibration;
use shared::framing::Framing;
use shared::limits::Limits;
use shared::messages::{Feature, LAYOUT_VERSION};
use shared::mlp::{InputScale, Mlp};
use shared::weights::{Estimator, Method, Origin, Weights};

/// Period of a tick and of a camera frame, ns.
const PERIOD_NS: u64 = 33_333_333;
/// How much older than its tick a picture is, ns.
const DELAY_NS: u64 = 20_000_000;
/// V_e of a stream of 1 ml a frame, px^2.
const AREA_OF_1_ML_PX2: f32 = 1000.0;

/// The simulator: what stands around the core.
struct Cylinder {
    now_ns: u64,
    frame: u64,
    alpha_deg: f32,
    /// Volume that has left the cylinder, ml.
    poured_ml: f32,
}

impl Cylinder {
    /// Moves on by one period at the commanded angle, and gives what the camera then sees.
    fn step(&mut self) -> Feature {
        self.now_ns += PERIOD_NS;
        self.frame += 1;
        // A full cylinder begins to pour at 40 degrees; the more has left it, the further it must be tilted.
        let lip_deg = 40.0 + 0.2 * self.poured_ml;
        let outflow_ml = 0.04 * (self.alpha_deg - lip_deg).max(0.0);
        self.poured_ml += outflow_ml;
        Feature {
            version: LAYOUT_VERSION,
            sequence: self.frame,
            worker_epoch_ns: 1,
            captured_at_ns: self.now_ns - DELAY_NS,
            published_at_ns: self.now_ns,
            area_px2: AREA_OF_1_ML_PX2 * outflow_ml,
            confidence: 1.0,
            ..Feature::default()
        }
    }
}

/// Makes weights by hand. The network always asks for the action i = 3, which is 0.45 degrees a frame. The agent turns back by itself when
/// the goal is reached. A trained network would slow down before that.
fn weights() -> Weights {
    let mut network = Mlp::ZERO;
    network.b3[13] = 1.0;
    Weights {
        network,
        actions_deg: action_table(),
        selection: Selection::Argmax,
        scale: InputScale::default(),
        calibration: Calibration {
            volume_at_1_px2_ml: 1.0 / AREA_OF_1_ML_PX2,
            area_exponent: 1.0,
            log_tilt_slope: 0.0,
            hold_above_px2: f32::INFINITY,
        },
        estimator: Estimator::Sum,
        rate_hz: 30.0,
        origin: Origin { method: Method::Handmade, actions: 21, episodes: 0, data_sha256: [0; 32], framing: Framing::default() },
        seed: 0,
    }
}

/// Pours `goal_ml`; gives the core's result and the volume that has really left the cylinder, ml.
pub fn pour(goal_ml: f32) -> (Outcome, f32) {
    let settings = Settings {
        period_ns: PERIOD_NS,
        frame_ns: PERIOD_NS,
        limits: Limits::default(),
        stale_ns: 200_000_000,
        max_frames: 900,
        empty_frames: 60,
        goal_max_ml: 300.0,
        upright_deg: 2.0,
        patience_ns: 100_000_000,
        usual_lag_ns: 156_000_000,
    };
    let mut core = Core::new(settings);
    core.exchange(Box::new(Agent::new(&weights())));
    let mut cylinder = Cylinder { now_ns: 1_000_000_000, frame: 0, alpha_deg: 0.0, poured_ml: 0.0 };
    loop {
        let feature = cylinder.step();
        // In the first tick the core finds that the robot may move and is upright; then the goal can be set.
        let order = (cylinder.frame == 2).then_some(Order::Pour { episode: 1, goal_ml, flows_by_deg: None });
        let robot = Robot::that_may_move(cylinder.alpha_deg, cylinder.now_ns);
        let output = core.step(&Input { now_ns: cylinder.now_ns, features: &[feature], robot, order });
        if let Some(Err(refusal)) = output.ordered {
            println!("refused: {refusal}");
        }
        if let Some(target_deg) = output.target_deg {
            cylinder.alpha_deg = target_deg;
        }
        if cylinder.frame.is_multiple_of(15) {
            let t = output.telemetry;
            println!(
                "{:5.1} s  alpha {:6.2} deg  V_e {:6.0} px^2  d {:6.2} ml",
                cylinder.frame as f32 / 30.0,
                t.alpha_deg,
                t.area_px2,
                t.d_ml
            );
        }
        if let Some(outcome) = output.ended {
            return (outcome, cylinder.poured_ml);
        }
    }
}

fn main() {
    let (outcome, poured_ml) = pour(30.0);
    println!("{}: the core counted {:.2} ml, the cylinder poured {poured_ml:.2} ml", outcome.reason.words(), outcome.poured_ml);
}
