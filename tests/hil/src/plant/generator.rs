//! The motion generator: motion commands in, joint targets out, one control step at a time.

use super::compliance::Compliance;
use super::leg::{Leg, Shape};
use super::motion::{MAX_TARGET_ACCEL, Motion, REDUCED_SPEED_FRACTION, SAFETY_DECEL, StopCause};
use super::path::CartesianPath;
use super::profile::Profile;
use super::{Joints, Kinematics, vector_to_pose};
use nalgebra::{Isometry3, Vector3, Vector6};

/// The motion under way.
#[derive(Clone, Copy, Debug, PartialEq)]
#[expect(
    clippy::large_enum_variant,
    reason = "one value per arm, copied once a step; a box would allocate in the step"
)]
pub(super) enum Active {
    Rest,
    Follow(Motion),
    /// Decelerating to rest (rad/s^2 of the leading joint), then an optional move.
    Brake(f64, Option<Motion>),
    /// A move.
    Path(Leg),
    /// The end of a move and the beginning of the next one: their displacements from `corner`, the end of the first,
    /// add up.
    Blend {
        tail: Leg,
        lead: Leg,
        corner: Joints,
    },
}

/// Largest rate of change of the speed scaling, 1/s.
const SCALING_SLEW_PER_S: f64 = 5.0;

/// Generates the targets of six joints.
#[derive(Clone, Debug)]
pub struct Generator {
    pub(super) q: Joints,
    pub(super) qd: Joints,
    qdd: Joints,
    pub(super) active: Active,
    pub(super) scaling: f64,
    pub(super) max_speed: Joints,
    position_limit: Joints,
    pub(super) reduced: bool,
    pub(super) kinematics: Kinematics,
    pub(super) tool: Isometry3<f64>,
    pub(super) compliance: Compliance,
    /// Tool pose at the end of the present or the last move, base frame.
    waypoint: Option<Isometry3<f64>>,
    /// Blend radius of the move that is planned next, m.
    next_blend_m: f64,
}

impl Generator {
    /// At rest at `q`.
    pub fn new(q: Joints, kinematics: Kinematics, max_speed: Joints, position_limit: Joints) -> Self {
        Generator {
            q,
            qd: [0.0; 6],
            qdd: [0.0; 6],
            active: Active::Rest,
            scaling: 1.0,
            max_speed,
            position_limit,
            reduced: false,
            kinematics,
            tool: Isometry3::identity(),
            compliance: Compliance::default(),
            waypoint: None,
            next_blend_m: 0.0,
        }
    }

    /// Target positions, rad.
    pub fn q(&self) -> &Joints {
        &self.q
    }

    /// Target speeds, rad/s.
    pub fn qd(&self) -> &Joints {
        &self.qd
    }

    /// Target accelerations of the last step, rad/s^2.
    pub fn qdd(&self) -> &Joints {
        &self.qdd
    }

    /// Present speed scaling, 0 to 1.
    pub fn scaling(&self) -> f64 {
        self.scaling
    }

    /// Sets `flange_from_tcp` of tool motions.
    pub fn set_tool(&mut self, flange_from_tcp: Isometry3<f64>) {
        self.tool = flange_from_tcp;
    }

    /// Sets or ends reduced mode: half the joint speed limits; set-points beyond them are scaled down.
    pub fn set_reduced(&mut self, reduced: bool) {
        self.reduced = reduced;
    }

    /// Starts a motion, replacing the present one. A move begins once the arm is at rest.
    pub fn start(&mut self, motion: Motion) {
        self.start_blended(motion, 0.0);
    }

