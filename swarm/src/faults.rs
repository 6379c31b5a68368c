//! The kinds of faults that a seed draws, by name.
//!
//! Pure; allocates; cannot fail.

use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use shared::config::Joint;
use simulator::ur::{Fault, SafetyMode};

use crate::vessels::VESSELS;
use crate::what::{EyeFault, What};

/// What happens, and how many ms after the fault's begin.
type Happens = Vec<(u64, What)>;

/// A kind of fault.
#[derive(Debug, Clone, Copy)]
pub struct Kind {
    /// Its name in tables and for `--only`.
    pub name: &'static str,
    /// After this time it could first be noticed, ms: the bounds of ARCHITECTURE.md's table of deadlines, and for what is told by the robot
    /// or the operator one packet and one tick.
    pub noticed_ms: u32,
    /// Whether what may leave from then on is bounded ([`crate::bound`]), if a pour or recording ends because of it. It is not where the robot
    /// stands tilted or returns slower than it can, or where the pour need not end and goes on to its goal.
    pub is_bounded: bool,
    draw: fn(&mut Pcg64Mcg) -> Happens,
}

/// A kind after which no more leaves than a prompt way upright gives.
const fn bounded(name: &'static str, noticed_ms: u32, draw: fn(&mut Pcg64Mcg) -> Happens) -> Kind {
    Kind { name, noticed_ms, is_bounded: true, draw }
}

/// A kind that only the vessel's content bounds.
const fn unbounded(name: &'static str, noticed_ms: u32, draw: fn(&mut Pcg64Mcg) -> Happens) -> Kind {
    Kind { name, noticed_ms, is_bounded: false, draw }
}

