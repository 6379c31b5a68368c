//! `trainer report`: one self-contained HTML page of trainings and evaluations, plots inline as SVG.
//!
//! Offline, ordinary thread, allocates. Reads the JSON files that `trainer train`, `trainer refine`, `experiments evaluate`
//! and `experiments reproduce` write; a file of another kind is refused by name.

use std::path::PathBuf;

use plotters::prelude::*;
use serde_json::Value;
use shared::exit::{self, Failure, OrExit as _};

/// Command-line arguments of `trainer report`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  trainer report out/weights.bin.json --out out/training.html
  trainer report out/evaluation.json out/weights.bin.json --out out/report.html
  trainer report n1.json n5.json n10.json --out report.html     (error against number of episodes)")]
pub struct Args {
    /// JSON files written by `train`, `refine`, `evaluate --json` or `reproduce --json`.
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// The page.
    #[arg(long)]
    out: PathBuf,
}

/// How a series is drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Look {
    /// Joined by a line.
    Line,
    /// Dots.
    Dots,
    /// A thin dark line that the others are compared with; it takes none of their colours.
    Reference,
}

/// A line or a cloud of points.
#[derive(Debug, Clone)]
pub struct Series {
    /// Name in the legend.
    pub name: String,
    /// Points.
    pub points: Vec<(f64, f64)>,
    /// How it is drawn.
    pub look: Look,
}

impl Series {
    /// Joined points.
    pub fn line(name: &str, points: Vec<(f64, f64)>) -> Self {
        Self { name: name.into(), points, look: Look::Line }
    }
    /// Dots.
    pub fn dots(name: &str, points: Vec<(f64, f64)>) -> Self {
        Self { name: name.into(), points, look: Look::Dots }
    }
    /// What the others are compared with.
    pub fn reference(name: &str, points: Vec<(f64, f64)>) -> Self {
        Self { name: name.into(), points, look: Look::Reference }
    }
}

/// Colours that print apart in grey too.
const COLOURS: [RGBColor; 8] = [
    RGBColor(0, 90, 181),
    RGBColor(220, 50, 32),
    RGBColor(0, 128, 96),
    RGBColor(150, 80, 170),
    RGBColor(230, 145, 0),
    RGBColor(60, 60, 60),
    RGBColor(0, 150, 200),
    RGBColor(160, 110, 60),
];

/// Of a reference.
const DARK: RGBColor = RGBColor(20, 20, 20);

/// The colour of each series.
fn colours(series: &[Series]) -> Vec<RGBColor> {
    let mut free = COLOURS.iter().cycle();
    series.iter().map(|s| if s.look == Look::Reference { DARK } else { *free.next().unwrap_or(&DARK) }).collect()
}

/// A plot as an SVG element, its legend below it. Axes include all points, and 0 on the y-axis if `from_zero`.
pub fn plot(x_title: &str, y_title: &str, series: &[Series], from_zero: bool) -> String {
    let mut svg = String::new();
    if draw(&mut svg, x_title, y_title, series, from_zero).is_err() {
        return "<p>(this plot could not be drawn)</p>".into();
    }
    // Inline in HTML the XML prologue is not allowed.
    let svg = svg.find("<svg").map_or(svg.clone(), |at| svg[at..].to_owned());
    if series.len() < 2 {
        return svg;
    }
    // Below, where it hides no curve; characters, because browsers print no backgrounds.
    let entry = |(s, RGBColor(r, g, b)): (&Series, RGBColor)| {
        let mark = if s.look == Look::Dots { '\u{25cf}' } else { '\u{25ac}' };
        format!("<span><b style=\"color:#{r:02x}{g:02x}{b:02x}\">{mark}</b> {}</span> ", escape(&s.name))
    };
    let entries: String = series.iter().zip(colours(series)).map(entry).collect();
    format!("{svg}<div class=legend>{entries}</div>")
}

