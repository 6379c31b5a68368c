//! The controller's core with a toy container that leaks: phases, endings, limits, weights, and bridging. The tests use no process and no
//! clock.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

mod camera;

use rt_controller::core::{Core, Input, Order, Output, Refusal, Robot, Settings};
use shared::actions::{Selection, action_table};
use shared::agent::Agent;
use shared::config::Config;
use shared::control::{EndReason, Outcome};
use shared::estimator::Calibration;
use shared::framing::Framing;
use shared::gaussian_curve::Curve;
use shared::messages::{Doubt, Feature, LAYOUT_VERSION, Phase};
use shared::mlp::{InputScale, Mlp};
use shared::weights::{Estimator, Method, Origin, Weights};

/// An agent that always chooses the action `index`; 1 px^2 is 0.001 ml.
fn always(index: usize) -> Box<Agent> {
    always_in(index, Framing::default())
}

/// The same, trained on pictures in which the lip lies so.
fn always_in(index: usize, framing: Framing) -> Box<Agent> {
    let mut network = Mlp::ZERO;
    network.b3[index] = 1.0;
    Box::new(Agent::new(&Weights {
        network,
        actions_deg: action_table(),
        selection: Selection::Argmax,
        scale: InputScale::default(),
        calibration: Calibration { volume_at_1_px2_ml: 0.001, area_exponent: 1.0, log_tilt_slope: 0.0, hold_above_px2: f32::INFINITY },
        estimator: Estimator::Sum,
        rate_hz: 30.0,
        origin: Origin { method: Method::Handmade, actions: 21, episodes: 0, data_sha256: [0; 32], framing },
        seed: 1,
    }))
}

/// The cell around the core: a robot that follows at once, a container that leaks from 40 degrees on, and a camera.
struct ToyCell {
    core: Core,
    now_ns: u64,
    sequence: u64,
    epoch_ns: u64,
    alpha_deg: f32,
    hindrance: Option<EndReason>,
    speed_scaling: Option<f32>,
    /// Largest rate of the joint, degrees/s.
    joint_deg_s: f32,
    doubt: Doubt,
    camera: bool,
    dry: bool,
    /// Whether a bead at the lip is taken for a stream.
    bead: bool,
    settings: Settings,
    out_ml: f32,
    largest_rate_deg_s: f32,
    /// How far the camera driver's clock is ahead of the controller's, ns.
    clock_ahead_ns: u64,
    /// How the lip lies in the camera's pictures.
    framing: Framing,
    last_ended: Option<Outcome>,
}

impl ToyCell {
    fn new() -> Self {
        let config =
            Config::parse(include_str!("../../../config/sim.toml"), "config/sim.toml").expect("the shipped configuration is valid");
        let settings = Settings::new(&config);
        let mut core = Core::new(settings);
        core.exchange(always(13));
        let mut cell = Self {
            core,
            now_ns: 1_000_000_000,
            sequence: 0,
            epoch_ns: 7,
            alpha_deg: 0.0,
            hindrance: None,
            speed_scaling: None,
            joint_deg_s: f32::INFINITY,
            doubt: Doubt::None,
            camera: true,
            dry: false,
            bead: false,
            settings,
            out_ml: 0.0,
            largest_rate_deg_s: 0.0,
            clock_ahead_ns: 0,
            framing: Framing::default(),
            last_ended: None,
        };
        cell.tick(None);
        cell
    }

    fn feature(&mut self) -> Feature {
        self.sequence += 1;
        let area_px2 = if self.bead {
            90.0
        } else if self.dry {
            0.0
        } else {
            40.0 * (self.alpha_deg - 40.0).max(0.0)
        };
        self.out_ml += area_px2 * 0.001;
        Feature {
            version: LAYOUT_VERSION,
            doubt: self.doubt as u32,
            sequence: self.sequence,
            worker_epoch_ns: self.epoch_ns,
            captured_at_ns: self.now_ns - 20_000_000 + self.clock_ahead_ns,
            received_at_ns: self.now_ns - 1_000_000,
            published_at_ns: self.now_ns - 500_000,
            area_px2,
            confidence: 1.0,
            triangle_px: [0.0; 6],
            framing: self.framing,
        }
    }

    fn tick(&mut self, order: Option<Order>) -> Output {
        self.now_ns += self.settings.period_ns;
        let fresh = if self.camera { vec![self.feature()] } else { vec![] };
        self.step(&fresh, order)
    }

