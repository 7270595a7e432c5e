//! Checks a set-point, and the path to it before the first step: marks in view, arm in reach, no singularity, joints in
//! range.

use super::settings::CycleConfig;
use crate::arm::{Joints, newton};
use crate::geom::{Pose, View};
use crate::guard::Limits;
use crate::mode::Reject;
use crate::online::interaction::PlacedView;
use crate::online::path::Leg;
use crate::online::rates::singularity;
use crate::setpoint::{Goal, SetPoint};

/// Poses checked on each leg.
const SAMPLES: u32 = 8;
/// Distance from the image border below which a mark does not count, pixels.
const MARGIN_PX: f64 = 8.0;

/// Whether a set-point is finite and has enough marks in the views in use.
pub(super) fn setpoint(c: &CycleConfig, s: &SetPoint) -> Result<(), Reject> {
    for goal in [&s.pregrasp, &s.grasp] {
        if goal_points(c, goal, s.best_view)? < c.settings.law.min_points {
            return Err(Reject::BadSetPoint);
        }
    }
    let normal = s.object_normal.norm();
    let finite = s.object_centre.iter().all(|v| v.is_finite()) && normal > 0.5 && normal < 1.5;
    if finite { Ok(()) } else { Err(Reject::BadSetPoint) }
}

fn goal_points(c: &CycleConfig, goal: &Goal, best: View) -> Result<u8, Reject> {
    let p = &goal.left_from_gripper;
    if p.translation.vector.iter().chain(p.rotation.quaternion().coords.iter()).any(|v| !v.is_finite()) {
        return Err(Reject::BadSetPoint);
    }
    let mut points = 0;
    for view in View::BOTH {
        for pixel in goal.marks[view.index()].iter().take(c.gripper.marks.len()).flatten() {
            if !(pixel.x.is_finite() && pixel.y.is_finite()) {
                return Err(Reject::BadSetPoint);
            }
            if c.settings.law.views.uses(view, best) {
                points += 1;
            }
        }
    }
    Ok(points)
}

/// Whether the path from `pose` (gripper in the rig now, joints `q`) over the pre-grasp to the grasp is possible.
///
/// Only the motion relative to the gripper's pose is needed, not the pose of the rig in the robot's base. Bounded work:
/// 16 poses, each with a few Newton steps.
pub(super) fn path(c: &CycleConfig, limits: &Limits, pose: &Pose, q: &Joints, s: &SetPoint) -> Result<(), Reject> {
    let mount = &c.gripper.flange_from_gripper;
    let base_from_left = c.dh.base_from_gripper(q, mount) * pose.inverse();
    let unmount = mount.inverse();
    let (min, max) = limits.positions();
    let mut joints = *q;
    let legs = [
        Leg::line(pose, &s.pregrasp.left_from_gripper),
        Leg::line(&s.pregrasp.left_from_gripper, &s.grasp.left_from_gripper),
    ];
    let samples = || legs.iter().flat_map(|leg| (1..=SAMPLES).map(|k| leg.pose(f64::from(k) / f64::from(SAMPLES))));
    if samples().any(|at| points(c, &at, s.best_view) < c.settings.law.min_points) {
        return Err(Reject::PathLeavesView);
    }
    for at in samples() {
        joints = newton(&c.dh, &(base_from_left * at * unmount), &joints).map_err(|_| Reject::OutOfReach)?;
        let inside = (0..6).all(|i| joints[i] >= min[i] && joints[i] <= max[i]);
        let sigma = singularity(&c.dh.body_jacobian(&joints, mount), &c.settings.rates).map_or(0.0, |(s, _)| s);
        if !inside || sigma <= c.settings.rates.hard_sigma {
            return Err(Reject::OutOfReach);
        }
    }
    Ok(())
}

/// Number of marks that face a camera in use and are inside its image with the gripper at `pose`.
fn points(c: &CycleConfig, pose: &Pose, best: View) -> u8 {
    let mut n = 0;
    for view in View::BOTH {
        if !c.settings.law.views.uses(view, best) {
            continue;
        }
        let placed = PlacedView::new(c.rig.camera(view), &(c.rig.view_from_left(view) * pose));
        for m in &c.gripper.marks {
            let seen = placed.project(&m.position).is_some_and(|p| placed.contains(p, MARGIN_PX));
            if seen && placed.faces(&m.position, &m.normal) {
                n += 1;
            }
        }
    }
    n
}
