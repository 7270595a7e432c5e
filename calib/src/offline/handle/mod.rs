//! Grasps of a parallel gripper on a rim (paper section 3.2): four positions on an ellipse, one free angle on a circle.
//!
//! Gripper frame: z along the approach, which is minus the rim's normal; x along the closing direction; origin on the
//! axis of the rim.

pub mod grasp;
pub mod setpoint;
pub mod visibility;

use crate::offline::handle::visibility::{FlatMark, PinholeCamera, visibility};
use crate::offline::rim::circle::frame_of;
use crate::offline::rim::model::Rim;
use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
use std::f64::consts::TAU;

/// Smallest flatness ([`FreeAngle::flatness`]) at which the visibility determines the free angle.
pub const FLAT: f64 = 0.05;

/// Steps of the global search over the free angle: half a degree each, refined by a parabola.
const GRID: usize = 720;

/// Gripper pose whose closing direction is `x` projected to the rim's plane, at `standoff` from the rim's centre along
/// its normal.
pub fn gripper_pose(rim: &Rim, x: &Vector3<f64>, standoff: f64) -> Isometry3<f64> {
    let z = -rim.normal;
    let x = (x - z * z.dot(x)).normalize();
    let r = Matrix3::from_columns(&[x, z.cross(&x), z]);
    Isometry3::from_parts(
        Translation3::from(rim.centre + rim.normal * standoff),
        UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(r)),
    )
}

/// The best free angle for one camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FreeAngle {
    /// Angle about the normal from `e1` of [`frame_of`], radians in `[0, 2 pi)`.
    pub phi: f64,
    /// Sum of the marks' solid angles at that angle, steradians.
    pub visibility: f64,
    /// Whether all marks are visible at some angle.
    pub feasible: bool,
    /// `(max - min) / max` of the visibility over all angles; below [`FLAT`] it does not determine the angle.
    pub flatness: f64,
}

/// A grasp on a circle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CircleGrasp {
    /// The best angle for each camera.
    pub per_camera: [FreeAngle; 2],
    /// The camera with the larger visibility at its best angle: 0 left, 1 right.
    pub camera: usize,
    /// The chosen angle, radians.
    pub phi: f64,
    /// The gripper pose at that angle.
    pub pose: Isometry3<f64>,
}

/// Unit closing direction at an angle (radians) about the normal, from `e1` of [`frame_of`].
pub fn direction(rim: &Rim, phi: f64) -> Vector3<f64> {
    let f = frame_of(&rim.normal);
    f.column(0) * phi.cos() + f.column(1) * phi.sin()
}

/// Determines the free rotation about a circle's axis by maximum visibility, with a global search for each camera.
pub fn grasp_circle(rim: &Rim, marks: &[FlatMark], cameras: &[PinholeCamera; 2], standoff: f64) -> CircleGrasp {
    let per_camera = [0, 1].map(|k| free_angle(rim, marks, &cameras[k], standoff));
    let value = per_camera.map(|c| if c.feasible { c.visibility } else { -1.0 });
    let camera = usize::from(value[1] > value[0]);
    let phi = per_camera[camera].phi;
    CircleGrasp { per_camera, camera, phi, pose: gripper_pose(rim, &direction(rim, phi), standoff) }
}

/// The angle with the largest visibility for one camera, among the angles at which all marks are visible, if there are
/// any.
pub fn free_angle(rim: &Rim, marks: &[FlatMark], camera: &PinholeCamera, standoff: f64) -> FreeAngle {
    let step = TAU / GRID as f64;
    let at = |phi: f64| visibility(&gripper_pose(rim, &direction(rim, phi), standoff), marks, camera);
    let grid: Vec<(f64, bool)> = (0..GRID).map(|i| at(i as f64 * step)).collect();
    let feasible = grid.iter().any(|(_, ok)| *ok);
    let mut best = 0;
    let mut value = f64::NEG_INFINITY;
    for (i, (v, ok)) in grid.iter().enumerate() {
        if (*ok || !feasible) && *v > value {
            (best, value) = (i, *v);
        }
    }
    let phi = best as f64 * step;
    let (before, after) = (at(phi - step).0, at(phi + step).0);
    let bend = before - 2.0 * value + after;
    let offset = if bend < 0.0 { (0.5 * (before - after) / bend).clamp(-1.0, 1.0) } else { 0.0 };
    let mut refined = phi + offset * step;
    if feasible && !at(refined).1 {
        refined = phi;
    }
    let max = grid.iter().map(|g| g.0).fold(f64::NEG_INFINITY, f64::max);
    let min = grid.iter().map(|g| g.0).fold(f64::INFINITY, f64::min);
    FreeAngle {
        phi: refined.rem_euclid(TAU),
        visibility: at(refined).0,
        feasible,
        flatness: (max - min) / max.max(1e-300),
    }
}

