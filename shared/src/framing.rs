//! How the lip lies in the camera's pictures, and how liquid is told in them, on which it depends what an area in px^2 is in ml.
//!
//! The worker says it with each measurement, an episode by its configuration, and weights by the episodes that they are trained on. The controller's loop
//! compares two of them, which does not allocate; all else is for ordinary threads. What is not known differs from nothing.

use iceoryx2::prelude::ZeroCopySend;
use serde::{Deserialize, Serialize};

use crate::config::{CameraConfig, ImageConfig, LiquidMethod};

/// The lip may lie elsewhere by this share of the picture's width, 2 px of 640. Where the edge of a stream of 3,000 px^2 stays, one of its legs is then
/// longer by 3 %, and its area by as much: what the estimate expects of the camera's gain from one pour to the next. Chosen by hand.
const LIP_MOVED: f32 = 0.003;
/// An axis may be turned by this, degrees: a leg of such a stream is then longer by up to 4 %. Chosen by hand.
const AXIS_TURNED_DEG: f32 = 2.0;

/// The methods by which liquid is told.
const METHODS: [LiquidMethod; 2] = [LiquidMethod::Colour, LiquidMethod::Clear];

/// A method's name in a configuration.
fn name(method: LiquidMethod) -> &'static str {
    match method {
        LiquidMethod::Colour => "colour",
        LiquidMethod::Clear => "clear",
    }
}

/// A method's code in a framing; 0 is none that is known.
fn code(method: LiquidMethod) -> u32 {
    match method {
        LiquidMethod::Colour => 1,
        LiquidMethod::Clear => 2,
    }
}

/// How the lip lies in the camera's pictures, and how liquid is told in them; all 0 where that is not known.
#[derive(Debug, Clone, Copy, PartialEq, Default, ZeroCopySend, Serialize, Deserialize)]
#[repr(C)]
pub struct Framing {
    /// Width and height of the pictures, px.
    pub size_px: [u16; 2],
    /// How liquid is told, as a code of [`Framing::method`]: the two methods' areas of the same stream differ by some 10 %.
    pub method_code: u32,
    /// Where the axes cross, px.
    pub lip_px: [f32; 2],
    /// Directions of the x-axis and the y-axis, degrees, from the picture's right clockwise.
    pub axes_deg: [f32; 2],
}

/// What of a picture is so different that an area may be another volume in it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Difference {
    /// The pictures' sizes, px.
    Size([u16; 2], [u16; 2]),
    /// How liquid is told.
    Method(LiquidMethod, LiquidMethod),
    /// Where the axes cross, px.
    Lip([f32; 2], [f32; 2]),
    /// The direction of the x-axis, degrees.
    XAxis(f32, f32),
    /// The direction of the y-axis, degrees.
    YAxis(f32, f32),
}

impl Framing {
    /// The framing of a checked configuration.
    pub fn new(camera: &CameraConfig, image: &ImageConfig) -> Self {
        let direction_deg = |[x0, y0, x1, y1]: [f32; 4]| (y1 - y0).atan2(x1 - x0).to_degrees();
        Self {
            // A checked configuration has at most 4,096.
            size_px: [camera.width_px, camera.height_px].map(|px| u16::try_from(px).unwrap_or(u16::MAX)),
            method_code: code(image.method),
            lip_px: image.lip_px(),
            axes_deg: [image.x_axis_px, image.y_axis_px].map(direction_deg),
        }
    }

    /// The framing that a configuration names, as TOML; unknown if it names none.
    pub fn of_toml(config: &str) -> Self {
        let named = || {
            let tables: toml::Table = config.parse().ok()?;
            let image: ImageConfig = tables.get("image")?.clone().try_into().ok()?;
            let camera: CameraConfig = tables.get("camera")?.clone().try_into().ok()?;
            Some(Self::new(&camera, &image)).filter(Self::is_finite)
        };
        named().unwrap_or_default()
    }

    /// The framing as a table has it: [`Framing::text`]; `None` if the text is no framing. Without the method's name, as older tables are, the method is not
    /// known.
    pub fn of_text(text: &str) -> Option<Self> {
        let words: Vec<&str> = text.split_whitespace().collect();
        let (numbers, method_code) = match words[..] {
            [ref numbers @ .., name] if numbers.len() == 6 => {
                (numbers, METHODS.into_iter().find(|method| self::name(*method) == name).map(code)?)
            }
            ref numbers => (numbers, 0),
        };
        let [width, height, x, y, x_deg, y_deg] = *numbers else { return None };
        let size_px = [width.parse().ok()?, height.parse().ok()?];
        let (lip_px, axes_deg) = ([x.parse().ok()?, y.parse().ok()?], [x_deg.parse().ok()?, y_deg.parse().ok()?]);
        let framing = Self { size_px, method_code, lip_px, axes_deg };
        (framing.is_finite() && !size_px.contains(&0)).then_some(framing)
    }