fn draw(svg: &mut String, x_title: &str, y_title: &str, series: &[Series], from_zero: bool) -> Result<(), Box<dyn std::error::Error>> {
    let all = || series.iter().flat_map(|s| &s.points).filter(|(x, y)| x.is_finite() && y.is_finite());
    let bounds = |f: fn(&(f64, f64)) -> f64| {
        let low = all().map(f).fold(f64::INFINITY, f64::min);
        let high = all().map(f).fold(f64::NEG_INFINITY, f64::max);
        if low.is_finite() { (low, high) } else { (0.0, 1.0) }
    };
    let ((x0, x1), (mut y0, mut y1)) = (bounds(|p| p.0), bounds(|p| p.1));
    if from_zero {
        y0 = y0.min(0.0);
        y1 = y1.max(0.0);
    }
    let pad = |a: f64, b: f64| ((b - a) * 0.04).max(1e-6 * b.abs().max(1.0));
    let (px, py) = (pad(x0, x1), pad(y0, y1));
    // Whole numbers, such as those of episodes, have nothing in between.
    let whole = all().all(|(x, _)| x.fract() == 0.0);
    let tick = |v: f64| ((v * 1e6).round() / 1e6).to_string();
    let root = SVGBackend::with_string(svg, (480, 320)).into_drawing_area();
    root.fill(&WHITE)?;
    let mut chart = ChartBuilder::on(&root)
        .margin(10)
        .x_label_area_size(44)
        .y_label_area_size(58)
        .build_cartesian_2d(x0 - px..x1 + px, if from_zero && y0 == 0.0 { 0.0 } else { y0 - py }..y1 + py)?;
    chart
        .configure_mesh()
        .light_line_style(WHITE)
        .bold_line_style(RGBColor(225, 225, 225))
        .x_desc(x_title)
        .y_desc(y_title)
        .x_label_formatter(&|x| if whole && (x - x.round()).abs() > 1e-6 { String::new() } else { tick(*x) })
        .y_label_formatter(&|y| tick(*y))
        .label_style(("sans-serif", 13))
        .axis_desc_style(("sans-serif", 14))
        .draw()?;
    for (s, colour) in series.iter().zip(colours(series)) {
        let points = s.points.iter().copied().filter(|(x, y)| x.is_finite() && y.is_finite());
        match s.look {
            Look::Line => chart.draw_series(LineSeries::new(points, colour.stroke_width(2)))?,
            Look::Reference => chart.draw_series(LineSeries::new(points, colour.stroke_width(1)))?,
            Look::Dots => chart.draw_series(points.map(|p| Circle::new(p, 2, colour.mix(0.55).filled())))?,
        };
    }
    root.present()?;
    Ok(())
}

/// Shares of `values` in bins of `width`, as a stepped line around the bins' edges.
pub fn histogram(name: &str, values: &[f64], width: f64, limit: f64) -> Series {
    let bins = (2.0 * limit / width).round() as usize;
    let mut counts = vec![0.0; bins];
    for v in values.iter().filter(|v| v.is_finite()) {
        let k = (((v + limit) / width).floor().max(0.0) as usize).min(bins - 1);
        counts[k] += 100.0 / values.len() as f64;
    }
    let mut points = vec![(-limit, 0.0)];
    for (k, c) in counts.iter().enumerate() {
        let x = -limit + k as f64 * width;
        points.extend([(x, *c), (x + width, *c)]);
    }
    points.push((limit, 0.0));
    Series::line(name, points)
}

/// Text as it must stand in HTML.
pub fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// A table; the first row is the heading. A screen that is narrower scrolls it.
pub fn table(rows: &[Vec<String>]) -> String {
    let mut html = String::from("<div class=scroll><table>");
    let words =
        |column: usize| rows.iter().skip(1).any(|r| r.get(column).is_some_and(|c| c.starts_with(char::is_alphabetic) && c != "NaN"));
    for (k, row) in rows.iter().enumerate() {
        let tag = if k == 0 { "th" } else { "td" };
        let class = |column: usize| if words(column) { " class=words" } else { "" };
        let cells: String = row.iter().enumerate().map(|(i, c)| format!("<{tag}{}>{}</{tag}>", class(i), escape(c))).collect();
        html += &format!("<tr>{cells}</tr>");
    }
    html + "</table></div>"
}