/// All kinds, by the names of the tables and of `--only`.
pub const KINDS: [Kind; 50] = [
    unbounded("protective-stop", 50, |r| pair(Fault::ProtectiveStop, 5_500 + later(r), Fault::UnlockProtectiveStop)),
    unbounded("emergency-stop", 50, |r| {
        let ms = later(r);
        let release = [(ms, What::Robot(Fault::EmergencyRelease)), (ms + 300, What::Robot(Fault::BrakeRelease))];
        robot(Fault::EmergencyStop).into_iter().chain(release).collect()
    }),
    unbounded("program-pause", 50, |r| pair(Fault::ProgramPause, later(r), Fault::ProgramResume)),
    unbounded("program-stop", 50, |_| robot(Fault::ProgramStop)),
    unbounded("speed-slider", 50, |r| pair(Fault::SpeedSlider(r.random_range(0.01..0.99)), later(r), Fault::SpeedSlider(1.0))),
    unbounded("time-scaling", 300, |r| pair(Fault::TimeScaling(r.random_range(0.05..0.9)), later(r), Fault::Clear)),
    unbounded("held-back", 350, |r| pair(Fault::HeldBack(r.random_range(1.0..60.0)), later(r), Fault::Clear)),
    unbounded("joint-speed-limit", 300, |r| pair(Fault::JointSpeedLimit(r.random_range(5.0..60.0)), later(r), Fault::Clear)),
    unbounded("freedrive", 50, |r| pair(Fault::Freedrive, later(r), Fault::FreedriveEnd)),
    unbounded("jog", 50, |r| {
        let jog = Fault::Jog(Joint::Base, r.random_range(-25.0..25.0));
        let resume = (800 + later(r), What::Robot(Fault::ProgramResume));
        vec![(0, What::Robot(Fault::ProgramPause)), (800, What::Robot(jog)), resume]
    }),
    unbounded("boot", 50, |r| pair(Fault::Boot, later(r), Fault::BrakeRelease)),
    bounded("fin", 50, |_| robot(Fault::Fin)),
    bounded("link-cut", 50, |_| vec![(0, What::LinkCut)]),
    bounded("offline", 50, |r| robot(Fault::Offline(if r.random_bool(0.05) { r.random_range(10.0..40.0) } else { 4.0 * seconds(r) }))),
    bounded("stall", 150, |r| robot(Fault::Stall(seconds(r)))),
    bounded("freeze", 150, |r| robot(Fault::Freeze(seconds(r)))),
    bounded("slow-reader", 150, |r| robot(Fault::SlowReader(seconds(r)))),
    unbounded("skip-outputs", 150, |r| robot(Fault::SkipOutputs(r.random_range(1..60)))),
    unbounded("coalesce", 150, |r| robot(Fault::Coalesce(seconds(r)))),
    unbounded("split", 150, |r| robot(Fault::Split(seconds(r)))),
    unbounded("late-start", 0, |r| pair(Fault::LateStart(seconds(r)), 9_000, Fault::Clear)),
    unbounded("in-use", 0, |r| pair(Fault::InUse("input_int_register_24".into()), later(r), Fault::Clear)),
    bounded("link-stall", 150, |r| vec![(0, What::LinkStall(r.random_range(20..1_500)))]),
    unbounded("link-split", 150, |r| vec![(0, What::LinkSplit(r.random_range(20..3_000)))]),
    bounded("eye-loss", 250, |r| eye(EyeFault::Loss(frames(r)))),
    bounded("eye-freeze", 250, |r| eye(EyeFault::Freeze(frames(r)))),
    unbounded("eye-duplicate", 250, |r| eye(EyeFault::Duplicate(frames(r)))),
    unbounded("eye-reorder", 250, |_| eye(EyeFault::Reorder)),
    unbounded("eye-late", 250, |r| eye(EyeFault::Late(r.random_range(10..300)))),
    unbounded("eye-gain-drift", 250, |r| eye(EyeFault::GainDrift(r.random_range(-0.3..0.3)))),
    unbounded("eye-false-zero", 400, |r| eye(EyeFault::FalseZero(frames(r)))),
    unbounded("eye-spike", 250, |r| eye(EyeFault::Spike(r.random_range(200.0..20_000.0)))),
    unbounded("eye-stuck", 400, |r| eye(EyeFault::Stuck(frames(r)))),
    bounded("worker-killed", 250, |r| eye(EyeFault::Killed(r.random_range(100..4_000)))),
    bounded("worker-hung", 250, |r| eye(EyeFault::Hung(r.random_range(50..3_000)))),
    bounded("second-worker", 50, |r| eye(EyeFault::Two(r.random_range(100..3_000)))),
    bounded("overrun", 150, |r| vec![(0, What::Overrun(r.random_range(20..400)))]),
    bounded("suspended", 150, |r| vec![(0, What::Suspended(r.random_range(50..5_000)))]),
    bounded("controller-killed", 150, |r| vec![(0, What::ControllerKilled(r.random_range(100..4_000)))]),
    bounded("abort", 50, |_| vec![(0, What::Abort)]),
    unbounded("second-order", 0, |r| vec![(0, if r.random_bool(0.5) { What::Pour(60.0) } else { What::Record(70.0, 1.0) })]),
    unbounded("resume-asked", 0, |_| vec![(0, What::Resume)]),
    unbounded("bad-weights", 0, |_| vec![(0, What::BadWeights)]),
    unbounded("weights-of-another-vessel", 0, |r| vec![(0, What::Weights(r.random_range(0..VESSELS.len())))]),
    unbounded("disk-full", 0, |_| vec![(0, What::DiskFull)]),
    unbounded("remote-control", 0, |r| pair(Fault::LocalControl, later(r), Fault::RemoteControl)),
    unbounded("safeguard-stop", 50, |r| pair(Fault::SafeguardOpen, later(r), Fault::SafeguardClosed)),
    unbounded("hand-move", 50, |r| {
        // The teach button ends the program; then a person moves a joint, and lets go.
        let joint = if r.random_bool(0.5) { Joint::Base } else { Joint::Wrist3 };
        let hand = (3_500, What::Robot(Fault::HandMove(joint, r.random_range(-25.0..25.0))));
        vec![(0, What::Robot(Fault::Freedrive)), hand, (6_000 + later(r), What::Robot(Fault::FreedriveEnd))]
    }),
    unbounded("second-client", 0, |r| vec![(0, What::SecondClient(r.random_range(100..9_000)))]),
    unbounded("safety-mode", 50, |r| {
        use SafetyMode::{Recovery, SystemEmergencyStop, Violation};
        let mode = [Recovery, SystemEmergencyStop, Violation, SafetyMode::Fault][r.random_range(0..4)];
        let ms = later(r);
        let remedy = [(ms, What::Robot(Fault::SafetyMode(SafetyMode::Normal))), (ms + 300, What::Robot(Fault::BrakeRelease))];
        robot(Fault::SafetyMode(mode)).into_iter().chain(remedy).collect()
    }),
];

/// The number of the kind with this name.
///
/// # Errors
/// One line with the names that there are.
pub fn named(name: &str) -> Result<usize, String> {
    let names = || KINDS.map(|kind| kind.name).join(", ");
    KINDS.iter().position(|kind| kind.name == name).ok_or_else(|| format!("no fault is called {name}; there are {}", names()))
}

/// What the kind with this number draws.
pub fn draw(kind: usize, random: &mut Pcg64Mcg) -> Happens {
    (KINDS[kind % KINDS.len()].draw)(random)
}

fn pair(first: Fault, later_ms: u64, then: Fault) -> Happens {
    vec![(0, What::Robot(first)), (later_ms, What::Robot(then))]
}

fn robot(fault: Fault) -> Happens {
    vec![(0, What::Robot(fault))]
}

fn eye(fault: EyeFault) -> Happens {
    vec![(0, What::Eye(fault))]
}

/// When somebody sets it right again, ms after the fault.
fn later(random: &mut Pcg64Mcg) -> u64 {
    random.random_range(300..9_000)
}

/// How long it lasts, s: mostly less than one, at most three.
fn seconds(random: &mut Pcg64Mcg) -> f64 {
    random.random_range(0.02..1.0) * random.random_range(0.1..3.0f64)
}

/// For how many frames it lasts.
fn frames(random: &mut Pcg64Mcg) -> u32 {
    random.random_range(1..20)
}