    fn step(&mut self, features: &[Feature], order: Option<Order>) -> Output {
        let Self { hindrance, speed_scaling, .. } = *self;
        let robot = Robot { hindrance, speed_scaling, ..Robot::that_may_move(self.alpha_deg, self.now_ns) };
        let output = self.core.step(&Input { now_ns: self.now_ns, features, robot, order });
        if let Some(target_deg) = output.target_deg {
            let rate = (target_deg - self.alpha_deg).abs() / (self.settings.period_ns as f32 / 1e9);
            self.largest_rate_deg_s = self.largest_rate_deg_s.max(rate);
            let most_deg = self.joint_deg_s * self.settings.period_ns as f32 / 1e9;
            self.alpha_deg += (target_deg - self.alpha_deg).clamp(-most_deg, most_deg);
        }
        output
    }

    /// Runs a tick in which the joint is not where it was commanded.
    fn tick_with_joint_at(&mut self, alpha_deg: f32) {
        self.alpha_deg = alpha_deg;
        let output = self.tick(None);
        self.last_ended = output.ended.or(self.last_ended);
    }

    fn pour(&mut self, goal_ml: f32) -> Result<(), Refusal> {
        self.tick(Some(Order::Pour { episode: 5, goal_ml, flows_by_deg: None })).ordered.expect("an order is answered in its tick")
    }

    /// Runs ticks until the pour has ended.
    fn finish(&mut self) -> Outcome {
        for _ in 0..2000 {
            if let Some(outcome) = self.tick(None).ended {
                return outcome;
            }
        }
        panic!("the pour never ended, phase {:?}", self.core.phase());
    }

    fn run_to_flow(&mut self) {
        while self.alpha_deg < 45.0 {
            self.tick(None);
        }
    }
}

/// Protects section 3.3.2's beginning: with d = 0 the controller does nothing and stays at the start.
#[test]
fn idle_it_stays_at_the_start() {
    let mut cell = ToyCell::new();
    for _ in 0..100 {
        assert_eq!(cell.tick(None).target_deg, Some(0.0));
    }
    assert_eq!(cell.core.phase(), Phase::Idle);
}

/// Protects whoever stands beside a robot that has just been connected: a joint that was found within the tolerance of upright stays there until an
/// operator orders something.
#[test]
fn nothing_moves_before_somebody_asks() {
    let mut cell = ToyCell::new();
    cell.core = Core::new(cell.settings);
    cell.core.exchange(always(13));
    cell.alpha_deg = 1.9;
    for _ in 0..100 {
        assert_eq!(cell.tick(None).target_deg, Some(1.9));
    }
    cell.tick(Some(Order::Abort));
    for _ in 0..100 {
        cell.tick(None);
    }
    assert_eq!((cell.alpha_deg, cell.core.phase()), (0.0, Phase::Idle), "an abort brings it upright");
}

/// Protects the pour: it tilts, counts, returns to the start angle when d reaches 0, and reports what flowed.
#[test]
fn a_pour_ends_upright_with_its_volume() {
    let mut cell = ToyCell::new();
    cell.pour(8.0).expect("ready");
    let outcome = cell.finish();
    assert_eq!((outcome.reason, outcome.episode, outcome.goal_ml), (EndReason::Done, 5, Some(8.0)));
    assert_eq!((cell.alpha_deg, cell.core.phase()), (0.0, Phase::Idle));
    assert!((outcome.poured_ml - cell.out_ml).abs() < 0.05, "reported {}, really {}", outcome.poured_ml, cell.out_ml);
    assert!(outcome.poured_ml >= 8.0 && outcome.bridged_frames == 0);
    assert!(cell.largest_rate_deg_s <= 90.01);
    cell.pour(3.0).expect("the next pour starts");
}

/// Protects the agent's action when the loop is faster than the camera: an action takes several ticks under the limits, and no more.
#[test]
fn an_action_is_finished_between_frames() {
    let mut cell = ToyCell::new();
    cell.settings.period_ns = 8_000_000;
    cell.core = Core::new(cell.settings);
    cell.core.exchange(always(17));
    cell.tick(None);
    cell.pour(50.0).expect("ready");
    let (first_deg, action_deg) = (cell.alpha_deg, action_table()[17]);
    cell.camera = false;
    for _ in 0..12 {
        cell.tick(None);
    }
    assert!(first_deg < action_deg / 2.0, "the limits allow {first_deg} degrees in one tick");
    assert!((cell.alpha_deg - action_deg).abs() < 0.01, "{} degrees after an action of {action_deg}", cell.alpha_deg);
}