    /// Starts a motion. Within `blend_m` of its end a move counts as settled, and the next move begins without a stop.
    pub fn start_blended(&mut self, motion: Motion, blend_m: f64) {
        if let Some(waypoint) = self.target(&motion) {
            self.waypoint = Some(waypoint);
            if let Some(blend) = self.blend(motion, blend_m) {
                self.active = blend;
                return;
            }
        }
        self.next_blend_m = blend_m;
        self.active = match motion {
            Motion::SpeedJ { .. } | Motion::SpeedL { .. } | Motion::Servo { .. } | Motion::StopL { .. } => {
                Active::Follow(motion)
            }
            Motion::StopJ { decel } => Active::Brake(decel, None),
            Motion::MoveJ { accel, .. } => Active::Brake(accel, Some(motion)),
            Motion::MoveL { .. } | Motion::MoveC { .. } => Active::Brake(4.0, Some(motion)),
        };
    }

    /// Tool pose at the end of a move.
    fn target(&self, motion: &Motion) -> Option<Isometry3<f64>> {
        match motion {
            Motion::MoveJ { q, .. } => Some(self.kinematics.forward(q) * self.tool),
            Motion::MoveL { pose, .. } | Motion::MoveC { pose, .. } => Some(vector_to_pose(pose)),
            _ => None,
        }
    }

    /// The blend of the present move with the next one, if the present move has a blend radius and has not ended.
    fn blend(&self, next: Motion, blend_m: f64) -> Option<Active> {
        let Active::Path(tail) = self.active else { return None };
        if tail.blend_m <= 0.0 || tail.profile.is_done() {
            return None;
        }
        let corner = tail.last(&self.kinematics, &self.tool)?;
        let lead = self.leg(next, corner, blend_m)?;
        Some(Active::Blend { tail, lead, corner })
    }

    /// Tool pose at the end of the present or the last move; the present one before the first move.
    pub fn waypoint(&self) -> Isometry3<f64> {
        self.waypoint.unwrap_or_else(|| self.tool_pose())
    }

    /// Stops the joints with the deceleration of the safety system.
    pub fn safety_stop(&mut self) {
        self.active = Active::Brake(SAFETY_DECEL, None);
        self.compliance.cancel();
    }

    /// Sets the targets to joint positions, at rest: after power on or brake release.
    pub fn snap(&mut self, q: Joints) {
        (self.q, self.qd, self.qdd, self.active) = (q, [0.0; 6], [0.0; 6], Active::Rest);
        self.compliance.cancel();
    }

    /// Stops a move before its end; speed and servo motions continue.
    pub fn abandon_move(&mut self) {
        if matches!(self.active, Active::Path(_) | Active::Blend { .. } | Active::Brake(_, Some(_))) {
            self.active = Active::Brake(4.0, None);
        }
    }

    /// Whether the motion has reached its goal: the end of the path, rest, or the commanded speed.
    pub fn is_settled(&self) -> bool {
        match &self.active {
            Active::Rest => true,
            Active::Brake(..) => false,
            Active::Path(leg) => {
                leg.profile.is_done() || self.tool_pose().translation.vector.metric_distance(&leg.end) < leg.blend_m
            }
            Active::Blend { .. } => false,
            Active::Follow(Motion::SpeedJ { qd, .. }) => {
                (0..6).all(|i| (self.qd[i] - qd[i] * self.scaling).abs() < 1e-9)
            }
            Active::Follow(Motion::SpeedL { twist, .. }) => {
                let now = self.tool_velocity();
                (0..6).all(|i| (now[i] - twist[i] * self.scaling).abs() < 1e-4)
            }
            Active::Follow(Motion::StopL { .. }) => self.at_rest(),
            Active::Follow(Motion::Servo { q, .. }) => {
                self.at_rest() && (0..6).all(|i| (self.q[i] - q[i]).abs() < 1e-4)
            }
            Active::Follow(_) => true,
        }
    }

    /// Whether all target speeds are zero.
    pub fn at_rest(&self) -> bool {
        self.qd.iter().all(|v| v.abs() < 1e-6)
    }

