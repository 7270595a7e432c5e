//! The mechanical part: six joints that follow their targets with lag, limited acceleration and quantised encoders.

use super::Joints;

/// A disturbance of the joints.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct DriveFault {
    /// Additional time constant of the velocity loop, s.
    pub lag_s: f64,
    /// Joint speeds added to those of the velocity loop, rad/s: the arm drifts without a command.
    pub drift: Joints,
    /// Joints that do not move.
    pub stuck: [bool; 6],
}

/// Positions and speeds of six joints.
#[derive(Clone, Debug, PartialEq)]
pub struct Drives {
    q: Joints,
    qd: Joints,
    /// Accelerations of the last step, rad/s^2.
    qdd: Joints,
    max_accel: f64,
    /// Largest joint speeds of the motors, rad/s.
    max_speed: Joints,
    fault: DriveFault,
    braked: bool,
    /// Displacement by drift that the position loop does not see, rad.
    drifted: Joints,
}

/// Time constant of the velocity loop, s.
const VELOCITY_LAG_S: f64 = 0.002;
/// Position loop gain, 1/s: a quarter of the velocity loop's corner frequency, which gives critical damping.
const POSITION_GAIN: f64 = 125.0;
/// Largest fraction of a position error corrected in one step; keeps the loop stable at low control rates.
const MAX_STEP_FRACTION: f64 = 0.5;
/// Encoder counts per radian: 2^20 per turn of the joint.
const COUNTS_PER_RAD: f64 = 1_048_576.0 / std::f64::consts::TAU;

impl Drives {
    /// At rest at `q`.
    pub fn new(q: Joints, max_accel: f64) -> Self {
        Drives {
            q,
            qd: [0.0; 6],
            qdd: [0.0; 6],
            max_accel,
            max_speed: [f64::INFINITY; 6],
            fault: DriveFault::default(),
            braked: false,
            drifted: [0.0; 6],
        }
    }

    /// Limits the joint speeds of the motors, rad/s.
    #[must_use]
    pub fn limited(mut self, max_speed: Joints) -> Self {
        self.max_speed = max_speed;
        self
    }

    /// Sets the disturbance of the joints; the default removes it.
    pub fn set_fault(&mut self, fault: DriveFault) {
        for i in 0..6 {
            if fault.drift[i] == 0.0 {
                self.drifted[i] = 0.0;
            }
        }
        self.fault = fault;
    }

    /// The present disturbance.
    pub fn fault(&self) -> &DriveFault {
        &self.fault
    }

    /// Applies or releases the brakes. They hold a joint in place and stop a moving joint at the acceleration limit.
    pub fn set_brakes(&mut self, on: bool) {
        self.braked = on;
    }

    /// Advances by one control step towards the targets.
    pub fn step(&mut self, target_q: &Joints, target_qd: &Joints, dt: f64) {
        let blend = 1.0 - (-dt / (VELOCITY_LAG_S + self.fault.lag_s)).exp();
        let most = self.max_accel * dt;
        let gain = (POSITION_GAIN / (1.0 + self.fault.lag_s / VELOCITY_LAG_S)).min(MAX_STEP_FRACTION / dt);
        for i in 0..6 {
            let demanded =
                if self.braked { 0.0 } else { target_qd[i] + gain * (target_q[i] - self.q[i] + self.drifted[i]) };
            let before = self.qd[i];
            let change = if self.braked { -before } else { blend * (demanded - before) };
            self.qd[i] = (before + change.clamp(-most, most)).clamp(-self.max_speed[i], self.max_speed[i]);
            if self.fault.stuck[i] {
                self.qd[i] = 0.0;
            }
            self.qdd[i] = (self.qd[i] - before) / dt;
            self.q[i] += (self.qd[i] + self.fault.drift[i]) * dt;
            self.drifted[i] += self.fault.drift[i] * dt;
        }
    }

    /// Joint positions read by the encoders, rad.
    pub fn read_q(&self) -> Joints {
        self.q.map(|q| (q * COUNTS_PER_RAD).round() / COUNTS_PER_RAD)
    }

    /// Joint speeds, rad/s.
    pub fn read_qd(&self) -> Joints {
        std::array::from_fn(|i| self.qd[i] + self.fault.drift[i])
    }

    /// Joint accelerations of the last step, rad/s^2.
    pub fn accelerations(&self) -> Joints {
        self.qdd
    }

    /// Exact joint positions, rad.
    pub fn true_q(&self) -> Joints {
        self.q
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn follows_a_ramp_with_little_lag_and_bounded_acceleration() {
        let mut d = Drives::new([0.0; 6], 40.0);
        let (mut q, dt) = (0.0, 0.002);
        for k in 0..500 {
            let v = (k as f64 * dt * 2.0).min(0.5);
            q += v * dt;
            d.step(&[q; 6], &[v; 6], dt);
            assert!(d.accelerations().iter().all(|a| a.abs() <= 40.0 + 1e-9));
        }
        assert!((d.read_qd()[0] - 0.5).abs() < 1e-3);
        assert!((d.read_q()[0] - q).abs() < 2e-3, "{}", d.read_q()[0] - q);
    }

    #[test]
    fn settles_at_every_control_rate() {
        for rate in [50.0, 125.0, 500.0, 1000.0] {
            let mut d = Drives::new([0.0; 6], 80.0);
            for _ in 0..rate as usize {
                d.step(&[0.01; 6], &[0.0; 6], 1.0 / rate);
            }
            assert!((d.true_q()[0] - 0.01).abs() < 1e-6 && d.read_qd()[0].abs() < 1e-4, "{rate} Hz: {:?}", d.true_q());
        }
    }

    #[test]
    fn brakes_hold_and_a_stuck_joint_does_not_move() {
        let mut d = Drives::new([0.1; 6], 40.0);
        d.set_brakes(true);
        d.step(&[1.0; 6], &[1.0; 6], 0.002);
        assert!((d.true_q()[0] - 0.1).abs() < 1e-12);
        d.set_brakes(false);
        d.set_fault(DriveFault { stuck: [true, false, false, false, false, false], ..DriveFault::default() });
        for _ in 0..200 {
            d.step(&[0.2; 6], &[0.0; 6], 0.002);
        }
        assert!((d.true_q()[0] - 0.1).abs() < 1e-12 && (d.true_q()[1] - 0.2).abs() < 1e-3);
    }
}
