//! `rt-controller record`: runs the Gaussian curve of eq. (1) and produces one episode. It is a short, ordinary process, and every
//! failure is one line.

use std::io::{BufRead, IsTerminal, Write};
use std::path::Path;

use shared::config::Config;
use shared::control::Request;
use shared::episode::{WeightError, check_reading, set_weight};
use shared::exit::{self, Failure, OrExit as _, failure};
use shared::gaussian_curve::Curve;
use shared::os;

use super::pour;
use crate::client::Common;

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  rt-controller record --lambda 70 --gamma 0.3\n  rt-controller record --lambda 60 --gamma 0.5 --weight 83\n\n\
The curve is alpha(t) = lambda exp(-gamma (t - beta)^2), from t = 0 to 2 beta. Afterwards the command asks for the weight\n\
on the scale, if a person is at the terminal; it can also be given later with `feature-worker episodes weigh FILE --weight G`."
)]
pub struct Args {
    /// Height of the curve, degrees.
    #[arg(long)]
    lambda: f32,
    /// How narrow the curve is, 1/s^2.
    #[arg(long)]
    gamma: f32,
    /// Time of the curve's top, s; by default chosen so that the curve starts at 0.05 degrees.
    #[arg(long)]
    beta: Option<f32>,
    /// Weight on the scale in g, if it is known already and need not be asked for.
    #[arg(long)]
    weight: Option<f64>,
    #[command(flatten)]
    common: Common,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let config = Config::read(&args.common.config).or_exit(exit::BAD_INPUT)?;
    // It is known before anything moves that the weight can be written.
    let given_g = args.weight.map(|g| check_reading(g).map_err(|e| format!("--weight {g}: {e}"))).transpose().or_exit(exit::BAD_INPUT)?;
    let own = Curve::from_upright(args.lambda, args.gamma);
    let curve = Curve { beta_s: args.beta.unwrap_or(own.beta_s), ..own };
    let ended = pour::order(&config.cell, &Request::Record(curve))?;
    ended.as_result().inspect_err(|_| report_early(&ended, &curve, given_g, args.common.json))?;
    let pour::Ended { outcome, recorded, .. } = ended;
    let file = match recorded.map(|r| r.file) {
        Some(Ok(file)) => file,
        Some(Err(e)) => return Err(failure(exit::FAILED, format!("the curve was run, but not recorded: {e}"))),
        None => {
            let what = "the curve was run, but no recorder answered: is `feature-worker run` running?";
            return Err(failure(exit::UNREACHABLE, what));
        }
    };
    let weight_g = given_g.or_else(ask_weight);
    if let Some(weight_g) = weight_g {
        set_weight(Path::new(&file), weight_g).or_exit(exit::FAILED)?;
    }
    if args.common.json {
        println!("{}", serde_json::json!({ "outcome": outcome, "curve": curve, "episode_file": file, "weight_g": weight_g }));
    } else {
        println!("recorded: {file}");
        match weight_g {
            Some(weight_g) => println!("weight: {weight_g} g"),
            None => println!("read the scale, then: feature-worker episodes weigh {file} --weight GRAMS"),
        }
    }
    Ok(())
}

/// Says what there is of a curve that was not run to its end: its file, if there is one, and that the weight is not in it.
fn report_early(ended: &pour::Ended, curve: &Curve, given_g: Option<f64>, json: bool) {
    let file = ended.recorded.as_ref().and_then(|r| r.file.as_ref().ok());
    if json {
        let weight_g = None::<f64>;
        println!("{}", serde_json::json!({ "outcome": ended.outcome, "curve": curve, "episode_file": file, "weight_g": weight_g }));
    } else if let Some(file) = file {
        println!("recorded: {file}");
    }
    if given_g.is_some() {
        eprintln!("note: the weight is not written, because the curve was not run to its end: read the scale again");
    }
}

/// A plain decimal number as people type it. 1,250 and 1.250 are a thousand to some and one to others, so neither is taken.
fn reading(text: &str) -> Result<f64, String> {
    let grouped = text.split_once([',', '.']).is_some_and(|(whole, rest)| rest.len() == 3 && !whole.is_empty() && whole != "0");
    if grouped {
        return Err("a comma or point before exactly three digits is not understood: leave it out, or give other decimals".into());
    }
    let weight_g = text.replace(',', ".").parse().map_err(|_| WeightError::NotAReading);
    weight_g.and_then(check_reading).map_err(|e| format!("{e}, for example 83"))
}

/// Asks a person for the weight on the scale, if there is one at the terminal; an empty line means that it is given later.
fn ask_weight() -> Option<f64> {
    let stdin = std::io::stdin();
    if !stdin.is_terminal() {
        return None;
    }
    // Nothing moves any more that they would have to stop, and the read would go on over them. The weight can be given later.
    let _ = os::end_at_signals(exit::INTERRUPTED);
    loop {
        eprint!("weight on the scale in g (empty: later): ");
        let _ = std::io::stderr().flush();
        let mut line = String::new();
        if stdin.lock().read_line(&mut line).is_err() || line.trim().is_empty() {
            return None;
        }
        match reading(line.trim()) {
            Ok(weight_g) => return Some(weight_g),
            Err(e) => eprintln!("weight '{}': {e}", line.trim()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects whoever types what a scale shows: what is a thousand to some and one to others is asked for again, as on the page.
    #[test]
    fn a_reading_has_one_meaning() {
        assert_eq!(["83", "83,5", "83.5", "0.125"].map(|text| reading(text).unwrap()), [83.0, 83.5, 83.5, 0.125]);
        for text in ["1,250", "1.250", "", "-3", "many"] {
            assert!(reading(text).is_err(), "{text}");
        }
    }
}
