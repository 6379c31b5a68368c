//! Which of the feature worker's measurements count: their layout, their clock, their order, and the frames that were lost between.
//!
//! It is pure and runs in the controller's loop; it does not allocate or fail.

use shared::messages::{Doubt, Feature, LAYOUT_VERSION};

/// Longest gap whose lost frames are bridged at once, s. A longer one is older than the largest `controller.stale_feature_ms` allows.
pub const BRIDGED_S: f64 = 1.0;

/// Whether a feature has another layout, or comes from the future and so from another clock. Its age, on which the endings rest, would mean
/// nothing.
pub fn is_foreign(feature: &Feature, now_ns: u64) -> bool {
    feature.version != LAYOUT_VERSION || feature.captured_at_ns > now_ns
}

/// V_e, px^2, if it could be measured and may be used.
pub fn usable_area_px2(feature: &Feature) -> Option<f32> {
    let usable = feature.area_px2.is_finite() && Doubt::from_code(feature.doubt).usable(feature.area_px2);
    usable.then_some(feature.area_px2)
}

/// The newest time at which a usable picture was taken, ns: among `features` and `before_ns`.
pub fn newest_usable_ns(features: &[Feature], before_ns: u64, now_ns: u64) -> u64 {
    let usable = features.iter().filter(|f| !is_foreign(f, now_ns) && usable_area_px2(f).is_some());
    usable.map(|f| f.captured_at_ns).fold(before_ns, u64::max)
}

/// A feature that counts, and how it follows the one before it.
#[derive(Debug, Clone, Copy)]
pub struct Taken {
    previous: Option<Feature>,
    feature: Feature,
    /// Number of frames lost between the two, at most as many as are bridged.
    pub lost: u32,
}

impl Taken {
    /// Takes `feature` after `previous`; `None` if it must be ignored, because it is foreign, or comes twice or too late. At most `bridged` lost
    /// frames count.
    pub fn new(previous: Option<Feature>, feature: &Feature, now_ns: u64, bridged: u32) -> Option<Self> {
        let of_same_worker = previous.filter(|p| p.worker_epoch_ns == feature.worker_epoch_ns);
        if is_foreign(feature, now_ns) || of_same_worker.is_some_and(|p| feature.sequence <= p.sequence) {
            return None;
        }
        let lost = of_same_worker.map_or(0, |p| (feature.sequence - p.sequence - 1).min(bridged.into()) as u32);
        Some(Self { previous, feature: *feature, lost })
    }

    /// When the `nth` of the lost frames was taken, `nth` from 1: they lie evenly between the two features.
    pub fn lost_at_ns(&self, nth: u32) -> u64 {
        let to_ns = self.feature.captured_at_ns;
        let from_ns = self.previous.map_or(to_ns, |p| p.captured_at_ns);
        from_ns.saturating_add(to_ns.saturating_sub(from_ns) / u64::from(self.lost + 1) * u64::from(nth))
    }
}
