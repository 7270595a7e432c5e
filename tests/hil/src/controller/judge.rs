//! The judge, a test oracle: checks the set-points of clients and the motion of the arm against limits.
//!
//! It knows the register layout of the project's control script (set-points in float registers 24 to 29, mode word in
//! integer register 24, heartbeat counter in 25) and shares no code with the client. It receives every input package
//! and every control step, live from the mock or later from the wire record.

use crate::plant::Joints;
use graspd_rt::rtde::{Field, Value};
use serde::Serialize;

/// Limits of the client and of the arm.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Limits {
    /// Largest joint speed that a client may command, rad/s.
    pub rate: f64,
    /// Largest joint acceleration that a client may command, rad/s^2; 1 % more is allowed for rounding.
    pub accel: f64,
    /// Largest joint speeds of the arm, rad/s.
    pub arm_rate: Joints,
    /// Largest absolute joint positions, rad.
    pub position: Joints,
    /// Control step, s: the shortest cycle of a client.
    pub step_s: f64,
}

/// Mode word with which the script applies the rates.
const MODE_VELOCITY: i32 = 1;
/// First float register of the rates.
const RATES_REGISTER: u16 = 24;
/// Integer register of the mode word.
const MODE_REGISTER: u16 = 24;
/// Integer register of the heartbeat counter.
const CYCLE_REGISTER: u16 = 25;
/// Joint speed below which a joint counts as at rest, rad/s.
const MAX_REST_SPEED: f64 = 1e-3;
/// Violations kept with their details; all are counted.
const MAX_VIOLATIONS: usize = 32;
/// Episodes kept; all are counted.
const MAX_EPISODES: usize = 64;

/// A violation of a rule.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Violation {
    /// CLOCK_MONOTONIC or virtual time, ns.
    pub at_ns: u64,
    /// Which rule.
    pub rule: Rule,
    /// Joint, if the rule applies to one.
    pub joint: Option<usize>,
    /// The offending value, SI units; `None` for NaN and infinity.
    pub value: Option<f64>,
}

/// The rules.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Rule {
    /// A set-point is NaN or infinite.
    Finite,
    /// A set-point exceeds the rate limit.
    Rate,
    /// A set-point exceeds the acceleration limit.
    Accel,
    /// Rates are not zero although the mode word is not velocity.
    ZeroUnlessVelocity,
    /// A joint of the arm exceeded its speed limit.
    ArmRate,
    /// A joint left its range.
    ArmPosition,
}

/// One movement of the arm, from rest to rest.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Episode {
    /// Start of the movement, ns.
    pub moved_ns: u64,
    /// The last heartbeat of a client before the arm came to rest, ns.
    pub last_heartbeat_ns: u64,
    /// Largest joint speed, rad/s.
    pub peak_rate: f64,
    /// End of the movement, ns; 0 while moving.
    pub rest_ns: u64,
}

impl Episode {
    /// Time from the last heartbeat to rest, ns; `None` while the arm moves. After a client was killed this is the
    /// reaction time of watchdog and ramp.
    pub fn stop_ns(&self) -> Option<u64> {
        (self.rest_ns > 0).then(|| self.rest_ns.saturating_sub(self.last_heartbeat_ns))
    }
}

/// Observations so far.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Summary {
    /// Control steps.
    pub steps: u64,
    /// Input packages of all clients.
    pub inputs: u64,
    /// Input packages that hold a set-point.
    pub setpoints: u64,
    /// Number of violations.
    pub limit_violations: u64,
    /// The first violations.
    pub violations: Vec<Violation>,
    /// Largest commanded joint speed, rad/s.
    pub max_setpoint_rate: f64,
    /// Largest commanded joint acceleration, rad/s^2.
    pub max_setpoint_accel: f64,
    /// Largest joint speed of the arm, rad/s.
    pub max_arm_rate: f64,
    /// Largest target acceleration of the arm, rad/s^2.
    pub max_target_accel: f64,
    /// Longest gap between two set-points while rates were not zero, ns.
    pub max_setpoint_gap_ns: u64,
    /// Time of the newest heartbeat, ns.
    pub last_heartbeat_ns: u64,
    /// The newest movements.
    pub episodes: Vec<Episode>,
    /// Number of movements.
    pub episode_count: u64,
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct Setpoint {
    at_ns: u64,
    rates: Joints,
    cycle: i32,
}

/// Checks set-points and motion; see the module page.
#[derive(Clone, Debug)]
pub struct Judge {
    limits: Limits,
    summary: Summary,
    rates: Joints,
    mode: i32,
    cycle: i32,
    last: Option<Setpoint>,
    moving: Option<Episode>,
}

