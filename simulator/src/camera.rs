//! The rendered camera: what an in-hand camera beside the container's lip would see.
//!
//! The picture is drawn from the physics of the outflow, never from the triangle that the feature worker looks for, and it shares no code
//! and no constant with the feature worker. The camera looks along the tilt axis and is fixed to the container, so glass and lip stay
//! where they are while background and gravity turn in the picture.
//!
//! | file | what it holds |
//! |---|---|
//! | [`view`] | the camera, and the scene that it is shown |
//! | `board` | what stands behind |
//! | `stream_outline` | the liquid's outline, from the hydraulics of the outflow, and the truth about it |
//! | `drops` | drops in flight and the bead at the lip |
//! | `cover` | outlines become a share of each pixel |
//! | `liquid`, `water` | how coloured liquid and clear water look |
//! | `glass`, `sensor` | the container's glass; exposure, vignette and noise |
//! | [`faults`] | what goes wrong in real cameras, laid over pictures of any source |
//!
//! Called from the cell's camera thread and from experiments. Memory is allocated in [`Renderer::new`], in the first frames, and a little
//! for outlines in every frame. The same view, seed and scenes give the same bytes. Failures are OpenCV's and come back as errors.

mod board;
mod cover;
mod drops;
pub mod faults;
mod glass;
mod liquid;
mod sensor;
mod stream_outline;
pub mod view;
mod water;

use std::sync::Once;

use opencv::core::{self, CV_8UC3, Mat, Rect, Scalar, Size};
use opencv::imgproc;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use board::Board;
use cover::{Cover, join};
use drops::Drops;
use glass::Glass;
use liquid::Liquid;
use sensor::Sensor;
use stream_outline::{Ripple, Stream};
pub use view::{Background, Scene, Truth, View};

