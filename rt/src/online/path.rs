//! The path of the reference from the gripper's pose to the goal: planned in space, followed in the images.
//!
//! A reference pose moves along a leg: a straight line with a uniform rotation, or an arc about the valve's axis. The
//! pixels of the marks at that pose are the reference features of the servo, and its velocity is the feed-forward, so
//! the image error is always small. When the gripper lags, the reference waits. At the end of a leg the reference
//! features are the pixels of the plan.

use crate::geom::{Pixel, Pose, Twist, Vec3, exp_twist, log_pose};
use crate::math;
use nalgebra::{Quaternion, Translation3, UnitQuaternion};

/// Settings of the path.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PathSettings {
    /// Speed of the gripper along a leg, m/s. Default 0.15.
    pub speed_m_per_s: f64,
    /// Rotation speed along a leg, rad/s. Default 0.35.
    pub turn_rad_per_s: f64,
    /// Time to reach full speed from rest, seconds. Default 0.4.
    pub rise_s: f64,
    /// Lag of the gripper from which the reference slows down, metres (unit-scaled). Default 0.008.
    pub slow_lag_m: f64,
    /// Lag of the gripper at which the reference stops and waits, metres (unit-scaled). Default 0.025.
    pub wait_lag_m: f64,
}

impl Default for PathSettings {
    fn default() -> Self {
        Self { speed_m_per_s: 0.15, turn_rad_per_s: 0.35, rise_s: 0.4, slow_lag_m: 0.008, wait_lag_m: 0.025 }
    }
}

/// One leg in space; poses are `left_from_gripper`, and the leg's parameter runs from 0 to 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Leg {
    /// The origin moves on a straight line, and the gripper rotates uniformly about one axis.
    Line {
        /// Pose at the start.
        from: Pose,
        /// Pose at the end.
        to: Pose,
        /// Total rotation as a rotation vector in the gripper frame, rad.
        turn: Vec3,
    },
    /// A rotation about an axis fixed in the rig.
    Arc {
        /// Pose at the start.
        from: Pose,
        /// A point on the axis, left frame, metres.
        centre: Vec3,
        /// Unit direction of the axis, left frame.
        axis: Vec3,
        /// Total angle, rad, right-handed about the axis.
        angle: f64,
    },
}

/// Rotation by a rotation vector (rad), with the sine and cosine of this crate.
fn rotation(v: &Vec3) -> UnitQuaternion<f64> {
    exp_twist(&Twist::new(0.0, 0.0, 0.0, v.x, v.y, v.z)).rotation
}

impl Leg {
    /// A straight leg with the shorter of the two rotations.
    pub fn line(from: &Pose, to: &Pose) -> Self {
        let w = log_pose(&Pose::from_parts(Translation3::identity(), from.rotation.inverse() * to.rotation));
        Leg::Line { from: *from, to: *to, turn: Vec3::new(w[3], w[4], w[5]) }
    }

    /// An arc about an axis through `centre`; `None` if the direction has no length.
    pub fn arc(from: &Pose, centre: &Vec3, axis: &Vec3, angle: f64) -> Option<Self> {
        let n = axis.norm();
        (n > 1e-9 && n.is_finite()).then(|| Leg::Arc { from: *from, centre: *centre, axis: axis / n, angle })
    }

    /// The reference pose at `s` (0 to 1).
    pub fn pose(&self, s: f64) -> Pose {
        match self {
            Leg::Line { to, .. } if s >= 1.0 => *to,
            Leg::Line { from, to, turn } => {
                let p = from.translation.vector + (to.translation.vector - from.translation.vector) * s;
                Pose::from_parts(Translation3::from(p), from.rotation * rotation(&(turn * s)))
            }
            Leg::Arc { from, centre, axis, angle } => {
                let (sn, cs) = math::sin_cos(0.5 * angle * s);
                let r = UnitQuaternion::new_unchecked(Quaternion::new(cs, sn * axis.x, sn * axis.y, sn * axis.z));
                let p = centre + r * (from.translation.vector - centre);
                Pose::from_parts(Translation3::from(p), r * from.rotation)
            }
        }
    }

    /// Velocity of the reference for `ds/dt = 1`, as a screw in its gripper frame (m, rad per unit of s).
    pub fn screw(&self, s: f64) -> Twist {
        let inverse = self.pose(s).rotation.inverse();
        let (v, w) = match self {
            Leg::Line { from, to, turn } => (inverse * (to.translation.vector - from.translation.vector), *turn),
            Leg::Arc { centre, axis, angle, .. } => {
                let w = axis * *angle;
                (inverse * w.cross(&(self.pose(s).translation.vector - centre)), inverse * w)
            }
        };
        Twist::new(v.x, v.y, v.z, w.x, w.y, w.z)
    }

