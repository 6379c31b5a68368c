//! A picture of one run: alpha, flow, d and what was poured over time, what happened, and what was violated.
//!
//! Ordinary thread; allocates. An error of the file is one line.

use std::path::Path;

use plotters::coord::Shift;
use plotters::prelude::*;

use crate::faults::KINDS;
use crate::plan::{Item, Plan};
use crate::records::Row;
use crate::run::Shown;

/// Size of the picture, px.
const SIZE_PX: (u32, u32) = (1400, 1000);
/// Height of the strip with the names of what happens, px: the longest name fits upright.
const STRIP_PX: u32 = 190;
/// Margins of the panels, px: left for the labels of the axis, and all around.
const MARGINS_PX: (u32, u32) = (70, 10);
/// Least distance of two names, px: the height of their letters.
const APART_PX: f64 = 13.0;
/// Colours of what is ordinary, of faults, and of violations.
const COLOURS: [RGBColor; 3] = [RGBColor(150, 150, 150), RGBColor(190, 0, 190), RGBColor(220, 0, 0)];

/// A column of the rows, with its name and colour.
type Column = (&'static str, RGBColor, fn(&Row) -> f64);
/// Where something is drawn.
type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;

/// A line across all panels: when, s, its name, and the place of its colour in [`COLOURS`].
type Mark = (f64, String, usize);

/// Draws a run.
///
/// # Errors
/// One line, when the file cannot be written.
pub fn plot(plan: &Plan, shown: &Shown, path: &Path) -> Result<(), String> {
    // The drawing itself is made in memory, so that what fails is the file alone.
    let mut text = String::new();
    draw(plan, shown, &mut text).map_err(|e| format!("{}: the plot cannot be drawn: {e}", path.display()))?;
    std::fs::write(path, text).map_err(|e| format!("{}: the plot cannot be written: {e}; give another file", path.display()))
}

fn draw(plan: &Plan, shown: &Shown, text: &mut String) -> Result<(), Box<dyn std::error::Error>> {
    let area = SVGBackend::with_string(text, SIZE_PX).into_drawing_area();
    area.fill(&WHITE)?;
    let (strip, panels) = area.split_vertically(STRIP_PX);
    let marks = marks(plan, shown);
    name_marks(&strip, &marks, shown.virtual_s)?;
    let columns: [(&str, &[Column]); 3] = [
        ("degrees", &[("commanded alpha", BLUE, |r| r.alpha_deg), ("measured alpha", RGBColor(0, 170, 190), |r| r.measured_deg)]),
        ("ml/s", &[("flow", RGBColor(0, 140, 0), |r| r.flow_ml_s)]),
        ("ml", &[("poured", BLACK, |r| r.poured_ml), ("d", RGBColor(230, 120, 0), |r| r.d_ml)]),
    ];
    for (panel, (unit, columns)) in panels.split_evenly((3, 1)).iter().zip(columns) {
        let values = || shown.rows.iter().flat_map(|row| columns.iter().map(move |c| c.2(row))).filter(|v| v.is_finite());
        let (low, high) = values().fold((0.0f64, 1.0f64), |(low, high), v| (low.min(v), high.max(v)));
        let mut chart = ChartBuilder::on(panel)
            .margin(MARGINS_PX.1)
            .x_label_area_size(30)
            .y_label_area_size(MARGINS_PX.0 - MARGINS_PX.1)
            .build_cartesian_2d(0.0..shown.virtual_s, low * 1.05..high * 1.05)?;
        chart.configure_mesh().light_line_style(TRANSPARENT).x_desc("s").y_desc(unit).draw()?;
        for (at_s, _, colour) in &marks {
            chart.draw_series([PathElement::new([(*at_s, low * 1.05), (*at_s, high * 1.05)], COLOURS[*colour].mix(0.6))])?;
        }
        for (name, colour, value) in columns {
            let colour = *colour;
            // A value that is not there leaves a gap.
            let points: Vec<_> = shown.rows.iter().map(|row| (row.at_s, value(row))).collect();
            for (k, part) in points.split(|(_, v)| !v.is_finite()).filter(|part| !part.is_empty()).enumerate() {
                let series = chart.draw_series(LineSeries::new(part.iter().copied(), colour.stroke_width(2)))?;
                if k == 0 {
                    series.label(*name).legend(move |(x, y)| PathElement::new([(x, y), (x + 15, y)], colour.stroke_width(2)));
                }
            }
        }
        chart.configure_series_labels().background_style(WHITE.mix(0.8)).border_style(BLACK).draw()?;
    }
    area.present()?;
    Ok(())
}

/// What happens, and what was violated, in the order of time.
fn marks(plan: &Plan, shown: &Shown) -> Vec<Mark> {
    let mut named = Vec::new();
    let mut name = |item: &Item| match item.fault {
        Some(number) if !named.contains(&number) => {
            named.push(number);
            (format!("{number} {}", KINDS[plan.faults[number]].name), 1)
        }
        Some(number) => (format!("{number} {}", item.what.name()), 0),
        None => (item.what.name(), 0),
    };
    let items = plan.items.iter().map(|item| {
        let (text, colour) = name(item);
        (item.at_ms as f64 / 1000.0, text, colour)
    });
    let mut marks: Vec<Mark> = items.collect();
    marks.extend(shown.violations.iter().map(|v| (v.at_s, v.invariant.to_owned(), 2)));
    marks.sort_by(|a, b| a.0.total_cmp(&b.0));
    marks
}

/// Writes the names upright, each over its line, and beside the one before where they would cover each other.
fn name_marks(strip: &Area<'_>, marks: &[Mark], until_s: f64) -> Result<(), Box<dyn std::error::Error>> {
    let width_px = f64::from(SIZE_PX.0 - MARGINS_PX.0 - MARGINS_PX.1);
    let bottom_px = STRIP_PX as i32;
    let mut last_px = f64::NEG_INFINITY;
    for (at_s, text, colour) in marks {
        let line_px = f64::from(MARGINS_PX.0) + width_px * at_s / until_s;
        let at_px = line_px.max(last_px + APART_PX).min(f64::from(SIZE_PX.0) - APART_PX);
        last_px = at_px;
        let font = ("sans-serif", 13).into_font().transform(FontTransform::Rotate270).color(&COLOURS[*colour]);
        strip.draw(&Text::new(text.clone(), (at_px as i32 - 6, bottom_px - 20), font))?;
        strip.draw(&PathElement::new([(at_px as i32, bottom_px - 18), (line_px as i32, bottom_px)], COLOURS[*colour]))?;
    }
    Ok(())
}
