//! What the camera may show instead of the stream: faults of the eye, for a bench that knows the truth.
//!
//! Pure, any thread; the same seed gives the same areas; allocates nothing; cannot fail.

use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;
use simulator::physics::RATE_HZ;

/// Noise of a false stream, as a share of its area: a little less than that of a real one on the rigs, 8 %.
const FALSE_NOISE: f64 = 0.05;
/// Area to which a stuck camera sticks, px^2: a quarter of a wanted stream on the rigs.
const STUCK_PX2: f32 = 90.0;
/// Areas among which that of a spike is drawn, px^2: those of the swarm's cells.
const SPIKE_PX2: std::ops::Range<f32> = 200.0..20_000.0;
/// Frames among which the one with the spike is drawn: most pours flow then.
const SPIKE_FRAMES: std::ops::Range<u32> = 40..140;
/// How long a gain drifts before it stays, s.
const DRIFT_S: f64 = 10.0;
/// By which share a gain drifts.
const DRIFT_SHARE: f64 = 0.3;

/// A fault of the eye.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum EyeFault {
    /// No stream is ever seen.
    Blind,
    /// From the first stream on, one area is seen, the same to the bit.
    Stuck,
    /// From the first stream on, an area of this many px^2 is seen that wavers as a stream does.
    Wavering(f64),
    /// The same, from the first frame in which the container is tilted.
    WaveringEarly(f64),
    /// One frame shows an area of up to 20,000 px^2.
    Spike,
    /// The gain falls by 30 % within ten seconds.
    DriftDown,
    /// The gain rises by 30 % within ten seconds.
    DriftUp,
}

/// A fault of the eye in one pour.
#[derive(Debug, Clone)]
pub struct FaultyEye {
    fault: EyeFault,
    random: Pcg64Mcg,
    frame: u32,
    spike_at: u32,
    spike_px2: f32,
    seen_stream: bool,
}

impl FaultyEye {
    /// This fault in the pour of this seed.
    pub fn new(fault: EyeFault, seed: u64) -> Self {
        let mut random = Pcg64Mcg::seed_from_u64(seed ^ 0x0e1e);
        let (spike_at, spike_px2) = (random.random_range(SPIKE_FRAMES), random.random_range(SPIKE_PX2));
        Self { fault, random, frame: 0, spike_at, spike_px2, seen_stream: false }
    }

    /// What is seen instead of `area_px2` in the next frame, at this commanded tilt.
    pub fn see(&mut self, area_px2: f32, alpha_deg: f64) -> f32 {
        self.frame += 1;
        self.seen_stream |= area_px2 > 0.0;
        let noise: f64 = StandardNormal.sample(&mut self.random);
        let wavering = |px2: f64| (px2 * (FALSE_NOISE * noise).exp()) as f32;
        let drifted = |share: f64| area_px2 * (1.0 + share * (f64::from(self.frame) / (DRIFT_S * RATE_HZ)).min(1.0)) as f32;
        match self.fault {
            EyeFault::Blind => 0.0,
            EyeFault::Stuck if self.seen_stream => STUCK_PX2,
            EyeFault::Wavering(px2) if self.seen_stream => wavering(px2),
            EyeFault::WaveringEarly(px2) if alpha_deg > 5.0 => wavering(px2),
            EyeFault::Spike if self.frame == self.spike_at => self.spike_px2,
            EyeFault::DriftDown => drifted(-DRIFT_SHARE),
            EyeFault::DriftUp => drifted(DRIFT_SHARE),
            _ => area_px2,
        }
    }
}
