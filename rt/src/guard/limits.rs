//! Limits of every command, checked once at start against compiled ceilings.

use crate::arm::{JointRange, Model};

/// Absolute ceilings. No configuration raises them.
pub mod ceiling {
    /// Joint speed, rad/s.
    pub const VELOCITY: f64 = 1.6;
    /// Joint acceleration, rad/s².
    pub const ACCELERATION: f64 = 15.0;
    /// Speed of the gripper's origin, m/s.
    pub const TCP_SPEED: f64 = 0.5;
}

/// Longest stop from full speed, in time and distance, that the limits of a configuration may give.
pub mod stop_bound {
    /// Time until the rates sent are zero, seconds: twice what the default limits need, and well within the second that
    /// a signal allows.
    pub const TIME_S: f64 = 0.3;
    /// Travel of the fastest joint, rad (8.6 degrees): five times that of the default limits.
    pub const JOINT_RAD: f64 = 0.15;
    /// Travel of the gripper's origin, m: three times that of the default limits, and less than the shortest default
    /// standoff (80 mm), so that a stop that begins at the pre-grasp ends before the part.
    pub const TCP_M: f64 = 0.05;
}

/// Duration and travel of a stop from full speed, from the first set-point of its ramp.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StopFigures {
    /// Until the rates sent are zero, seconds.
    pub time_s: f64,
    /// Travel of the fastest joint, rad.
    pub joint_rad: f64,
    /// Travel of the gripper's origin, m, with both caps reached at the same time: the longest possible.
    pub tcp_m: f64,
}

/// Longest jerk filter, cycles: bounds its memory and the delay that it adds to a stop.
pub const MAX_FILTER: usize = 32;

/// Limits of the motion. All are kept by slowing all joints together, so that the direction of the motion is preserved.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LimitSettings {
    /// Joint speed, rad/s. Default 0.5.
    pub velocity_rad_per_s: f64,
    /// Joint acceleration, and the deceleration of every stop, rad/s². Default 4.
    pub acceleration_rad_per_s2: f64,
    /// Joint jerk, rad/s³; 0 allows steps of the acceleration. Default 800.
    pub jerk_rad_per_s3: f64,
    /// Speed of the gripper's origin, m/s. Default 0.25.
    pub tcp_speed_m_per_s: f64,
    /// Fraction of the speed caps while the controller is in reduced mode. Default 0.4.
    pub reduced_share: f64,
    /// Margin at each end of a joint's range, rad. Default 0.1.
    pub position_margin_rad: f64,
    /// Time for which the arm may continue at the old speed after a command changes, seconds. Default 0.03.
    pub reaction_s: f64,
    /// Lowest joint positions, rad; narrows the range of the model.
    pub position_min_rad: [f64; 6],
    /// Highest joint positions, rad; narrows the range of the model.
    pub position_max_rad: [f64; 6],
}

impl Default for LimitSettings {
    fn default() -> Self {
        Self {
            velocity_rad_per_s: 0.5,
            acceleration_rad_per_s2: 4.0,
            jerk_rad_per_s3: 800.0,
            tcp_speed_m_per_s: 0.25,
            reduced_share: 0.4,
            position_margin_rad: 0.1,
            reaction_s: 0.03,
            position_min_rad: [-core::f64::consts::TAU; 6],
            position_max_rad: [core::f64::consts::TAU; 6],
        }
    }
}

/// Why limits are refused: the key, its value, and the allowed range.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LimitError {
    /// The setting's name.
    pub key: &'static str,
    /// The configured value.
    pub value: f64,
    /// Lowest allowed value.
    pub lowest: f64,
    /// Highest allowed value.
    pub highest: f64,
}

/// Checked limits; the guard takes no others.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    pub(crate) velocity: [f64; 6],
    pub(crate) acceleration: f64,
    pub(crate) tcp_speed: f64,
    pub(crate) reduced_share: f64,
    pub(crate) min: [f64; 6],
    pub(crate) max: [f64; 6],
    pub(crate) reaction_s: f64,
    pub(crate) period_s: f64,
    pub(crate) filter: usize,
}