    /// Its six numbers in a row, each to the last bit, and the method's name; empty if it is not known.
    pub fn text(&self) -> String {
        let ([width, height], [x, y], [x_deg, y_deg]) = (self.size_px, self.lip_px, self.axes_deg);
        let method = self.method().map_or(String::new(), |method| format!(" {}", name(method)));
        if self.is_known() { format!("{width} {height} {x} {y} {x_deg} {y_deg}{method}") } else { String::new() }
    }

    /// How liquid is told; `None` if it is not known.
    pub fn method(&self) -> Option<LiquidMethod> {
        METHODS.into_iter().find(|method| code(*method) == self.method_code)
    }

    /// Whether it is known at all.
    pub fn is_known(&self) -> bool {
        self.size_px != [0, 0]
    }

    /// Whether all of it are numbers.
    pub fn is_finite(&self) -> bool {
        self.lip_px.iter().chain(&self.axes_deg).all(|v| v.is_finite())
    }

    /// What in this differs from `other` so much that an area may be another volume; `None` if nothing does, or if one of the two is not known.
    pub fn difference(&self, other: &Self) -> Option<Difference> {
        if !(self.is_known() && other.is_known()) {
            return None;
        }
        if self.size_px != other.size_px {
            return Some(Difference::Size(self.size_px, other.size_px));
        }
        if let (Some(method), Some(other_method)) = (self.method(), other.method())
            && method != other_method
        {
            return Some(Difference::Method(method, other_method));
        }
        let ([x, y], [other_x, other_y]) = (self.lip_px, other.lip_px);
        let moved_px = (x - other_x).hypot(y - other_y);
        // What is no number is nothing that could be allowed.
        if moved_px.is_nan() || moved_px > LIP_MOVED * f32::from(self.size_px[0]) {
            return Some(Difference::Lip(self.lip_px, other.lip_px));
        }
        let differs = |deg: f32, other_deg: f32| {
            let turned_deg = ((other_deg - deg + 180.0).rem_euclid(360.0) - 180.0).abs();
            turned_deg.is_nan() || turned_deg > AXIS_TURNED_DEG
        };
        let ([x_deg, y_deg], [other_x_deg, other_y_deg]) = (self.axes_deg, other.axes_deg);
        if differs(x_deg, other_x_deg) {
            return Some(Difference::XAxis(x_deg, other_x_deg));
        }
        differs(y_deg, other_y_deg).then_some(Difference::YAxis(y_deg, other_y_deg))
    }
}

impl std::fmt::Display for Difference {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Size([w, h], [other_w, other_h]) => write!(f, "pictures of {w} x {h} px and not of {other_w} x {other_h}"),
            Self::Method(method, other) => write!(f, "areas by the method '{}' and not by '{}'", name(*method), name(*other)),
            Self::Lip([x, y], [other_x, other_y]) => write!(f, "the lip at ({x:.0}, {y:.0}) px and not at ({other_x:.0}, {other_y:.0})"),
            Self::XAxis(deg, other_deg) => write!(f, "the x-axis at {deg:.0} degrees and not at {other_deg:.0}"),
            Self::YAxis(deg, other_deg) => write!(f, "the y-axis at {deg:.0} degrees and not at {other_deg:.0}"),
        }
    }
}

impl std::fmt::Display for Framing {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        if !self.is_known() {
            return write!(f, "not known");
        }
        let ([width, height], [x, y], [x_deg, y_deg]) = (self.size_px, self.lip_px, self.axes_deg);
        write!(f, "pictures of {width} x {height} px, the lip at ({x:.0}, {y:.0}), the axes at {x_deg:.0} and {y_deg:.0} degrees")?;
        self.method().map_or(Ok(()), |method| write!(f, ", areas by the method '{}'", name(method)))
    }
}

