//! The cell and its yardsticks in turns, at rest, under load, and in a storm of other programs' questions.
//!
//! Ordinary thread; allocates and blocks. Their order changes from round to round, so that warming up affects all alike.

use serde_json::{Map, Value};

use super::bare_loop;
use super::cell_run::{CellRun, run_cell};
use super::condition::Condition;
use super::measured::Measured;
use super::other_programs::{cyclictest, latencies_us, load};
use super::ratios::Ratios;
use crate::own_cell::{OwnCell, OwnCellError};

/// The conditions under which the machine is measured.
const CONDITIONS: [&str; 3] = ["at rest", "under load", "in a storm"];
/// Length of a quick run's cell and of its yardsticks, s: with starting and stopping, less than 60 s in all.
const QUICK_S: [u64; 2] = [18, 10];
/// Parts into which a quick run's ticks are cut in place of rounds: each has more than 100 ticks.
const QUICK_PARTS: usize = 5;

/// Measures in `rounds` rounds with runs of `seconds`.
///
/// # Errors
/// When the cell or a yardstick cannot be run, or Ctrl-C is pressed; what was measured until then is lost.
pub fn measure(cell: &mut OwnCell, rounds: usize, seconds: u64) -> Result<Measured, OwnCellError> {
    let mut conditions = CONDITIONS.map(Condition::new);
    for round in 0..rounds {
        for condition in &mut conditions {
            let _load = if condition.name == CONDITIONS[1] { Some(load()?) } else { None };
            let storm = condition.name == CONDITIONS[2];
            for turn in 0..3 {
                let say = |cell: &OwnCell, what: &str| cell.note(&format!("round {} of {rounds}: {what} {}", round + 1, condition.name));
                match (turn + round) % 3 {
                    0 => {
                        say(cell, "the cell");
                        condition.cells.push(run_cell(cell, seconds, storm)?);
                    }
                    1 => {
                        say(cell, "cyclictest");
                        condition.cyclictest.push(run_cyclictest(cell, seconds)?);
                    }
                    _ => {
                        say(cell, "the bare loop");
                        condition.bare.push(bare_loop::run(cell, seconds)?);
                    }
                }
            }
            let last = condition.cells.len() - 1;
            let ratios = Ratios::new(&condition.cells[last].ticks, &condition.cyclictest[last], &condition.bare[last]);
            condition.rounds.push(ratios);
        }
    }
    Ok(told(&conditions))
}

/// Measures at rest only, in less than a minute: one run of the cell and of each yardstick. In place of rounds, the ticks are cut into
/// parts, each over the whole yardstick. So a disturbance of one of the three runs is not told from a change.
///
/// # Errors
/// As [`measure`].
pub fn measure_quickly(cell: &mut OwnCell) -> Result<Measured, OwnCellError> {
    let [cell_s, yardstick_s] = QUICK_S;
    let mut condition = Condition::new(CONDITIONS[0]);
    cell.note("quick: the bare loop");
    let bare = bare_loop::run(cell, yardstick_s)?;
    cell.note("quick: the cell");
    let run: CellRun = run_cell(cell, cell_s, false)?;
    cell.note("quick: cyclictest");
    let cyclictest = run_cyclictest(cell, yardstick_s)?;
    condition.rounds = run.ticks.parts(QUICK_PARTS).iter().map(|part| Ratios::new(part, &cyclictest, &bare)).collect();
    condition.cells.push(run);
    condition.cyclictest.push(cyclictest);
    condition.bare.push(bare);
    Ok(told(&[condition]))
}

/// Latencies of one run of cyclictest, us.
fn run_cyclictest(cell: &OwnCell, seconds: u64) -> Result<Vec<f64>, OwnCellError> {
    let child = cyclictest(cell, seconds, 0)?;
    let output = child.wait_with_output().map_err(|error| OwnCellError::File { what: "cyclictest".into(), error })?;
    cell.interrupted()?;
    let latencies = latencies_us(&output.stdout);
    if latencies.is_empty() {
        return Err(OwnCellError::Other("cyclictest printed no sample: may it use SCHED_FIFO and lock memory?".into()));
    }
    Ok(latencies)
}

/// What the conditions become.
fn told(conditions: &[Condition]) -> Measured {
    let (mut text, mut html, mut numbers) = (String::new(), String::new(), Map::new());
    for condition in conditions {
        let part = condition.told();
        text += &part.text;
        html += &part.html;
        numbers.insert(condition.name.into(), part.numbers);
    }
    let verdict = conditions.iter().map(Condition::verdict).collect::<Vec<_>>().join(" ");
    Measured {
        verdict,
        rounds: conditions.iter().map(|c| (c.name, c.rounds.clone())).collect(),
        numbers: Value::Object(numbers),
        text,
        html,
    }
}