/// Protects the operator: a second goal while pouring, nonsense goals and missing weights are refused, with the reason.
#[test]
fn orders_that_cannot_be_obeyed_are_refused() {
    let mut cell = ToyCell::new();
    for goal_ml in [0.0, -4.0, 1e-30, f32::NAN, f32::INFINITY, 301.0] {
        assert_eq!(cell.pour(goal_ml), Err(Refusal::Goal(300.0)));
    }
    cell.pour(50.0).expect("ready");
    assert_eq!(cell.pour(60.0), Err(Refusal::Busy));
    let mut blank = ToyCell::new();
    blank.core = Core::new(blank.settings);
    blank.tick(None);
    assert_eq!(blank.pour(50.0), Err(Refusal::NoWeights));
    let mut dark = ToyCell::new();
    dark.doubt = Doubt::TooDark;
    (0..10).for_each(|_| _ = dark.tick(None));
    assert_eq!(dark.pour(50.0), Err(Refusal::NoFeature), "nothing can be seen");
    blank.hindrance = Some(EndReason::ProtectiveStop);
    assert_eq!(blank.pour(50.0), Err(Refusal::Robot(EndReason::ProtectiveStop)));
}

/// Protects people: whatever goes wrong at full flow, the pour ends upright and with its reason.
#[test]
fn every_doubt_ends_the_pour_upright_with_its_reason() {
    type Trouble = fn(&mut ToyCell);
    let troubles: [(Trouble, EndReason); 10] = [
        (|w| w.camera = false, EndReason::StaleFeature),
        (|w| w.doubt = Doubt::TooDark, EndReason::StaleFeature),
        // Nothing seen in a doubtful picture does not say that nothing flows.
        (|w| (w.doubt, w.dry) = (Doubt::Blurred, true), EndReason::StaleFeature),
        (|w| (w.doubt, w.dry) = (Doubt::ColoursChanged, true), EndReason::StaleFeature),
        (|w| w.clock_ahead_ns = 1_000_000_000_000, EndReason::StaleFeature),
        (|w| w.epoch_ns += 1, EndReason::WorkerRestarted),
        (|w| w.dry = true, EndReason::StreamLost),
        (|w| w.now_ns += 150_000_000, EndReason::ControllerOverrun),
        (|w| _ = w.tick(Some(Order::Abort)), EndReason::Aborted),
        (|w| _ = w.tick(Some(Order::Shutdown)), EndReason::Shutdown),
    ];
    for (trouble, reason) in troubles {
        let mut cell = ToyCell::new();
        cell.pour(200.0).expect("ready");
        cell.run_to_flow();
        trouble(&mut cell);
        assert_eq!(cell.finish().reason, reason);
        assert_eq!(cell.alpha_deg, 0.0, "{reason:?}");
        assert!(cell.largest_rate_deg_s <= 90.01);
    }
}

/// Protects the cup: a stream that is no longer seen ends the pour 10 degrees further, and not only at the largest tilt. A container from
/// which nothing flowed is tilted up to the largest tilt, also when a bead was taken for a stream before.
#[test]
fn a_lost_stream_ends_the_pour_early_and_an_empty_container_late() {
    let mut lost = ToyCell::new();
    lost.pour(200.0).expect("ready");
    lost.run_to_flow();
    lost.dry = true;
    let mut largest_deg = 0.0f32;
    while lost.core.phase() == Phase::Pouring {
        lost.tick(None);
        largest_deg = largest_deg.max(lost.alpha_deg);
    }
    // The stream was last seen at 45 degrees.
    assert!((53.0..62.0).contains(&largest_deg), "{largest_deg}");
    assert_eq!(lost.finish().reason, EndReason::StreamLost);

    let mut empty = ToyCell::new();
    empty.dry = true;
    empty.pour(200.0).expect("ready");
    for i in 0..40 {
        empty.bead = (20..28).contains(&i);
        empty.tick(None);
    }
    assert_eq!(empty.finish().reason, EndReason::ContainerEmpty);

    // Without even a bead nobody knows whether the container is empty or the camera blind.
    let mut blind = ToyCell::new();
    blind.dry = true;
    blind.pour(200.0).expect("ready");
    let outcome = blind.finish();
    assert_eq!((outcome.reason, outcome.unseen), (EndReason::NothingFlows, true));
}