impl Limits {
    /// Checks settings for a model and a cycle of `period_ns`.
    ///
    /// # Errors
    /// [`LimitError`] names the key, its value and its range.
    pub fn new(settings: &LimitSettings, model: Model, period_ns: u64) -> Result<Self, LimitError> {
        let period_s = period_ns as f64 * 1e-9;
        within("period_s", period_s, 0.001, 0.02)?;
        within("velocity_rad_per_s", settings.velocity_rad_per_s, 1e-3, ceiling::VELOCITY)?;
        within("acceleration_rad_per_s2", settings.acceleration_rad_per_s2, 0.1, ceiling::ACCELERATION)?;
        within("tcp_speed_m_per_s", settings.tcp_speed_m_per_s, 1e-3, ceiling::TCP_SPEED)?;
        within("reduced_share", settings.reduced_share, 0.0, 1.0)?;
        within("position_margin_rad", settings.position_margin_rad, 0.0, 1.0)?;
        within("reaction_s", settings.reaction_s, 0.0, 0.2)?;
        let filter = if settings.jerk_rad_per_s3 == 0.0 {
            1
        } else {
            // A mean over n cycles of a motion within A has a jerk within 2 A / (n T).
            let least = 2.0 * settings.acceleration_rad_per_s2 / (MAX_FILTER as f64 * period_s);
            within("jerk_rad_per_s3", settings.jerk_rad_per_s3, least, 1e6)?;
            let n = 2.0 * settings.acceleration_rad_per_s2 / (settings.jerk_rad_per_s3 * period_s);
            (crate::math::ceil(n - 1e-9) as usize).clamp(1, MAX_FILTER)
        };
        let ranges = model.joints();
        let (mut min, mut max, mut velocity) = ([0.0; 6], [0.0; 6], [0.0; 6]);
        for (i, JointRange { min: low, max: high, speed }) in ranges.into_iter().enumerate() {
            let (a, b) = (settings.position_min_rad[i], settings.position_max_rad[i]);
            if a.is_nan() || b.is_nan() {
                return Err(LimitError { key: "position_min_rad", value: a, lowest: low, highest: high });
            }
            min[i] = low.max(a) + settings.position_margin_rad;
            max[i] = high.min(b) - settings.position_margin_rad;
            if !(min[i] < max[i]) {
                return Err(LimitError { key: "position_max_rad", value: b, lowest: min[i], highest: high });
            }
            velocity[i] = settings.velocity_rad_per_s.min(speed).min(ceiling::VELOCITY);
        }
        let limits = Self {
            velocity,
            acceleration: settings.acceleration_rad_per_s2,
            tcp_speed: settings.tcp_speed_m_per_s,
            reduced_share: settings.reduced_share,
            min,
            max,
            reaction_s: settings.reaction_s,
            period_s,
            filter,
        };
        let stop = limits.stop_figures();
        within("stop.time_s", stop.time_s, 0.0, stop_bound::TIME_S)?;
        within("stop.joint_rad", stop.joint_rad, 0.0, stop_bound::JOINT_RAD)?;
        within("stop.tcp_m", stop.tcp_m, 0.0, stop_bound::TCP_M)?;
        Ok(limits)
    }

    /// The guard's stop from full speed, exact to the cycle: the rates shrink by A T per cycle for N cycles. The mean
    /// over the last n cycles starts filled with the old rates, follows (n - 1) / 2 cycles later and ends n - 1 cycles
    /// later.
    pub fn stop_figures(&self) -> StopFigures {
        let fastest = self.velocity.iter().fold(0.0_f64, |m, v| m.max(*v));
        let (step, lag) = (self.acceleration * self.period_s, self.filter as f64 - 1.0);
        // Cycles of the ramp; the last one is rest.
        let n = crate::math::ceil(fastest / step - 1e-9).max(1.0);
        let ramp = (n - 1.0) * fastest - step * (n - 1.0) * n * 0.5;
        let joint_rad = self.period_s * (ramp + fastest * lag * 0.5);
        StopFigures { time_s: self.period_s * (n + lag), joint_rad, tcp_m: self.tcp_speed * joint_rad / fastest }
    }

    /// Joint speed caps, rad/s.
    pub fn velocity(&self) -> [f64; 6] {
        self.velocity
    }

    /// Deceleration of every stop, rad/s².
    pub fn acceleration(&self) -> f64 {
        self.acceleration
    }

    /// Speed cap of the gripper, m/s.
    pub fn tcp_speed(&self) -> f64 {
        self.tcp_speed
    }

    /// Lowest and highest joint positions at which a motion may end, rad (without the margin).
    pub fn positions(&self) -> ([f64; 6], [f64; 6]) {
        (self.min, self.max)
    }

    /// Longest duration of a stop on the wire, nanoseconds, including one late cycle.
    pub fn ramp_ns(&self) -> u64 {
        ((self.stop_figures().time_s + self.period_s) * 1e9) as u64
    }

    /// Time for which the arm may continue at the old speed after a command changes, seconds.
    pub fn reaction_s(&self) -> f64 {
        self.reaction_s
    }
}

