//! The cell and its yardsticks in turns, at rest, under load, and in a storm of other programs' questions.
//!
//! Ordinary thread; allocates and blocks. Their order changes from round to round, so that warming up affects all alike.

use std::time::Duration;

use serde_json::{Map, Value};
use shared::os::now_ns;

use super::bare_loop;
use super::cell_run::{run_cell, run_cell_beside};
use super::condition::Condition;
use super::measured::Measured;
use super::other_programs::{cyclictest, latencies_us, load};
use super::ratios::Ratios;
use super::storm::STATES_HZ;
use super::tick_times::TickTimes;
use crate::own_cell::{OwnCell, OwnCellError};

/// The conditions under which the machine is measured.
const CONDITIONS: [&str; 3] = ["at rest", "under load", "in a storm"];
/// Rate at which the cell's robot sends states, Hz: it is a CB3, unless the configuration says otherwise.
const ROBOT_HZ: u64 = 125;
/// How long a quick run's cell rests before it pours. With starting, pieces and stopping it takes less than 60 s.
const QUICK_REST: Duration = Duration::from_secs(4);
/// Number of pieces of a quick run: two for each of its rounds.
const QUICK_PIECES: usize = 10;
/// The times of the cell alone, the bare loop, and cyclictest in a piece, ms: each some thirty ticks or more.
const QUICK_PIECE_MS: [u64; 3] = [1_500, 1_000, 1_000];
/// The rounds that the pieces are put together to. The pieces of a round lie half a run apart, so that one of them falls into a pour.
const QUICK_ROUNDS: usize = 5;

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
                        condition.cyclictest.push(run_cyclictest(cell, Duration::from_secs(seconds))?);
                    }
                    _ => {
                        say(cell, "the bare loop");
                        condition.bare.push(bare_loop::run(cell, Duration::from_secs(seconds), if storm { STATES_HZ } else { ROBOT_HZ })?);
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

/// Measures at rest only, in less than a minute: one run of the cell, with its yardsticks in short turns while it goes on. A disturbance of
/// seconds so meets all three; only ticks without a yardstick beside them are counted.
///
/// # Errors
/// As [`measure`].
pub fn measure_quickly(cell: &mut OwnCell) -> Result<Measured, OwnCellError> {
    let mut condition = Condition::new(CONDITIONS[0]);
    cell.note("quick: the cell, and its yardsticks in turns");
    let whole = QUICK_REST + Duration::from_millis(QUICK_PIECES as u64 * QUICK_PIECE_MS.iter().sum::<u64>());
    let (mut run, pieces) = run_cell_beside(cell, (QUICK_REST, whole), false, measure_pieces)?;
    for round in 0..QUICK_ROUNDS {
        let (mut ticks, mut bare, mut cyclictest) = (TickTimes::default(), Vec::new(), Vec::new());
        for piece in pieces.iter().skip(round).step_by(QUICK_ROUNDS) {
            ticks.add(&TickTimes::read(cell, piece.from_ns, piece.to_ns)?);
            bare.extend_from_slice(&piece.bare);
            cyclictest.extend_from_slice(&piece.cyclictest);
        }
        condition.rounds.push(Ratios::new(&ticks, &cyclictest, &bare));
        condition.bare.push(bare);
        condition.cyclictest.push(cyclictest);
        if round == 0 {
            run.ticks = TickTimes { worst: std::mem::take(&mut run.ticks.worst), ..TickTimes::default() };
        }
        run.ticks.add(&ticks);
    }
    condition.cells.push(run);
    Ok(told(&[condition]))
}

/// One piece of a quick run: when the cell was alone, and what the yardsticks took after it, us.
struct Piece {
    from_ns: u64,
    to_ns: u64,
    bare: Vec<f64>,
    cyclictest: Vec<f64>,
}

/// The pieces of a quick run, one after the other.
fn measure_pieces(cell: &OwnCell) -> Result<Vec<Piece>, OwnCellError> {
    let [alone_ms, bare_ms, cyclictest_ms] = QUICK_PIECE_MS;
    let piece = |_| {
        let from_ns = now_ns();
        std::thread::sleep(Duration::from_millis(alone_ms));
        let to_ns = now_ns();
        let bare = bare_loop::run(cell, Duration::from_millis(bare_ms), ROBOT_HZ)?;
        let cyclictest = run_cyclictest(cell, Duration::from_millis(cyclictest_ms))?;
        Ok(Piece { from_ns, to_ns, bare, cyclictest })
    };
    (0..QUICK_PIECES).map(piece).collect()
}

/// Latencies of one run of cyclictest, us.
fn run_cyclictest(cell: &OwnCell, time: Duration) -> Result<Vec<f64>, OwnCellError> {
    let child = cyclictest(cell, time, 0)?;
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
    let mut verdict = conditions.iter().map(Condition::verdict).collect::<Vec<_>>().join(" ");
    if let [rest, _, storm] = conditions {
        verdict += &format!(" {}", storm.over(rest));
    }
    Measured {
        verdict,
        rounds: conditions.iter().map(|c| (c.name, c.rounds.clone())).collect(),
        numbers: Value::Object(numbers),
        text,
        html,
    }
}
