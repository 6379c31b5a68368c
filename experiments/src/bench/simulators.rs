//! The simulators that a pour can run on: the paper's (a), a physical rig (b), and the same rig through a rendered camera.
//!
//! Pure, any thread; the same seeds give the same pours. Allocates when a bench or a pour is set up; cannot fail.

use simulator::physics::ALPHA_MAX_DEG;
use simulator::physics::container::Container;
use simulator::physics::paper::PaperPour;
use simulator::physics::rig::{Rig, RigPour};

use super::eye_fault::{EyeFault, FaultyEye};
use super::through_camera::{BenchCamera, CameraPour};

/// One pour on any of the simulators, frame by frame.
#[derive(Debug, Clone)]
pub enum BenchPour {
    /// Simulator a.
    Paper(PaperPour),
    /// Simulator b.
    Rig(Box<RigPour>),
    /// Simulator b through a rendered camera.
    ThroughCamera(Box<CameraPour>),
    /// Any of them, seen with a faulty eye.
    Faulty(Box<(BenchPour, FaultyEye)>),
}

impl BenchPour {
    /// Lets one frame pass with `alpha_deg` commanded. Returns the area that the camera reports at its end, px^2; NaN if that frame
    /// cannot be used.
    pub fn frame(&mut self, alpha_deg: f64) -> f32 {
        match self {
            Self::Paper(pour) => pour.frame(alpha_deg),
            Self::Rig(pour) => pour.frame(alpha_deg),
            Self::ThroughCamera(seen) => seen.frame(alpha_deg),
            Self::Faulty(faulty) => {
                let (pour, eye) = &mut **faulty;
                let area_px2 = pour.frame(alpha_deg);
                eye.see(area_px2, alpha_deg)
            }
        }
    }

    /// The confidence of the area that was reported last, 0 to 1; 1 where no camera measured it.
    pub fn confidence(&self) -> f32 {
        match self {
            Self::Paper(_) | Self::Rig(_) => 1.0,
            Self::ThroughCamera(seen) => seen.confidence(),
            Self::Faulty(faulty) => faulty.0.confidence(),
        }
    }

    /// The same pour, seen with a faulty eye if there is a fault; `seed` draws what it shows.
    #[must_use]
    pub fn seen_with(self, fault: Option<EyeFault>, seed: u64) -> Self {
        match fault {
            Some(fault) => Self::Faulty(Box::new((self, FaultyEye::new(fault, seed)))),
            None => self,
        }
    }

    /// The container's tilt, as a robot measures it, degrees; NaN where the simulator has no joint.
    pub fn tilt_deg(&self) -> f64 {
        match self {
            Self::Paper(_) => f64::NAN,
            Self::Rig(pour) => pour.tilt_deg(),
            Self::ThroughCamera(seen) => seen.pour.tilt_deg(),
            Self::Faulty(faulty) => faulty.0.tilt_deg(),
        }
    }

    /// The volume that has really left so far, ml. The film that has yet to drip is not in it.
    pub fn poured_ml(&self) -> f64 {
        match self {
            Self::Paper(pour) => pour.poured_ml(),
            Self::Rig(pour) => pour.poured_ml(),
            Self::ThroughCamera(seen) => seen.pour.poured_ml(),
            Self::Faulty(faulty) => faulty.0.poured_ml(),
        }
    }
}

/// A simulator that is set up for pours and for recording episodes.
#[derive(Debug, Clone)]
pub enum Bench {
    /// Simulator a.
    Paper,
    /// One rig of simulator b. Its container is built once, because its tables cost time.
    Rig(Box<(Rig, Container)>),
    /// The same through a rendered camera.
    ThroughCamera(Box<(Rig, Container, BenchCamera)>),
}

impl Bench {
    /// A bench with `rig` on it.
    pub fn on(rig: &Rig) -> Self {
        Self::Rig(Box::new((rig.clone(), rig.container(0.0))))
    }

    /// A bench with `rig` on it and a rendered camera before it.
    pub fn through_camera(rig: &Rig, camera: BenchCamera) -> Self {
        Self::ThroughCamera(Box::new((rig.clone(), rig.container(0.0), camera)))
    }

    /// Rig and container of simulator b; `None` for simulator a.
    pub fn rig(&self) -> Option<(&Rig, &Container)> {
        match self {
            Self::Paper => None,
            Self::Rig(bench) => Some((&bench.0, &bench.1)),
            Self::ThroughCamera(bench) => Some((&bench.0, &bench.1)),
        }
    }

    /// A pour from `volume_ml`; `seed` draws what changes from pour to pour.
    pub fn pour(&self, volume_ml: f64, seed: u64) -> BenchPour {
        let Some((rig, container)) = self.rig() else { return BenchPour::Paper(PaperPour::new(volume_ml)) };
        let mut container = container.clone();
        container.refill(volume_ml);
        let pour = RigPour::new(rig, container, seed);
        match self {
            Self::ThroughCamera(bench) => BenchPour::ThroughCamera(Box::new(CameraPour::new(pour, &bench.2, rig.delay_frames, seed))),
            _ => BenchPour::Rig(Box::new(pour)),
        }
    }

    /// The tilt at which `volume_ml` starts to flow, degrees.
    pub fn spill_angle_deg(&self, volume_ml: f64) -> f64 {
        let Some((_, container)) = self.rig() else { return PaperPour::new(volume_ml).spill_angle_deg() };
        let mut container = container.clone();
        container.refill(volume_ml);
        container.spill_angle_deg()
    }

    /// What the vessel holds, ml; `None` for simulator a, which has none.
    pub fn full_ml(&self) -> Option<f64> {
        self.rig().map(|(_, container)| container.full_ml())
    }

    /// The volume that flows out of `volume_ml` at the largest tilt if one waits for ever, ml.
    pub fn reach_ml(&self, volume_ml: f64) -> f64 {
        let Some((_, container)) = self.rig() else { return volume_ml };
        let mut container = container.clone();
        container.refill(volume_ml);
        container.volume_ml() - container.retained_ml(ALPHA_MAX_DEG)
    }
}