/// One of the four grasps on an ellipse.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EllipseGrasp {
    /// 0 to 3: closing direction along `+a, +b, -a, -b` (quarter turns about the normal).
    pub index: usize,
    /// The gripper pose.
    pub pose: Isometry3<f64>,
    /// Required jaw opening: `2 a` or `2 b`.
    pub opening: f64,
    /// Sum of the marks' solid angles for each camera, steradians.
    pub visibility: [f64; 2],
    /// For each camera, whether it sees all marks and the jaws open wide enough.
    pub feasible: [bool; 2],
}

/// The four grasps that align the gripper with the axes of an ellipse. `half_widths` are those that the jaws must span:
/// the semi-axes, plus the radius of a bar.
pub fn grasp_ellipse(
    rim: &Rim,
    half_widths: (f64, f64),
    marks: &[FlatMark],
    cameras: &[PinholeCamera; 2],
    standoff: f64,
    max_opening: f64,
) -> [EllipseGrasp; 4] {
    let (a, b) = half_widths;
    let sides = [(rim.axis_a, a), (rim.axis_b, b), (-rim.axis_a, a), (-rim.axis_b, b)];
    let mut index = 0;
    sides.map(|(x, half)| {
        let pose = gripper_pose(rim, &x, standoff);
        let opening = 2.0 * half;
        let seen = [0, 1].map(|k| visibility(&pose, marks, &cameras[k]));
        index += 1;
        EllipseGrasp {
            index: index - 1,
            pose,
            opening,
            visibility: seen.map(|s| s.0),
            feasible: seen.map(|s| s.1 && opening <= max_opening),
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::offline::rim::synthetic::{rig, rim_tilted};

    fn plate(lean: f64) -> Vec<FlatMark> {
        let r = Rotation3::from_axis_angle(&Vector3::x_axis(), lean);
        [(-0.04, -0.025), (0.04, -0.025), (0.04, 0.025), (-0.04, 0.025)]
            .map(|(x, y)| FlatMark {
                position: r * Vector3::new(x, y, 0.0) + Vector3::new(0.0, 0.0, -0.12),
                normal: r * -Vector3::z(),
                area: 1e-4,
            })
            .to_vec()
    }

    #[test]
    fn the_gripper_approaches_against_the_normal_and_its_frame_is_right_handed() {
        let rim = rim_tilted(Vector3::new(0.0, 0.05, 1.5), 0.5, 0.3, 0.075, 0.06);
        let cameras = rig(0.5, 1200.0, 1.5).map(|p| PinholeCamera::new(&p, [1280.0, 1024.0]).unwrap());
        let four = grasp_ellipse(&rim, (rim.a, rim.b), &plate(0.6), &cameras, 0.1, 0.14);
        for g in &four {
            assert!((g.pose.rotation * Vector3::z() + rim.normal).norm() < 1e-12);
            assert!((g.pose.translation.vector - rim.centre - rim.normal * 0.1).norm() < 1e-12);
        }
        assert!((four[1].pose.rotation * Vector3::x() - rim.axis_b).norm() < 1e-12);
        // The jaws open to 140 mm: enough for the minor axis, not for the major one.
        assert!(!four.map(|g| g.feasible[0] || g.feasible[1])[0]);
        assert!((four[0].opening - 0.15).abs() < 1e-12);
    }

    #[test]
    fn the_chosen_angle_is_the_best_of_a_fine_search_and_a_flat_plate_does_not_determine_it() {
        let rim = rim_tilted(Vector3::new(0.02, 0.05, 1.5), 0.35, 0.9, 0.07, 0.07);
        let cameras = rig(0.5, 1200.0, 1.5).map(|p| PinholeCamera::new(&p, [1280.0, 1024.0]).unwrap());
        let grasp = grasp_circle(&rim, &plate(0.6), &cameras, 0.0);
        let chosen = grasp.per_camera[grasp.camera];
        for i in 0..3600 {
            let phi = f64::from(i) * TAU / 3600.0;
            let (v, ok) =
                visibility(&gripper_pose(&rim, &direction(&rim, phi), 0.0), &plate(0.6), &cameras[grasp.camera]);
            assert!(!ok || v <= chosen.visibility * (1.0 + 1e-6), "{phi}");
        }
        assert!(chosen.flatness > FLAT);
        let flat = grasp_circle(&rim, &plate(0.0), &cameras, 0.0);
        assert!(flat.per_camera[flat.camera].flatness < FLAT);
    }
}