/// Names and what they stand for, in words.
fn facts(rows: &[(String, String)]) -> String {
    let row = |(name, what): &(String, String)| format!("<tr><th>{}</th><td>{}</td></tr>", escape(name), escape(what));
    format!("<table class=facts>{}</table>", rows.iter().map(row).collect::<String>())
}

/// The page around `body`.
pub fn page(title: &str, body: &str) -> String {
    format!(
        "<!doctype html><html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width\"><title>{title}</title><style>\
body{{font:15px/1.5 system-ui,sans-serif;max-width:72rem;margin:2rem auto;padding:0 1rem;color:#222}}\
h1{{font-size:1.6rem}}h2{{font-size:1.25rem;margin-top:2.2rem;border-bottom:1px solid #ccc}}\
.scroll{{overflow-x:auto}}table{{border-collapse:collapse;margin:1rem 0;font-size:.92rem;break-inside:avoid}}\
th,td{{padding:.25rem .6rem;border-bottom:1px solid #ddd;text-align:right;white-space:nowrap}}th{{background:#f2f4f7;vertical-align:bottom;white-space:normal}}\
td.words{{white-space:normal}}td:first-child{{white-space:nowrap}}\
th:first-child,td:first-child,.words,.facts td{{text-align:left}}.facts th{{vertical-align:top;white-space:nowrap}}.facts td{{white-space:normal;overflow-wrap:anywhere}}\
.plots{{display:grid;grid-template-columns:repeat(2,1fr);gap:1rem}}figure{{margin:0;break-inside:avoid}}\
figure svg{{width:100%;height:auto}}figcaption{{font-size:.9rem;color:#444}}.legend{{font-size:.85rem}}.legend span{{margin-right:.9em;white-space:nowrap}}code{{font-size:.85em}}\
@media screen and (max-width:45rem){{.plots{{grid-template-columns:1fr}}}}\
@media print{{html{{font-size:9pt}}body{{max-width:none;margin:0;padding:0;font-size:1rem}}h2,p,.scroll{{break-after:avoid}}.scroll{{overflow:visible}}\
table{{font-size:7.5pt}}th,td{{padding:.15rem .35rem}}figure{{margin-bottom:.5rem}}}}\
</style></head><body><h1>{title}</h1>{body}</body></html>\n",
        title = escape(title)
    )
}

/// A figure with a caption.
pub fn figure(svg: &str, caption: &str) -> String {
    format!("<figure>{svg}<figcaption>{}</figcaption></figure>", escape(caption))
}

fn numbers(v: &Value) -> Vec<f64> {
    v.as_array().map(|a| a.iter().map(|x| x.as_f64().unwrap_or(f64::NAN)).collect()).unwrap_or_default()
}

fn text(v: &Value) -> String {
    v.as_str().map_or_else(|| v.to_string(), str::to_owned)
}

fn number(v: &Value, digits: usize) -> String {
    v.as_f64().map_or_else(|| "-".into(), |x| format!("{x:.digits$}"))
}

