//! `rt-controller status`: shows the running controller's state, counters and histograms. It is a short, ordinary process,
//! and every failure is one line.

use std::path::Path;

use shared::config::Config;
use shared::control::Status;
use shared::control::volume_words;
use shared::disk_space::{LEAST_FREE, room};
use shared::exit::{self, Failure, OrExit as _};
use shared::whole_file::may_make_in;

use crate::client::{Client, Common};

/// Pause between two looks with --watch. Chosen by hand; no measurement is recorded.
const WATCH_BEAT: std::time::Duration = std::time::Duration::from_secs(1);

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  rt-controller status\n  rt-controller status --json\n  rt-controller status --watch")]
pub struct Args {
    #[command(flatten)]
    common: Common,
    /// Shows it again each second, until Ctrl-C, also while the controller is started again; with --json, one line each.
    #[arg(long)]
    watch: bool,
}

/// What is shown: what the controller says, and what is found beside it.
#[derive(serde::Serialize)]
struct Shown<'a> {
    #[serde(flatten)]
    status: &'a Status,
    /// Who records, one line.
    recorder: &'a str,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let config = Config::read(&args.common.config).or_exit(exit::BAD_INPUT)?;
    let mut seen = false;
    loop {
        let (status, recorder) = match look(&config) {
            Ok(found) => found,
            // Whoever watches, watches a controller that is started again too.
            Err(e) if args.watch && seen => {
                match args.common.json {
                    true => println!("{}", serde_json::json!({ "error": e.what })),
                    false => println!("\x1b[2J\x1b[H{}", e.what),
                }
                std::thread::sleep(WATCH_BEAT);
                continue;
            }
            Err(e) => return Err(e),
        };
        seen = true;
        let shown = Shown { status: &status, recorder: &recorder };
        match (args.common.json, args.watch) {
            (true, false) => println!("{}", serde_json::to_string_pretty(&shown).or_exit(exit::FAILED)?),
            (true, true) => println!("{}", serde_json::to_string(&shown).or_exit(exit::FAILED)?),
            (false, false) => print(&status, &recorder),
            (false, true) => {
                // These clear a terminal and go to its first place (ECMA-48).
                print!("\x1b[2J\x1b[H");
                print(&status, &recorder);
            }
        }
        if !args.watch {
            return Ok(());
        }
        std::thread::sleep(WATCH_BEAT);
    }
}

/// What the controller says, and who records.
fn look(config: &Config) -> Result<(Box<Status>, String), Failure> {
    // Each look connects anew, because what dead programs left is cleared then: a worker that was killed is not there any more.
    let client = Client::connect_or_end(&config.cell)?;
    let status = client.status()?;
    let directory = &config.recording.directory;
    let recorder = match client.has_recorder()? {
        false => "none: no feature worker runs, so nothing is recorded".to_string(),
        true => match no_place(directory) {
            None => format!("a feature worker is there; episodes go to {}", directory.display()),
            Some(why) => format!("a feature worker is there, and records nothing: {}: {why}", directory.display()),
        },
    };
    Ok((status, recorder))
}

/// Why the worker, which runs as this user, records nothing in `directory`; `None` if it does, as far as can be seen from here.
fn no_place(directory: &Path) -> Option<String> {
    if let Some(room) = room(directory) {
        if room.lacks_files() {
            return Some("the disk holds as many files as it may, whatever their size".into());
        }
        if room.bytes < LEAST_FREE {
            return Some(format!(
                "only {} MB are free, and below {} MB no episode is begun",
                room.bytes / 1_000_000,
                LEAST_FREE / 1_000_000
            ));
        }
    }
    // The worker makes a directory that is not there.
    directory.is_dir().then(|| may_make_in(directory).err()).flatten().map(|e| e.to_string())
}

/// The name that JSON has for a value.
fn name(value: &impl serde::Serialize) -> String {
    serde_json::to_value(value).ok().and_then(|v| v.as_str().map(String::from)).unwrap_or_default()
}

/// A time for people.
fn age(seconds: f64) -> String {
    let (days, hours, minutes) = (seconds / 86_400.0, seconds / 3600.0, seconds / 60.0);
    match seconds {
        s if s >= 172_800.0 => format!("{days:.0} days"),
        s if s >= 7200.0 => format!("{hours:.0} h"),
        s if s >= 120.0 => format!("{minutes:.0} min"),
        s => format!("{s:.0} s"),
    }
}

/// Prints the status for people.
fn print(s: &Status, recorder: &str) {
    println!("version    {}, running for {}", s.version, age(s.uptime_s));
    println!("phase      {}", name(&s.phase));
    if !s.hindrance.is_empty() {
        println!("hindrance  {}", s.hindrance);
    }
    let measured =
        if s.alpha_measured_deg.is_finite() { format!("{:.2} deg measured", s.alpha_measured_deg) } else { "not measured".into() };
    println!("alpha      {:.2} deg commanded, {measured}", s.alpha_deg);
    if s.goal_ml.is_finite() {
        println!(
            "volume     goal {:.1} ml, d {:.1} ml, poured {} ml (estimate)",
            s.goal_ml,
            s.d_ml,
            volume_words(s.poured_ml, s.poured_sd_ml)
        );
    }
    let written = s.weights_age_s.map_or(String::new(), |a| format!(", the newest file written {} ago", age(a)));
    println!("weights    {} ({} taken{written})", if s.weights.is_empty() { "none" } else { &s.weights }, s.weights_taken);
    if !s.weights_refused.is_empty() {
        println!("           refused: {}", s.weights_refused);
    }
    println!("ticks      {} ({} late, {} skipped)", s.ticks, s.late_ticks, s.skipped_ticks);
    println!("features   {} ({} stale, {} bridged, {} ignored)", s.features, s.stale_features, s.bridged_frames, s.ignored_features);
    let c = s.clipped;
    println!("clipped    angle {}, rate {}, acceleration {}, not finite {}", c.angle, c.rate, c.acceleration, c.not_finite);
    println!("loop       {} allocations, {} page faults, {} events lost", s.loop_allocations, s.loop_page_faults, s.events_lost);
    println!("journal    {}", s.journal);
    println!("recorder   {recorder}");
    println!("space      {}", s.space);
    println!("robot      {}, {} connections", name(&s.robot), s.robot_connections);
    if !s.robot_warning.is_empty() {
        println!("           warning: {}", s.robot_warning);
    }
    println!("\n{:<28} {:>8} {:>10} {:>10} {:>10} {:>10}", "us", "n", "p50", "p99", "p99.9", "max");
    for h in &s.timing {
        println!("{:<28} {:>8} {:>10.1} {:>10.1} {:>10.1} {:>10.1}", h.name, h.n, h.p50_us, h.p99_us, h.p999_us, h.max_us);
    }
    if !s.outcomes.is_empty() {
        println!("\nnewest results");
    }
    for o in &s.outcomes {
        let what = o.goal_ml.map_or("recording".into(), |g| format!("goal {g:6.1} ml, poured {:>14} ml", o.poured_words()));
        println!("{:>12}  {what}  {:5.1} s  {}", o.episode, o.seconds, o.words());
    }
}