/// Protects people: when the robot may not move, nothing is commanded, the pour ends at once, and nothing resumes by itself.
#[test]
fn a_robot_that_may_not_move_gets_no_targets() {
    for reason in [EndReason::ProtectiveStop, EndReason::EmergencyStop, EndReason::RobotLost, EndReason::ProgramStopped] {
        let mut cell = ToyCell::new();
        cell.pour(200.0).expect("ready");
        cell.run_to_flow();
        cell.hindrance = Some(reason);
        let output = cell.tick(None);
        assert_eq!((output.target_deg, output.ended.map(|o| o.reason)), (None, Some(reason)));
        assert!(output.ended.is_some_and(|o| o.poured_ml > 0.0), "the volume so far is reported");
        cell.hindrance = None;
        for _ in 0..30 {
            assert_eq!(cell.tick(None).target_deg, None, "still tilted: waits for a person");
        }
        cell.alpha_deg = 0.3;
        cell.tick(None);
        assert_eq!(cell.core.phase(), Phase::Idle);
        cell.pour(5.0).expect("a new pour works");
    }
}

/// Protects the volume: frames that were lost are counted and bridged, and doubtful ones are not believed.
#[test]
fn lost_and_doubtful_frames_are_bridged() {
    let mut cell = ToyCell::new();
    cell.pour(30.0).expect("ready");
    cell.run_to_flow();
    cell.feature();
    cell.feature();
    cell.doubt = Doubt::TooDark;
    cell.tick(None);
    cell.doubt = Doubt::None;
    let outcome = cell.finish();
    assert_eq!((outcome.reason, outcome.bridged_frames), (EndReason::Done, 2));
    // The three frames are taken as the one before them: the flow is rising, so a little is missing.
    assert!((outcome.poured_ml - cell.out_ml).abs() < 0.5, "reported {}, really {}", outcome.poured_ml, cell.out_ml);
}

/// Protects people: a joint that stays tilted although nothing hinders it is not reported as upright.
#[test]
fn a_joint_that_stays_tilted_is_reported() {
    let mut cell = ToyCell::new();
    cell.pour(8.0).expect("ready");
    cell.run_to_flow();
    cell.tick(Some(Order::Abort));
    for _ in 0..300 {
        cell.tick_with_joint_at(30.0);
    }
    assert_eq!(cell.last_ended.map(|o| o.reason), Some(EndReason::NotUpright));
}

/// Protects the cup from a robot that is slower than it is commanded: the pour ends with its own reason before anything flows, no command is
/// out of the joint's reach, and the result waits until the joint is upright, however long that takes.
#[test]
fn a_joint_that_does_not_follow_ends_the_pour() {
    for joint_deg_s in [30.0, 20.0, 10.0, 2.0] {
        let mut cell = ToyCell::new();
        cell.core.exchange(always(20));
        cell.joint_deg_s = joint_deg_s;
        cell.pour(75.0).expect("ready");
        let outcome = cell.finish();
        assert_eq!(outcome.reason, EndReason::NotFollowed, "{joint_deg_s}");
        assert!(cell.alpha_deg.abs() <= 2.0 && cell.out_ml == 0.0, "{joint_deg_s}: {} degrees, {} ml", cell.alpha_deg, cell.out_ml);
        // The same pour again, to look at the commands.
        (0..100).for_each(|_| _ = cell.tick(None));
        cell.pour(75.0).expect("ready again");
        let mut farthest_deg = 0.0f32;
        while cell.core.phase() == Phase::Pouring {
            let before_deg = cell.alpha_deg;
            let commanded_deg = cell.tick(None).target_deg.unwrap_or(0.0);
            farthest_deg = farthest_deg.max(commanded_deg - before_deg);
        }
        // The reach is 90 degrees/s for 0.23 s, and 2 degrees.
        assert!(farthest_deg < 24.0, "{joint_deg_s}: {farthest_deg} degrees ahead");
    }
}

/// Protects the operator: a pour that was aborted, and that a stop then holds tilted, goes on leaving, so the stop is its reason, and "at least" is said.
/// Once it is upright, what it ended for stays.
#[test]
fn what_holds_an_aborted_pour_tilted_is_its_reason() {
    for (upright, reason) in [(false, EndReason::ProtectiveStop), (true, EndReason::Aborted)] {
        let mut cell = ToyCell::new();
        cell.pour(200.0).expect("ready");
        cell.run_to_flow();
        cell.tick(Some(Order::Abort));
        while upright && cell.alpha_deg.abs() > 1.0 {
            cell.tick(None);
        }
        cell.hindrance = Some(EndReason::ProtectiveStop);
        let outcome = cell.tick(None).ended.expect("ended");
        assert_eq!((outcome.reason, outcome.poured_words().starts_with("at least ")), (reason, !upright));
    }
}

