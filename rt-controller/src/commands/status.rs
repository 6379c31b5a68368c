//! `rt-controller status`: shows the running controller's state, counters and histograms. It is a short, ordinary process,
//! and every failure is one line.

use shared::config::Config;
use shared::control::Status;
use shared::control::volume_words;
use shared::exit::{self, Failure, OrExit as _};

use crate::client::{Client, Common};

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  rt-controller status\n  rt-controller status --json")]
pub struct Args {
    #[command(flatten)]
    common: Common,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let config = Config::read(&args.common.config).or_exit(exit::BAD_INPUT)?;
    let status = Client::connect_or_end(&config.cell).and_then(|c| c.status()).or_exit(exit::UNREACHABLE)?;
    if args.common.json {
        println!("{}", serde_json::to_string_pretty(&status).or_exit(exit::FAILED)?);
    } else {
        print(&status);
    }
    Ok(())
}

/// The name that JSON has for a value.
fn name(value: &impl serde::Serialize) -> String {
    serde_json::to_value(value).ok().and_then(|v| v.as_str().map(String::from)).unwrap_or_default()
}

/// Prints the status for people.
fn print(s: &Status) {
    println!("phase      {}", name(&s.phase));
    if !s.hindrance.is_empty() {
        println!("hindrance  {}", s.hindrance);
    }
    println!("alpha      {:.2} deg commanded, {:.2} deg measured", s.alpha_deg, s.alpha_measured_deg);
    println!("volume     goal {:.1} ml, d {:.1} ml, poured {} ml (estimate)", s.goal_ml, s.d_ml, volume_words(s.poured_ml, s.poured_sd_ml));
    println!("weights    {} ({} taken)", if s.weights.is_empty() { "none" } else { &s.weights }, s.weights_taken);
    if !s.weights_refused.is_empty() {
        println!("           refused: {}", s.weights_refused);
    }
    println!("ticks      {} ({} late, {} skipped)", s.ticks, s.late_ticks, s.skipped_ticks);
    println!("features   {} ({} stale, {} bridged, {} ignored)", s.features, s.stale_features, s.bridged_frames, s.ignored_features);
    let c = s.clipped;
    println!("clipped    angle {}, rate {}, acceleration {}, not finite {}", c.angle, c.rate, c.acceleration, c.not_finite);
    println!("loop       {} allocations, {} page faults, {} events lost", s.loop_allocations, s.loop_page_faults, s.events_lost);
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
        println!("{:>12}  {what}  {:5.1} s  {}", o.episode, o.seconds, o.reason.words());
    }
}
