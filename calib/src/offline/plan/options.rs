//! OPTIONS

use crate::files::RigFile;
use crate::offline::correspondence::rig_prior::RigPrior;
use crate::offline::handle::grasp::Approach;
use crate::offline::rim::model;

/// What to assume, to tolerate and to aim at.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlanOptions {
    /// Of the reconstruction. Lengths in metres.
    pub rim: model::Options,
    /// Of the approach.
    pub approach: Approach,
    /// Epipolar displacement that the rig file may have wrong, pixels (one standard deviation); `None` for its stated quality, or the default.
    pub calibration_px: Option<f64>,
}

impl Default for PlanOptions {
    /// A real rig's calibration is good to a fraction of a pixel, and the edges' own noise is a lower bound of the doubt.
    fn default() -> Self {
        Self {
            rim: model::Options { calibration_px: 1.0, edge_bias_px: 0.1, ..model::Options::default() },
            approach: Approach::default(),
            calibration_px: None,
        }
    }
}

impl PlanOptions {
    /// What the rig file may have wrong.
    pub fn prior(&self, rig: &RigFile) -> RigPrior {
        let stated = RigPrior(rig.error());
        self.calibration_px.map_or(stated, |px| stated.displacing(&rig.rig, px))
    }
}