/// The arm in one control step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StepSample {
    /// CLOCK_MONOTONIC or virtual time, ns.
    pub at_ns: u64,
    /// True joint positions, rad.
    pub q: Joints,
    /// True joint speeds, rad/s.
    pub qd: Joints,
    /// Target joint speeds, rad/s.
    pub target_qd: Joints,
    /// Target joint accelerations, rad/s^2.
    pub target_qdd: Joints,
}

impl Judge {
    /// A judge with these limits.
    pub fn new(limits: Limits) -> Self {
        Judge { limits, summary: Summary::default(), rates: [0.0; 6], mode: 0, cycle: 0, last: None, moving: None }
    }

    /// The present limits.
    pub fn limits(&self) -> &Limits {
        &self.limits
    }

    /// Changes the client's limits from now on.
    pub fn set_client_limits(&mut self, rate: f64, accel: f64) {
        (self.limits.rate, self.limits.accel) = (rate, accel);
    }

    /// Checks one input package of any client.
    pub fn input(&mut self, at_ns: u64, values: &[(Field, Value)]) {
        self.summary.inputs += 1;
        let mut is_setpoint = false;
        for (field, value) in values {
            match (field.stem(), value) {
                (("input_double_register_", Some(n)), Value::Double(v))
                    if (RATES_REGISTER..RATES_REGISTER + 6).contains(&n) =>
                {
                    if let Some(rate) = self.rates.get_mut(usize::from(n - RATES_REGISTER)) {
                        *rate = *v;
                    }
                    is_setpoint = true;
                }
                (("input_int_register_", Some(MODE_REGISTER)), Value::Int32(v)) => self.mode = *v,
                (("input_int_register_", Some(CYCLE_REGISTER)), Value::Int32(v)) => {
                    if *v != self.cycle {
                        self.summary.last_heartbeat_ns = at_ns;
                    }
                    self.cycle = *v;
                }
                _ => {}
            }
        }
        if is_setpoint {
            self.setpoint(at_ns);
        }
    }

    fn setpoint(&mut self, at_ns: u64) {
        self.summary.setpoints += 1;
        // Outside velocity mode the script ignores the rates and decelerates: they count as zero.
        let moving = self.mode == MODE_VELOCITY;
        let rates = if moving { self.rates } else { [0.0; 6] };
        let now = Setpoint { at_ns, rates, cycle: self.cycle };
        let limits = self.limits;
        for (joint, v) in self.rates.into_iter().enumerate() {
            if !v.is_finite() {
                self.violate(at_ns, Rule::Finite, Some(joint), v);
                continue;
            }
            self.summary.max_setpoint_rate = self.summary.max_setpoint_rate.max(v.abs());
            if v.abs() > limits.rate * (1.0 + 1e-9) {
                self.violate(at_ns, Rule::Rate, Some(joint), v);
            }
            if v != 0.0 && !moving {
                self.violate(at_ns, Rule::ZeroUnlessVelocity, Some(joint), v);
            }
            // A client that has just connected finds the arm at rest, so its first set-point is compared with zero.
            let (from, last_heartbeat) = self.last.map_or((0.0, now.cycle), |l| (l.rates[joint], l.cycle));
            if moving && from.is_finite() {
                // Skipped cycles permit a larger change; a heartbeat that did not change counts as one step.
                let cycles = f64::from(now.cycle.wrapping_sub(last_heartbeat).clamp(1, 1000));
                let accel = (v - from).abs() / (cycles * limits.step_s);
                self.summary.max_setpoint_accel = self.summary.max_setpoint_accel.max(accel);
                if accel > limits.accel * 1.01 + 1e-6 {
                    self.violate(at_ns, Rule::Accel, Some(joint), accel);
                }
            }
        }
        if let Some(last) = self.last.filter(|l| l.rates.iter().any(|r| *r != 0.0)) {
            let gap = at_ns.saturating_sub(last.at_ns);
            self.summary.max_setpoint_gap_ns = self.summary.max_setpoint_gap_ns.max(gap);
        }
        self.last = Some(now);
    }

    /// Notes a new client: its first set-point is compared with rest, not with the last one of the previous client.
    pub fn forget_client(&mut self) {
        self.last = None;
    }