    /// Completed fraction of the move, 0 to 1; 1 if no move is under way.
    pub fn progress(&self) -> f64 {
        match &self.active {
            Active::Path(leg) | Active::Blend { lead: leg, .. } => leg.profile.fraction(),
            Active::Brake(_, Some(_)) => 0.0,
            _ => 1.0,
        }
    }

    /// Tool velocity of the targets: linear then angular, base frame.
    pub fn tool_velocity(&self) -> [f64; 6] {
        (self.kinematics.jacobian(&self.q, &self.tool) * Vector6::from_column_slice(&self.qd)).into()
    }

    /// Advances by one control step. `requested_scaling` (0 to 1) slows every motion except stops. Computes at most one
    /// inverse kinematics solution.
    pub fn step(&mut self, dt: f64, requested_scaling: f64) -> Result<(), StopCause> {
        let slew = SCALING_SLEW_PER_S * dt;
        self.scaling += (requested_scaling.clamp(0.0, 1.0) - self.scaling).clamp(-slew, slew);
        let (q, qd) = (self.q, self.qd);
        self.remove_compliance();
        let result = self.advance(dt);
        let on_path = matches!(self.active, Active::Path(_) | Active::Blend { .. });
        self.add_compliance(on_path, dt);
        if result.is_err() {
            (self.q, self.qd) = (q, qd);
            self.safety_stop();
            self.brake(SAFETY_DECEL, dt);
        }
        let result = result.and_then(|()| self.check(dt));
        if matches!(result, Err(StopCause::JointSpeed { .. })) {
            // A target beyond the limit must not reach the drives: the stop begins from the previous target.
            (self.q, self.qd) = (q, qd);
            self.compliance.cancel();
            self.brake(SAFETY_DECEL, dt);
        }
        self.qdd = std::array::from_fn(|i| (self.qd[i] - qd[i]) / dt);
        result
    }

    fn advance(&mut self, dt: f64) -> Result<(), StopCause> {
        match self.active {
            Active::Rest => self.qd = [0.0; 6],
            Active::Brake(decel, next) => {
                if self.brake(decel, dt) {
                    self.active = match next {
                        Some(motion) => self.plan(motion),
                        None => Active::Rest,
                    };
                }
            }
            Active::Follow(motion) => self.follow(motion, dt)?,
            Active::Path(mut leg) => {
                let q = leg
                    .advance(dt * self.path_scaling(), &self.kinematics, &self.tool)
                    .ok_or(StopCause::Unreachable)?;
                self.qd = std::array::from_fn(|i| (q[i] - self.q[i]) / dt);
                self.q = q;
                self.active = if leg.profile.is_done() { Active::Rest } else { Active::Path(leg) };
            }
            Active::Blend { mut tail, mut lead, corner } => {
                let path_dt = dt * self.path_scaling();
                let advance = |leg: &mut Leg| leg.advance(path_dt, &self.kinematics, &self.tool);
                let (a, b) = advance(&mut tail).zip(advance(&mut lead)).ok_or(StopCause::Unreachable)?;
                let q: Joints = std::array::from_fn(|i| a[i] + b[i] - corner[i]);
                self.qd = std::array::from_fn(|i| (q[i] - self.q[i]) / dt);
                self.q = q;
                self.active = match (tail.profile.is_done(), lead.profile.is_done()) {
                    (true, true) => Active::Rest,
                    (true, false) => Active::Path(lead),
                    _ => Active::Blend { tail, lead, corner },
                };
            }
        }
        Ok(())
    }

    fn path_scaling(&self) -> f64 {
        self.scaling * if self.reduced { REDUCED_SPEED_FRACTION } else { 1.0 }
    }

    /// Plans a move from the present position, where the arm is at rest.
    fn plan(&self, motion: Motion) -> Active {
        self.leg(motion, self.q, self.next_blend_m).map_or(Active::Rest, Active::Path)
    }

