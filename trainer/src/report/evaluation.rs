//! The part of a page that shows evaluations.
//!
//! Pure functions, for any thread. They allocate and do not fail.

use std::collections::BTreeMap;

use serde_json::Value;

use super::json::{items, number, numbers, rounded, text};
use super::page::{escape, figure, table};
use super::plot::{PlotSeries, histogram, plot, plot_below};

/// Dots of a method in a plot: with every dot of a large evaluation, a page would be tens of megabytes.
const DOTS: usize = 600;
/// Width of the errors' bins, ml.
const BIN_ML: f64 = 0.5;
/// Errors beyond this are counted in the outermost bins, ml.
const LAST_BIN_ML: f64 = 12.0;

/// Columns of a table of errors. Chosen by hand: with the names of the rows they fit a window of 1,000 px.
const METHODS_A_TABLE: usize = 6;
/// The last number of standard deviations on the calibration's axis.
const LAST_SDS: f64 = 3.0;
/// Number of points of a line of it.
const SHARE_STEPS: u32 = 60;

/// An evaluation as `experiments evaluate` writes it.
pub fn evaluation(v: &Value) -> String {
    let shown = |key: &str| escape(&text(&v[key]));
    let mut html = format!(
        "<h2>Evaluation: simulator {}, container {}, change {}</h2><p>{} rigs from {}, {} data seeds, {} episodes and {} weighed pours. Errors in ml; the interval is 95 % over rigs and seeds.</p>",
        shown("sim"),
        shown("container"),
        shown("change"),
        shown("rigs"),
        shown("first_rig"),
        shown("seeds"),
        shown("episodes"),
        shown("weighed")
    );
    html += &summaries(&v["summaries"]);
    html += "<div class=plots>";
    html += &pours(&v["pours"]);
    html.extend(items(&v["traces"]).map(trace));
    html + "</div>"
}

/// Errors of each method. The methods are the columns, so that the table is narrow; many of them make several tables.
fn summaries(summaries: &Value) -> String {
    let heading = [
        "method",
        "n",
        "MAE",
        "±",
        "median",
        "p95",
        "max",
        "bias",
        "≤ 5 ml",
        "≤ 5 %",
        "never poured",
        "never stopped",
        "ended by mistake",
        "within the deviation",
        "measurement",
        "plain sum",
        "control",
        "s a pour",
    ];
    let mut methods = Vec::new();
    for s in items(summaries) {
        let percent = |key: &str| s[key].as_f64().map_or_else(|| "-".into(), |x| format!("{:.1}\u{a0}%", 100.0 * x));
        methods.push([
            text(&s["name"]),
            s["n"].to_string(),
            rounded(&s["mae_ml"], 2),
            rounded(&s["mae_ci_ml"], 2),
            rounded(&s["median_ml"], 2),
            rounded(&s["p95_ml"], 2),
            rounded(&s["max_ml"], 1),
            rounded(&s["bias_ml"], 2),
            percent("within_5_ml"),
            percent("within_5_percent"),
            s["never_poured"].to_string(),
            s["never_stopped"].to_string(),
            s["falsely_ended"].to_string(),
            percent("covered"),
            rounded(&s["measurement_ml"], 2),
            rounded(&s["sum_ml"], 2),
            rounded(&s["control_ml"], 2),
            rounded(&s["seconds"], 1),
        ]);
    }
    let names = heading.map(String::from);
    let one = |methods: &[[String; 18]]| {
        let row = |(i, name): (usize, &String)| [name.clone()].into_iter().chain(methods.iter().map(|m| m[i].clone())).collect();
        table(&names.iter().enumerate().map(row).collect::<Vec<Vec<String>>>())
    };
    methods.chunks(METHODS_A_TABLE).map(one).collect()
}

/// Goal against poured, and the errors' histogram, of each method.
fn pours(methods: &Value) -> String {
    let mut scatter = vec![PlotSeries::reference("poured = goal", vec![(0.0, 0.0), (200.0, 200.0)])];
    let mut bars = Vec::new();
    for method in items(methods) {
        let name = text(&method["name"]);
        let pours: Vec<(f64, f64)> =
            items(&method["groups"]).flat_map(items).map(|p| (number(&p["goal_ml"]), number(&p["true_ml"]))).collect();
        let every = (pours.len() / DOTS).max(1);
        let spread = |(k, (goal, poured)): (usize, &(f64, f64))| (goal + (k % 9) as f64 - 4.0, *poured);
        scatter.push(PlotSeries::dots(&name, pours.iter().step_by(every).enumerate().map(spread).collect()));
        let errors: Vec<f64> = pours.iter().map(|(goal, poured)| poured - goal).collect();
        bars.push(histogram(&name, &errors, BIN_ML, LAST_BIN_ML));
    }
    figure(&plot("goal in ml (spread by ±4 for sight)", "poured in ml", &scatter, true), "Goal against poured.")
        + &figure(&plot("error in ml (ends hold what is beyond)", "% of the pours", &bars, true), "Errors.")
        + &calibration(methods)
}

