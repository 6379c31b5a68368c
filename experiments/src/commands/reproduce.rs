//! `experiments reproduce`: repeats section 4 of the paper, and says which of its claims hold.
//!
//! Ordinary threads, all cores; allocates. Trains once with the plain cross-entropy and once with the clip of p to [1e-7, 1 - 1e-7] that
//! Keras applies silently. The same arguments give the same numbers. A file that cannot be written is an error of one line.

use std::path::PathBuf;

use rayon::prelude::*;
use serde_json::{Value, json};
use shared::exit::{self, Failure, OrExit as _};
use trainer::method::policy_gradient::{DELTA, KERAS_CLIP};
use trainer::report::json_out::JsonOut;
use trainer::report::page::{figure, page, table};
use trainer::report::plot::{PlotSeries, plot};

use crate::paper_section_4::{KAPPAS, Run, run_once, triangle};

/// A run whose mean absolute error is below this has learned to pour, ml. Chosen by hand: a small share of goals up to 160 ml.
const GOOD_MAE_ML: f64 = 10.0;

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
    /// Prints the report as JSON in place of the text, or writes it to FILE beside it, for `trainer report`.
    #[arg(long, value_name = "FILE", num_args = 0..=1, default_missing_value = "-")]
    json: Option<PathBuf>,
}

/// The runs with one form of the cross-entropy.
struct Form {
    name: &'static str,
    runs: Vec<Run>,
    /// Mean absolute errors of the runs at their end, sorted, ml.
    mae_ml: Vec<f64>,
}

impl Form {
    fn run(name: &'static str, clip: Option<f32>, top: usize, args: &Args) -> Self {
        let runs: Vec<Run> = (0..args.seeds).into_par_iter().map(|seed| run_once(top, clip, args.steps as usize, seed + 1)).collect();
        let mut mae_ml: Vec<f64> = runs.iter().map(Run::last_mae_ml).collect();
        mae_ml.sort_by(f64::total_cmp);
        Self { name, runs, mae_ml }
    }

    /// Number of runs that learned to pour.
    fn good(&self) -> usize {
        self.mae_ml.iter().filter(|m| **m < GOOD_MAE_ML).count()
    }

    /// Its row of the table.
    fn row(&self) -> Vec<String> {
        let (n, mae) = (self.mae_ml.len(), &self.mae_ml);
        vec![
            self.name.to_owned(),
            format!("{:.1}", mae[n / 2]),
            format!("{:.1}", mae[0]),
            format!("{:.1}", mae[n - 1]),
            format!("{} of {n}", self.good()),
        ]
    }

    /// Its two figures: convergence, and goal against poured volume.
    fn figures(&self) -> String {
        let (runs, name) = (&self.runs, self.name);
        let curves: Vec<PlotSeries> =
            runs.iter().enumerate().map(|(k, r)| PlotSeries::line(&format!("seed {}", k + 1), r.curve.clone())).collect();
        let converges =
            figure(&plot("Adam step", "mean absolute error in ml", &curves, true), &format!("Convergence, cross-entropy {name}."));
        let mut dots = vec![PlotSeries::reference("poured = goal", vec![(0.0, 0.0), (160.0, 160.0)])];
        let beside =
            |k: usize, r: &Run| r.pours.iter().map(|(goal, poured)| (goal + (k as f64 - (runs.len() - 1) as f64 / 2.0), *poured)).collect();
        dots.extend(runs.iter().enumerate().map(|(k, r)| PlotSeries::dots(&format!("seed {}", k + 1), beside(k, r))));
        converges
            + &figure(
                &plot("goal in ml (seeds side by side)", "poured in ml", &dots, true),
                &format!("Goal against poured, cross-entropy {name}."),
            )
    }

    /// Whether the paper's claim holds, in words.
    fn verdict(&self) -> String {
        let (good, n) = (self.good(), self.mae_ml.len());
        let words = if good == 0 {
            "does not learn to pour in any run: the claim of a converging policy does not hold"
        } else if 2 * good > n {
            "converges in most runs to below 10 ml: the claim of convergence and of arbitrary goals holds, roughly"
        } else {
            "converges in some runs only: whether the claim holds depends on the seed"
        };
        format!("Cross-entropy {}: {words} ({good} of {n}).", self.name)
    }
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let poured = |top: usize| triangle(top).1.iter().sum::<f64>();
    let far = |top: usize| (poured(top) - args.weight).abs();
    let top = (50..=100).min_by(|a, b| far(*a).total_cmp(&far(*b))).unwrap_or(70);
    let weight = poured(top);
    let json = JsonOut::open(args.json.as_deref())?;
    if json.tables() {
        println!(
            "section 4: simulator a, 300 ml, one triangle of +-1 degree up to {top} degrees pours {weight:.1} ml; delta {DELTA}, 2 actions, \
             4-40-40-2"
        );
    }
    let forms: Vec<Form> = [("as printed", None), ("clipped to [1e-7, 1 - 1e-7]", Some(KERAS_CLIP))]
        .into_iter()
        .map(|(name, clip)| Form::run(name, clip, top, args))
        .collect();
    let verdicts: Vec<String> = forms.iter().map(Form::verdict).collect();
    if json.tables() {
        for Form { name, mae_ml, .. } in &forms {
            println!("{name:<28} MAE of the runs: {}", mae_ml.iter().map(|m| format!("{m:.1}")).collect::<Vec<_>>().join(" "));
        }
        println!("{}", verdicts.join("\n"));
    }
    let html = html(args, top, weight, &forms, &verdicts);
    let runs: Vec<Value> = forms.iter().map(|f| json!({ "name": f.name, "mae_ml": f.mae_ml })).collect();
    let report = json!({ "kind": "reproduction", "html": html, "weight_ml": weight, "runs": runs });
    if let Some(file) = &args.html {
        std::fs::write(file, page("Decant: section 4 of the paper", &html))
            .map_err(|e| format!("{}: {e}", file.display()))
            .or_exit(exit::FAILED)?;
    }
    json.write(&report)
}

/// The report as a part of a page.
fn html(args: &Args, top: usize, weight_ml: f64, forms: &[Form], verdicts: &[String]) -> String {
    let intro = format!(
        "<h2>Section 4 of the paper</h2><p>Simulator a, two actions of ±1 degree, 4-40-40-2 (1922 parameters), one episode: a triangle up to {top} degrees that pours {weight_ml:.1} ml; {KAPPAS} random kappas; {} seeds. Judged on 24 pours of 20 to 160 ml from 200, 300 and 400 ml.</p>",
        args.seeds
    );
    let heading = ["cross-entropy", "median MAE of the runs in ml", "best in ml", "worst in ml", "runs below 10 ml"];
    let mut rows = vec![heading.map(String::from).to_vec()];
    rows.extend(forms.iter().map(Form::row));
    let plots: String = forms.iter().map(Form::figures).collect();
    format!("{intro}<p>{}</p>{}<div class=plots>{plots}</div>", verdicts.join("<br>"), table(&rows))
}
