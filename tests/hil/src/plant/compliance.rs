//! Force mode: compliant axes of a force frame move with a velocity proportional to the force error.

use super::Joints;
use nalgebra::{Isometry3, Matrix3, Rotation3, UnitQuaternion, Vector3};

/// Speed per force error at a gain scaling of 1, m/s per N.
const LINEAR_GAIN: f64 = 0.04;
/// Angular speed per torque error at a gain scaling of 1, rad/s per Nm.
const ANGULAR_GAIN: f64 = 1.0;
/// Gain scaling of a controller after start, as documented for `force_mode_set_gain_scaling`.
const DEFAULT_GAIN_SCALING: f64 = 0.5;
/// Time constant of the velocity, s. With a contact stiffness of 2000 N/m the force loop has a bandwidth of 40 rad/s,
/// far below this and the drives' lag of 8 ms, so that contact is stable.
const LAG_S: f64 = 0.005;
/// Largest linear acceleration, m/s^2.
const MAX_LINEAR_ACCEL: f64 = 5.0;
/// Largest angular acceleration, rad/s^2.
const MAX_ANGULAR_ACCEL: f64 = 20.0;

/// Parameters of force mode.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ForceControl {
    /// Pose of the force frame in the base frame.
    pub base_from_frame: Isometry3<f64>,
    /// Compliant axes of the force frame.
    pub compliant: [bool; 6],
    /// Wrench to be applied to the environment, force frame, N and Nm.
    pub wrench: [f64; 6],
    /// 1: y axis from the TCP towards the frame's origin; 2: as given; 3: x axis along the TCP's velocity.
    pub frame_type: i32,
    /// Largest speeds of the compliant axes, m/s and rad/s.
    pub limits: [f64; 6],
}

/// State of force mode in the motion generator.
#[derive(Clone, Debug)]
pub(super) struct Compliance {
    pub(super) control: Option<ForceControl>,
    pub(super) gain_scaling: f64,
    /// Measured wrench of the environment on the TCP, base frame.
    pub(super) measured: [f64; 6],
    /// Linear and angular velocity of the TCP, base frame.
    pub(super) velocity: [Vector3<f64>; 2],
    /// Joint speeds of the last step.
    pub(super) qd: Joints,
    /// Displacement from the path of the present move, rad.
    pub(super) offset: Joints,
}

impl Default for Compliance {
    fn default() -> Self {
        Compliance {
            control: None,
            gain_scaling: DEFAULT_GAIN_SCALING,
            measured: [0.0; 6],
            velocity: [Vector3::zeros(); 2],
            qd: [0.0; 6],
            offset: [0.0; 6],
        }
    }
}

impl Compliance {
    /// Ends force mode without a ramp; the safety system stops the arm.
    pub(super) fn cancel(&mut self) {
        *self = Compliance { gain_scaling: self.gain_scaling, measured: self.measured, ..Compliance::default() };
    }

    /// Whether force mode has no effect at present.
    pub(super) fn is_idle(&self) -> bool {
        self.control.is_none() && self.velocity.iter().all(|v| v.norm() == 0.0)
    }

    /// Advances the velocity by one step towards the force error's.
    pub(super) fn update(&mut self, tool: &Isometry3<f64>, tool_velocity: &[f64; 6], dt: f64) {
        let goals = self.control.map_or([Vector3::zeros(); 2], |c| {
            let r = axes(&c, tool, tool_velocity);
            let scaling = self.gain_scaling;
            [0, 3].map(|k| {
                let gain = if k == 0 { LINEAR_GAIN } else { ANGULAR_GAIN } * scaling;
                let measured = r.inverse() * Vector3::from_column_slice(&self.measured[k..k + 3]);
                let v = Vector3::from_fn(|i, _| {
                    if !c.compliant[k + i] {
                        return 0.0;
                    }
                    let limit = c.limits[k + i].abs();
                    (gain * (c.wrench[k + i] + measured[i])).clamp(-limit, limit)
                });
                r * v
            })
        });
        let blend = 1.0 - (-dt / LAG_S).exp();
        for ((v, goal), accel) in self.velocity.iter_mut().zip(goals).zip([MAX_LINEAR_ACCEL, MAX_ANGULAR_ACCEL]) {
            let change = (goal - *v) * blend;
            let most = accel * dt;
            *v += if change.norm() > most { change * (most / change.norm()) } else { change };
            if self.control.is_none() && v.norm() < 1e-6 {
                *v = Vector3::zeros();
            }
        }
    }
}

/// Orientation of the force frame in the base frame.
fn axes(c: &ForceControl, tool: &Isometry3<f64>, tool_velocity: &[f64; 6]) -> UnitQuaternion<f64> {
    let given = c.base_from_frame.rotation;
    let z = given * Vector3::z();
    let direction = match c.frame_type {
        1 => c.base_from_frame.translation.vector - tool.translation.vector,
        3 => {
            let v = Vector3::from_column_slice(&tool_velocity[..3]);
            v - z * v.dot(&z)
        }
        _ => return given,
    };
    let Some(d) = direction.try_normalize(1e-6) else { return given };
    let (x, y, z) = if c.frame_type == 1 {
        let Some(x) = d.cross(&z).try_normalize(1e-6) else { return given };
        (x, d, x.cross(&d))
    } else {
        (d, z.cross(&d), z)
    };
    UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[x, y, z])))
}
