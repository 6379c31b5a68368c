//! Percentile curves on logarithmic axes: what share of the readings is above which duration.
//!
//! Ordinary thread; allocates. A drawing that fails becomes a line of text.

use plotters::prelude::*;
use trainer::report::page;

/// The share of readings above a value that the axis ends with, as a power of ten: one in a hundred thousand, beyond what a run of hours
/// resolves at 30 Hz.
const LAST_NINES: f64 = 5.0;
/// Colours of the curves, chosen so that they can be told apart in a grey print too; the yardstick comes last and is grey.
const COLOURS: [RGBColor; 4] = [RGBColor(0, 90, 181), RGBColor(220, 50, 32), RGBColor(0, 128, 96), RGBColor(120, 120, 120)];

/// A figure with one curve for each named series of durations, us. The last series is the yardstick and is drawn in grey. Above the
/// curve's end lies its largest reading.
pub fn percentile_curves(caption: &str, series: &[(&str, &[f64])]) -> String {
    let mut svg = String::new();
    if draw(&mut svg, series).is_err() {
        return page::figure("<p>(this plot could not be drawn)</p>", caption);
    }
    // Inside HTML, the XML prologue is not allowed.
    let svg = svg.find("<svg").map_or(svg.clone(), |at| svg[at..].to_owned());
    let entry = |((name, values), colour): (&(&str, &[f64]), RGBColor)| {
        let RGBColor(r, g, b) = colour;
        format!("<span><b style=\"color:#{r:02x}{g:02x}{b:02x}\">\u{25ac}</b> {} (n {})</span> ", page::escape(name), values.len())
    };
    let entries: String = series.iter().zip(colours(series.len())).map(entry).collect();
    page::figure(&format!("{svg}<div class=legend>{entries}</div>"), caption)
}

/// The colour of each of `n` curves; of two or more, the last is grey.
fn colours(n: usize) -> impl Iterator<Item = RGBColor> {
    let last = COLOURS.len() - 1;
    (0..n).map(move |k| if n > 1 && k + 1 == n { COLOURS[last] } else { COLOURS[k % last] })
}

/// The points of a curve: -log10 of the share of readings above, and the reading. Only ranks that the number of readings resolves.
fn curve(values: &[f64]) -> Vec<(f64, f64)> {
    let mut sorted: Vec<f64> = values.iter().copied().filter(|v| v.is_finite() && *v > 0.0).collect();
    sorted.sort_by(f64::total_cmp);
    let n = sorted.len() as f64;
    let points = sorted.iter().enumerate().map(|(k, v)| ((n / (n - k as f64)).log10().min(LAST_NINES), *v));
    // Hundreds of thousands of readings would make a page of megabytes; neighbours that look the same are left out.
    let mut kept: Vec<(f64, f64)> = Vec::new();
    for (x, y) in points {
        if kept.last().is_none_or(|(x0, y0)| x - x0 > 0.01 || y / y0 > 1.02) {
            kept.push((x, y));
        }
    }
    kept
}

/// A share above, as its percentile: 0 is the smallest reading, 2 the 99th percentile.
fn percentile(nines: f64) -> String {
    let percent = 100.0 * (1.0 - 10f64.powf(-nines));
    if nines < 0.01 { "min".into() } else { format!("{percent:.*} %", (nines - 2.0).max(0.0).ceil() as usize) }
}

/// A duration on the axis; only 1, 2 and 5 of each decade have room for words.
fn duration(us: f64) -> String {
    let words = format!("{us}");
    let leading = words.trim_start_matches(['0', '.']).chars().next();
    if matches!(leading, Some('1' | '2' | '5')) { words } else { String::new() }
}

fn draw(svg: &mut String, series: &[(&str, &[f64])]) -> Result<(), Box<dyn std::error::Error>> {
    let curves: Vec<Vec<(f64, f64)>> = series.iter().map(|(_, values)| curve(values)).collect();
    let all = || curves.iter().flatten();
    let low = all().map(|p| p.1).fold(f64::INFINITY, f64::min).clamp(1e-3, 1e9);
    let high = all().map(|p| p.1).fold(low, f64::max).min(1e12);
    let end = all().map(|p| p.0).fold(1.0, f64::max).min(LAST_NINES);
    let root = SVGBackend::with_string(svg, (480, 320)).into_drawing_area();
    root.fill(&WHITE)?;
    let mut chart = ChartBuilder::on(&root)
        .margin(10)
        .margin_right(24)
        .x_label_area_size(44)
        .y_label_area_size(58)
        .build_cartesian_2d(0.0..end, (low / 1.3..high * 1.3).log_scale())?;
    chart
        .configure_mesh()
        .light_line_style(WHITE)
        .bold_line_style(RGBColor(225, 225, 225))
        .x_desc("share of readings below")
        .y_desc("us")
        .x_labels(end as usize + 1)
        .x_label_formatter(&|x| percentile(*x))
        .y_label_formatter(&|y| duration(*y))
        .label_style(("sans-serif", 13))
        .axis_desc_style(("sans-serif", 14))
        .draw()?;
    for (points, colour) in curves.iter().zip(colours(series.len())) {
        chart.draw_series(LineSeries::new(points.iter().copied(), colour.stroke_width(2)))?;
        if let Some(last) = points.last() {
            chart.draw_series([Circle::new(*last, 3, colour.filled())])?;
        }
    }
    root.present()?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects whoever reads the curve: the median of the readings stands at one half, the 99th percentile at two nines, and one large
    /// reading at the curve's end is drawn.
    #[test]
    fn a_curve_passes_its_percentiles() {
        let values: Vec<f64> = (1..=1000).map(f64::from).collect();
        let curve = curve(&values);
        let at = |nines: f64| curve.iter().rev().find(|p| p.0 <= nines).unwrap().1;
        assert!((at(2f64.log10()) / 500.0 - 1.0).abs() < 0.05 && (at(2.0) / 990.0 - 1.0).abs() < 0.03);
        assert_eq!(curve.last().unwrap().1, 1000.0);
        assert_eq!((percentile(1.0).as_str(), percentile(3.0).as_str()), ("90 %", "99.9 %"));
        assert!(percentile_curves("a caption", &[("a", &values), ("b", &[])]).contains("<svg"));
    }
}
