//! `experiments motion`: what the robot makes of a recorded pour's targets, with the program that is uploaded and without it.
//!
//! Feeds the 30 Hz targets of an episode, at the times at which they were recorded, to two simulated controllers: one runs
//! `pour.script`, the other hands each target to servoj as it is until the next one comes. Pure stepping, no clock, no socket:
//! the same episode gives the same picture. Ordinary thread; allocates; errors are one line.

use std::path::{Path, PathBuf};

use plotters::prelude::*;
use rt_controller::link::{LinkOptions, Mode, program};
use serde::Serialize;
use shared::config::Config;
use shared::episode::Episode;
use shared::exit::{self, Failure, OrExit as _};

use simulator::ur::variables::{Input, Series};
use simulator::ur::{Machine, RuntimeState};

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  experiments motion out/episodes/episode-0001.mcap\n  \
experiments motion out/episodes/episode-0001.mcap --series e-series --from 1 --to 3 --out out/motion.svg")]
pub struct Args {
    /// A recorded pour or curve
    episode: PathBuf,
    /// The cell's configuration: joint, limits, servoj parameters
    #[arg(long, default_value = shared::config::DEFAULT_FILE)]
    config: PathBuf,
    /// Controller generation: 125 or 500 cycles a second
    #[arg(long, value_enum, default_value = "cb3")]
    series: SeriesArg,
    /// Show the picture from this time on, s
    #[arg(long, default_value_t = 0.0)]
    from: f64,
    /// Show the picture up to this time, s; 0: to the end
    #[arg(long, default_value_t = 0.0)]
    to: f64,
    /// The picture
    #[arg(long, default_value = "out/motion.svg")]
    out: PathBuf,
    /// Print the figures as JSON
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum SeriesArg {
    Cb3,
    ESeries,
}

/// One control cycle; alpha in degrees.
#[derive(Debug, Clone, Copy)]
struct Cycle {
    t_s: f64,
    target_deg: f64,
    command_deg: f64,
    actual_deg: f64,
}

/// Figures of one motion.
#[derive(Debug, Clone, Copy, Serialize)]
struct Figures {
    /// Largest |rate| given to servoj, degrees/s.
    command_rate_deg_s: f64,
    /// Largest |acceleration| given to servoj, degrees/s^2.
    command_acceleration_deg_s2: f64,
    /// Largest |acceleration| of the joint, degrees/s^2.
    joint_acceleration_deg_s2: f64,
    /// Root mean square of the joint's acceleration, degrees/s^2.
    joint_acceleration_rms_deg_s2: f64,
    /// Root mean square of the joint's jerk, degrees/s^3.
    joint_jerk_rms_deg_s3: f64,
    /// Time by which the joint is behind the targets (best fit), ms.
    delay_ms: f64,
}

#[derive(Debug, Serialize)]
struct Report {
    targets: usize,
    with_program: Figures,
    raw: Figures,
    picture: String,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let config = Config::read(&args.config).or_exit(exit::BAD_INPUT)?;
    let episode = Episode::read(&args.episode).or_exit(exit::BAD_INPUT)?;
    let report = compare(args, &config, &episode).map_err(|e| format!("{}: {e}", args.episode.display())).or_exit(exit::FAILED)?;
    if args.json {
        println!("{}", serde_json::to_string_pretty(&report).or_exit(exit::FAILED)?);
    } else {
        print(&report);
    }
    Ok(())
}

fn print(report: &Report) {
    println!("{} targets; picture {}", report.targets, report.picture);
    println!("{:44}{:>14}{:>14}", "", "pour.script", "raw servoj");
    type Row = (&'static str, fn(&Figures) -> f64);
    let rows: [Row; 6] = [
        ("command: largest rate, deg/s", |f| f.command_rate_deg_s),
        ("command: largest acceleration, deg/s^2", |f| f.command_acceleration_deg_s2),
        ("joint: largest acceleration, deg/s^2", |f| f.joint_acceleration_deg_s2),
        ("joint: acceleration, r.m.s., deg/s^2", |f| f.joint_acceleration_rms_deg_s2),
        ("joint: jerk, r.m.s., deg/s^3", |f| f.joint_jerk_rms_deg_s3),
        ("joint behind the targets, ms", |f| f.delay_ms),
    ];
    for (name, value) in rows {
        println!("{name:44}{:>14.0}{:>14.0}", value(&report.with_program), value(&report.raw));
    }
}

fn compare(args: &Args, config: &Config, episode: &Episode) -> Result<Report, Box<dyn std::error::Error>> {
    let options = LinkOptions::new(config);
    let series = match args.series {
        SeriesArg::Cb3 => Series::Cb3,
        SeriesArg::ESeries => Series::ESeries,
    };
    let mut targets: Vec<(f64, f32)> =
        episode.rows.iter().filter(|f| f.alpha_commanded_deg.is_finite()).map(|f| (f.t_s, f.alpha_commanded_deg)).collect();
    // An episode has one row a camera frame; a loop that is faster had targets in between.
    let period_s = 1.0 / options.rate_hz;
    let mut i = 1;
    while i < targets.len() {
        let (before, after) = (targets[i - 1], targets[i]);
        if after.0 - before.0 > 1.5 * period_s {
            let part = (period_s / (after.0 - before.0)) as f32;
            targets.insert(i, (before.0 + period_s, before.1 + part * (after.1 - before.1)));
        }
        i += 1;
    }
    let (Some(first), Some(last)) = (targets.first(), targets.last()) else { return Err("no targets in it".into()) };
    let targets: Vec<(f64, f32)> = targets.iter().map(|(t, alpha)| (t - first.0, *alpha)).collect();
    let end_s = last.0 - first.0;

    let ours = program::text(&options, 1.0 / series.rate_hz(), 1)?;
    let with_program = follow(&options, series, &ours, &targets)?;
    let raw = follow(&options, series, &raw_program(&options, 1.0 / series.rate_hz()), &targets)?;

    let to_s = if args.to > 0.0 { args.to.min(end_s) } else { end_s };
    if args.from >= to_s {
        return Err(format!("it ends after {end_s:.1} s: choose --from and --to within").into());
    }
    if let Some(parent) = args.out.parent() {
        std::fs::create_dir_all(parent)?;
    }
    let names = ["pour.script: interpolated on the robot", "raw: each target straight to servoj"];
    draw(&args.out, args.from..to_s, &[(names[0], &with_program), (names[1], &raw)])?;
    Ok(Report { targets: targets.len(), with_program: figures(&with_program), raw: figures(&raw), picture: args.out.display().to_string() })
}

/// What a client without a program of its own does.
fn raw_program(options: &LinkOptions, cycle_s: f64) -> String {
    let (joint, base) = (options.tilt.joint.index(), options.register_base);
    format!(
        "def raw_stream():\n  q = get_target_joint_positions()\n  while True:\n    q[{joint}] = read_input_float_register({base})\n    \
         servoj(q, 0, 0, {cycle_s}, {}, {})\n  end\nend\n",
        options.lookahead_s, options.gain
    )
}

/// Runs `program` on a fresh controller and streams `targets` (s, degrees) to it.
fn follow(options: &LinkOptions, series: Series, program: &str, targets: &[(f64, f32)]) -> Result<Vec<Cycle>, String> {
    let tilt = options.tilt;
    let joint = tilt.joint.index();
    let start_deg = targets.first().map_or(0.0, |t| t.1);
    let mut stance = [0.0, -1.571, 1.571, -1.571, -1.571, 0.0];
    stance[joint] = tilt.joint_rad(start_deg);
    let mut machine = Machine::new(series, series.default_version(), stance);
    let send = |machine: &mut Machine, sequence: i32, alpha_deg: f32| {
        let mut write = |name: String, bytes: &[u8]| {
            if let Some(input) = Input::parse(&name) {
                machine.robot.write_input(input, bytes);
            }
        };
        let base = options.register_base;
        write(format!("input_int_register_{base}"), &sequence.to_be_bytes());
        write(format!("input_int_register_{}", base + 1), &(Mode::Stream as i32).to_be_bytes());
        write(format!("input_double_register_{base}"), &tilt.joint_rad(alpha_deg).to_be_bytes());
    };
    send(&mut machine, 0, start_deg);
    machine.upload(program);
    let end_s = targets.last().map_or(0.0, |t| t.0);
    let mut cycles: Vec<Cycle> = Vec::new();
    let (mut started_s, mut sent, mut target_deg) = (None, 0, start_deg);
    loop {
        machine.step();
        let now_s = machine.robot.timestamp_s();
        if machine.runtime_state() != RuntimeState::Playing {
            if started_s.is_some() || machine.cycle() > 10_000 {
                let log: Vec<String> = machine.take_log().map(|l| l.text).collect();
                return Err(format!("the program did not run to the end: {}", log.join("; ")));
            }
            continue;
        }
        let t_s = now_s - *started_s.get_or_insert(now_s);
        if t_s > end_s {
            return Ok(cycles);
        }
        while let Some((_, alpha_deg)) = targets.get(sent).filter(|(at_s, _)| *at_s <= t_s) {
            sent += 1;
            target_deg = *alpha_deg;
            send(&mut machine, sent as i32, target_deg);
        }
        let servo = &machine.robot.servo;
        let alpha = |q: f64| tilt.direction * (q.to_degrees() - tilt.start_deg);
        cycles.push(Cycle {
            t_s,
            target_deg: target_deg.into(),
            command_deg: alpha(servo.commanded_q[joint]),
            actual_deg: alpha(servo.actual_q[joint]),
        });
    }
}

/// Differences of neighbours, over time.
fn slope(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    points.windows(2).map(|w| (w[1].0, (w[1].1 - w[0].1) / (w[1].0 - w[0].0))).collect()
}

fn largest(points: &[(f64, f64)]) -> f64 {
    points.iter().fold(0.0, |m, p| m.max(p.1.abs()))
}

fn rms(points: &[(f64, f64)]) -> f64 {
    (points.iter().map(|p| p.1 * p.1).sum::<f64>() / points.len().max(1) as f64).sqrt()
}

fn figures(cycles: &[Cycle]) -> Figures {
    let command: Vec<_> = cycles.iter().map(|c| (c.t_s, c.command_deg)).collect();
    let actual: Vec<_> = cycles.iter().map(|c| (c.t_s, c.actual_deg)).collect();
    let (rate, acceleration) = (slope(&command), slope(&slope(&actual)));
    // The shift that makes the joint's angle most like the targets.
    let off = |shift: usize| {
        cycles.iter().zip(&cycles[shift..]).map(|(t, a)| (a.actual_deg - t.target_deg).powi(2)).sum::<f64>() / (cycles.len() - shift) as f64
    };
    let best = (0..cycles.len().min(250)).min_by(|a, b| off(*a).total_cmp(&off(*b))).unwrap_or(0);
    let cycle_s = cycles.get(1).map_or(0.0, |c| c.t_s - cycles[0].t_s);
    Figures {
        command_rate_deg_s: largest(&rate),
        command_acceleration_deg_s2: largest(&slope(&rate)),
        joint_acceleration_deg_s2: largest(&acceleration),
        joint_acceleration_rms_deg_s2: rms(&acceleration),
        joint_jerk_rms_deg_s3: rms(&slope(&acceleration)),
        delay_ms: 1000.0 * best as f64 * cycle_s,
    }
}

const TARGET: RGBColor = RGBColor(120, 120, 120);
const COMMAND: RGBColor = RGBColor(31, 119, 180);
const ACTUAL: RGBColor = RGBColor(214, 39, 40);

type Line = (&'static str, RGBColor, Vec<(f64, f64)>);

fn draw(file: &Path, span: std::ops::Range<f64>, motions: &[(&str, &[Cycle])]) -> Result<(), Box<dyn std::error::Error>> {
    // For each motion the three rows of lines: angle, rate, acceleration.
    let rows = |cycles: &[Cycle]| -> [Vec<Line>; 3] {
        let of = |value: fn(&Cycle) -> f64| -> Vec<(f64, f64)> { cycles.iter().map(|c| (c.t_s, value(c))).collect() };
        let (target, command, actual) = (of(|c| c.target_deg), of(|c| c.command_deg), of(|c| c.actual_deg));
        let stepped = target.windows(2).flat_map(|w| [w[0], (w[1].0, w[0].1)]).collect();
        let rates = (slope(&command), slope(&actual));
        let accelerations = (slope(&rates.0), slope(&rates.1));
        [
            vec![("target at 30 Hz", TARGET, stepped), ("given to servoj", COMMAND, command), ("joint", ACTUAL, actual)],
            vec![("given to servoj", COMMAND, rates.0), ("joint", ACTUAL, rates.1)],
            vec![("given to servoj", COMMAND, accelerations.0), ("joint", ACTUAL, accelerations.1)],
        ]
    };
    let columns: Vec<[Vec<Line>; 3]> = motions.iter().map(|(_, cycles)| rows(cycles)).collect();
    let root = SVGBackend::new(file, (1400, 900)).into_drawing_area();
    root.fill(&WHITE)?;
    let panels = root.split_evenly((3, motions.len()));
    for (row, unit) in ["alpha, degrees", "rate, degrees/s", "acceleration, degrees/s²"].into_iter().enumerate() {
        // One scale for a row: that of the joints, and of the program's commands; raw commands go beyond it and are cut.
        let shown = columns.iter().enumerate().flat_map(|(c, rows)| rows[row].iter().filter(move |l| c == 0 || l.0 == "joint"));
        let values = shown.flat_map(|l| &l.2).filter(|p| span.contains(&p.0)).map(|p| p.1);
        let (low, high) = values.fold((0.0f64, 1.0f64), |(l, h), v| (l.min(v), h.max(v)));
        let margin = 0.06 * (high - low);
        let (low, high) = (low - margin, high + margin);
        for (column, lines) in columns.iter().enumerate() {
            let mut builder = ChartBuilder::on(&panels[row * motions.len() + column]);
            if row == 0 {
                builder.caption(motions[column].0, ("sans-serif", 20));
            }
            let mut chart = builder.margin(8).x_label_area_size(36).y_label_area_size(70).build_cartesian_2d(span.clone(), low..high)?;
            chart.configure_mesh().x_desc("s").y_desc(unit).light_line_style(TRANSPARENT).label_style(("sans-serif", 13)).draw()?;
            for (name, colour, points) in &lines[row] {
                let inside = points.iter().filter(|p| span.contains(&p.0)).map(|p| (p.0, p.1.clamp(low, high)));
                let (colour, width) = (*colour, if *name == "joint" { 2 } else { 1 });
                chart
                    .draw_series(LineSeries::new(inside, colour.stroke_width(width)))?
                    .label(*name)
                    .legend(move |(x, y)| PathElement::new([(x, y), (x + 18, y)], colour.stroke_width(2)));
            }
            chart
                .configure_series_labels()
                .position(if row == 0 { SeriesLabelPosition::UpperLeft } else { SeriesLabelPosition::LowerLeft })
                .background_style(WHITE.mix(0.8))
                .border_style(BLACK.mix(0.3))
                .label_font(("sans-serif", 13))
                .draw()?;
        }
    }
    root.present()?;
    Ok(())
}