/// OpenCV could not draw.
#[derive(Debug, thiserror::Error)]
#[error("rendering the camera's picture: {0}")]
pub struct RenderError(#[from] opencv::Error);

/// Draws frames of one [`View`].
pub struct Renderer {
    view: View,
    random: Pcg64Mcg,
    board: Board,
    stream: Stream,
    ripple: Ripple,
    drops: Drops,
    cover: Cover,
    liquid: Liquid,
    glass: Glass,
    sensor: Sensor,
    frame: Mat,
    blurred: Mat,
    /// Time of the frame before this one, s.
    last_s: Option<f64>,
}

/// Lets OpenCV work in the calling threads alone. That is done once in a process: OpenCV crashes where two threads set the number of its own at a time.
fn one_thread() -> opencv::Result<()> {
    static DONE: Once = Once::new();
    let mut done = Ok(());
    DONE.call_once(|| done = core::set_num_threads(1));
    done
}

impl Renderer {
    /// A renderer of `view`; `seed` decides background, noise, drops, drift and the room that water reflects.
    ///
    /// # Errors
    /// When OpenCV refuses, for instance for want of memory.
    pub fn new(view: &View, seed: u64) -> Result<Self, RenderError> {
        // One thread: what is drawn does not depend on the machine, and the other core is left to the controller.
        one_thread()?;
        let mut random = Pcg64Mcg::seed_from_u64(seed);
        let board = Board::new(view, &mut random)?;
        let sensor = Sensor::new(view, &mut random);
        Ok(Self {
            view: view.clone(),
            random,
            board,
            stream: Stream::new(),
            ripple: Ripple::default(),
            drops: Drops::new(),
            cover: Cover::new(view.width_px, view.height_px)?,
            liquid: Liquid::new(view, seed),
            glass: Glass::new(view)?,
            sensor,
            frame: Mat::new_rows_cols_with_default(view.height_px as i32, view.width_px as i32, CV_8UC3, Scalar::all(0.0))?,
            blurred: Mat::default(),
            last_s: None,
        })
    }

    /// The view that is drawn.
    pub fn view(&self) -> &View {
        &self.view
    }

    /// Draws one frame of `scene` into `out` (width * height * 3 bytes, BGR), and returns the truth about it.
    ///
    /// # Errors
    /// When OpenCV refuses.
    pub fn render(&mut self, scene: &Scene, out: &mut [u8]) -> Result<Truth, RenderError> {
        let dt_s = self.last_s.map_or(0.0, |last| (scene.at_s - last).clamp(0.0, 0.2));
        self.last_s = Some(scene.at_s);
        self.drops.step(scene, dt_s, &mut self.random);
        self.sensor.drift(&self.view, &mut self.random);
        self.ripple.phase_rad += dt_s * 95.0;
        self.ripple.amplitude = 0.025 * (1.0 + (scene.at_s * 3.1).sin()) * self.random.random_range(0.5..1.0);
        self.ripple.shimmer_rad = self.random.random_range(0.0..std::f64::consts::TAU);

        self.board.shake(&self.view, &mut self.random);
        self.board.draw(&self.view, scene, &mut self.frame)?;
        self.stream.trace(&self.view, scene, self.ripple);
        let truth = self.stream.truth(&self.view);
        let outline: Vec<[f64; 2]> = self.stream.outline().iter().map(|p| self.view.to_image(*p)).collect();
        let body = if outline.is_empty() { Rect::default() } else { self.cover.fill(&outline)? };
        let area = join(body, self.drops.fill(&self.view, scene, &mut self.cover)?);
        self.liquid.lay(&mut self.cover.shares, &mut self.frame, area, self.ripple)?;
        self.glass.lay(&mut self.frame)?;
        let blur_px = self.view.blur_px;
        if blur_px > 0.0 {
            imgproc::gaussian_blur_def(&self.frame, &mut self.blurred, Size::new(0, 0), blur_px)?;
            std::mem::swap(&mut self.frame, &mut self.blurred);
        }
        self.sensor.expose(&self.view, &self.frame, &mut self.random, out)?;
        Ok(truth)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scene(alpha_deg: f64, flow_ml_s: f64) -> Scene {
        Scene { at_s: 1.0, alpha_deg, flow_ml_s, level_mm: -3.0, ..Scene::default() }
    }

    /// Protects the link between flow and feature: more flow always gives a larger triangle, and no flow gives none.
    #[test]
    fn area_grows_with_flow() -> Result<(), RenderError> {
        let view = View::default();
        let mut out = vec![0; 640 * 480 * 3];
        for alpha in [25.0, 45.0, 60.0, 75.0, 90.0, 105.0] {
            let mut renderer = Renderer::new(&view, 1)?;
            assert_eq!(renderer.render(&scene(alpha, 0.0), &mut out)?.area_px2, 0.0);
            let mut last = 0.0;
            print!("{alpha:5}:");
            for flow in [0.3, 1.0, 3.0, 5.0, 10.0, 20.0, 40.0] {
                let area = renderer.render(&scene(alpha, flow), &mut out)?.area_px2;
                print!(" {area:6.0}");
                assert!(area > 1.3 * last, "alpha {alpha} flow {flow}: {area} after {last}");
                last = area;
            }
            println!();
        }
        Ok(())
    }

    /// Protects evaluations and the swarm, which draw on every core, from a crash that takes all their results with it.
    #[test]
    fn many_threads_may_begin_to_draw_at_once() {
        std::thread::scope(|scope| {
            for _ in 0..8 {
                scope.spawn(|| (0..20_000).for_each(|_| assert!(one_thread().is_ok())));
            }
        });
    }

    /// Protects reproducible evaluation: the same view, seed and scenes give the same bytes.
    #[test]
    fn same_seed_same_bytes() -> Result<(), RenderError> {
        let draw = || -> Result<Vec<u8>, RenderError> {
            let mut renderer = Renderer::new(&View::default(), 7)?;
            let mut out = vec![0; 640 * 480 * 3];
            for i in 0..12 {
                let at_s = f64::from(i) / 30.0;
                let flow = if i < 6 { 8.0 } else { 0.05 };
                renderer.render(&Scene { at_s, alpha_deg: 70.0, rate_deg_s: 5.0, flow_ml_s: flow, level_mm: -1.0 }, &mut out)?;
            }
            Ok(out)
        };
        assert!(draw()? == draw()?);
        Ok(())
    }
}
