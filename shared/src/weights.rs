//! The weight file.

use std::path::Path;

/// Everything that the controller needs to pour: network, action table, scaling, calibration, estimator parameters.
#[derive(Debug, Clone)]
pub struct Weights {}

/// Why a weight file is refused.
#[derive(Debug, thiserror::Error)]
pub enum WeightsError {}

impl Weights {
    /// Reads and checks a weight file.
    pub fn read(_path: &Path) -> Result<Self, WeightsError> {
        Ok(Self {})
    }
}