/// The share of the pours whose estimate is off by no more than so many of the standard deviations that were said, beside what an honest
/// deviation gives; nothing where none was said.
fn calibration(methods: &Value) -> String {
    let steps = || (0..=SHARE_STEPS).map(|k| LAST_SDS * f64::from(k) / f64::from(SHARE_STEPS));
    let normal = PlotSeries::reference("honest (normal)", steps().map(|sds| (sds, 100.0 * within_normal(sds))).collect());
    let mut lines = vec![normal];
    let mut count = 0;
    for method in items(methods) {
        let off_sds: Vec<f64> = items(&method["groups"])
            .flat_map(items)
            .filter(|p| number(&p["believed_sd_ml"]) > 0.0)
            .map(|p| (number(&p["true_ml"]) - number(&p["believed_ml"])).abs() / number(&p["believed_sd_ml"]))
            .collect();
        if off_sds.is_empty() {
            continue;
        }
        count += off_sds.len();
        let share = |sds: f64| 100.0 * off_sds.iter().filter(|off| **off <= sds).count() as f64 / off_sds.len() as f64;
        lines.push(PlotSeries::line(&text(&method["name"]), steps().map(|sds| (sds, share(sds))).collect()));
    }
    if count == 0 {
        return String::new();
    }
    let caption = format!("How often the estimate is within so many of its own standard deviations, over {count} pours.");
    figure(&plot("standard deviations", "% of the pours within", &lines, true), &caption)
}

/// The share of a normal distribution within so many standard deviations of its mean, by the midpoint rule.
fn within_normal(sds: f64) -> f64 {
    let steps = 200;
    let step = sds / f64::from(steps);
    let density = |x: f64| (-0.5 * x * x).exp() * (2.0 / std::f64::consts::PI).sqrt();
    (0..steps).map(|k| density((f64::from(k) + 0.5) * step) * step).sum()
}

/// One pour frame by frame.
fn trace(trace: &Value) -> String {
    let column = |key: &str| -> Vec<(f64, f64)> { numbers(&trace["t_s"]).into_iter().zip(numbers(&trace[key])).collect() };
    let area_px2: Vec<(f64, f64)> = column("area_4_px2").into_iter().map(|(t, quarter)| (t, 4.0 * quarter)).collect();
    let panels = [
        ("alpha, degrees", PlotSeries::line("alpha", column("alpha_deg"))),
        ("V_e, px²", PlotSeries::line("V_e", area_px2)),
        ("poured, ml", PlotSeries::line("poured", column("true_ml"))),
    ];
    let caption = format!("A pour of {} ml from {} ml, {}.", trace["goal_ml"], trace["init_ml"], text(&trace["name"]));
    figure(&plot_below("time in s", &panels), &caption)
}

/// Error against number of episodes, if several evaluations differ in that number; otherwise nothing.
pub fn against_episodes<'a>(values: impl Iterator<Item = &'a Value>) -> String {
    let mut by_method: BTreeMap<String, Vec<(f64, f64)>> = BTreeMap::new();
    for v in values.filter(|v| v["kind"] == "evaluation") {
        let n = v["episodes"].as_f64().unwrap_or(0.0) + v["weighed"].as_f64().unwrap_or(0.0);
        for s in items(&v["summaries"]) {
            by_method.entry(text(&s["name"])).or_default().push((n, number(&s["mae_ml"])));
        }
    }
    let series: Vec<PlotSeries> = by_method
        .into_iter()
        .filter(|(_, p)| p.iter().any(|(n, _)| *n != p[0].0))
        .map(|(name, mut points)| {
            points.sort_by(|a, b| a.0.total_cmp(&b.0));
            PlotSeries::line(&name, points)
        })
        .collect();
    if series.is_empty() {
        return String::new();
    }
    let svg = plot("episodes and weighed pours", "mean absolute error in ml", &series, true);
    format!(
        "<h2>Error against number of episodes</h2><div class=plots>{}</div>",
        figure(&svg, "Mean absolute error over all rigs and seeds.")
    )
}
