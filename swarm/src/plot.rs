//! One run as an SVG plot: tilt, flow, d and what was poured over time, and the faults as lines.
//!
//! Ordinary thread; allocates. An error of the file is one line.

use std::path::Path;

use plotters::prelude::*;

use crate::plan::Plan;
use crate::records::Row;
use crate::run::Shown;

/// Size of the picture, px.
const SIZE_PX: (u32, u32) = (1200, 900);

/// A column of the rows, with its name and colour.
type Column = (&'static str, RGBColor, fn(&Row) -> f64);

/// Draws a run.
///
/// # Errors
/// One line, when the file cannot be written.
pub fn plot(plan: &Plan, shown: &Shown, path: &Path) -> Result<(), String> {
    let words = |e: &dyn std::fmt::Display| format!("{}: the plot cannot be written: {e}", path.display());
    let area = SVGBackend::new(path, SIZE_PX).into_drawing_area();
    area.fill(&WHITE).map_err(|e| words(&e))?;
    let panels: [(&str, &[Column]); 3] = [
        ("degrees", &[("commanded alpha", BLUE, |r| r.alpha_deg), ("measured alpha", CYAN, |r| r.measured_deg)]),
        ("ml/s", &[("flow", GREEN, |r| r.flow_ml_s)]),
        ("ml", &[("poured", BLACK, |r| r.poured_ml), ("d", RED, |r| r.d_ml)]),
    ];
    for (panel, (unit, columns)) in area.split_evenly((3, 1)).iter().zip(panels) {
        let values = || shown.rows.iter().flat_map(|row| columns.iter().map(move |c| c.2(row))).filter(|v| v.is_finite());
        let (low, high) = values().fold((0.0f64, 1.0f64), |(low, high), v| (low.min(v), high.max(v)));
        let mut chart = ChartBuilder::on(panel)
            .margin(10)
            .x_label_area_size(30)
            .y_label_area_size(60)
            .build_cartesian_2d(0.0..shown.virtual_s, low..high * 1.05)
            .map_err(|e| words(&e))?;
        chart.configure_mesh().x_desc("s").y_desc(unit).draw().map_err(|e| words(&e))?;
        for (name, colour, value) in columns {
            let points = shown.rows.iter().map(|row| (row.at_s, value(row))).filter(|(_, v)| v.is_finite());
            let colour = *colour;
            let series = chart.draw_series(LineSeries::new(points, colour)).map_err(|e| words(&e))?;
            series.label(*name).legend(move |(x, y)| PathElement::new([(x, y), (x + 15, y)], colour));
        }
        for item in &plan.items {
            let at_s = item.at_ms as f64 / 1000.0;
            let colour = if item.what.is_ordinary() { RGBColor(190, 190, 190) } else { MAGENTA };
            chart.draw_series([PathElement::new([(at_s, low), (at_s, high)], colour)]).map_err(|e| words(&e))?;
            let text = Text::new(item.what.name(), (at_s, high), ("sans-serif", 11).into_font());
            chart.draw_series([text]).map_err(|e| words(&e))?;
        }
        chart.configure_series_labels().background_style(WHITE).border_style(BLACK).draw().map_err(|e| words(&e))?;
    }
    area.present().map_err(|e| words(&e))
}
