//! The part of a page that shows a training.
//!
//! Pure functions, for any thread. They allocate and do not fail.

use serde_json::Value;

use super::json::{items, number, numbers, rounded, text};
use super::page::{escape, facts, figure};
use super::plot::{PlotSeries, plot};
use crate::network::REPORT_EVERY;

/// A training as `trainer train` and `trainer refine` write it.
pub fn training(v: &Value) -> String {
    let mut html = format!("<h2>Training {}</h2>", escape(&text(&v["weights"])));
    html += &facts(&origin(v));
    html += "<div class=plots>";
    let loss: Vec<(f64, f64)> = (1..).map(|k| (k * REPORT_EVERY) as f64).zip(numbers(&v["loss"])).collect();
    html += &figure(
        &plot("step of the optimiser", "loss", &[PlotSeries::line("loss", loss)], false),
        "Learning curve of the network: the cross-entropy between its answers and the actions that the method teaches, mean over the examples of \
         one step of the optimiser (Adam). It falls while something is learned and levels off when no more is to be had. Its level is no error in \
         ml: an evaluation tells that. If it still falls at its end, more steps may help.",
    );
    let cost: Vec<(f64, f64)> = (1..).map(f64::from).zip(numbers(&v["search_cost"])).collect();
    if !cost.is_empty() {
        html += &figure(
            &plot("iteration", "cost", &[PlotSeries::line("cost", cost)], true),
            "Search of the control law: mean cost of the best candidates of each round in pours of the fitted model, made of error and time. It falls \
             until the search has settled.",
        );
    }
    if items(&v["extra"]["pours"]).next().is_some() {
        html += &weighed_pours(&v["extra"]["pours"]);
    }
    html + "</div>"
}

/// What was trained on what, in words.
fn origin(v: &Value) -> Vec<(String, String)> {
    let options = &v["options"];
    let calibration = &v["calibration"];
    let row = |name: &str, what: String| (name.to_owned(), what);
    let mut rows = vec![
        row("identity", text(&v["identity"])),
        row("method", text(&options["method"])),
        row("actions", options["actions"].to_string()),
        row("estimate", text(&options["estimate"])),
        row("seed", options["seed"].to_string()),
        row("episodes", items(&v["episodes"]).count().to_string()),
        row("data (SHA-256)", text(&v["data_sha256"])),
        row(
            "calibration",
            format!(
                "v = c area^q exp(tilt z) ml, z = (alpha - 60 degrees) / 30 degrees; c {:.3e}, q {}, tilt {}",
                number(&calibration["volume_at_1_px2_ml"]),
                rounded(&calibration["area_exponent"], 3),
                rounded(&calibration["log_tilt_slope"], 3)
            ),
        ),
    ];
    rows.extend(items(&v["left_out"]).map(|l| row(&format!("left out: {}", text(&l[0])), text(&l[1]))));
    rows
}

/// The errors of the weighed pours so far.
fn weighed_pours(pours: &Value) -> String {
    let of_number = |error_ml: fn(&Value) -> f64| items(pours).map(|p| (number(&p["number"]), error_ml(p))).collect();
    let series = [
        PlotSeries::dots("this pour", of_number(|p| (number(&p["weight_g"]) - number(&p["goal_ml"])).abs())),
        PlotSeries::line("mean so far", of_number(|p| number(&p["mae_so_far_ml"]))),
    ];
    figure(&plot("weighed pours", "|error| in ml", &series, true), "Error against the number of weighed pours.")
}