/// Protects the operator from a wrong amount that looks right: if the way back is not followed, more flows than was foreseen, and the pour is
/// not done. What was given up for another reason keeps it. Both are waited for.
#[test]
fn a_slow_way_back_is_waited_for_and_is_not_done() {
    for (abort, reason) in [(false, EndReason::NotFollowed), (true, EndReason::Aborted)] {
        let mut cell = ToyCell::new();
        cell.pour(4.0).expect("ready");
        cell.run_to_flow();
        if abort {
            cell.tick(Some(Order::Abort));
        }
        while cell.core.phase() == Phase::Pouring {
            cell.tick(None);
        }
        cell.joint_deg_s = 8.0;
        let outcome = cell.finish();
        assert_eq!(outcome.reason, reason);
        assert!(cell.alpha_deg.abs() <= 2.0 && outcome.seconds > 5.0, "{} degrees after {} s", cell.alpha_deg, outcome.seconds);
        assert!((outcome.poured_ml - cell.out_ml).abs() < 0.05, "what flowed meanwhile is counted");
    }
}

/// Protects the dose before anything moves: a robot that slows itself, and a joint that is not upright, are refused by name.
#[test]
fn a_slowed_or_tilted_robot_is_refused() {
    let mut cell = ToyCell::new();
    cell.speed_scaling = Some(0.4);
    assert_eq!(cell.pour(50.0), Err(Refusal::Slowed(0.4)));
    assert!(Refusal::Slowed(0.4).to_string().contains("40 % of its speed (speed_scaling)"));
    cell.speed_scaling = Some(1.0);
    cell.alpha_deg = 5.0;
    assert_eq!(cell.pour(50.0), Err(Refusal::NotUpright(5.0)));
    (0..10).for_each(|_| _ = cell.tick(None));
    cell.pour(50.0).expect("upright again");
}

/// Protects a pour in progress: new weights wait for its end, and the old ones come back to be dropped elsewhere.
#[test]
fn weights_are_exchanged_between_pours_only() {
    let mut cell = ToyCell::new();
    assert!(cell.core.exchange(always(13)).is_some());
    cell.pour(8.0).expect("ready");
    assert!(!cell.core.may_exchange());
    cell.finish();
    assert!(cell.core.may_exchange());
    // An agent that stays never pours: the largest number of frames ends it.
    cell.core.exchange(always(10));
    cell.pour(8.0).expect("ready");
    let outcome = cell.finish();
    assert_eq!((outcome.reason, outcome.frames >= cell.settings.max_frames), (EndReason::MaxFrames, true));
}

/// Protects eq. (1): the curve is run as given, to its end; one that leaves the limits is refused before it starts.
#[test]
fn a_recording_follows_the_curve() {
    let mut cell = ToyCell::new();
    let curve = Curve { lambda_deg: 70.0, gamma_per_s2: 0.3, beta_s: 4.914 };
    for bad in [
        Curve { lambda_deg: 200.0, ..curve },
        Curve { gamma_per_s2: 9.0, ..curve },
        Curve { beta_s: 1.0, ..curve },
        Curve { beta_s: f32::NAN, ..curve },
    ] {
        let answer = cell.tick(Some(Order::Record { episode: 6, curve: bad })).ordered;
        assert_eq!(answer, Some(Err(Refusal::Curve)), "{bad:?}");
    }
    cell.tick(Some(Order::Record { episode: 6, curve })).ordered.expect("answered").expect("ready");
    let start_ns = cell.now_ns;
    loop {
        let output = cell.tick(None);
        let t = (cell.now_ns - start_ns) as f32 / 1e9;
        if t > 2.0 * curve.beta_s {
            break;
        }
        assert!((cell.alpha_deg - curve.alpha_deg(t)).abs() < 0.06, "at {t} s");
        assert_eq!(output.telemetry.lambda_deg, 70.0);
    }
    let outcome = cell.finish();
    assert_eq!((outcome.reason, outcome.goal_ml, cell.alpha_deg), (EndReason::Done, None, 0.0));
}
