//! From an image to V_e, the area of the triangle of section 3.3.1 and Fig. 4.
//!
//! | file | what it does |
//! |---|---|
//! | `extractor` | measures one image: checks, then the liquid, then the line |
//! | `checks` | whether a picture can be used: light, repetition, focus |
//! | `whole` | whether a picture is whole: decoded to its end, of one moment, with the glass in its place |
//! | `reflection` | a lamp's reflection that hides the lip |
//! | `wandering` | whether colours or brightness wander, so that a coloured liquid may look like the ground |
//! | `pace` | how many pictures stand for a time, and whether a pause lies between two |
//! | `presence` | when a stream that is not seen any more is gone |
//! | `ground_colours`, `ground_beside` | the colours of the ground behind a coloured liquid; what is seen beside the container and in the glass |
//! | `grey` | whether a picture has no colour |
//! | `foreign` | what has the colours of neither the ground nor the coloured liquid |
//! | `hues` | the ranges of hue that are a liquid's |
//! | `liquid` | what the extractor asks of a liquid; `coloured_liquid` (with `coloured_edge`) and `clear_water` are the two kinds |
//! | `stream_edge` | the stream's edge as a robust line, then through sub-pixel points of profiles |
//! | `geometry`, `ray_maps` | lines, the two axes, and the rays between them; where the rays' samples lie in the region |
//! | `picture` | images, their pixels, and samples between pixels |
//! | `confidence` | what a measurement's confidence means |
//! | `measurement` | what one image tells |
//! | `learn_axes` | finds the axes in the mean of many pictures |
//! | `learn_colour` | learns the liquid's colour from the pictures of one pour |
//!
//! docs/VISION.md says how well each works. Nothing here knows where images come from or who reads the measurements.

mod checks;
mod clear_water;
mod coloured_edge;
mod coloured_liquid;
mod confidence;
mod extractor;
mod foreign;
mod geometry;
mod grey;
mod ground_beside;
mod ground_colours;
mod hues;
mod learn_axes;
mod learn_colour;
mod learn_poses;
mod learn_profile;
mod learn_steady;
mod liquid;
mod liquid_mask;
mod measurement;
mod pace;
mod picture;
mod presence;
mod ray_maps;
mod reflection;
mod stream_edge;
mod wandering;
mod whole;

pub use extractor::{ExtractError, Extractor};
pub use geometry::Axes;
pub use ground_beside::{InGlass, RoomBeside, room_beside};
pub use learn_axes::{AxesError, Corner, find_corner};
pub use learn_colour::{ColourError, ColourLearner, DryBackground};
pub use learn_poses::Poses;
pub use learn_steady::Steadiness;
pub use measurement::{Measurement, Stages};
pub use pace::PictureTime;
pub use picture::Image;
