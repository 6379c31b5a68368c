//! The weights that a virtual cell can be given, by robot and vessel.
//!
//! Plain data, shared by all threads; allocates when it is made; cannot fail.

use std::collections::BTreeMap;
use std::sync::Arc;

use shared::weights::Weights;
use simulator::ur::Series;

/// The weights for each pair of robot (whether it is an e-Series) and vessel.
#[derive(Debug, Clone, Default)]
pub struct TrainedSet(pub Arc<BTreeMap<(bool, usize), Weights>>);

impl TrainedSet {
    /// The weights for a robot and a vessel.
    pub fn get(&self, series: Series, vessel: usize) -> Option<&Weights> {
        self.0.get(&(series == Series::ESeries, vessel))
    }
}
