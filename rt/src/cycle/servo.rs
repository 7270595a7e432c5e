//! The control law of one cycle: where the gripper is, where it should be, and the joint rates that lead there.
//!
//! The marks of the newest image are moved to now by the joints ([`crate::online::predict`]), compared with the
//! reference's marks ([`crate::online::path`]), and stacked and solved for the gripper's screw
//! ([`crate::online::screw`], with the interaction matrix of [`crate::online::interaction`]), which the arm's Jacobian
//! turns into joint rates ([`crate::online::rates`]).

use super::io::Stage;
use super::settings::CycleConfig;
use super::watch_vision::Seen;
use crate::arm::Joints;
use crate::geom::{Pixel, Pose, Rig, Twist, View, adjoint, log_pose};
use crate::gripper::{Gripper, MAX_MARKS};
use crate::math;
use crate::mode::HoldCause;
use crate::online::interaction::PlacedView;
use crate::online::path::{Leg, Reference, blend, reference_pixel};
use crate::online::rates::{RateError, joint_rates};
use crate::online::screw::{MarkError, Screw, ScrewError, Stack};
use crate::setpoint::{Goal, SetPoint};
use nalgebra::{Matrix6, Vector6};

type Offsets = [[Option<Pixel>; MAX_MARKS]; 2];

/// A motion in progress: the leg, and the offsets of the plan's pixels at its two ends.
#[derive(Clone, Debug)]
pub(super) struct Motion {
    pub(super) stage: Stage,
    pub(super) reference: Reference,
    from: Offsets,
    to: Offsets,
    /// Whether marks that the plan does not see at the end of the leg fade out towards it.
    fade: bool,
}

/// Result of one cycle of the law.
#[derive(Clone, Copy, Debug)]
pub(super) struct Drive {
    pub(super) pose: Pose,
    pub(super) screw: Screw,
    pub(super) xi: Twist,
    pub(super) rates: Joints,
    pub(super) scale: f64,
    pub(super) arm_sigma: f64,
    pub(super) arm_joint: u8,
}

/// Offsets of the plan's pixels from the projection of the goal pose, pixels.
fn offsets(rig: &Rig, gripper: &Gripper, goal: &Goal) -> Offsets {
    let mut out = [[None; MAX_MARKS]; 2];
    for view in View::BOTH {
        let placed = PlacedView::new(rig.camera(view), &(rig.view_from_left(view) * goal.left_from_gripper));
        for (i, mark) in gripper.marks.iter().enumerate() {
            let planned = goal.marks[view.index()][i];
            out[view.index()][i] = planned.and_then(|p| placed.project(&mark.position).map(|q| p - q));
        }
    }
    out
}

impl Motion {
    /// From `pose` to the pre-grasp pose.
    pub(super) fn to_pregrasp(c: &CycleConfig, pose: &Pose, setpoint: &SetPoint) -> Self {
        Self {
            stage: Stage::Pregrasp,
            reference: Reference::new(Leg::line(pose, &setpoint.pregrasp.left_from_gripper), &c.settings.path),
            from: [[None; MAX_MARKS]; 2],
            to: offsets(&c.rig, &c.gripper, &setpoint.pregrasp),
            fade: true,
        }
    }

    /// From the pre-grasp reference straight to the grasp.
    pub(super) fn to_grasp(&self, c: &CycleConfig, setpoint: &SetPoint) -> Self {
        Self {
            stage: Stage::Grasp,
            reference: Reference::new(
                Leg::line(&self.reference.pose(), &setpoint.grasp.left_from_gripper),
                &c.settings.path,
            ),
            from: self.to,
            to: offsets(&c.rig, &c.gripper, &setpoint.grasp),
            fade: true,
        }
    }

    /// An arc about the valve's axis from the current reference.
    pub(super) fn turn(&self, c: &CycleConfig, setpoint: &SetPoint, angle: f64) -> Option<Self> {
        let leg = Leg::arc(&self.reference.pose(), &setpoint.object_centre, &setpoint.object_normal, angle)?;
        Some(Self {
            stage: Stage::Turn,
            reference: Reference::new(leg, &c.settings.path),
            from: self.to,
            to: self.to,
            fade: false,
        })
    }

    /// Straight back from the current reference by the plan's standoff, in the gripper's present orientation.
    pub(super) fn retreat(&self, c: &CycleConfig, setpoint: &SetPoint) -> Self {
        let grasp_from_pregrasp = setpoint.grasp.left_from_gripper.inverse() * setpoint.pregrasp.left_from_gripper;
        let here = self.reference.pose();
        Self {
            stage: Stage::Retreat,
            reference: Reference::new(Leg::line(&here, &(here * grasp_from_pregrasp)), &c.settings.path),
            from: self.to,
            to: self.to,
            fade: false,
        }
    }

