//! Connects the robot: it settles protocol, versions and recipes, and uploads the program, until a [`Session`] is ready for the loop.
//!
//! It runs on an ordinary thread, allocates, and blocks for seconds: for some 20 s with a robot that answers late each time. Every failure
//! is a [`LinkError`] whose one line says what to do; the caller shows it and tries again later. A running program is never replaced,
//! because it may be ours and bringing the container upright at this moment; a paused one neither, because a person has paused it; and a
//! robot that somebody has, or had, in hand is left alone ([`hands`]).

use std::time::Duration;

use shared::control::EndReason;

use super::dialogue::Dialogue;
use super::error::{ANSWER, LinkError, PROGRAM_START};
use super::hands::{self, Before, Handover};
use super::health::{self, RUNTIME_PAUSED, RUNTIME_PAUSING, RUNTIME_PLAYING, RUNTIME_STOPPED, RUNTIME_STOPPING};
use super::network::{Network, System};
use super::upload::Upload;
use super::wire::OutputRecipe;
use super::{LinkOptions, ProgramState, RobotState, Session, program, wire};

/// The version of RTDE that is spoken (RTDE guide).
const PROTOCOL: u16 = 2;
/// PolyScope versions, major and minor, since which there are registers 24 to 47 for external clients (RTDE guide).
const UPPER_REGISTERS: [(u32, u32); 2] = [(3, 9), (5, 3)];
/// Number of control cycles a second of a CB3 (RTDE guide).
const CB3_HZ: f64 = 125.0;
/// Number of control cycles a second of an e-Series robot (RTDE guide).
const E_SERIES_HZ: f64 = 500.0;
/// How long one socket is read while the other one waits. Chosen by hand; no measurement is recorded.
const GLANCE: Duration = Duration::from_millis(20);
/// How long the robot must stand still before the program is uploaded. Chosen by hand: in this time also a joint that is jogged at 0.3
/// degrees/s moves visibly.
const REST: Duration = Duration::from_millis(400);
/// A robot whose newest state is older than this does not tell what it does now. Chosen by hand: a dozen cycles of a CB3.
const SILENT: Duration = Duration::from_millis(100);
/// A look that takes longer than this does not tell that nothing is left: this process stood still meanwhile. Chosen by hand.
const STOOD_STILL: Duration = Duration::from_millis(50);
/// A robot that said "paused" only stops when it gets its first program; if it has stopped and the program has not started after this, it gets it
/// again. Chosen by hand: a program starts within 0.1 s.
const AGAIN: Duration = Duration::from_millis(700);

/// Connects to a robot of which nothing is known from before. See [`connect_after`].
pub fn connect(options: &LinkOptions) -> Result<Session, LinkError> {
    connect_after(options, &Before::default())
}

/// Connects over this machine's network. See [`connect_over`].
pub fn connect_after(options: &LinkOptions, before: &Before) -> Result<Session, LinkError> {
    connect_over(&System, options, &mut before.clone())
}

/// Connects, checks everything that can be checked, starts the program, and gives a session whose program waits for targets. `before` takes note of the
/// program.
///
/// The first target is due within two seconds after this returns.
pub fn connect_over(network: &dyn Network, options: &LinkOptions, before: &mut Before) -> Result<Session, LinkError> {
    let (mut dialogue, version, rate_hz) = introduce(network, options)?;
    let run = (network.now_ns() as i32 & i32::MAX).max(1);
    let program = program::text(options, 1.0 / rate_hz, run)?;

    let output_recipe = dialogue.agree_outputs(rate_hz, options.register_base)?;
    let input_recipe = dialogue.agree_inputs(&wire::input_names(options.register_base))?;
    // A port that does not answer takes seconds. Nobody looks at the robot then, and it sends no states yet that would have to be read.
    let mut upload = Upload::open(network, options.address)?;
    let mut state = first_state(&mut dialogue, options, output_recipe)?;
    ready_for_program(options, before, &state)?;
    stands_still((network, options), &mut dialogue, &mut upload, output_recipe, &mut state)?;
    ready_for_program(options, before, &state)?;

    (before.uploaded, before.looked) = (Some(run), false);
    start_program((network, options, before), (&mut dialogue, &mut upload), output_recipe, &mut state, (&program, run))?;
    let now = network.now_ns();
    (state.received_at_ns, state.advanced_at_ns, state.answered_at_ns) = (now, now, now);
    let at = dialogue.at;
    let tilt = (options.tilt, options.rate_hz);
    Session::new(dialogue.stream, dialogue.inbox, tilt, (output_recipe, input_recipe), version, state).map_err(|e| LinkError::Lost {
        at,
        doing: "the hand-over to the loop",
        what: e.to_string(),
    })
}