    /// Duration of the leg at full speed, seconds.
    pub fn seconds(&self, settings: &PathSettings) -> f64 {
        let xi = self.screw(0.0);
        let shift = xi.fixed_rows::<3>(0).norm() / settings.speed_m_per_s;
        let turn = xi.fixed_rows::<3>(3).norm() / settings.turn_rad_per_s;
        shift.max(turn)
    }
}

/// A reference that moves along a leg with bounded speed and acceleration, waits when the gripper lags, and ends at
/// rest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reference {
    leg: Leg,
    s: f64,
    /// ds/dt, 1/s.
    rate: f64,
    /// ds/dt at full speed, 1/s.
    full: f64,
}

impl Reference {
    /// A reference at rest at the start of `leg`.
    pub fn new(leg: Leg, settings: &PathSettings) -> Self {
        let seconds = leg.seconds(settings);
        // A leg of no length has already ended.
        let (s, full) = if seconds > 1e-6 { (0.0, 1.0 / seconds) } else { (1.0, 0.0) };
        Self { leg, s, rate: 0.0, full }
    }

    /// The leg.
    pub fn leg(&self) -> &Leg {
        &self.leg
    }

    /// Progress along the leg, 0 to 1.
    pub fn progress(&self) -> f64 {
        self.s
    }

    /// Whether the reference has reached the end.
    pub fn ended(&self) -> bool {
        self.s >= 1.0
    }

    /// The current reference pose, `left_from_gripper`.
    pub fn pose(&self) -> Pose {
        self.leg.pose(self.s)
    }

    /// The current velocity of the reference in its gripper frame, m/s and rad/s.
    pub fn screw(&self) -> Twist {
        self.leg.screw(self.s) * self.rate
    }

    /// Stops the reference immediately (the guard decelerates the arm).
    pub fn halt(&mut self) {
        self.rate = 0.0;
    }

    /// Advances by `dt_s` seconds at the fraction `scale` (0 to 1) of full speed; `lag_m` is the lag of the gripper
    /// (unit-scaled).
    pub fn advance(&mut self, dt_s: f64, scale: f64, lag_m: f64, settings: &PathSettings) {
        if self.ended() || !(dt_s > 0.0 && dt_s.is_finite()) {
            self.rate = 0.0;
            return;
        }
        let patience = (settings.wait_lag_m - lag_m) / (settings.wait_lag_m - settings.slow_lag_m);
        let patience = if patience.is_finite() { patience.clamp(0.0, 1.0) } else { 0.0 };
        let scale = if scale.is_finite() { scale.clamp(0.0, 1.0) } else { 0.0 };
        let acceleration = self.full / settings.rise_s;
        let left = 1.0 - self.s;
        // Braking curve v² = 2 a x, lowered by one step, so that the reference reaches the end at rest.
        let one = acceleration * dt_s;
        let braking = math::sqrt(2.0 * acceleration * left + one * one) - one;
        let target = (self.full * scale * patience).min(braking);
        // Deceleration is twice the acceleration, so that a waiting reference does not run ahead of the gripper.
        let step = acceleration * dt_s;
        self.rate = target.clamp(self.rate - 2.0 * step, self.rate + step).max(0.0);
        self.s += self.rate * dt_s;
        if self.s >= 1.0 - 1e-6 {
            self.s = 1.0;
            self.rate = 0.0;
        }
    }
}

/// Weight of the goal's pixel offset in the reference at `s`: 0 at the start, 1 at the end, with zero slope at both.
pub fn blend(s: f64) -> f64 {
    let s = s.clamp(0.0, 1.0);
    s * s * (3.0 - 2.0 * s)
}

/// Reference pixel of a mark: its projection at the reference pose plus the blended offset of the plan.
///
/// `from` and `to` are the differences between the plan's pixel and the projection of the plan's pose, at the start and
/// the end of the leg. At `s = 1`, with the reference at the goal pose, the result is the plan's pixel.
pub fn reference_pixel(projection: Pixel, from: Option<Pixel>, to: Option<Pixel>, s: f64) -> Pixel {
    let b = blend(s);
    projection + from.unwrap_or_default() * (1.0 - b) + to.unwrap_or_default() * b
}

#[cfg(test)]
mod tests {
    use super::*;

    fn poses() -> (Pose, Pose) {
        let a = Pose::translation(0.2, 0.1, 1.4) * exp_twist(&Twist::new(0.0, 0.0, 0.0, 2.0, 0.4, -0.3));
        let b = Pose::translation(-0.1, 0.0, 1.6) * exp_twist(&Twist::new(0.0, 0.0, 0.0, 2.4, -0.2, 0.5));
        (a, b)
    }

