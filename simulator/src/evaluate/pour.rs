//! One pour in closed loop on a simulated bench, at full speed.
//!
//! Pure; no allocation per frame. What decides is [`shared::agent::Agent`] behind [`shared::limits::Limiter`], as at run time.

use serde::Serialize;
use shared::agent::{Agent, Frame};
use shared::limits::{Limiter, Limits};

use crate::physics::{RATE_HZ, World};

/// A pour ends after this many frames.
pub const MAX_FRAMES: u32 = 900;
/// Frames after upright in which the last drops fall and are counted.
const SETTLE_FRAMES: u32 = 45;

/// How one pour went.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Poured {
    /// Initial volume asked for, ml.
    pub init_ml: f64,
    /// V_G, ml.
    pub goal_ml: f64,
    /// On the scale, ml.
    pub true_ml: f64,
    /// What the controller believes to have poured, ml.
    pub believed_ml: f64,
    /// Until the container was upright, s.
    pub seconds: f64,
    /// Frames.
    pub frames: u32,
    /// The pour came to its end by itself.
    pub ended: bool,
}

impl Poured {
    /// On the scale minus goal, ml.
    pub fn error_ml(&self) -> f64 {
        self.true_ml - self.goal_ml
    }
    /// Part of the error that measurement made, ml.
    pub fn measurement_ml(&self) -> f64 {
        self.true_ml - self.believed_ml
    }
    /// Part of the error that control made, ml.
    pub fn control_ml(&self) -> f64 {
        self.believed_ml - self.goal_ml
    }
    /// Nothing was poured, or it never came to an end.
    pub fn failed(&self) -> bool {
        !self.ended || self.true_ml < 1.0
    }
}

/// What decides in a pour.
pub trait Controller {
    /// The angle asked for next, degrees relative to the command in force; `None`: the pour is over, upright.
    fn decide(&mut self, area_px2: f32, alpha_deg: f32, world: &World) -> Option<f32>;
    /// Volume believed to have been poured, ml.
    fn believed_ml(&self) -> f64;
}

/// The agent as a controller.
pub struct ByAgent {
    agent: Agent,
    believed_ml: f32,
}

impl ByAgent {
    /// Sets the goal.
    pub fn new(mut agent: Agent, goal_ml: f64) -> Self {
        agent.start(goal_ml as f32);
        Self { agent, believed_ml: 0.0 }
    }
}

impl Controller for ByAgent {
    fn decide(&mut self, area_px2: f32, alpha_deg: f32, _: &World) -> Option<f32> {
        let decision = self.agent.step(Frame { area_px2: Some(area_px2), alpha_deg, alpha_now_deg: alpha_deg });
        self.believed_ml = decision.poured_ml;
        (!decision.finished).then_some(decision.dalpha_deg)
    }
    fn believed_ml(&self) -> f64 {
        f64::from(self.believed_ml)
    }
}

/// Pours `goal_ml` with `controller`.
pub fn pour(world: &mut World, controller: &mut dyn Controller, limits: Limits, init_ml: f64, goal_ml: f64) -> Poured {
    let mut limiter = Limiter::new(limits, (1.0 / RATE_HZ) as f32, 0.0);
    let mut back = false;
    let mut frames = 0;
    let mut upright_frames = 0;
    let mut upright_at = None;
    while upright_frames < SETTLE_FRAMES {
        let alpha = limiter.alpha_deg();
        let area = world.frame(f64::from(alpha));
        let asked = controller.decide(area, alpha, world);
        frames += 1;
        back |= asked.is_none();
        let out_of_time = frames >= MAX_FRAMES;
        match asked {
            Some(dalpha) if !back && !out_of_time => limiter.step(alpha + dalpha),
            _ => limiter.step_upright(),
        };
        if (back || out_of_time) && limiter.alpha_deg() <= 0.0 {
            upright_at.get_or_insert(frames);
            upright_frames += 1;
        }
    }
    Poured {
        init_ml,
        goal_ml,
        true_ml: world.poured_ml(),
        believed_ml: controller.believed_ml(),
        seconds: f64::from(upright_at.unwrap_or(frames)) / RATE_HZ,
        frames,
        ended: back,
    }
}

/// The grid of the reference: V_init x V_G with V_G <= 0.85 V_init, 45 cells.
pub fn grid() -> Vec<(f64, f64)> {
    let mut cells = Vec::new();
    for init in [150.0, 225.0, 300.0, 375.0, 450.0] {
        for k in 1..=10 {
            let goal = 20.0 * f64::from(k);
            if goal <= 0.85 * init {
                cells.push((init, goal));
            }
        }
    }
    cells
}
