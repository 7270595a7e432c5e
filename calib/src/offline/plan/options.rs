//! Assumptions, tolerances and approach of a plan.

use crate::files::RigFile;
use crate::offline::correspondence::rig_prior::RigPrior;
use crate::offline::handle::grasp::Approach;
use crate::offline::rim::model;

/// Assumptions, tolerances and approach of a plan.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlanOptions {
    /// Options of the reconstruction. Lengths in metres.
    pub rim: model::Options,
    /// Options of the approach.
    pub approach: Approach,
    /// Epipolar displacement by the error of the rig file, pixels (one standard deviation); `None` for its stated
    /// quality, or the default.
    pub calibration_px: Option<f64>,
}

impl Default for PlanOptions {
    /// The calibration of a real rig is accurate to a fraction of a pixel, and the noise of the edges is a lower bound
    /// of the uncertainty.
    fn default() -> Self {
        Self {
            rim: model::Options { calibration_px: 1.0, edge_bias_px: 0.1, ..model::Options::default() },
            approach: Approach::default(),
            calibration_px: None,
        }
    }
}

impl PlanOptions {
    /// Prior of the error of the rig file.
    pub fn prior(&self, rig: &RigFile) -> RigPrior {
        let stated = RigPrior(rig.error());
        self.calibration_px.map_or(stated, |px| stated.displacing(&rig.rig, px))
    }
}
