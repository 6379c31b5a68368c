//! Lines, the two axes and the rays between them, in px of a picture. Whole numbers are the middles of pixels.
//!
//! Pure functions of plain numbers. Called on the extraction thread; nothing allocates and nothing fails.

use shared::config::ImageConfig;

/// A straight line: all points `p` with `normal . p = distance`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Line {
    /// Unit vector square to the line.
    pub(crate) normal: [f32; 2],
    /// Distance of the line from the origin along `normal`, px.
    pub(crate) distance: f32,
}

impl Line {
    /// The line through `a` and `b`, which lie `length_px` apart.
    pub(crate) fn through(a: [f32; 2], b: [f32; 2], length_px: f32) -> Self {
        let normal = [-(b[1] - a[1]) / length_px, (b[0] - a[0]) / length_px];
        Self { normal, distance: normal[0] * a[0] + normal[1] * a[1] }
    }

    /// Signed distance of a point from the line, px.
    pub(crate) fn offset(&self, p: [f32; 2]) -> f32 {
        self.normal[0] * p[0] + self.normal[1] * p[1] - self.distance
    }

    /// The line with the least weighted sum of squared distances from `(point, weight)` (total least squares). There is none without
    /// a positive weight.
    pub(crate) fn fit(points: impl Iterator<Item = ([f32; 2], f32)> + Clone) -> Option<Self> {
        let (mut total, mut x, mut y) = (0.0f64, 0.0f64, 0.0f64);
        for (p, w) in points.clone() {
            total += f64::from(w);
            x += f64::from(w * p[0]);
            y += f64::from(w * p[1]);
        }
        if total <= 0.0 {
            return None;
        }
        let (x, y) = (x / total, y / total);
        let (mut xx, mut xy, mut yy) = (0.0f64, 0.0f64, 0.0f64);
        for (p, w) in points {
            let (dx, dy) = (f64::from(p[0]) - x, f64::from(p[1]) - y);
            xx += f64::from(w) * dx * dx;
            xy += f64::from(w) * dx * dy;
            yy += f64::from(w) * dy * dy;
        }
        let along = 0.5 * (2.0 * xy).atan2(xx - yy);
        let normal = [-along.sin(), along.cos()];
        Some(Self { normal: normal.map(|v| v as f32), distance: (normal[0] * x + normal[1] * y) as f32 })
    }

    /// How far from `from` along the unit vector `along` the line is reached, px.
    pub(crate) fn cut(&self, from: [f32; 2], along: [f32; 2]) -> f32 {
        -self.offset(from) / (self.normal[0] * along[0] + self.normal[1] * along[1])
    }
}

/// Distance between two points, px.
pub(crate) fn distance(a: [f32; 2], b: [f32; 2]) -> f32 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// The two axes of Fig. 4 in a picture, px.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Axes {
    /// Where the axes cross: the lip.
    pub lip_px: [f32; 2],
    /// Unit vector along the glass's top edge, into the mouth.
    pub x: [f32; 2],
    /// Unit vector along the container's left side, from its foot beyond the rim.
    pub y: [f32; 2],
}

impl Axes {
    /// The axes of a checked configuration, in which they are not parallel.
    pub fn new(image: &ImageConfig) -> Self {
        let unit = |a: [f32; 4]| {
            let (dx, dy) = (a[2] - a[0], a[3] - a[1]);
            let length = dx.hypot(dy);
            [dx / length, dy / length]
        };
        let (x, y) = (unit(image.x_axis_px), unit(image.y_axis_px));
        Self { lip_px: image.lip_px(), x, y }
    }

    /// Sine of the angle from x to y. Its sign tells the sense of turning.
    pub(crate) fn sine(&self) -> f32 {
        self.x[0] * self.y[1] - self.x[1] * self.y[0]
    }

    /// How far `point_px` lies between the axes: the smaller of its distances from the two, px. Negative outside.
    pub fn between(&self, point_px: [f32; 2]) -> f32 {
        let p = [point_px[0] - self.lip_px[0], point_px[1] - self.lip_px[1]];
        let turn = self.sine().signum();
        let from_x = (self.x[0] * p[1] - self.x[1] * p[0]) * turn;
        let from_y = (p[0] * self.y[1] - p[1] * self.y[0]) * turn;
        from_x.min(from_y)
    }

    /// The point at `distance_px` from the lip in the direction `along`.
    pub(crate) fn at(&self, distance_px: f32, along: [f32; 2]) -> [f32; 2] {
        [self.lip_px[0] + distance_px * along[0], self.lip_px[1] + distance_px * along[1]]
    }

    /// Unit vectors of `count` rays from the lip that divide the wedge between the axes evenly, from the x-axis to the y-axis.
    pub(crate) fn rays(&self, count: usize) -> impl Iterator<Item = [f32; 2]> + Clone {
        let (x, y, sine) = (self.x, self.y, self.sine());
        let wedge = sine.abs().atan2(x[0] * y[0] + x[1] * y[1]);
        let turn = sine.signum();
        (0..count).map(move |i| {
            let (sin, cos) = ((i as f32 + 0.5) / count as f32 * wedge * turn).sin_cos();
            [x[0] * cos - x[1] * sin, x[0] * sin + x[1] * cos]
        })
    }