/// What was seen of a robot that was only looked at.
#[derive(Debug)]
pub struct Seen {
    /// PolyScope's version: major, minor, bug fix and build.
    pub version: [u32; 4],
    /// Its first state.
    pub state: RobotState,
    /// Whether the registers that Decant writes are free.
    pub registers: Result<(), LinkError>,
    /// Whether the program could be uploaded now.
    pub ready: Result<(), LinkError>,
}

/// Looks at a robot and changes nothing on it. Registers that somebody else writes are no failure here.
pub fn look(options: &LinkOptions) -> Result<Seen, LinkError> {
    let (mut dialogue, version, rate_hz) = introduce(&System, options)?;
    let output_recipe = dialogue.agree_outputs(rate_hz, options.register_base)?;
    let registers = dialogue.agree_inputs(&wire::input_names(options.register_base)).map(|_| ());
    let state = first_state(&mut dialogue, options, output_recipe)?;
    Ok(Seen { version, state, registers, ready: ready_for_program(options, &Before::default(), &state) })
}

/// Connects to RTDE, and settles protocol and version. Gives the version and the number of control cycles a second.
fn introduce<'a>(network: &'a dyn Network, options: &LinkOptions) -> Result<(Dialogue<'a>, [u32; 4], f64), LinkError> {
    let address = options.address;
    let mut dialogue = Dialogue::open(network, address)?;
    if !dialogue.ask(wire::PROTOCOL_VERSION, &[&PROTOCOL.to_be_bytes()], "the request for the protocol version", wire::accepted)? {
        return Err(LinkError::VersionRefused { address });
    }
    let version = dialogue.ask(wire::CONTROLLER_VERSION, &[], "the request for the controller's version", wire::controller_version)?;
    let [major, minor, ..] = version;
    // A generation later than those known here is taken to have what these have.
    if UPPER_REGISTERS.iter().any(|&(m, n)| major == m && minor < n) || major < 3 {
        return Err(LinkError::TooOld { address, major, minor });
    }
    Ok((dialogue, version, if major >= 5 { E_SERIES_HZ } else { CB3_HZ }))
}

/// Starts the transfer of states, and gives the first one.
fn first_state(dialogue: &mut Dialogue<'_>, options: &LinkOptions, recipe: OutputRecipe) -> Result<RobotState, LinkError> {
    let doing = "the request to start";
    if !dialogue.ask(wire::START, &[], doing, wire::accepted)? {
        return Err(LinkError::StartRefused { address: options.address, said: dialogue.said.clone() });
    }
    let mut state = RobotState::default();
    dialogue.next_state(recipe, &options.tilt, &mut state, ANSWER)?.ok_or_else(|| dialogue.no_answer(doing))?;
    Ok(state)
}

/// Whether the robot may move, runs no program, holds the container upright, and is in nobody's hand, so that the program may be uploaded.
fn ready_for_program(options: &LinkOptions, before: &Before, state: &RobotState) -> Result<(), LinkError> {
    let address = options.address;
    if let Some(reason) = health::hindrance(state) {
        return Err(may_not_move((options, before), state, reason));
    }
    match state.runtime_state {
        RUNTIME_STOPPING | RUNTIME_STOPPED => {}
        RUNTIME_PAUSING | RUNTIME_PAUSED if hands::never_started(before, state) => {}
        RUNTIME_PAUSING | RUNTIME_PAUSED => return Err(LinkError::ProgramPaused { address }),
        _ => return Err(LinkError::ProgramRunning { address }),
    }
    if let Some(why) = hands::since(before, state, options.tilt.joint) {
        return Err(LinkError::Handover { address, why });
    }
    // The comparison is written so that an angle that is not a number counts as too far.
    if f64::from(state.alpha_deg.abs()) <= options.start_tolerance_deg { Ok(()) } else { Err(too_far(options, state)) }
}