    /// Plans a move that begins at `start`; `None` for other motions.
    fn leg(&self, motion: Motion, start: Joints, blend_m: f64) -> Option<Leg> {
        let from = self.kinematics.forward(&start) * self.tool;
        let (shape, profile) = match motion {
            Motion::MoveJ { q, accel, speed, duration } => {
                let far = (0..6).map(|i| (q[i] - start[i]).abs()).fold(0.0, f64::max);
                // Joints have different speed limits: the move is slowed down until no joint exceeds its own.
                let allowed = (0..6)
                    .map(|i| self.max_speed[i] * far / (q[i] - start[i]).abs().max(1e-12))
                    .fold(speed.abs(), f64::min);
                let accel = accel.abs().min(MAX_TARGET_ACCEL);
                (Shape::Joint { from: start, to: q }, Profile::new(far, allowed, accel, duration))
            }
            Motion::MoveL { pose, accel, speed, duration } => {
                let path = CartesianPath::Line { from, to: vector_to_pose(&pose) };
                (Shape::Tool(path), Profile::new(path.length(), speed, accel, duration))
            }
            Motion::MoveC { via, pose, accel, speed } => {
                let via = Vector3::new(via[0], via[1], via[2]);
                let path = CartesianPath::arc(from, via, vector_to_pose(&pose));
                (Shape::Tool(path), Profile::new(path.length(), speed, accel, 0.0))
            }
            _ => return None,
        };
        let end = self.target(&motion)?.translation.vector;
        // A blend radius above half the length would begin the next move before this one has got under way.
        let blend_m = blend_m.max(0.0).min(0.5 * end.metric_distance(&from.translation.vector));
        Some(Leg { shape, profile, q: start, end, blend_m })
    }

    /// Tool pose of the targets.
    pub fn tool_pose(&self) -> Isometry3<f64> {
        self.kinematics.forward(&self.q) * self.tool
    }

