//! Plots as SVG, to stand inside a page.
//!
//! Pure functions, for any thread. They allocate and do not fail.

use plotters::prelude::*;

use super::page::escape;

/// How the points of a series are drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SeriesStyle {
    /// They are joined by a line.
    Line,
    /// Each is a dot.
    Dots,
    /// A thin dark line that the others are compared with; it takes none of their colours.
    Reference,
}

/// A line or a cloud of points.
#[derive(Debug, Clone)]
pub struct PlotSeries {
    /// Name in the legend.
    pub name: String,
    /// Points.
    pub points: Vec<(f64, f64)>,
    /// How it is drawn.
    pub style: SeriesStyle,
}

impl PlotSeries {
    /// Points that are joined by a line.
    pub fn line(name: &str, points: Vec<(f64, f64)>) -> Self {
        Self { name: name.into(), points, style: SeriesStyle::Line }
    }
    /// Points that are dots.
    pub fn dots(name: &str, points: Vec<(f64, f64)>) -> Self {
        Self { name: name.into(), points, style: SeriesStyle::Dots }
    }
    /// A line that the others are compared with.
    pub fn reference(name: &str, points: Vec<(f64, f64)>) -> Self {
        Self { name: name.into(), points, style: SeriesStyle::Reference }
    }
}

/// Colours of the series, chosen so that they can be told apart in a grey print too.
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

/// Numbers from here on are not drawn, as those that are not finite: the distance of two of them has to be a number, too.
const LARGEST: f64 = 1e300;
/// Height of each plot of several one below the other, px. Chosen by hand: three are as high as wide, and a little more.
const PANEL_PX: u32 = 190;
/// Colour of a reference.
const DARK: RGBColor = RGBColor(20, 20, 20);

/// The colour of each series.
fn colours(series: &[PlotSeries]) -> Vec<RGBColor> {
    let mut free = COLOURS.iter().cycle();
    series.iter().map(|s| if s.style == SeriesStyle::Reference { DARK } else { *free.next().unwrap_or(&DARK) }).collect()
}

/// A plot as an SVG element, with its legend below it. The axes include all points, and with `from_zero` the y-axis includes 0.
pub fn plot(x_title: &str, y_title: &str, series: &[PlotSeries], from_zero: bool) -> String {
    let mut svg = String::new();
    if draw(&mut svg, x_title, y_title, series, from_zero).is_err() {
        return "<p>(this plot could not be drawn)</p>".into();
    }
    // Inside HTML, the XML prologue is not allowed.
    let svg = svg.find("<svg").map_or(svg.clone(), |at| svg[at..].to_owned());
    if series.len() < 2 {
        return svg;
    }
    // The legend is below, where it hides no curve. Its marks are characters, because browsers print no backgrounds.
    let entry = |(s, RGBColor(r, g, b)): (&PlotSeries, RGBColor)| {
        let mark = if s.style == SeriesStyle::Dots { '\u{25cf}' } else { '\u{25ac}' };
        format!("<span><b style=\"color:#{r:02x}{g:02x}{b:02x}\">{mark}</b> {}</span> ", escape(&s.name))
    };
    let entries: String = series.iter().zip(colours(series)).map(entry).collect();
    format!("{svg}<div class=legend>{entries}</div>")
}

/// Plots one below the other over the same x, each with the title and the unit of its own y-axis, as one SVG element.
pub fn plot_below(x_title: &str, panels: &[(&str, PlotSeries)]) -> String {
    let mut svg = String::new();
    let mut drawn = || -> Result<(), Box<dyn std::error::Error>> {
        let root = SVGBackend::with_string(&mut svg, (480, PANEL_PX * panels.len() as u32)).into_drawing_area();
        root.fill(&WHITE)?;
        for (area, (y_title, series)) in root.split_evenly((panels.len(), 1)).iter().zip(panels) {
            draw_on(area, x_title, y_title, std::slice::from_ref(series), true)?;
        }
        root.present()?;
        Ok(())
    };
    if drawn().is_err() {
        return "<p>(this plot could not be drawn)</p>".into();
    }
    svg.find("<svg").map_or(svg.clone(), |at| svg[at..].to_owned())
}

/// Draws the plot without its legend into `svg`.
fn draw(svg: &mut String, x_title: &str, y_title: &str, series: &[PlotSeries], from_zero: bool) -> Result<(), Box<dyn std::error::Error>> {
    let root = SVGBackend::with_string(svg, (480, 320)).into_drawing_area();
    root.fill(&WHITE)?;
    draw_on(&root, x_title, y_title, series, from_zero)?;
    root.present()?;
    Ok(())
}

/// Whether a point can be drawn.
fn drawable((x, y): &(f64, f64)) -> bool {
    x.abs() < LARGEST && y.abs() < LARGEST
}

/// Draws a plot into an area.
fn draw_on(
    area: &DrawingArea<SVGBackend<'_>, plotters::coord::Shift>,
    x_title: &str,
    y_title: &str,
    series: &[PlotSeries],
    from_zero: bool,
) -> Result<(), Box<dyn std::error::Error>> {
    let all = || series.iter().flat_map(|s| &s.points).filter(|point| drawable(point));
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
    // Where all values are the same, the axis still has numbers that can be told from each other.
    let pad = |a: f64, b: f64| if b > a { (b - a) * 0.04 } else { b.abs().max(1.0) };
    let (px, py) = (pad(x0, x1), pad(y0, y1));
    // Where all x are whole numbers, as those of episodes are, there are no ticks between them.
    let whole = all().all(|(x, _)| x.fract() == 0.0);
    let tick = |v: f64| ((v * 1e6).round() / 1e6).to_string();
    let mut chart = ChartBuilder::on(area)
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
        let points = s.points.iter().copied().filter(drawable);
        match s.style {
            SeriesStyle::Line => chart.draw_series(LineSeries::new(points, colour.stroke_width(2)))?,
            SeriesStyle::Reference => chart.draw_series(LineSeries::new(points, colour.stroke_width(1)))?,
            SeriesStyle::Dots => chart.draw_series(points.map(|p| Circle::new(p, 2, colour.mix(0.55).filled())))?,
        };
    }
    Ok(())
}

/// Shares of `values` in bins of `width` from -`limit` to `limit`, in percent, as a stepped line around the bins' edges. The
/// outermost bins hold what is beyond.
pub fn histogram(name: &str, values: &[f64], width: f64, limit: f64) -> PlotSeries {
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
    PlotSeries::line(name, points)
}
