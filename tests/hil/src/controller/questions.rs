//! Script functions that query the controller: history, contact, limits, temperatures, flags.

use super::robot::Robot;
use crate::urscript::{Host, HostError, KinematicsQuery, Value};

fn refused(text: impl Into<String>) -> HostError {
    HostError::Refused(text.into())
}

fn six(v: Option<&Value>) -> Option<[f64; 6]> {
    v.and_then(Value::as_six).filter(|s| s.iter().all(|x| x.is_finite()))
}

fn whole(v: Option<&Value>, limit: usize) -> Option<usize> {
    let x = v.and_then(Value::as_f64)?;
    (x.fract() == 0.0 && x >= 0.0 && x < limit as f64).then_some(x as usize)
}

impl Robot {
    /// Evaluates a query function of a script.
    ///
    /// # Errors
    /// The name is unknown or an argument is invalid.
    pub(super) fn answer(&mut self, name: &str, a: &[Value]) -> Result<Value, HostError> {
        if let Some(answer) = self.devices.answer(name, a) {
            return answer;
        }
        let bad = |what: &str| refused(format!("{name}: {what}"));
        Ok(match name {
            "get_actual_joint_positions_history" => {
                let back = whole(a.first(), usize::MAX).ok_or_else(|| bad("expected a number of steps, at least 0"))?;
                // Script manual: beyond the history the oldest sample is returned.
                let at = self.memory.history.len().saturating_sub(1).saturating_sub(back);
                Value::floats(&self.memory.history.get(at).copied().unwrap_or(self.truth.actual_q))
            }
            "get_target_joint_accelerations" => Value::floats(&self.truth.target_qdd),
            "get_target_payload_inertia" => Value::floats(&self.payload.inertia),
            "is_within_safety_limits" => {
                Value::Bool(self.within_limits(a).ok_or_else(|| bad("expected a pose or six joint positions"))?)
            }
            "tool_contact" => {
                let force = self.truth.tcp_force;
                let along = match a.first() {
                    None | Some(Value::None) => None,
                    some => Some(six(some).ok_or_else(|| bad("the direction must be a pose or six numbers"))?),
                };
                // With a direction only contact opposing a motion in that direction counts; without one (or zero) any.
                let opposes = along.is_none_or(|d| {
                    let dot: f64 = d.iter().zip(&force).take(3).map(|(d, f)| d * f).sum();
                    d.iter().take(3).all(|v| *v == 0.0) || dot < 0.0
                });
                let steps = if opposes { self.memory.contact_steps } else { 0 };
                Value::Int(i32::try_from(steps).unwrap_or(i32::MAX))
            }
            // 0 normal, 1 close to a singularity, 2 too close.
            "get_freedrive_status" => Value::Int(0),
            "get_joint_temp" => {
                let joint = whole(a.first(), 6).ok_or_else(|| bad("joints are numbered 0 to 5"))?;
                Value::Float(28.0 + 0.5 * self.truth.actual_current.get(joint).map_or(0.0, |i| i.abs()))
            }
            "get_controller_temp" => Value::Float(30.0),
            "get_tool_current" => Value::Float(0.01),
            "get_tool_accelerometer_reading" => Value::floats(&self.truth.tool_acceleration),
            "get_flag" => {
                let n = whole(a.first(), 32).ok_or_else(|| bad("flags are numbered 0 to 31"))?;
                Value::Bool(self.memory.flags >> n & 1 == 1)
            }
            "set_flag" => {
                let n = whole(a.first(), 32).ok_or_else(|| bad("flags are numbered 0 to 31"))?;
                let Some(Value::Bool(on)) = a.get(1) else { return Err(bad("expected a boolean")) };
                self.memory.flags = self.memory.flags & !(1 << n) | u32::from(*on) << n;
                Value::None
            }
            "random" => Value::Float(self.memory.random()),
            _ => return self.configure(name, a),
        })
    }

    /// Executes a setting of a script.
    ///
    /// # Errors
    /// The name is unknown or an argument is invalid.
    fn configure(&mut self, name: &str, a: &[Value]) -> Result<Value, HostError> {
        let bad = |what: &str| refused(format!("{name}: {what}"));
        Ok(match name {
            "zero_ftsensor" => {
                self.zero_force_sensor();
                Value::None
            }
            "force_mode_set_gain_scaling" => {
                let scaling = a.first().and_then(Value::as_f64).filter(|s| (0.0..=2.0).contains(s));
                self.generator.set_force_gain(scaling.ok_or_else(|| bad("the scaling must be from 0 to 2"))?);
                Value::None
            }
            // The simulated contact is damped enough; the value is only checked.
            "force_mode_set_damping" => {
                let damping = a.first().and_then(Value::as_f64).filter(|d| (0.0..=1.0).contains(d));
                damping.ok_or_else(|| bad("the damping must be from 0 to 1"))?;
                Value::None
            }
            "set_tool_voltage" => {
                let voltage = whole(a.first(), 25).filter(|v| [0, 12, 24].contains(v));
                self.signals.tool_voltage = voltage.ok_or_else(|| bad("the voltage must be 0, 12 or 24"))? as i32;
                Value::None
            }
            "get_standard_analog_out" | "get_analog_out" => {
                let n = whole(a.first(), 2).ok_or_else(|| bad("outputs are numbered 0 and 1"))?;
                Value::Float(self.signals.analog_out[n])
            }
            "powerdown" => {
                self.power_off();
                Value::None
            }
            _ => return Err(HostError::UnknownFunction(name.to_owned())),
        })
    }

    /// Whether joint positions, or the nearest solution for a pose, are within the joint limits.
    fn within_limits(&self, a: &[Value]) -> Option<bool> {
        let limit = self.setup.model.position_limit();
        let q = match a.first()? {
            Value::Pose(pose) => {
                let near = six(a.get(1));
                let (max_position_error, max_orientation_error) = (1e-10, 1e-10);
                self.inverse_kinematics(&KinematicsQuery {
                    pose: *pose,
                    near,
                    max_position_error,
                    max_orientation_error,
                    tcp: None,
                })
            }
            joints => Some(six(Some(joints))?),
        };
        Some(q.is_some_and(|q| q.iter().zip(limit).all(|(q, l)| q.abs() <= l)))
    }
}
