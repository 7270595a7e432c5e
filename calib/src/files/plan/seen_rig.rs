//! The rig as estimated from the images of a plan.

use crate::files::error::{FileError, Source};
use crate::files::pose::PoseRecord;
use graspd_rt::geom::{Camera, Rig, View};
use serde::{Deserialize, Serialize};

/// A camera as estimated from the images of a plan.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SeenCamera {
    /// Focal lengths, pixels.
    pub focal_px: [f64; 2],
    /// Principal point, pixels.
    pub principal_px: [f64; 2],
}

/// The rig as estimated from the images of a plan: the rig file, corrected as far as the images determine its error.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SeenRig {
    /// The left camera.
    pub left: SeenCamera,
    /// The right camera.
    pub right: SeenCamera,
    /// Pose of the left camera's frame in the right camera's frame.
    pub right_from_left: PoseRecord,
    /// Root mean square epipolar error of the rig file in these images, pixels.
    pub epipolar_px: f64,
    /// Number of matched points that it was measured on.
    pub matches: usize,
}

/// Largest relative difference of a focal length from the rig file: a larger one is another camera.
const MAX_FOCAL_CHANGE: f64 = 0.05;
/// Largest difference of a principal-point coordinate from the rig file, pixels.
const MAX_PRINCIPAL_CHANGE_PX: f64 = 30.0;
/// Largest rotation of the right camera from the rig file, radians (2 degrees).
const MAX_ROTATION_RAD: f64 = 0.035;
/// Largest translation of the right camera from the rig file, as a fraction of the baseline.
const MAX_TRANSLATION: f64 = 0.05;

impl SeenRig {
    /// The record of a rig.
    pub fn of(rig: &Rig, epipolar_px: f64, matches: usize) -> Self {
        let camera = |c: &Camera| SeenCamera { focal_px: [c.fx, c.fy], principal_px: [c.cx, c.cy] };
        Self {
            left: camera(&rig.left),
            right: camera(&rig.right),
            right_from_left: PoseRecord::of(&rig.right_from_left),
            epipolar_px,
            matches,
        }
    }

    /// The rig, with the lens distortion of the rig file.
    ///
    /// # Errors
    /// The record differs from the rig file by more than a calibration error.
    pub(super) fn rig(&self, src: &Source<'_>, file: &Rig) -> Result<Rig, FileError> {
        let mut out = *file;
        for (key, seen, camera) in [("left", &self.left, &mut out.left), ("right", &self.right, &mut out.right)] {
            let focal = (seen.focal_px[0] / camera.fx - 1.0).abs().max((seen.focal_px[1] / camera.fy - 1.0).abs());
            let off = (seen.principal_px[0] - camera.cx).abs().max((seen.principal_px[1] - camera.cy).abs());
            for (leaf, values, good) in [
                ("focal_px", seen.focal_px, focal <= MAX_FOCAL_CHANGE),
                ("principal_px", seen.principal_px, off <= MAX_PRINCIPAL_CHANGE_PX),
            ] {
                if !good {
                    return Err(src.refuse(
                        &format!("seen_rig.{key}.{leaf}"),
                        values,
                        "it differs from the rig file by more than a calibration error",
                        "the plan was edited or damaged: make it again",
                    ));
                }
            }
            [camera.fx, camera.fy] = seen.focal_px;
            [camera.cx, camera.cy] = seen.principal_px;
        }
        let pose = self.right_from_left.pose(src, "seen_rig.right_from_left", 1e3)?;
        let turned = pose.rotation.angle_to(&file.right_from_left.rotation);
        out.right_from_left = pose;
        let moved = (out.centre(View::Right) - file.centre(View::Right)).norm();
        if !(turned <= MAX_ROTATION_RAD && moved <= MAX_TRANSLATION * file.centre(View::Right).norm()) {
            return Err(src.refuse(
                "seen_rig.right_from_left",
                self.right_from_left.translation_m,
                "it differs from the rig file by more than a calibration error",
                "the plan was edited or damaged: make it again",
            ));
        }
        Ok(out)
    }
}