    /// Checks speed limits, and position limits with the braking distance.
    fn check(&mut self, dt: f64) -> Result<(), StopCause> {
        for i in 0..6 {
            let (q, qd, limit) = (self.q[i], self.qd[i], self.max_speed[i]);
            let braking = qd * qd / (2.0 * SAFETY_DECEL) + 2.0 * qd.abs() * dt + 1e-3;
            let cause = if qd.abs() > limit * 1.0001 {
                StopCause::JointSpeed { joint: i, speed: qd, limit }
            } else if q * qd > 0.0 && q.abs() + braking > self.position_limit[i] && qd.abs() > 1e-6 {
                StopCause::JointPosition { joint: i, position: q }
            } else {
                continue;
            };
            if matches!(self.active, Active::Brake(_, None)) {
                continue; // the arm is stopping already
            }
            self.safety_stop();
            return Err(cause);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::super::Model;
    use super::*;

    const START: Joints = [0.3, -1.2, 1.4, -0.9, 1.1, 0.5];

    fn generator() -> Generator {
        let m = Model::by_name("ur5e").unwrap();
        Generator::new(START, m.nominal(), m.max_speed, m.position_limit())
    }

    fn run(g: &mut Generator, seconds: f64) -> Result<(), StopCause> {
        for _ in 0..(seconds / 0.002) as usize {
            g.step(0.002, 1.0)?;
        }
        Ok(())
    }

    #[test]
    fn speedj_continues_until_the_next_motion() {
        let mut g = generator();
        g.start(Motion::SpeedJ { qd: [0.2, 0.0, -0.1, 0.0, 0.0, 0.0], accel: 2.0 });
        run(&mut g, 2.0).unwrap();
        assert!((g.qd()[0] - 0.2).abs() < 1e-12 && (g.qd()[2] + 0.1).abs() < 1e-12);
        assert!((g.q()[0] - START[0] - 0.2 * 1.95).abs() < 1e-3);
        g.start(Motion::StopJ { decel: 4.0 });
        run(&mut g, 0.052).unwrap();
        assert!(g.at_rest() && g.is_settled());
    }

    #[test]
    fn movej_and_movel_reach_their_targets() {
        let mut g = generator();
        let to = [0.5, -1.0, 1.2, -1.0, 1.3, 0.0];
        g.start(Motion::MoveJ { q: to, accel: 1.4, speed: 1.05, duration: 0.0 });
        run(&mut g, 2.0).unwrap();
        assert!(g.is_settled() && (0..6).all(|i| (g.q()[i] - to[i]).abs() < 1e-12));
        g.set_tool(Isometry3::translation(0.0, 0.0, 0.1));
        let mut goal = super::super::pose_to_vector(&g.tool_pose());
        goal[2] -= 0.1;
        g.start(Motion::MoveL { pose: goal, accel: 1.2, speed: 0.25, duration: 0.0 });
        run(&mut g, 2.0).unwrap();
        let there = super::super::pose_to_vector(&g.tool_pose());
        assert!(g.is_settled() && (0..6).all(|i| (there[i] - goal[i]).abs() < 1e-7), "{there:?} {goal:?}");
    }

    #[test]
    fn servoj_lags_by_about_its_lookahead() {
        let mut g = generator();
        let mut goal = START;
        for _ in 0..1000 {
            goal[0] += 0.3 * 0.002;
            g.start(Motion::Servo { q: goal, lookahead: 0.1, gain: 300.0 });
            g.step(0.002, 1.0).unwrap();
        }
        let lag = (goal[0] - g.q()[0]) / 0.3;
        assert!((lag - 0.1).abs() < 0.01, "{lag}");
    }

    #[test]
    fn speedl_moves_the_tool_straight() {
        let mut g = generator();
        let from = g.tool_pose().translation.vector;
        g.start(Motion::SpeedL { twist: [0.0, 0.0, -0.1, 0.0, 0.0, 0.0], accel: 0.5, rot_accel: 1.0 });
        run(&mut g, 1.0).unwrap();
        let moved = g.tool_pose().translation.vector - from;
        assert!(moved.x.abs() < 2e-4 && moved.y.abs() < 2e-4 && (moved.z + 0.09).abs() < 2e-3, "{moved}");
        g.start(Motion::StopL { decel: 0.5, rot_decel: 1.0 });
        run(&mut g, 0.3).unwrap();
        assert!(g.at_rest());
    }

    #[test]
    fn stops_before_position_and_speed_limits() {
        let mut g = generator();
        g.start(Motion::SpeedJ { qd: [2.0, 0.0, 0.0, 0.0, 0.0, 0.0], accel: 10.0 });
        assert!(matches!(run(&mut g, 4.0), Err(StopCause::JointPosition { joint: 0, .. })));
        run(&mut g, 1.0).unwrap();
        assert!(g.at_rest() && g.q()[0] < std::f64::consts::TAU);
        let mut g = generator();
        g.start(Motion::SpeedJ { qd: [4.0, 0.0, 0.0, 0.0, 0.0, 0.0], accel: 40.0 });
        assert!(matches!(run(&mut g, 1.0), Err(StopCause::JointSpeed { joint: 0, .. })));
    }

    #[test]
    fn the_slider_scales_and_reduced_mode_limits_the_speed() {
        let mut g = generator();
        g.start(Motion::SpeedJ { qd: [1.0; 6], accel: 10.0 });
        for _ in 0..500 {
            g.step(0.002, 0.25).unwrap();
        }
        assert!((g.qd()[3] - 0.25).abs() < 1e-9);
        let mut g = generator();
        g.set_reduced(true);
        g.start(Motion::SpeedJ { qd: [3.0, 1.5, 0.0, 0.0, 0.0, 0.0], accel: 10.0 });
        run(&mut g, 0.5).unwrap();
        let half = Model::by_name("ur5e").unwrap().max_speed[0] / 2.0;
        assert!((g.qd()[0] - half).abs() < 1e-9 && (g.qd()[1] - half / 2.0).abs() < 1e-9);
    }
}
