//! `rt-controller step`: runs the controller's core as a filter, so that any other simulator can drive it. It is an ordinary
//! process, and every failure is one line. A simulator in Rust can call the core itself: see `examples/drive_core.rs`.

use std::io::{BufRead, Read as _, Write};
use std::path::PathBuf;

use shared::agent::Agent;
use shared::config::Config;
use shared::control::EndReason;
use shared::disk_space::error_words;
use shared::exit::{self, Failure, OrExit as _, failure};
use shared::framing::Framing;
use shared::messages::{Doubt, Feature, LAYOUT_VERSION, Telemetry};
use shared::weights::Weights;

use crate::core::{Core, Input, Order, Robot, Settings};
use crate::disk::check_weights;
use crate::foreseen;

/// Longest line of input, bytes: no number that anybody writes is longer.
const LINE_MAX: u64 = 128;

/// Largest measured angle that is believed, degrees: no wrist of a UR5 turns farther than a turn either way.
const ANGLE_MAX_DEG: f32 = 360.0;

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  printf '0\\n0\\n350\\nnan\\n410\\n' | rt-controller step --weights out/weights.bin --goal 75\n\n\
Each line of output is 'dalpha_deg alpha_deg d_ml', flushed at once: the change and the angle commanded now (all limits of the\n\
configuration applied), and the volume still to pour. The first line comes before any input, because the tick that takes the goal already\n\
moves, from upright. Then each line of input is one frame's V_e in px^2 (nan: no measurement), and each has one line of output. Behind V_e\n\
may stand the alpha that the robot measured when the frame was taken, in degrees, as in '350 12.5'. Each alpha_deg is the sum of all\n\
dalpha_deg so far. How the pour ended is said on standard error, and by exit code 4 where it ended early.")]
pub struct Args {
    /// The weight file.
    #[arg(long)]
    weights: PathBuf,
    /// Goal volume V_G in ml.
    #[arg(long)]
    goal: f32,
    /// The cell's configuration.
    #[arg(long, env = shared::config::VARIABLE, default_value = shared::config::DEFAULT_FILE)]
    config: PathBuf,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let config = Config::read(&args.config).or_exit(exit::BAD_INPUT)?;
    let weights = Weights::read(&args.weights).or_exit(exit::BAD_INPUT)?;
    let fits = check_weights(&weights, config.camera.fps, &config.limits);
    fits.map_err(|why| failure(exit::BAD_INPUT, format!("{}: {why}", args.weights.display())))?;
    let (rate_hz, fps) = (config.controller.rate_hz, config.camera.fps);
    if (rate_hz - fps).abs() > 1e-3 {
        let what = format!(
            "controller.rate_hz is {rate_hz} and camera.fps {fps}: `step` has one tick for each frame, so give a configuration in which both are alike"
        );
        return Err(failure(exit::BAD_INPUT, what));
    }
    if let Some(line) = foreseen::pictures_line(&weights) {
        eprintln!("{line}");
    }
    // The areas are taken to be of the pictures that the configuration names, so that the core refuses weights of others.
    let framing = Framing::new(&config.camera, &config.image);
    let settings = Settings::new(&config);
    let mut core = Core::new(settings);
    core.exchange(Box::new(Agent::new(&weights)));
    let (mut alpha_deg, mut now_ns, mut sequence) = (0.0, 0, 0);
    let mut frame = |Line { area_px2, alpha_measured_deg }: Line, order: Option<Order>| {
        now_ns += settings.period_ns;
        sequence += 1;
        let doubt = if area_px2.is_finite() { Doubt::None } else { Doubt::EdgeNotFound };
        let feature = Feature {
            version: LAYOUT_VERSION,
            doubt: doubt as u32,
            sequence,
            captured_at_ns: now_ns,
            received_at_ns: now_ns,
            published_at_ns: now_ns,
            area_px2,
            confidence: 1.0,
            framing,
            ..Feature::default()
        };
        // Where the robot is not measured it is not taken to be measured where it was sent: the agent then reckons with the joint's lag.
        let robot = alpha_measured_deg.map_or(Robot::that_may_move(alpha_deg, 0), |deg| Robot::that_may_move(deg, now_ns));
        let output = core.step(&Input { now_ns, features: &[feature], robot, order });
        alpha_deg = output.telemetry.alpha_deg;
        output
    };
    // Two frames come before the first line of input: in one the robot becomes ready, in the other the goal is set.
    let container = config.container;
    let flows_by_deg = foreseen::must_flow_by_deg(&weights, None, container.least_fill_ml, container.holds_ml);
    frame(Line::default(), None);
    let started = frame(Line::default(), Some(Order::Pour { episode: 1, goal_ml: args.goal, flows_by_deg }));
    if let Some(Err(refusal)) = started.ordered {
        return Err(failure(exit::REFUSED, refusal));
    }
    let mut lines = Lines { out: std::io::stdout().lock(), printed: 0 };
    if !lines.print(&started.telemetry)? {
        return Ok(());
    }
    let mut ended = None;
    let mut input = std::io::stdin().lock();
    for number in 0.. {
        let Some(line) = next_line(&mut input).map(|line| line.and_then(|text| parse(&text))) else { break };
        let line = line.map_err(|why| failure(exit::BAD_INPUT, format!("line {}: {why}", number + 1)))?;
        let output = frame(line, None);
        if !lines.print(&output.telemetry)? {
            return Ok(());
        }
        if let Some(outcome) = output.ended {
            eprintln!("{} ml poured (estimate), {}", outcome.poured_words(), outcome.words());
            ended = Some(outcome.reason);
        }
    }
    match ended {
        None | Some(EndReason::Done) => Ok(()),
        Some(reason) => Err(failure(exit::ENDED_EARLY, format!("ended early: {}", reason.words()))),
    }
}

