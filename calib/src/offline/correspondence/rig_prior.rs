//! Parameters and prior of the error of a rig file.

use crate::offline::edges::lens::projection;
use crate::offline::types::projection::Projection;
use graspd_rt::geom::{Rig, View};
use nalgebra::{SVector, UnitQuaternion, Vector3};

/// Number of parameters of a rig's error.
pub const PARAMETERS: usize = 12;

/// Error of a rig in units of the prior's standard deviations: rotation (3) and position (3) of the right camera,
/// common and differential focal length, principal point left (2) and right (2).
pub type Phi = SVector<f64, PARAMETERS>;

/// Standard deviations of the error of a rig file: its stated quality, or the default of
/// [`graspd_rt::geom::RigError`].
///
/// The position of the right camera has the standard deviation of its rotation in radians times the baseline along
/// every axis: the direction of the baseline is no better known than the orientation of the cameras.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RigPrior(pub graspd_rt::geom::RigError);

impl RigPrior {
    /// A rig without error.
    pub(super) fn exact() -> Self {
        Self(graspd_rt::geom::RigError::default().scaled(0.0))
    }

    /// The rig corrected by an error in standard deviations.
    pub(super) fn corrected(&self, rig: &Rig, phi: &Phi) -> Rig {
        let mut out = *rig;
        let turn = Vector3::new(phi[0], phi[1], phi[2]) * self.0.rotation_rad;
        out.right_from_left.rotation = UnitQuaternion::from_scaled_axis(turn) * rig.right_from_left.rotation;
        let baseline = rig.right_from_left.translation.vector.norm();
        // The rotation is about the right camera's own centre, which is displaced afterwards.
        let centre = rig.centre(View::Right) + Vector3::new(phi[3], phi[4], phi[5]) * (self.0.rotation_rad * baseline);
        out.right_from_left.translation.vector = -(out.right_from_left.rotation * centre);
        let (common, half) = (self.0.focal * phi[6], self.0.focal_difference * phi[7]);
        for (camera, scale, at) in [(&mut out.left, common - half, 8), (&mut out.right, common + half, 10)] {
            camera.fx *= 1.0 + scale;
            camera.fy *= 1.0 + scale;
            camera.cx += self.0.principal_px * phi[at];
            camera.cy += self.0.principal_px * phi[at + 1];
        }
        out
    }
}

/// Derivatives of both projection matrices by the parameters of the error, in units of the prior.
pub(super) fn derivatives(rig: &Rig, prior: &RigPrior) -> [[Projection; 2]; PARAMETERS] {
    const STEP: f64 = 0.05;
    std::array::from_fn(|i| {
        let mut d = Phi::zeros();
        d[i] = STEP;
        let (ahead, behind) = (prior.corrected(rig, &d), prior.corrected(rig, &-d));
        View::BOTH.map(|v| (projection(&ahead, v) - projection(&behind, v)) / (2.0 * STEP))
    })
}
