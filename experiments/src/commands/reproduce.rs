//! `experiments reproduce`: repeats section 4 of the paper, and says what holds of it.
//!
//! Ordinary threads, both cores; allocates. The paper's simulation (simulator a), two actions of +-1 degree, two hidden layers
//! of 40 neurons (1922 parameters), one experimental episode (a triangle of +-1 degree a frame), random kappa, eq. (5) to (8)
//! as printed; once with the plain cross-entropy and once with the clip of p to [1e-7, 1 - 1e-7] that Keras applies silently.
//! The same arguments give the same numbers.

use std::path::PathBuf;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use rayon::prelude::*;
use shared::exit::{self, Failure, OrExit as _};
use shared::mlp::InputScale;
use trainer::method::policy_gradient::{DELTA, KERAS_CLIP, LAMBDA, reward};
use trainer::network::{Adam, Example, Network};
use trainer::report::page::{self, figure, table};
use trainer::report::plot::{PlotSeries, plot};

use simulator::physics::paper::PaperPour;

/// Adam steps between two looks at the policy.
const LOOK_EVERY: usize = 250;
/// Frames of a pour.
const FRAMES: usize = 900;
/// Random kappas drawn from the one episode.
const KAPPAS: usize = 40;

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  experiments reproduce
  experiments reproduce --weight 55 --html out/section4.html")]
pub struct Args {
    /// Volume that the one episode pours, ml; the triangle nearest to it is taken.
    #[arg(long, default_value_t = 99.0)]
    weight: f64,
    /// Adam steps.
    #[arg(long, default_value_t = 3000, value_parser = clap::value_parser!(u32).range(250..=100_000))]
    steps: u32,
    /// Runs, each with its own seed.
    #[arg(long, default_value_t = 8, value_parser = clap::value_parser!(u64).range(1..=100))]
    seeds: u64,
    /// Writes the report as a page.
    #[arg(long)]
    html: Option<PathBuf>,
    /// Writes the report as JSON, for `trainer report`.
    #[arg(long)]
    json: Option<PathBuf>,
}

/// One run: mean absolute error after each look, and the last policy's pours (goal, poured).
struct Run {
    curve: Vec<(f64, f64)>,
    pours: Vec<(f64, f64)>,
}

impl Run {
    fn last_mae(&self) -> f64 {
        self.curve.last().map_or(f64::NAN, |c| c.1)
    }
}

/// The triangle up to `top` degrees and back, 1 degree a frame, from 300 ml: angles and volumes.
fn triangle(top: usize) -> (Vec<f64>, Vec<f64>) {
    let alphas: Vec<f64> = (0..=top).chain((0..top).rev()).map(|a| a as f64).collect();
    let mut pour = PaperPour::new(300.0);
    let volumes = alphas.iter().map(|a| f64::from(pour.frame(*a)) / 400.0).collect();
    (alphas, volumes)
}

fn pour_with(net: &Network, scale: &InputScale, init_ml: f64, goal_ml: f64) -> f64 {
    let mut pour = PaperPour::new(init_ml);
    let (mut alpha, mut v) = (0.0f64, [0.0f32; 3]);
    let mut d = goal_ml;
    for _ in 0..FRAMES {
        let logits = net.logits(&scale.apply(v, d as f32));
        alpha = (alpha + if logits[1] > logits[0] { 1.0 } else { -1.0 }).clamp(0.0, 110.0);
        let now = pour.frame(alpha) / 400.0;
        v = [now, v[0], v[1]];
        d -= f64::from(now);
    }
    pour.poured_ml()
}

/// Goals that the training never saw, from volumes that it never saw.
fn goals() -> impl Iterator<Item = (f64, f64)> {
    [200.0, 300.0, 400.0].into_iter().flat_map(|init| (1..=8).map(move |k| (init, 20.0 * f64::from(k))))
}