fn training(v: &Value) -> String {
    let mut html = format!("<h2>Training {}</h2>", escape(&text(&v["weights"])));
    let options = &v["options"];
    let row = |a: &str, b: String| (a.to_owned(), b);
    let mut rows = vec![
        row("identity", text(&v["identity"])),
        row("method", text(&options["method"])),
        row("actions", options["actions"].to_string()),
        row("estimate", text(&options["estimate"])),
        row("seed", options["seed"].to_string()),
        row("episodes", v["episodes"].as_array().map_or(0, Vec::len).to_string()),
        row("data (SHA-256)", text(&v["data_sha256"])),
        row(
            "calibration",
            format!(
                "v = c area^q exp(tilt z) ml, z = (alpha - 60 degrees) / 30 degrees; c {:.3e}, q {}, tilt {}",
                v["calibration"]["c"].as_f64().unwrap_or(f64::NAN),
                number(&v["calibration"]["q"], 3),
                number(&v["calibration"]["tilt"], 3)
            ),
        ),
    ];
    for (name, what) in v["left_out"].as_array().into_iter().flatten().map(|l| (text(&l[0]), text(&l[1]))) {
        rows.push(row(&format!("left out: {name}"), what));
    }
    html += &facts(&rows);
    html += "<div class=plots>";
    let loss: Vec<(f64, f64)> = numbers(&v["loss"]).iter().enumerate().map(|(k, l)| ((k + 1) as f64 * 50.0, *l)).collect();
    html += &figure(&plot("Adam step", "loss", &[Series::line("loss", loss)], false), "Learning curve of the network.");
    let cost: Vec<(f64, f64)> = numbers(&v["search_cost"]).iter().enumerate().map(|(k, c)| ((k + 1) as f64, *c)).collect();
    if !cost.is_empty() {
        html +=
            &figure(&plot("iteration", "cost", &[Series::line("cost", cost)], true), "Search of the control law: mean cost of the elites.");
    }
    let pours = v["extra"]["pours"].as_array().cloned().unwrap_or_default();
    if !pours.is_empty() {
        let get = |key: &str| -> Vec<(f64, f64)> {
            pours.iter().map(|p| (p["number"].as_f64().unwrap_or(f64::NAN), p[key].as_f64().unwrap_or(f64::NAN))).collect()
        };
        let single = pours
            .iter()
            .map(|p| {
                (
                    p["number"].as_f64().unwrap_or(f64::NAN),
                    (p["weight_g"].as_f64().unwrap_or(f64::NAN) - p["goal_ml"].as_f64().unwrap_or(f64::NAN)).abs(),
                )
            })
            .collect();
        let series = [Series::dots("this pour", single), Series::line("mean so far", get("mae_so_far_ml"))];
        html += &figure(&plot("weighed pours", "|error| in ml", &series, true), "Error against the number of weighed pours.");
    }
    html + "</div>"
}

fn evaluation(v: &Value) -> String {
    let mut html = format!(
        "<h2>Evaluation: simulator {}, container {}, change {}</h2><p>{} rigs from {}, {} data seeds, {} episodes and {} weighed pours. Errors in ml; the interval is 95 % over rigs and seeds.</p>",
        text(&v["sim"]),
        text(&v["container"]),
        text(&v["change"]),
        v["rigs"],
        v["first_rig"],
        v["seeds"],
        v["episodes"],
        v["weighed"]
    );
    let mut rows = vec![
        [
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
            "measurement",
            "control",
            "s a pour",
        ]
        .map(String::from)
        .to_vec(),
    ];
    for s in v["summaries"].as_array().into_iter().flatten() {
        let percent = |key: &str| s[key].as_f64().map_or_else(String::new, |x| format!("{:.1}\u{a0}%", 100.0 * x));
        rows.push(vec![
            text(&s["name"]),
            s["n"].to_string(),
            number(&s["mae_ml"], 2),
            number(&s["mae_ci_ml"], 2),
            number(&s["median_ml"], 2),
            number(&s["p95_ml"], 2),
            number(&s["max_ml"], 1),
            number(&s["bias_ml"], 2),
            percent("within_5_ml"),
            percent("within_5_percent"),
            s["never_poured"].to_string(),
            s["never_stopped"].to_string(),
            number(&s["measurement_ml"], 2),
            number(&s["control_ml"], 2),
            number(&s["seconds"], 1),
        ]);
    }
    html += &table(&rows);
    let mut scatter = vec![Series::reference("poured = goal", vec![(0.0, 0.0), (200.0, 200.0)])];
    let mut bars = Vec::new();
    for m in v["pours"].as_array().into_iter().flatten() {
        let pours: Vec<&Value> = m["groups"].as_array().into_iter().flatten().flat_map(|g| g.as_array().into_iter().flatten()).collect();
        let value = |p: &Value, key: &str| p[key].as_f64().unwrap_or(f64::NAN);
        // A page with every dot of a large evaluation would be tens of megabytes.
        let every = (pours.len() / 600).max(1);
        let dots = pours
            .iter()
            .step_by(every)
            .enumerate()
            .map(|(k, p)| (value(p, "goal_ml") + (k % 9) as f64 - 4.0, value(p, "true_ml")))
            .collect();
        scatter.push(Series::dots(&text(&m["name"]), dots));
        let errors: Vec<f64> = pours.iter().map(|p| value(p, "true_ml") - value(p, "goal_ml")).collect();
        bars.push(histogram(&text(&m["name"]), &errors, 0.5, 12.0));
    }
    html += "<div class=plots>";
    html += &figure(&plot("goal in ml (spread by ±4 for sight)", "poured in ml", &scatter, true), "Goal against poured.");
    html += &figure(&plot("error in ml (ends hold what is beyond)", "% of the pours", &bars, true), "Errors.");
    for trace in v["traces"].as_array().into_iter().flatten() {
        let column = |key: &str| -> Vec<(f64, f64)> { numbers(&trace["t_s"]).into_iter().zip(numbers(&trace[key])).collect() };
        let series = [
            Series::line("alpha, degrees", column("alpha_deg")),
            Series::line("poured, ml", column("true_ml")),
            Series::line("area / 4, px²", column("area_4_px2")),
        ];
        html += &figure(
            &plot("time in s", "degrees, ml, px² / 4", &series, true),
            &format!("A pour of {} ml from {} ml, {}.", trace["goal_ml"], trace["init_ml"], text(&trace["name"])),
        );
    }
    html + "</div>"
}