impl ImageConfig {
    /// Where the axes cross, px: the lip. Of a checked configuration, in which they are not parallel.
    pub fn lip_px(&self) -> [f32; 2] {
        let ([x0, y0, x1, y1], [u0, v0, u1, v1]) = (self.x_axis_px, self.y_axis_px);
        let along = ((u0 - x0) * (v1 - v0) - (v0 - y0) * (u1 - u0)) / ((x1 - x0) * (v1 - v0) - (y1 - y0) * (u1 - u0));
        [x0 + along * (x1 - x0), y0 + along * (y1 - y0)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cell() -> (CameraConfig, ImageConfig) {
        let config = crate::config::Config::parse(include_str!("../../config/sim.toml"), "config/sim.toml").unwrap();
        (config.camera, config.image)
    }

    /// Protects a pour from weights of another picture: another size, place or direction is named, and what two calibrations differ by is not. What is not
    /// known differs from nothing.
    #[test]
    fn another_picture_is_named_and_a_second_calibration_is_none() {
        let (camera, image) = cell();
        let ours = Framing::new(&camera, &image);
        let said = |other: Framing| other.difference(&ours).map(|difference| difference.to_string());
        let moved = |dx: f32, dy: f32| {
            let shift = |[x0, y0, x1, y1]: [f32; 4]| [x0 + dx, y0 + dy, x1 + dx, y1 + dy];
            let image = ImageConfig { x_axis_px: shift(image.x_axis_px), y_axis_px: shift(image.y_axis_px), ..image.clone() };
            said(Framing::new(&camera, &image))
        };
        assert_eq!((moved(0.0, 0.0), moved(1.0, -1.0)), (None, None));
        assert!(moved(9.0, 0.0).is_some_and(|what| what.starts_with("the lip at (")));
        let clear = ImageConfig { method: LiquidMethod::Clear, ..image.clone() };
        assert_eq!(said(Framing::new(&camera, &clear)).unwrap(), "areas by the method 'clear' and not by 'colour'");
        assert_eq!(said(Framing { method_code: 0, ..ours }), None);
        let large = Framing::new(&CameraConfig { width_px: 960, height_px: 720, ..camera }, &image);
        assert_eq!(said(large).unwrap(), "pictures of 960 x 720 px and not of 640 x 480");
        let turned = |x_deg: f32, y_deg: f32| said(Framing { axes_deg: [ours.axes_deg[0] + x_deg, ours.axes_deg[1] + y_deg], ..ours });
        assert_eq!((turned(1.5, -1.5), turned(359.0, -359.0)), (None, None));
        assert!(turned(4.0, 0.0).unwrap().starts_with("the x-axis at ") && turned(0.0, 176.0).unwrap().starts_with("the y-axis at "));
        assert!(said(Framing { lip_px: [f32::NAN, 0.0], ..ours }).is_some());
        assert_eq!((said(Framing::default()), Framing::default().difference(&ours)), (None, None));
    }

    /// Protects what an episode file says: its configuration names the framing that the cell has, and one without it none.
    #[test]
    fn a_configuration_as_text_names_its_framing() {
        let (camera, image) = cell();
        assert_eq!(Framing::of_toml(include_str!("../../config/sim.toml")), Framing::new(&camera, &image));
        for text in ["", "[image]\nmethod = 1", "no TOML", "[camera]\nwidth_px = 640"] {
            assert!(!Framing::of_toml(text).is_known(), "{text}");
        }
    }

    /// Protects the way through a table: a framing comes back to the last bit, that of an older table too, and what is none is no framing.
    #[test]
    fn a_row_of_a_table_is_a_framing() {
        let (camera, image) = cell();
        let ours = Framing { lip_px: [215.37, 249.1], axes_deg: [0.03, -90.2], ..Framing::new(&camera, &image) };
        assert_eq!((Framing::of_text(&ours.text()), Framing::default().text()), (Some(ours), String::new()));
        let older = Framing { method_code: 0, ..ours };
        assert_eq!(
            (ours.text(), older.text()),
            ("640 480 215.37 249.1 0.03 -90.2 colour".into(), "640 480 215.37 249.1 0.03 -90.2".into())
        );
        assert_eq!(Framing::of_text(&older.text()), Some(older));
        let wrong =
            ["640 480 1 2 3", "640 480 1 2 3 4 5", "640 480 1 2 3 4 clear 5", "0 480 1 2 3 4", "-640 480 1 2 3 4", "640 480 nan 2 3 4"];
        for text in wrong.into_iter().chain(["", "a b c d e f", "70000 480 1 2 3 4"]) {
            assert_eq!(Framing::of_text(text), None, "{text}");
        }
    }

    /// Protects where an area begins: the axes cross where both lines are.
    #[test]
    fn the_lip_is_on_both_axes() {
        let image = ImageConfig { x_axis_px: [10.0, 20.0, 30.0, 20.0], y_axis_px: [5.0, 60.0, 5.0, 40.0], ..cell().1 };
        assert_eq!(image.lip_px(), [5.0, 20.0]);
    }
}
