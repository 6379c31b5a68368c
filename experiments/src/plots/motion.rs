//! The picture of a motion: target, command and joint against time, as angle, rate and acceleration.
//!
//! Ordinary thread; allocates; an error is the drawing library's text.

use std::ops::Range;
use std::path::Path;

use plotters::prelude::*;

use super::pour::Drawing;
use crate::motion::{Cycle, slope};

/// Colour of the targets: grey, because they are what the others are compared with.
const TARGET: RGBColor = RGBColor(120, 120, 120);
/// Colour of what is given to servoj: the first of the palette in [`super::pour`].
const COMMAND: RGBColor = RGBColor(31, 119, 180);
/// Colour of the joint: the fourth of the palette in [`super::pour`].
const ACTUAL: RGBColor = RGBColor(214, 39, 40);

/// One line of a panel: its name, its colour and its points.
type Line = (&'static str, RGBColor, Vec<(f64, f64)>);

/// The three panels of a motion: its lines of angle, rate and acceleration.
fn panels(cycles: &[Cycle]) -> [Vec<Line>; 3] {
    let of = |value: fn(&Cycle) -> f64| -> Vec<(f64, f64)> { cycles.iter().map(|c| (c.t_s, value(c))).collect() };
    let (target, command, actual) = (of(|c| c.target_deg), of(|c| c.command_deg), of(|c| c.actual_deg));
    let stepped = target.windows(2).flat_map(|w| [w[0], (w[1].0, w[0].1)]).collect();
    let rates = (slope(&command), slope(&actual));
    let accelerations = (slope(&rates.0), slope(&rates.1));
    [
        vec![("target at 30 Hz", TARGET, stepped), ("given to servoj", COMMAND, command), ("joint", ACTUAL, actual)],
        vec![("given to servoj", COMMAND, rates.0), ("joint", ACTUAL, rates.1)],
        vec![("given to servoj", COMMAND, accelerations.0), ("joint", ACTUAL, accelerations.1)],
    ]
}

/// Draws motions side by side, within `span` (s), to `file` (SVG).
///
/// # Errors
/// The drawing library's, when the file cannot be written.
pub fn draw(file: &Path, span: Range<f64>, motions: &[(&str, &[Cycle])]) -> Result<(), Box<dyn std::error::Error>> {
    let columns: Vec<[Vec<Line>; 3]> = motions.iter().map(|(_, cycles)| panels(cycles)).collect();
    let root = SVGBackend::new(file, (1400, 900)).into_drawing_area();
    root.fill(&WHITE)?;
    let areas = root.split_evenly((3, motions.len()));
    for (row, unit) in ["alpha, degrees", "rate, degrees/s", "acceleration, degrees/s²"].into_iter().enumerate() {
        // One scale for a row: that of the joints, and of the program's commands. Raw commands go beyond it and are cut.
        let shown = columns.iter().enumerate().flat_map(|(c, rows)| rows[row].iter().filter(move |l| c == 0 || l.0 == "joint"));
        let values = shown.flat_map(|l| &l.2).filter(|p| span.contains(&p.0)).map(|p| p.1);
        let (low, high) = values.fold((0.0f64, 1.0f64), |(l, h), v| (l.min(v), h.max(v)));
        let margin = 0.06 * (high - low);
        for (column, lines) in columns.iter().enumerate() {
            let caption = if row == 0 { motions[column].0 } else { "" };
            panel(&areas[row * motions.len() + column], caption, unit, &span, low - margin..high + margin, &lines[row])?;
        }
    }
    root.present()?;
    Ok(())
}

/// Draws one panel; without a caption it stands below another one.
fn panel(
    area: &Drawing,
    caption: &str,
    unit: &str,
    span: &Range<f64>,
    scale: Range<f64>,
    lines: &[Line],
) -> Result<(), Box<dyn std::error::Error>> {
    let mut builder = ChartBuilder::on(area);
    if !caption.is_empty() {
        builder.caption(caption, ("sans-serif", 20));
    }
    let mut chart = builder.margin(8).x_label_area_size(36).y_label_area_size(70).build_cartesian_2d(span.clone(), scale.clone())?;
    chart.configure_mesh().x_desc("s").y_desc(unit).light_line_style(TRANSPARENT).label_style(("sans-serif", 13)).draw()?;
    for (name, colour, points) in lines {
        let inside = points.iter().filter(|p| span.contains(&p.0)).map(|p| (p.0, p.1.clamp(scale.start, scale.end)));
        let (colour, width) = (*colour, if *name == "joint" { 2 } else { 1 });
        chart
            .draw_series(LineSeries::new(inside, colour.stroke_width(width)))?
            .label(*name)
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 18, y)], colour.stroke_width(2)));
    }
    chart
        .configure_series_labels()
        .position(if caption.is_empty() { SeriesLabelPosition::LowerLeft } else { SeriesLabelPosition::UpperLeft })
        .background_style(WHITE.mix(0.8))
        .border_style(BLACK.mix(0.3))
        .label_font(("sans-serif", 13))
        .draw()?;
    Ok(())
}