/// Error against number of episodes, when several evaluations are given.
fn against_episodes(files: &[Value]) -> String {
    let mut by_method: std::collections::BTreeMap<String, Vec<(f64, f64)>> = std::collections::BTreeMap::new();
    for v in files.iter().filter(|v| v["kind"] == "evaluation") {
        let n = v["episodes"].as_f64().unwrap_or(0.0) + v["weighed"].as_f64().unwrap_or(0.0);
        for s in v["summaries"].as_array().into_iter().flatten() {
            by_method.entry(text(&s["name"])).or_default().push((n, s["mae_ml"].as_f64().unwrap_or(f64::NAN)));
        }
    }
    let series: Vec<Series> = by_method
        .into_iter()
        .filter(|(_, p)| p.iter().any(|(n, _)| *n != p[0].0))
        .map(|(name, mut points)| {
            points.sort_by(|a, b| a.0.total_cmp(&b.0));
            Series::line(&name, points)
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

/// The page of some JSON values; an error names the value that is of no known kind.
pub fn build(files: &[(String, Value)]) -> Result<String, String> {
    let values: Vec<Value> = files.iter().map(|(_, v)| v.clone()).collect();
    let mut body = against_episodes(&values);
    for (name, v) in files {
        match v["kind"].as_str() {
            Some("training") => body += &training(v),
            Some("evaluation") => body += &evaluation(v),
            Some("reproduction") => body += v["html"].as_str().unwrap_or_default(),
            _ => return Err(format!("{name}: not a JSON report of `train`, `refine`, `evaluate` or `reproduce`")),
        }
    }
    Ok(page("Decant: report", &body))
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let mut files = Vec::new();
    for file in &args.files {
        let name = file.display().to_string();
        let text = std::fs::read_to_string(file).map_err(|e| e.to_string());
        let value = text.and_then(|t| serde_json::from_str(&t).map_err(|e| e.to_string()));
        let value = value.map_err(|e| format!("{name}: {e}")).or_exit(exit::BAD_INPUT)?;
        files.push((name, value));
    }
    let html = build(&files).or_exit(exit::BAD_INPUT)?;
    std::fs::write(&args.out, html).map_err(|e| format!("{}: {e}", args.out.display())).or_exit(exit::FAILED)
}
