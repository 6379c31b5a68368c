//! `rt-controller replay FILE`: runs a journal through the same core again and compares every answer. It is a short,
//! ordinary process, and every failure is one line.

use std::path::PathBuf;

use shared::exit::{self, Failure, OrExit as _, failure};
use shared::plural::counted;

use crate::journal::{self, Replay};

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  rt-controller replay out/journal.bin\n  rt-controller replay out/journal.bin --table > ticks.csv\n\n\
Exit codes: 0 every answer that could be compared is the same to the bit, 1 some differ, a tick came at another time, or none could be compared, 2 the file cannot be read.")]
pub struct Args {
    /// The journal (controller.journal of the configuration).
    file: PathBuf,
    /// Prints every tick as CSV instead of the summary.
    #[arg(long)]
    table: bool,
    /// Prints the summary as JSON.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    if args.table {
        println!("tick,at_ns,phase,area_px2,alpha_deg,alpha_measured_deg,v_ml,d_ml,poured_ml");
    }
    let replay = journal::replay(&args.file, |_, output| {
        let t = output.telemetry;
        if args.table {
            let values = [t.area_px2, t.alpha_deg, t.alpha_measured_deg, t.v_ml, t.d_ml, t.poured_ml].map(|v| v.to_string()).join(",");
            println!("{},{},{},{values}", t.tick, t.at_ns, t.phase);
        }
    });
    let replay = replay.or_exit(exit::BAD_INPUT)?;
    if args.json {
        println!("{}", serde_json::json!(replay));
    } else if !args.table {
        let Replay { ticks, compared, ended, different, different_deadlines, .. } = &replay;
        let ticks = counted(*ticks, "tick");
        println!("{ticks} replayed and {compared} compared, pours and recordings: {}, different answers: {different}", ended.len());
        println!("{} at another time than the pacing gives", counted(*different_deadlines, "tick"));
        if replay.continued {
            println!("the file begins in the middle of a run: answers are compared from its first pour or recording on, and no deadlines");
        }
        if replay.lost > 0 {
            let lost = counted(replay.lost, "tick");
            println!(
                "{lost} lost where the controller fell behind: behind a gap answers are compared from the next pour or recording on, and no deadlines"
            );
        }
        if replay.cut_off {
            println!("the file ends in the middle of an entry: the controller was killed, or is still writing");
        }
    }
    if let Some(tick) = replay.first_different {
        let what = format!("{}: the replay differs from tick {tick} on: another version of the code?", args.file.display());
        return Err(failure(exit::FAILED, what));
    }
    let why = match (replay.compared, replay.different_deadlines) {
        (0, _) => "nothing could be compared: the file has no tick of the begin of a run, and no pour or recording begins in it".into(),
        (_, 0) => return Ok(()),
        (_, n) => format!("{} at another time than the pacing gives: another version of the code?", counted(n, "tick")),
    };
    Err(failure(exit::FAILED, format!("{}: {why}", args.file.display())))
}
