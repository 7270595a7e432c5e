//! Whether the arm can follow the paths of a scenario, and whether the cameras see the marks on them.

use crate::scene::Body;
use graspd_rt::arm::{Dh, Joints, Model, inverse};
use graspd_rt::geom::{Pose, Rig, Vec3, View};
use nalgebra::{Matrix6, Point3};

/// Smallest allowed singular value of the gripper's Jacobian on a path, m/s per rad/s (rotations weighted by 0.25 m).
const MIN_SIGMA: f64 = 0.045;
/// Smallest cosine between a mark's normal and the direction to a camera at which the mark counts as seen.
const MIN_COS: f64 = 0.45;

/// Numbers of visible marks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Seen {
    /// Marks seen by both cameras.
    pub both: usize,
    /// Marks seen by the camera that sees fewer.
    pub least: usize,
}

/// Counts the marks that the cameras see at least `margin` pixels inside their images.
pub fn seen_marks(body: &Body, rig: &Rig, left_from_gripper: &Pose, opening: f64, margin: f64) -> Seen {
    let mut seen = [0u64; 2];
    for view in View::BOTH {
        let centre = (left_from_gripper.inverse() * Point3::from(rig.centre(view))).coords;
        for (i, m) in body.marks.iter().enumerate() {
            let at = (left_from_gripper * Point3::from(m.position)).coords;
            let inside = rig.project(view, &at).is_some_and(|p| rig.camera(view).contains(p, margin));
            if inside && body.mark_seen(i, &centre, opening) > MIN_COS {
                seen[view.index()] |= 1 << i;
            }
        }
    }
    let both = (seen[0] & seen[1]).count_ones() as usize;
    Seen { both, least: seen[0].count_ones().min(seen[1].count_ones()) as usize }
}

/// Smallest singular value of the gripper's Jacobian, rotations weighted by 0.25 m.
fn sigma_min(dh: &Dh, q: &Joints, flange_from_gripper: &Pose) -> f64 {
    let mut j: Matrix6<f64> = dh.body_jacobian(q, flange_from_gripper);
    for r in 3..6 {
        for c in 0..6 {
            j[(r, c)] *= 0.25;
        }
    }
    j.singular_values().min()
}

/// Joint positions along a sequence of gripper poses (base frame), starting near `near`. `None` if the arm cannot
/// follow it smoothly: out of reach, close to a singularity or joint limit, a change of configuration, or a wrist too
/// close to the floor or to the arm's column.
pub fn straight_path(
    model: Model,
    dh: &Dh,
    flange_from_gripper: &Pose,
    poses: &[Pose],
    near: &Joints,
) -> Option<Vec<Joints>> {
    let gripper_from_flange = flange_from_gripper.inverse();
    let ranges = model.joints();
    let mut out: Vec<Joints> = Vec::with_capacity(poses.len());
    for pose in poses {
        let from = out.last().unwrap_or(near);
        let q = inverse(dh, &(pose * gripper_from_flange), from).ok()?;
        if !out.is_empty() && q.iter().zip(from).any(|(a, b)| (a - b).abs() > 0.35) {
            return None;
        }
        let limit = |(v, r): (&f64, &graspd_rt::arm::JointRange)| *v < r.min + 0.5 || *v > r.max - 0.5;
        if q.iter().zip(&ranges).any(limit) || sigma_min(dh, &q, flange_from_gripper) < MIN_SIGMA {
            return None;
        }
        let frames = dh.frames(&q);
        let clear = |p: &Vec3| p.z > 0.06 && p.x.hypot(p.y) > 0.12;
        if !frames[3..].iter().all(|f| clear(&f.translation.vector)) || frames[2].translation.vector.z < 0.06 {
            return None;
        }
        out.push(q);
    }
    Some(out)
}

/// Poses from `a` to `b` in `n` equal steps, both ends included.
pub(super) fn line(a: &Pose, b: &Pose, n: usize) -> Vec<Pose> {
    (0..=n)
        .map(|k| {
            let t = k as f64 / n as f64;
            let p = a.translation.vector.lerp(&b.translation.vector, t);
            let r = a.rotation.try_slerp(&b.rotation, t, 1e-9).unwrap_or(b.rotation);
            Pose::from_parts(p.into(), r)
        })
        .collect()
}
