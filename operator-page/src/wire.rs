//! What crosses the pipe between the page's process and its link to the cell: frames of a length and a postcard message.
//!
//! Both ends use it in ordinary threads; it allocates, and a message is bounded. A pipe that ends, or a message that cannot be read, is an
//! error: then the page starts the link anew.

use std::io::{self, Read, Write};

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use shared::control::{Reply, Request, Status};

/// Largest message, bytes: a picture of 4096 x 4096 px as JPEG is below it.
const MESSAGE_MAX: usize = 8 << 20;
/// Room for a message around a picture, bytes: a status with full histograms takes a quarter of it.
const AROUND: usize = 128 * 1024;

/// One tick of the controller, as the page plots it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Point {
    /// Number of the tick.
    pub tick: u64,
    /// When it was, CLOCK_MONOTONIC ns.
    pub at_ns: u64,
    /// A code of [`shared::messages::Phase`].
    pub phase: u32,
    /// Number of the pour or recording; 0 if there is none.
    pub episode: u64,
    /// Commanded alpha, degrees.
    pub alpha_deg: f32,
    /// Measured alpha, degrees; NaN if it is not known.
    pub alpha_measured_deg: f32,
    /// V_e, px^2; NaN if the tick had none.
    pub area_px2: f32,
    /// d, ml.
    pub d_ml: f32,
    /// Goal, ml; NaN in a recording.
    pub goal_ml: f32,
    /// Estimated volume poured, ml.
    pub poured_ml: f32,
    /// Its standard deviation, ml; 0 if it is not known.
    pub poured_sd_ml: f32,
    /// A code of [`shared::messages::Doubt`] of the newest feature.
    pub doubt: u32,
}

/// What the worker measured in one frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Measured {
    /// Number of the frame.
    pub sequence: u64,
    /// V_e, px^2.
    pub area_px2: f32,
    /// Confidence, 0 to 1.
    pub confidence: f32,
    /// A code of [`shared::messages::Doubt`].
    pub doubt: u32,
    /// Corners of the triangle, px.
    pub triangle_px: [f32; 6],
}

/// A picture with what the worker measured in it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Picture {
    /// Number of the frame.
    pub sequence: u64,
    /// Size of the camera's picture, px; the JPEG may be smaller.
    pub size_px: (u32, u32),
    /// What the worker measured; none if it said nothing of this frame.
    pub measured: Option<Measured>,
    /// The picture.
    pub jpeg: Vec<u8>,
}

/// What became of an episode's file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Recorded {
    /// Number of the pour or recording.
    pub episode: u64,
    /// Path of the closed file, or why there is none.
    pub file: Result<String, String>,
}

/// From the link to the page.
#[derive(Debug, Serialize, Deserialize)]
pub enum FromLink {
    /// New ticks.
    Points(Vec<Point>),
    /// The controller's state.
    Status(Box<Status>),
    /// Why there is no state.
    NoStatus(String),
    /// The answer to a request.
    Answer(u64, Result<Reply, String>),
    /// A file is closed or failed.
    Recorded(Recorded),
    /// The newest picture.
    Picture(Picture),
    /// Why there is no picture.
    NoPicture(String),
    /// The link cannot go on; why.
    Broken(String),
}

/// From the page to the link.
#[derive(Debug, Serialize, Deserialize)]
pub enum ToLink {
    /// Asks the controller; the number comes back with the answer.
    Ask(u64, Request),
    /// Whether anybody looks at pictures.
    Look(bool),
}

/// Writes one message.
pub fn write<T: Serialize>(to: &mut impl Write, message: &T, around_bytes: usize) -> io::Result<()> {
    let mut buffer = vec![0; AROUND + around_bytes];
    let bytes = postcard::to_slice(message, &mut buffer).map_err(io::Error::other)?;
    let length = u32::try_from(bytes.len()).map_err(io::Error::other)?;
    to.write_all(&length.to_le_bytes())?;
    to.write_all(bytes)?;
    to.flush()
}

/// Reads one message.
pub fn read<T: DeserializeOwned>(from: &mut impl Read) -> io::Result<T> {
    let mut length = [0; 4];
    from.read_exact(&mut length)?;
    let length = u32::from_le_bytes(length) as usize;
    if length > MESSAGE_MAX {
        return Err(io::ErrorKind::InvalidData.into());
    }
    let mut bytes = vec![0; length];
    from.read_exact(&mut bytes)?;
    postcard::from_bytes(&bytes).map_err(io::Error::other)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects the page from numbers that are not known: NaN crosses the pipe, a picture too, and a cut or endless message is an error.
    #[test]
    fn messages_cross_the_pipe() {
        let picture = Picture { sequence: 7, size_px: (640, 480), measured: None, jpeg: vec![3; 300_000] };
        let mut pipe = Vec::new();
        write(&mut pipe, &FromLink::Picture(picture.clone()), picture.jpeg.len()).unwrap();
        let FromLink::Picture(read_back) = read(&mut pipe.as_slice()).unwrap() else { panic!("another message") };
        assert_eq!(read_back, picture);
        assert!(read::<FromLink>(&mut &pipe[..pipe.len() - 1]).is_err());
        assert!(read::<FromLink>(&mut [255, 255, 255, 255].as_slice()).is_err());
        let pour = Request::Pour { goal_ml: f32::NAN, flows_by_deg: None };
        let mut pipe = Vec::new();
        write(&mut pipe, &ToLink::Ask(1, pour), 0).unwrap();
        let ToLink::Ask(1, Request::Pour { goal_ml, .. }) = read(&mut pipe.as_slice()).unwrap() else { panic!("another message") };
        assert!(goal_ml.is_nan());
    }
}
