//! The picture of one pour: alpha, V_e, d and the volume poured against time, from the controller's telemetry.
//!
//! Ordinary thread; allocates; an error is the drawing library's text.

use std::path::Path;

use plotters::prelude::*;
use shared::messages::Telemetry;

/// A part of a picture.
pub type Drawing<'a> = DrawingArea<SVGBackend<'a>, plotters::coord::Shift>;
/// One line of a panel: its name, its colour and its points.
type Line<'a> = (&'a str, RGBColor, Vec<(f64, f64)>);

/// Where the names of the curves begin, px from the left: beside the plot, within a picture that is 900 px wide.
const KEY_FROM_PX: i32 = 760;

/// Colour of the commanded tilt; all colours here are of the palette "tab10", which many plotting programs use.
const ALPHA: RGBColor = RGBColor(31, 119, 180);
/// Colour of the measured tilt.
const MEASURED: RGBColor = RGBColor(255, 127, 14);
/// Colour of V_e.
const AREA: RGBColor = RGBColor(44, 160, 44);
/// Colour of d, the volume that is still to be poured.
const D: RGBColor = RGBColor(214, 39, 40);
/// Colour of the poured volume.
const POURED: RGBColor = RGBColor(148, 103, 189);

/// Colour of the poured volume with its standard deviation added, and taken off.
const DEVIATION: RGBColor = RGBColor(197, 176, 213);

/// Draws the ticks of one pour to `file` (SVG); `scale_g` is what the scale showed afterwards.
///
/// # Errors
/// When there are no ticks, or the file cannot be written.
pub fn draw(file: &Path, ticks: &[Telemetry], goal_ml: f32, scale_g: f64) -> Result<(), Box<dyn std::error::Error>> {
    let start_ns = ticks.first().ok_or("no telemetry was heard")?.at_ns;
    let points = |value: &dyn Fn(&Telemetry) -> f32| -> Vec<(f64, f64)> {
        let t = |tick: &Telemetry| tick.at_ns.saturating_sub(start_ns) as f64 / 1e9;
        ticks.iter().map(|tick| (t(tick), f64::from(value(tick)))).filter(|(_, v)| v.is_finite()).collect()
    };
    let root = SVGBackend::new(file, (900, 760)).into_drawing_area();
    root.fill(&WHITE)?;
    let title = format!("Goal {goal_ml:.0} ml, {scale_g:.0} g on the scale, error {:+.1} ml", scale_g - f64::from(goal_ml));
    let panels = root.titled(&title, ("sans-serif", 22))?.split_evenly((3, 1));
    panel(
        &panels[0],
        "alpha, degrees",
        &[("commanded", ALPHA, points(&|t| t.alpha_deg)), ("measured", MEASURED, points(&|t| t.alpha_measured_deg))],
    )?;
    panel(&panels[1], "V_e, px²", &[("V_e", AREA, points(&|t| t.area_px2))])?;
    let with_deviation = |sign: f32| points(&|t| if t.poured_sd_ml > 0.0 { t.poured_ml + sign * t.poured_sd_ml } else { f32::NAN });
    let poured = ("poured (estimate)", POURED, points(&|t| t.poured_ml));
    let above = ("its deviation", DEVIATION, with_deviation(1.0));
    let below = ("", DEVIATION, with_deviation(-1.0));
    panel(&panels[2], "ml", &[("d", D, points(&|t| t.d_ml)), poured, above, below])?;
    root.present()?;
    Ok(())
}

/// Draws one panel with the names of its lines beside it.
fn panel(area: &Drawing, unit: &str, lines: &[Line]) -> Result<(), Box<dyn std::error::Error>> {
    let all = || lines.iter().flat_map(|l| &l.2);
    let end_s = all().map(|p| p.0).fold(1.0, f64::max);
    let (low, high) = all().fold((0.0f64, 1.0f64), |(l, h), p| (l.min(p.1), h.max(p.1)));
    let margin = 0.05 * (high - low);
    // The names stand beside the plot, where they hide no curve.
    let (plot, key) = area.split_horizontally(KEY_FROM_PX);
    for (y, (name, colour, _)) in (20..).step_by(20).zip(lines.iter().filter(|(name, ..)| !name.is_empty())) {
        key.draw(&PathElement::new([(0, y), (18, y)], colour.stroke_width(2)))?;
        key.draw(&Text::new(*name, (24, y - 7), ("sans-serif", 13)))?;
    }
    let mut chart = ChartBuilder::on(&plot)
        .margin(8)
        .x_label_area_size(36)
        .y_label_area_size(60)
        .build_cartesian_2d(0.0..end_s, low - if low < 0.0 { margin } else { 0.0 }..high + margin)?;
    let tick = |v: &f64| ((v * 1e6).round() / 1e6).to_string();
    chart
        .configure_mesh()
        .x_desc("s")
        .y_desc(unit)
        .x_label_formatter(&tick)
        .y_label_formatter(&tick)
        .light_line_style(TRANSPARENT)
        .label_style(("sans-serif", 13))
        .draw()?;
    for (_, colour, points) in lines {
        chart.draw_series(LineSeries::new(points.iter().copied(), colour.stroke_width(2)))?;
    }
    Ok(())
}