/// Looks at the robot for [`REST`], and fails if a joint moves, or if the robot falls silent. `state` becomes the newest one: where this process stood still
/// meanwhile, old states have waited for it, and they do not tell what the robot does now. So all that have waited are read.
fn stands_still(
    (network, options): (&dyn Network, &LinkOptions),
    dialogue: &mut Dialogue<'_>,
    upload: &mut Upload,
    recipe: OutputRecipe,
    state: &mut RobotState,
) -> Result<(), LinkError> {
    let earlier = *state;
    let begin_ns = network.now_ns();
    let since = |ns: u64| Duration::from_nanos(network.now_ns().saturating_sub(ns));
    let mut heard_ns = begin_ns;
    loop {
        let before = since(begin_ns);
        // The last looks wait for nothing: a kernel's shortest wait can be longer than the cycle of an e-Series robot, in which
        // another state always comes.
        let left = REST.saturating_sub(before);
        let came = dialogue.next_state(recipe, &options.tilt, state, left)?.is_some();
        upload.discard();
        // A program that has started meanwhile may move them; it is found afterwards.
        if let (Some(joint), false) = (hands::moving(&earlier, state), state.runtime_state == RUNTIME_PLAYING) {
            return Err(LinkError::Handover { address: options.address, why: Handover::Moving(joint) });
        }
        if came {
            heard_ns = network.now_ns();
        }
        if left.is_zero() && !came && since(begin_ns) - before <= STOOD_STILL {
            let hears = since(heard_ns) <= SILENT;
            return if hears { Ok(()) } else { Err(dialogue.no_answer("the transfer of its state")) };
        }
    }
}

/// Uploads the program with its run number, and waits until it shows that it runs. `state` becomes the newest one.
fn start_program(
    (network, options, before): (&dyn Network, &LinkOptions, &Before),
    (dialogue, upload): (&mut Dialogue<'_>, &mut Upload),
    recipe: OutputRecipe,
    state: &mut RobotState,
    (program, run): (&str, i32),
) -> Result<(), LinkError> {
    let address = options.address;
    let mut again = matches!(state.runtime_state, RUNTIME_PAUSING | RUNTIME_PAUSED);
    upload.send(program)?;
    let mut sent_at_ns = network.now_ns();
    while state.program_run != run || state.runtime_state != RUNTIME_PLAYING {
        upload.discard();
        let since_sent = Duration::from_nanos(network.now_ns().saturating_sub(sent_at_ns));
        let left = PROGRAM_START.saturating_sub(since_sent);
        // The wait is short, so that the other socket is read too.
        dialogue.next_state(recipe, &options.tilt, state, left.min(GLANCE))?;
        if let Some(reason) = health::hindrance(state) {
            return Err(may_not_move((options, before), state, reason));
        }
        if state.program_run == run && state.program_state == ProgramState::TooFar {
            return Err(too_far(options, state));
        }
        if again && state.runtime_state == RUNTIME_STOPPED && network.now_ns().saturating_sub(sent_at_ns) > AGAIN.as_nanos() as u64 {
            again = false;
            upload.send_again(network, program)?;
            sent_at_ns = network.now_ns();
        }
        if left.is_zero() {
            return Err(LinkError::NotStarted { address });
        }
    }
    Ok(())
}

/// The error of a robot that may not be moved.
fn may_not_move((options, before): (&LinkOptions, &Before), state: &RobotState, reason: EndReason) -> LinkError {
    let (unpowered, program_there) = (hands::without_power(state), hands::program_there(before, state));
    LinkError::MayNotMove { address: options.address, reason, safety_mode: state.safety_mode, unpowered, program_there }
}

/// The error of a joint that is too far from its start angle. One that is off by whole turns holds the container upright, but cannot tilt it as far.
fn too_far(options: &LinkOptions, state: &RobotState) -> LinkError {
    let (alpha_deg, tolerance_deg) = (state.alpha_deg, options.start_tolerance_deg);
    let turns = (f64::from(alpha_deg) / 360.0).round();
    let remedy = if turns != 0.0 && (f64::from(alpha_deg) - turns * 360.0).abs() <= tolerance_deg {
        "turn it back by a full turn with the pendant"
    } else {
        "bring the container upright with the pendant, or correct robot.start_joint_deg"
    };
    LinkError::TooFar { address: options.address, alpha_deg, tolerance_deg, remedy }
}