/// The next line of input; `None` after the last one. A line that is too long, or no text, is an error.
fn next_line(input: &mut impl BufRead) -> Option<Result<String, String>> {
    let mut line = Vec::new();
    match input.take(LINE_MAX + 1).read_until(b'\n', &mut line) {
        Ok(0) => None,
        Ok(_) if line.len() as u64 > LINE_MAX => {
            Some(Err(format!("it is longer than {LINE_MAX} bytes: give one V_e in px^2, or nan, on each line")))
        }
        Ok(_) => Some(String::from_utf8(line).map_err(|_| "not a number: give one V_e in px^2, or nan, on each line".into())),
        Err(e) => Some(Err(e.to_string())),
    }
}

/// What a line of input says of one frame.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Line {
    /// V_e, px^2; NaN for a frame that was not measured.
    area_px2: f32,
    /// The alpha that the robot measured when the frame was taken, degrees, if the line says it.
    alpha_measured_deg: Option<f32>,
}

/// One frame's line as it was written.
fn parse(text: &str) -> Result<Line, String> {
    let mut words = text.split_whitespace();
    let wrong = || "not a number: give one V_e in px^2, or nan, on each line".to_string();
    let (area, angle, None) = (words.next().ok_or_else(wrong)?, words.next(), words.next()) else {
        return Err("more than two numbers: give V_e in px^2, or nan, and behind it at most the measured alpha in degrees".into());
    };
    let area_px2 = area.parse().map_err(|_| wrong())?;
    if !(f32::is_nan(area_px2) || (0.0..f32::INFINITY).contains(&area_px2)) {
        return Err(format!("{area} is no area: give a finite V_e of at least 0 px^2, or nan for no measurement"));
    }
    let alpha_measured_deg = match angle.map(|angle| (angle, angle.parse::<f32>())) {
        None => None,
        // As in a table: nan where the robot said nothing.
        Some((_, Ok(deg))) if deg.is_nan() => None,
        Some((_, Ok(deg))) if deg.abs() <= ANGLE_MAX_DEG => Some(deg),
        Some((angle, _)) => return Err(format!("{angle} is no angle: give the measured alpha in degrees, or leave it out")),
    };
    Ok(Line { area_px2, alpha_measured_deg })
}

/// Places of a printed angle: its last digit is 0.0001 degrees.
const PLACES: f64 = 1e4;

/// Prints the lines of output. What is printed adds up to the last digit, because a change is the difference of two printed angles.
struct Lines<W> {
    out: W,
    /// The angle printed last, in its last digit.
    printed: i64,
}

impl<W: Write> Lines<W> {
    /// Prints a line. Gives whether the reader is still there.
    fn print(&mut self, telemetry: &Telemetry) -> Result<bool, Failure> {
        let alpha = (f64::from(telemetry.alpha_deg) * PLACES).round() as i64;
        let dalpha = alpha - std::mem::replace(&mut self.printed, alpha);
        let line = format!("{:.4} {:.4} {:.4}\n", dalpha as f64 / PLACES, alpha as f64 / PLACES, telemetry.d_ml);
        match self.out.write_all(line.as_bytes()).and_then(|()| self.out.flush()) {
            Ok(()) => Ok(true),
            Err(e) if e.kind() == std::io::ErrorKind::BrokenPipe => Ok(false),
            Err(e) => Err(failure(exit::FAILED, format!("standard output: {}", error_words(&e)))),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects the filter from areas that no camera gives: a negative or endless one is refused in one line that says what to give.
    #[test]
    fn areas_that_cannot_be_are_refused() {
        let line = |area_px2, alpha_measured_deg| Ok(Line { area_px2, alpha_measured_deg });
        assert_eq!(parse(" 350 "), line(350.0, None));
        assert_eq!(parse("0"), line(0.0, None));
        assert_eq!(parse("350 -12.5\r"), line(350.0, Some(-12.5)));
        assert_eq!(parse("350 nan"), line(350.0, None), "the robot said nothing");
        assert!(parse("nan").is_ok_and(|line| line.area_px2.is_nan()));
        for text in ["-1", "1e999", "inf", "-inf", "-0.001", "", "3 4 5", "much"] {
            assert!(parse(text).is_err_and(|why| why.contains("px^2") && !why.contains('\n')), "{text}");
        }
        for text in ["350 inf", "350 1e6", "350 up"] {
            assert!(parse(text).is_err_and(|why| why.contains("the measured alpha in degrees, or leave it out")), "{text}");
        }
    }
}