    /// Area of the fan from the lip over `points_px`, which lie in order around it, px^2.
    pub(crate) fn fan_px2(&self, points_px: &[[f32; 2]]) -> f32 {
        let from_lip = |p: &[f32; 2]| [p[0] - self.lip_px[0], p[1] - self.lip_px[1]];
        let pairs = points_px.iter().map(from_lip).zip(points_px.iter().skip(1).map(from_lip));
        pairs.map(|(p, q)| 0.5 * (p[0] * q[1] - p[1] * q[0]).abs()).sum()
    }

    /// The cuts of a line with the x-axis and the y-axis, px from the lip.
    pub(crate) fn legs_px(&self, line: &Line) -> [f32; 2] {
        [line.cut(self.lip_px, self.x), line.cut(self.lip_px, self.y)]
    }

    /// Area of the triangle with these legs on the axes, px^2: V_e of Fig. 4.
    pub(crate) fn area_px2(&self, [a, b]: [f32; 2]) -> f32 {
        0.5 * a * b * self.sine().abs()
    }
}

/// A linear function of a place in a picture.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LinearField {
    /// Value at the origin.
    pub(crate) at_origin: f32,
    /// Change per px to the right.
    pub(crate) per_x: f32,
    /// Change per px down.
    pub(crate) per_y: f32,
}

impl LinearField {
    /// The same value everywhere.
    pub(crate) const fn constant(value: f32) -> Self {
        Self { at_origin: value, per_x: 0.0, per_y: 0.0 }
    }

    /// The function that is 0 at `zero` and changes by these amounts per px.
    pub(crate) fn from_zero([x, y]: [f32; 2], per_x: f32, per_y: f32) -> Self {
        Self { at_origin: -per_x * x - per_y * y, per_x, per_y }
    }

    /// The value at a place.
    #[inline(always)]
    pub(crate) fn at(&self, [x, y]: [f32; 2]) -> f32 {
        self.at_origin + self.per_x * x + self.per_y * y
    }
}

/// Rays between the axes of a region at full size. Chosen by hand; a stream that fills 80 % of them cannot be a drop.
pub(crate) const RAYS: usize = 48;
/// Distance from the lip at which rays begin, px: nearer, bead, rim and corner mix. Chosen by hand; no measurement is recorded.
pub(crate) const NEAR_PX: f32 = 3.0;
/// Up to this distance from the lip the samples of a ray lie 1 px apart, px; further out, in proportion to their distance. The rays
/// only have to find the edge to within a profile's reach. Tuned on seeds 1 and 5001 to 5003 of `evaluate-camera`, see docs/VISION.md.
const DENSE_PX: f32 = 36.0;
/// Largest distance between samples of a ray, px. Tuned as [`DENSE_PX`] was.
const STEP_MOST_PX: f32 = 5.0;
/// A ray with fewer samples inside the region tells nothing. Chosen by hand; no measurement is recorded.
const SAMPLES_LEAST: usize = 8;

/// One ray from the lip.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Ray {
    /// Unit vector.
    pub(crate) along: [f32; 2],
    /// Samples that lie inside the region.
    pub(crate) samples: usize,
}

/// The rays between the axes with the samples on each, within a region.
pub(crate) struct RayGrid {
    /// From the x-axis to the y-axis.
    pub(crate) rays: Vec<Ray>,
    /// Distance of each sample from the lip, px; the same on all rays.
    pub(crate) radii_px: Vec<f32>,
    /// The length of ray for which each sample stands, px.
    pub(crate) steps_px: Vec<f32>,
}

impl RayGrid {
    /// The rays of `axes`, which are relative to a region of `size_px`. There are none if the region has no room between the axes.
    pub(crate) fn new(axes: &Axes, size_px: [f32; 2]) -> Option<Self> {
        let lip = axes.lip_px;
        // Distance from the lip to the region's border in a direction.
        let room = |along: [f32; 2]| {
            let to = |k: usize| match along[k] {
                v if v > 1e-6 => (size_px[k] - 2.0 - lip[k]) / v,
                v if v < -1e-6 => (1.0 - lip[k]) / v,
                _ => f32::MAX,
            };
            to(0).min(to(1)).max(0.0)
        };
        let directions = axes.rays(RAYS);
        let longest = directions.clone().map(room).fold(0.0, f32::max);
        let (mut radii_px, mut steps_px) = (Vec::new(), Vec::new());
        let mut radius = NEAR_PX;
        while radius <= longest {
            let step = (radius / DENSE_PX).clamp(1.0, STEP_MOST_PX);
            radii_px.push(radius);
            steps_px.push(step);
            radius += step;
        }
        let rays: Vec<Ray> =
            directions.map(|along| Ray { along, samples: radii_px.iter().take_while(|r| **r <= room(along)).count() }).collect();
        rays.iter().all(|r| r.samples >= SAMPLES_LEAST).then_some(Self { rays, radii_px, steps_px })
    }
}

#[cfg(test)]
mod tests {
    use shared::config::Config;

    /// Protects whoever adapts a shipped configuration: its axes show the directions that V_e is measured in, from the lip into the mouth, and from the
    /// container's foot to its rim. Turned around they give areas that are wrong, and few of them.
    #[test]
    #[allow(clippy::unwrap_used)]
    fn the_shipped_axes_point_the_right_way() {
        for text in [include_str!("../../../config/sim.toml"), include_str!("../../../config/cell.toml")] {
            let image = Config::parse(text, "shipped").unwrap().image;
            let ([lip_x, _, mouth_x, _], [_, foot_y, _, rim_y]) = (image.x_axis_px, image.y_axis_px);
            assert!(lip_x < mouth_x && foot_y > rim_y, "{image:?}");
        }
    }
}