    #[test]
    fn legs_start_and_end_at_their_poses() {
        let (a, b) = poses();
        let line = Leg::line(&a, &b);
        assert!(log_pose(&(line.pose(0.0).inverse() * a)).norm() < 1e-12);
        assert!(log_pose(&(line.pose(1.0).inverse() * b)).norm() < 1e-12);
        assert!(log_pose(&(line.pose(1.0 - 1e-12).inverse() * b)).norm() < 1e-9, "continuous at the end");
        let arc = Leg::arc(&a, &Vec3::new(0.0, 0.0, 1.5), &Vec3::new(0.1, -0.3, -1.0), 0.8).unwrap();
        assert!(log_pose(&(arc.pose(0.0).inverse() * a)).norm() < 1e-12);
        let centre = Vec3::new(0.0, 0.0, 1.5);
        let radius = |p: &Pose| (p.translation.vector - centre).norm();
        assert!((radius(&arc.pose(0.0)) - radius(&arc.pose(0.7))).abs() < 1e-12);
        assert!((arc.pose(1.0).rotation.angle_to(&a.rotation) - 0.8).abs() < 1e-9);
        assert!(Leg::arc(&a, &centre, &Vec3::zeros(), 1.0).is_none());
    }

    #[test]
    fn screws_agree_with_finite_differences() {
        let (a, b) = poses();
        let arc = Leg::arc(&a, &Vec3::new(0.0, 0.05, 1.5), &Vec3::new(0.1, -0.3, -1.0), -1.2).unwrap();
        for leg in [Leg::line(&a, &b), arc] {
            for k in 1..10 {
                let s = f64::from(k) / 10.0;
                let h = 1e-6;
                let numeric = log_pose(&(leg.pose(s - h).inverse() * leg.pose(s + h))) / (2.0 * h);
                assert!((numeric - leg.screw(s)).norm() < 1e-7, "{s}");
            }
        }
    }

    #[test]
    fn the_reference_keeps_speed_and_acceleration_and_ends_at_rest() {
        let (a, b) = poses();
        let settings = PathSettings::default();
        let mut r = Reference::new(Leg::line(&a, &b), &settings);
        let dt = 0.002;
        let (mut last, mut steps) = (Twist::zeros(), 0);
        while !r.ended() {
            r.advance(dt, 1.0, 0.0, &settings);
            let xi = r.screw();
            assert!(xi.fixed_rows::<3>(0).norm() <= settings.speed_m_per_s * 1.0001);
            assert!(xi.fixed_rows::<3>(3).norm() <= settings.turn_rad_per_s * 1.0001);
            let bound = 2.1 * settings.speed_m_per_s.max(settings.turn_rad_per_s) / settings.rise_s * dt + 2e-3;
            assert!((xi - last).norm() < bound, "step {steps}: {}", (xi - last).norm());
            last = xi;
            steps += 1;
            assert!(steps < 5000, "never ends");
        }
        assert_eq!(r.screw(), Twist::zeros());
        assert_eq!(r.pose(), b);
    }

    #[test]
    fn the_reference_waits_for_a_lagging_gripper_and_at_zero_speed() {
        let (a, b) = poses();
        let settings = PathSettings::default();
        let mut r = Reference::new(Leg::line(&a, &b), &settings);
        for _ in 0..300 {
            r.advance(0.002, 1.0, 0.0, &settings);
        }
        for _ in 0..400 {
            r.advance(0.002, 1.0, settings.wait_lag_m, &settings);
        }
        let held = r.progress();
        assert_eq!(r.screw(), Twist::zeros());
        for _ in 0..400 {
            r.advance(0.002, 0.0, 0.0, &settings);
            r.advance(0.002, f64::NAN, 0.0, &settings);
            r.advance(f64::NAN, 1.0, 0.0, &settings);
        }
        assert_eq!(r.progress(), held);
    }

    #[test]
    fn at_the_end_the_reference_is_the_plans_pixel() {
        let (goal, projected) = (Pixel::new(10.0, 20.0), Pixel::new(11.5, 19.0));
        let offset = Some(goal - projected);
        assert!((reference_pixel(projected, None, offset, 1.0) - goal).norm() < 1e-12);
        assert_eq!(reference_pixel(projected, None, offset, 0.0), projected);
        assert!((reference_pixel(projected, offset, None, 0.0) - goal).norm() < 1e-12);
        assert_eq!(reference_pixel(projected, None, None, 1.0), projected);
    }

    #[test]
    fn a_leg_of_no_length_has_ended() {
        let (a, _) = poses();
        assert!(Reference::new(Leg::line(&a, &a), &PathSettings::default()).ended());
    }
}
