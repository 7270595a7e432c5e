//! What no command may exceed, checked once at start against what is compiled in.

use crate::arm::{JointRange, Model};

/// Absolute ceilings, compiled in: no configuration raises them.
pub mod ceiling {
    /// Joint speed, rad/s.
    pub const VELOCITY: f64 = 1.6;
    /// Joint acceleration, rad/s².
    pub const ACCELERATION: f64 = 15.0;
    /// Speed of the gripper's origin, m/s.
    pub const TCP_SPEED: f64 = 0.5;
}

/// The longest jerk filter, beats: bounds its memory, and how late it may make a stop.
pub const MAX_FILTER: usize = 32;

/// Limits of the motion. All are kept by slowing the whole motion, so that its direction stays.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LimitSettings {
    /// Joint speed, rad/s. Default 0.5.
    pub velocity_rad_per_s: f64,
    /// Joint acceleration, and the deceleration of every stop, rad/s². Default 4.
    pub acceleration_rad_per_s2: f64,
    /// Joint jerk, rad/s³; 0 leaves acceleration free to step. Default 800.
    pub jerk_rad_per_s3: f64,
    /// Speed of the gripper's origin, m/s. Default 0.25.
    pub tcp_speed_m_per_s: f64,
    /// Share of the speeds that is allowed while the controller is in reduced mode. Default 0.4.
    pub reduced_share: f64,
    /// Distance kept from each end of a joint's range, rad. Default 0.1.
    pub position_margin_rad: f64,
    /// How long the arm may run on at the old speed after a command changes, seconds. Default 0.03.
    pub reaction_s: f64,
    /// Lowest joint positions, rad; narrows the model's own range.
    pub position_min_rad: [f64; 6],
    /// Highest joint positions, rad; narrows the model's own range.
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

/// Why limits are refused: the key, its value, and what it may be at most (or at least).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LimitError {
    /// The setting's name.
    pub key: &'static str,
    /// What was asked for.
    pub value: f64,
    /// Lowest allowed value.
    pub lowest: f64,
    /// Highest allowed value.
    pub highest: f64,
}

/// Limits that have been checked; the guard takes no others.
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
    /// Checks settings for a model and a beat of `period_ns`.
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
            // A mean over n beats of a motion within A has a jerk within 2 A / (n T).
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
        Ok(Self {
            velocity,
            acceleration: settings.acceleration_rad_per_s2,
            tcp_speed: settings.tcp_speed_m_per_s,
            reduced_share: settings.reduced_share,
            min,
            max,
            reaction_s: settings.reaction_s,
            period_s,
            filter,
        })
    }

    /// Joint speed caps, rad/s.
    pub fn velocity(&self) -> [f64; 6] {
        self.velocity
    }

    /// Deceleration of every stop, rad/s².
    pub fn acceleration(&self) -> f64 {
        self.acceleration
    }

    /// Cap of the gripper's speed, m/s.
    pub fn tcp_speed(&self) -> f64 {
        self.tcp_speed
    }

    /// Lowest and highest joint positions that a motion may end at, rad (margin taken off).
    pub fn positions(&self) -> ([f64; 6], [f64; 6]) {
        (self.min, self.max)
    }

    /// Longest time a stop takes on the wire, nanoseconds: full speed at the stop deceleration, and the jerk filter's tail.
    pub fn ramp_ns(&self) -> u64 {
        let fastest = self.velocity.iter().fold(0.0_f64, |m, v| m.max(*v));
        ((fastest / self.acceleration + (self.filter as f64 + 1.0) * self.period_s) * 1e9) as u64
    }

    /// Distance the gripper can travel after a condition that takes `detect_s` to notice, metres: what the log prints for a configuration.
    pub fn stopping_distance(&self, detect_s: f64) -> f64 {
        self.tcp_speed * (detect_s + self.reaction_s + 0.5e-9 * self.ramp_ns() as f64)
    }
}

fn within(key: &'static str, value: f64, lowest: f64, highest: f64) -> Result<(), LimitError> {
    if value >= lowest && value <= highest { Ok(()) } else { Err(LimitError { key, value, lowest, highest }) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_hold_for_every_model_and_beat() {
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
}