fn run_once(top: usize, clip: Option<f32>, steps: usize, seed: u64) -> Run {
    let (alphas, volumes) = triangle(top);
    let weight: f64 = volumes.iter().sum();
    let scale = InputScale::default();
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let mut sequences = Vec::new();
    for _ in 0..KAPPAS {
        // Eq. (6), d_{i+1} = d_i - v_i, the action before the image, eq. (5).
        let mut d = rng.random_range(0.5..1.5) * weight;
        let mut states = Vec::new();
        for i in 1..volumes.len() {
            let at = |k: usize| i.checked_sub(k).map_or(0.0, |j| volumes[j]) as f32;
            // As printed: state i holds d_i, from which v_i has yet to be taken.
            states.push((scale.apply([at(0), at(1), at(2)], d as f32), u8::from(alphas[i] > alphas[i - 1])));
            d -= volumes[i];
        }
        sequences.push((states, reward(d)));
    }
    // Eq. (7).
    let n = sequences.len() as f64;
    let mean = sequences.iter().map(|s| s.1).sum::<f64>() / n;
    let sd = (sequences.iter().map(|s| (s.1 - mean).powi(2)).sum::<f64>() / n).sqrt().max(1e-9);
    let samples: Vec<Example> = sequences
        .iter()
        .flat_map(|(states, r)| {
            let weight = (LAMBDA * (r - mean) / sd) as f32;
            states.iter().map(move |(x, action)| Example { x: *x, action: *action, weight })
        })
        .collect();
    let mut net = Network::new([4, 40, 40, 2], &mut rng);
    let mut adam = Adam::new(&net);
    let look = |net: &Network| -> Vec<(f64, f64)> { goals().map(|(init, goal)| (goal, pour_with(net, &scale, init, goal))).collect() };
    let mae = |pours: &[(f64, f64)]| pours.iter().map(|(g, p)| (p - g).abs()).sum::<f64>() / pours.len() as f64;
    let mut pours = look(&net);
    let mut curve = vec![(0.0, mae(&pours))];
    for step in 1..=steps {
        let batch: Vec<Example> = (0..256).map(|_| samples[rng.random_range(0..samples.len())]).collect();
        net.learn(&batch, clip, 1e-3, &mut adam);
        if step % LOOK_EVERY == 0 {
            pours = look(&net);
            curve.push((step as f64, mae(&pours)));
        }
    }
    Run { curve, pours }
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let poured = |top: usize| triangle(top).1.iter().sum::<f64>();
    let far = |top: usize| (poured(top) - args.weight).abs();
    let top = (50..=100).min_by(|a, b| far(*a).total_cmp(&far(*b))).unwrap_or(70);
    let weight = poured(top);
    println!(
        "section 4: simulator a, 300 ml, one triangle of +-1 degree up to {top} degrees pours {weight:.1} ml; delta {DELTA}, 2 actions, 4-40-40-2"
    );
    let intro = format!(
        "<h2>Section 4 of the paper</h2><p>Simulator a, two actions of ±1 degree, 4-40-40-2 (1922 parameters), one episode: a triangle up to {top} degrees that pours {weight:.1} ml; {KAPPAS} random kappas; {} seeds. Judged on 24 pours of 20 to 160 ml from 200, 300 and 400 ml.</p>",
        args.seeds
    );
    let mut rows = vec![vec![
        "cross-entropy".to_owned(),
        "median MAE of the runs in ml".into(),
        "best in ml".into(),
        "worst in ml".into(),
        "runs below 10 ml".into(),
    ]];
    let mut plots = String::new();
    let mut verdicts = Vec::new();
    let mut json_runs = Vec::new();
    for (name, clip) in [("as printed", None), ("clipped to [1e-7, 1 - 1e-7]", Some(KERAS_CLIP))] {
        let runs: Vec<Run> = (0..args.seeds).into_par_iter().map(|seed| run_once(top, clip, args.steps as usize, seed + 1)).collect();
        let mut last: Vec<f64> = runs.iter().map(Run::last_mae).collect();
        last.sort_by(f64::total_cmp);
        let good = last.iter().filter(|m| **m < 10.0).count();
        println!("{name:<28} MAE of the runs: {}", last.iter().map(|m| format!("{m:.1}")).collect::<Vec<_>>().join(" "));
        rows.push(vec![
            name.to_owned(),
            format!("{:.1}", last[last.len() / 2]),
            format!("{:.1}", last[0]),
            format!("{:.1}", last[last.len() - 1]),
            format!("{good} of {}", last.len()),
        ]);
        let curves: Vec<PlotSeries> =
            runs.iter().enumerate().map(|(k, r)| PlotSeries::line(&format!("seed {}", k + 1), r.curve.clone())).collect();
        plots += &figure(&plot("Adam step", "mean absolute error in ml", &curves, true), &format!("Convergence, cross-entropy {name}."));
        let mut dots = vec![PlotSeries::reference("poured = goal", vec![(0.0, 0.0), (160.0, 160.0)])];
        let beside =
            |k: usize, r: &Run| r.pours.iter().map(|(goal, poured)| (goal + (k as f64 - (runs.len() - 1) as f64 / 2.0), *poured)).collect();
        dots.extend(runs.iter().enumerate().map(|(k, r)| PlotSeries::dots(&format!("seed {}", k + 1), beside(k, r))));
        plots += &figure(
            &plot("goal in ml (seeds side by side)", "poured in ml", &dots, true),
            &format!("Goal against poured, cross-entropy {name}."),
        );
        verdicts.push((name, good, last.len()));
        json_runs.push(serde_json::json!({ "name": name, "mae_ml": last }));
    }
    let say = |(name, good, n): &(&str, usize, usize)| {
        let words = if *good == 0 {
            "does not learn to pour in any run: the claim of a converging policy does not hold"
        } else if 2 * good > *n {
            "converges in most runs to below 10 ml: the claim of convergence and of arbitrary goals holds, roughly"
        } else {
            "converges in some runs only: the claim holds by luck of the seed"
        };
        format!("Cross-entropy {name}: {words} ({good} of {n}).")
    };
    let verdicts: Vec<String> = verdicts.iter().map(say).collect();
    println!("{}", verdicts.join("\n"));
    let html = format!("{intro}<p>{}</p>{}<div class=plots>{plots}</div>", verdicts.join("<br>"), table(&rows));
    let report = serde_json::json!({ "kind": "reproduction", "html": html, "weight_ml": weight, "runs": json_runs });
    let page = || page::page("Decant: section 4 of the paper", &html);
    let files = [(args.html.as_ref(), page()), (args.json.as_ref(), report.to_string())];
    for (file, text) in files.iter().filter_map(|(f, t)| f.map(|f| (f, t))) {
        std::fs::write(file, text).map_err(|e| format!("{}: {e}", file.display())).or_exit(exit::FAILED)?;
    }
    Ok(())
}