fn within(key: &'static str, value: f64, lowest: f64, highest: f64) -> Result<(), LimitError> {
    if value >= lowest && value <= highest { Ok(()) } else { Err(LimitError { key, value, lowest, highest }) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_are_valid_for_every_model_and_period() {
        for model in Model::ALL {
            for period in [1_000_000, 2_000_000, 8_000_000, 20_000_000] {
                let l = Limits::new(&LimitSettings::default(), model, period).unwrap();
                assert!(l.ramp_ns() >= 125_000_000 && l.ramp_ns() < 200_000_000, "{}", l.ramp_ns());
            }
        }
    }

    #[test]
    fn nothing_raises_the_ceilings() {
        let d = LimitSettings::default();
        let refused = |s: LimitSettings| Limits::new(&s, Model::Ur5e, 2_000_000).unwrap_err().key;
        assert_eq!(refused(LimitSettings { velocity_rad_per_s: 3.0, ..d }), "velocity_rad_per_s");
        assert_eq!(refused(LimitSettings { velocity_rad_per_s: f64::NAN, ..d }), "velocity_rad_per_s");
        assert_eq!(refused(LimitSettings { acceleration_rad_per_s2: 16.0, ..d }), "acceleration_rad_per_s2");
        assert_eq!(refused(LimitSettings { tcp_speed_m_per_s: 0.51, ..d }), "tcp_speed_m_per_s");
        assert_eq!(refused(LimitSettings { jerk_rad_per_s3: 10.0, ..d }), "jerk_rad_per_s3");
        assert_eq!(refused(LimitSettings { jerk_rad_per_s3: -1.0, ..d }), "jerk_rad_per_s3");
        let mut s = d;
        s.position_max_rad[2] = -7.0;
        assert_eq!(refused(s), "position_max_rad");
        assert_eq!(Limits::new(&d, Model::Ur5e, 1).unwrap_err().key, "period_s");
    }

    /// The formula agrees with the guard, from full speed of one joint and of all, at every period.
    #[test]
    fn stop_figures_agree_with_the_guard_to_the_cycle() {
        use crate::guard::Guard;
        let d = LimitSettings::default();
        let jerk = |jerk_rad_per_s3| LimitSettings { jerk_rad_per_s3, ..d };
        let wide = LimitSettings { position_margin_rad: 0.0, ..d };
        let sharp = LimitSettings { velocity_rad_per_s: 1.3, acceleration_rad_per_s2: 9.7, ..d };
        let odd = LimitSettings { velocity_rad_per_s: 0.333, acceleration_rad_per_s2: 2.9, ..d };
        for settings in [d, jerk(0.0), jerk(150.0), jerk(2000.0), wide, sharp, odd] {
            for period_ns in [1_000_000_u64, 2_000_000, 8_000_000] {
                let Ok(limits) = Limits::new(&settings, Model::Ur10e, period_ns) else { continue };
                let (mut guard, dt) = (Guard::new(limits), limits.period_s);
                let fastest = limits.velocity[0];
                let wanted = [fastest, -fastest, 0.5 * fastest, 0.0, 0.0, fastest];
                // A zero Jacobian: the gripper's speed cap does not slow the joints.
                let still = nalgebra::Matrix6::zeros();
                for _ in 0..2000 {
                    guard.step(&wanted, &[0.0; 6], &still, 1.0, dt);
                }
                assert!((guard.last()[0] - fastest).abs() < 1e-9, "{settings:?}: not at full speed");
                let (mut cycles, mut way) = (0, 0.0);
                while !guard.at_rest() {
                    let sent = guard.stop(dt).rates;
                    (cycles, way) = (cycles + 1, way + sent[0] * dt);
                }
                let f = limits.stop_figures();
                assert!((f.time_s - f64::from(cycles) * dt).abs() < 1e-9, "{settings:?} {period_ns}: {cycles} {f:?}");
                assert!((f.joint_rad - way).abs() < 1e-9, "{settings:?} {period_ns}: {way} {f:?}");
                assert!((f.tcp_m - limits.tcp_speed * way / fastest).abs() < 1e-9);
            }
        }
    }

    /// Both sides of each bound.
    #[test]
    fn limits_with_a_long_or_wide_stop_are_refused() {
        let d = LimitSettings::default();
        let made = |s: LimitSettings| Limits::new(&s, Model::Ur5e, 2_000_000);
        let refused = |s: LimitSettings| made(s).unwrap_err().key;
        let slow = |acceleration_rad_per_s2| LimitSettings { acceleration_rad_per_s2, ..d };
        assert_eq!(refused(slow(0.1)), "stop.time_s");
        assert_eq!(refused(slow(1.6)), "stop.time_s");
        assert!(made(slow(1.75)).is_ok());
        let fast = |velocity_rad_per_s| LimitSettings { velocity_rad_per_s, ..d };
        assert_eq!(refused(fast(1.15)), "stop.joint_rad");
        assert!(made(fast(1.0)).is_ok());
        let far = |tcp_speed_m_per_s| LimitSettings { tcp_speed_m_per_s, velocity_rad_per_s: 1.0, ..d };
        assert_eq!(refused(far(0.45)), "stop.tcp_m");
        assert!(made(far(0.35)).is_ok());
        // A long filter counts as well.
        assert_eq!(
            Limits::new(&LimitSettings { jerk_rad_per_s3: 32.0, ..d }, Model::Ur5e, 8_000_000).unwrap_err().key,
            "stop.time_s"
        );
    }
}