    /// Checks one control step.
    pub fn step(&mut self, s: &StepSample) {
        self.summary.steps += 1;
        let mut fastest = 0.0f64;
        for joint in 0..6 {
            let (q, qd) = (s.q[joint], s.qd[joint]);
            fastest = fastest.max(qd.abs());
            self.summary.max_target_accel = self.summary.max_target_accel.max(s.target_qdd[joint].abs());
            if qd.abs() > self.limits.arm_rate[joint] * 1.01 {
                self.violate(s.at_ns, Rule::ArmRate, Some(joint), qd);
            }
            if q.abs() > self.limits.position[joint] {
                self.violate(s.at_ns, Rule::ArmPosition, Some(joint), q);
            }
        }
        self.summary.max_arm_rate = self.summary.max_arm_rate.max(fastest);
        let at_rest = fastest < MAX_REST_SPEED && s.target_qd.iter().all(|v| v.abs() < MAX_REST_SPEED);
        match (&mut self.moving, at_rest) {
            (None, false) => {
                self.moving = Some(Episode { moved_ns: s.at_ns, peak_rate: fastest, ..Episode::default() });
            }
            (Some(episode), false) => episode.peak_rate = episode.peak_rate.max(fastest),
            (Some(episode), true) => {
                (episode.rest_ns, episode.last_heartbeat_ns) = (s.at_ns, self.summary.last_heartbeat_ns);
                if self.summary.episodes.len() == MAX_EPISODES {
                    self.summary.episodes.remove(0);
                }
                self.summary.episodes.push(*episode);
                self.summary.episode_count += 1;
                self.moving = None;
            }
            (None, true) => {}
        }
    }

    fn violate(&mut self, at_ns: u64, rule: Rule, joint: Option<usize>, value: f64) {
        self.summary.limit_violations += 1;
        if self.summary.violations.len() < MAX_VIOLATIONS {
            let value = value.is_finite().then_some(value);
            self.summary.violations.push(Violation { at_ns, rule, joint, value });
        }
    }

    /// Observations so far; a movement under way is the last episode, with `rest_ns` 0.
    pub fn summary(&self) -> Summary {
        let mut summary = self.summary.clone();
        if let Some(mut episode) = self.moving {
            episode.last_heartbeat_ns = self.summary.last_heartbeat_ns;
            summary.episodes.push(episode);
        }
        summary
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn judge() -> Judge {
        Judge::new(Limits { rate: 0.5, accel: 4.0, arm_rate: [3.0; 6], position: [6.2; 6], step_s: 0.002 })
    }

    fn package(mode: i32, cycle: i32, rate: f64) -> Vec<(Field, Value)> {
        let mut values: Vec<_> = (24..30)
            .map(|n| (Field::input(&format!("input_double_register_{n}")).unwrap(), Value::Double(rate)))
            .collect();
        values.insert(0, (Field::input("input_int_register_24").unwrap(), Value::Int32(mode)));
        values.insert(1, (Field::input("input_int_register_25").unwrap(), Value::Int32(cycle)));
        values
    }

    fn rules(j: &Judge) -> Vec<Rule> {
        j.summary().violations.iter().map(|v| v.rule).collect()
    }

    #[test]
    fn a_ramp_inside_the_limits_passes_and_a_step_does_not() {
        let mut j = judge();
        for k in 0..60 {
            j.input(k as u64 * 2_000_000, &package(1, k, f64::from(k) * 0.008));
        }
        assert_eq!(j.summary().limit_violations, 0);
        assert!((j.summary().max_setpoint_accel - 4.0).abs() < 1e-6);
        j.input(200_000_000, &package(1, 60, 0.0));
        assert_eq!(rules(&j), [Rule::Accel; 6]);
    }

    #[test]
    fn each_rule_can_be_broken() {
        let mut j = judge();
        j.input(0, &package(0, 1, 0.004));
        assert_eq!(rules(&j), [Rule::ZeroUnlessVelocity; 6]);
        let mut j = judge();
        j.input(0, &package(1, 1, f64::NAN));
        assert_eq!(rules(&j), [Rule::Finite; 6]);
        let mut j = judge();
        j.input(0, &package(1, 1, 0.51));
        // From rest it is too fast a change as well.
        assert_eq!(rules(&j), [[Rule::Rate, Rule::Accel]; 6].as_flattened());
        let mut j = judge();
        let still = StepSample { at_ns: 0, q: [7.0; 6], qd: [0.0; 6], target_qd: [0.0; 6], target_qdd: [0.0; 6] };
        j.step(&still);
        assert_eq!(rules(&j), [Rule::ArmPosition; 6]);
        let mut j = judge();
        j.step(&StepSample { q: [0.0; 6], qd: [3.1; 6], ..still });
        assert_eq!(rules(&j), [Rule::ArmRate; 6]);
    }

    #[test]
    fn a_movement_is_measured_from_the_last_cycle_to_rest() {
        let mut j = judge();
        let sample = |at_ns, v| StepSample { at_ns, q: [0.0; 6], qd: [v; 6], target_qd: [v; 6], target_qdd: [0.0; 6] };
        j.step(&sample(10, 0.0));
        j.input(15, &package(1, 1, 0.004));
        j.step(&sample(20, 0.3));
        assert_eq!(j.summary().episodes[0].rest_ns, 0);
        j.step(&sample(30, 0.0));
        let e = j.summary().episodes[0];
        assert_eq!((e.moved_ns, e.last_heartbeat_ns, e.rest_ns, j.summary().episode_count), (20, 15, 30, 1));
    }
}