    /// Stacks and solves the marks: observed at capture, moved to now by the joints, compared with the reference.
    fn stack(&self, c: &CycleConfig, seen: &Seen, pose: &Pose, best: View) -> Result<Screw, ScrewError> {
        let mount = &c.gripper.flange_from_gripper;
        let at_capture = &seen.vision.left_from_gripper;
        let s = self.reference.progress();
        let reference_pose = self.reference.pose();
        let mut stack = Stack::new(&c.settings.law);
        for view in View::BOTH {
            if !c.settings.law.views.uses(view, best) {
                continue;
            }
            let v = view.index();
            let camera = c.rig.camera(view);
            let view_from_left = c.rig.view_from_left(view);
            let then = at_capture * c.dh.gripper_motion(&seen.q, &seen.q_view[v], mount);
            let then = PlacedView::new(camera, &(view_from_left * then));
            let now = PlacedView::new(camera, &(view_from_left * pose));
            let reference = PlacedView::new(camera, &(view_from_left * reference_pose));
            for (i, mark) in c.gripper.marks.iter().enumerate() {
                let Some(o) = &seen.vision.marks[v][i] else { continue };
                let projections =
                    (then.project(&mark.position), now.project(&mark.position), reference.project(&mark.position));
                let (Some(p_then), Some(p_now), Some(p_reference)) = projections else { continue };
                let factor = if self.fade && self.to[v][i].is_none() { 1.0 - blend(s) } else { 1.0 };
                let error = MarkError {
                    now: o.pixel + (p_now - p_then),
                    reference: reference_pixel(p_reference, self.from[v][i], self.to[v][i], s),
                    covariance: o.covariance,
                    factor,
                };
                stack.add(&now, &reference, &mark.position, &error);
            }
        }
        stack.solve()
    }

    /// One cycle: pose now, correction, screw `ξ = λ · correction + feed-forward` and joint rates within the speed
    /// caps.
    ///
    /// # Errors
    /// The marks or the arm do not allow a finite, well-conditioned solution.
    pub(super) fn drive(
        &mut self,
        c: &CycleConfig,
        seen: &Seen,
        q: &Joints,
        jacobian: &Matrix6<f64>,
        pace: Pace,
        best: View,
    ) -> Result<Drive, HoldCause> {
        let s = &c.settings;
        let mount = &c.gripper.flange_from_gripper;
        let pose = seen.vision.left_from_gripper * c.dh.gripper_motion(&seen.q, q, mount);
        let screw = self.stack(c, seen, &pose, best).map_err(|e| match e {
            ScrewError::TooFewPoints { points, needed } => HoldCause::FewPoints { points, needed },
            ScrewError::NotFinite => HoldCause::NoSolution,
            ScrewError::IllConditioned { sigma_min, condition } => HoldCause::Geometry { sigma_min, condition },
        })?;
        let lag = s.law.size(&screw.correction);
        let task = if matches!(self.stage, Stage::Turn | Stage::Retreat) { s.task.speed_share } else { 1.0 };
        let path_pace = pace.scale * pace.share.min(1.0) * task;
        self.reference.advance(pace.dt_s * pace.slider, path_pace, lag, &s.path);
        let now_from_reference = pose.inverse() * self.reference.pose();
        let forward = adjoint(&now_from_reference) * self.reference.screw();
        let mut xi = (screw.correction * s.law.gain(lag)) * pace.scale + forward;
        let speed = xi.fixed_rows::<3>(0).norm();
        let cap = pace.tcp_cap * pace.share;
        if speed > cap {
            xi *= cap / speed;
        }
        let found = joint_rates(jacobian, &xi, &s.rates).map_err(|e| match e {
            RateError::Singular { sigma_min, joint } => HoldCause::Singular { sigma_min, joint },
            RateError::NotFinite => HoldCause::NoSolution,
        })?;
        let mut rates = found.rates;
        let over = (0..6).fold(1.0_f64, |m, i| m.max(math::fabs(rates[i]) / (pace.velocity[i] * pace.share)));
        let mut scale = pace.scale * found.scale;
        if over > 1.0 {
            rates = core::array::from_fn(|i| rates[i] / over);
            scale /= over;
        }
        Ok(Drive { pose, screw, xi, rates, scale, arm_sigma: found.sigma_min, arm_joint: found.joint })
    }

    /// Distance from the gripper's pose to the end of the leg, metres (unit-scaled).
    pub(super) fn left_m(&self, c: &CycleConfig, pose: &Pose) -> f64 {
        c.settings.law.size(&log_pose(&(pose.inverse() * self.reference.leg().pose(1.0))))
    }
}

/// Speed limits of a cycle.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pace {
    /// Time since the last cycle, seconds, at most one period.
    pub(super) dt_s: f64,
    /// Fraction of the speed for the age of the image and for lost marks, 0 to 1.
    pub(super) scale: f64,
    /// Fraction of the speed caps in force (reduced mode, probe), 0 to 1.
    pub(super) share: f64,
    /// Fraction of the commanded rates that the controller's speed slider lets through, 0 to 1.
    pub(super) slider: f64,
    /// Speed cap of the gripper, m/s.
    pub(super) tcp_cap: f64,
    /// Speed caps of the joints, rad/s.
    pub(super) velocity: Joints,
}

/// Gripper screw of joint rates, gripper frame (m/s, rad/s).
pub(super) fn screw_of(jacobian: &Matrix6<f64>, rates: &Joints) -> Twist {
    jacobian * Vector6::from_column_slice(rates)
}
