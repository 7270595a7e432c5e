//! The oracle: judges what clients ask for and what the arm does, and remembers the worst of both.
//!
//! It knows the register layout of the project's control script (set-points in float registers 24 to 29, mode word in integer
//! register 24, heartbeat counter in 25) and nothing of the client's code. It is fed with every input package and every control step,
//! live by the mock or later from its record.

use crate::plant::Joints;
use graspd_rt::rtde::{Field, Value};
use serde::Serialize;

/// Bounds that a client has promised, and those of the arm.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Limits {
    /// Largest joint rate a client may ask for, rad/s.
    pub rate: f64,
    /// Largest change of a joint rate, rad/s^2; 1 % is allowed on top for rounding.
    pub accel: f64,
    /// Largest joint rates of the arm itself, rad/s.
    pub arm_rate: Joints,
    /// Joint positions either way, rad.
    pub position: Joints,
    /// Control step, s: cycles of a client are this far apart at least.
    pub step_s: f64,
}

/// Mode word that lets rates through.
const MODE_VELOCITY: i32 = 1;
/// First float register of the rates.
const RATES: u16 = 24;
const MODE: u16 = 24;
const CYCLE: u16 = 25;
/// A joint slower than this stands still, rad/s.
const REST: f64 = 1e-3;
/// Violations kept in words; all are counted.
const KEPT: usize = 32;

/// A broken rule.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Violation {
    /// CLOCK_MONOTONIC or virtual time, ns.
    pub at_ns: u64,
    /// Which rule.
    pub rule: Rule,
    /// Joint, where one is meant.
    pub joint: Option<usize>,
    /// The value that broke it, SI units; `None` when it was not a number.
    pub value: Option<f64>,
}

/// The rules.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Rule {
    /// A set-point is NaN or infinite.
    Finite,
    /// A set-point above the rate limit.
    Rate,
    /// A set-point that changes too fast.
    Accel,
    /// Rates not zero while the mode word is not velocity.
    ZeroUnlessVelocity,
    /// The arm turned faster than it may.
    ArmRate,
    /// A joint left its range.
    ArmPosition,
}

/// One movement from leaving rest to rest again.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Episode {
    /// Left rest, ns.
    pub moved_ns: u64,
    /// The last cycle that a client sent before the arm rested, ns.
    pub last_heartbeat_ns: u64,
    /// Fastest joint speed of the episode, rad/s.
    pub peak_rate: f64,
    /// At rest again, ns; 0 while moving.
    pub rest_ns: u64,
}

impl Episode {
    /// From the last cycle to rest, ns; `None` while the arm moves. After a client died this is the robot's own reaction:
    /// watchdog and ramp.
    pub fn stop_ns(&self) -> Option<u64> {
        (self.rest_ns > 0).then(|| self.rest_ns.saturating_sub(self.last_heartbeat_ns))
    }
}

/// What was seen so far.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Summary {
    /// Control steps.
    pub steps: u64,
    /// Input packages, all clients.
    pub inputs: u64,
    /// Set-points among them.
    pub setpoints: u64,
    /// Broken rules, all.
    pub limit_violations: u64,
    /// The first broken rules.
    pub violations: Vec<Violation>,
    /// Fastest rate asked for, rad/s.
    pub max_setpoint_rate: f64,
    /// Fastest change asked for, rad/s^2.
    pub max_setpoint_accel: f64,
    /// Fastest joint speed of the arm, rad/s.
    pub max_arm_rate: f64,
    /// Fastest change of the arm's target speed, rad/s^2.
    pub max_target_accel: f64,
    /// Longest pause between two set-points while rates were not zero, ns.
    pub max_setpoint_gap_ns: u64,
    /// Time of the newest cycle, ns.
    pub last_heartbeat_ns: u64,
    /// Movements; the newest 64.
    pub episodes: Vec<Episode>,
    /// Movements in all.
    pub episode_count: u64,
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct Setpoint {
    at_ns: u64,
    rates: Joints,
    cycle: i32,
}

/// The judge itself.
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

/// What a control step came to.
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

    /// The limits in force.
    pub fn limits(&self) -> &Limits {
        &self.limits
    }

    /// Changes the client's limits from now on.
    pub fn set_client_limits(&mut self, rate: f64, accel: f64) {
        (self.limits.rate, self.limits.accel) = (rate, accel);
    }

    /// One input package of any client.
    pub fn input(&mut self, at_ns: u64, values: &[(Field, Value)]) {
        self.summary.inputs += 1;
        let mut is_setpoint = false;
        for (field, value) in values {
            match (field.stem(), value) {
                (("input_double_register_", Some(n)), Value::Double(v)) if (RATES..RATES + 6).contains(&n) => {
                    if let Some(rate) = self.rates.get_mut(usize::from(n - RATES)) {
                        *rate = *v;
                    }
                    is_setpoint = true;
                }
                (("input_int_register_", Some(MODE)), Value::Int32(v)) => self.mode = *v,
                (("input_int_register_", Some(CYCLE)), Value::Int32(v)) => {
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
        // Outside velocity mode the script ignores the rates and ramps by itself: they count as zero.
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
            // A client that has just connected finds an arm at rest: its first set-point counts from there.
            let (from, last_heartbeat) = self.last.map_or((0.0, now.cycle), |l| (l.rates[joint], l.cycle));
            if moving && from.is_finite() {
                // Cycles that were skipped leave room for more change; a heartbeat that stops is one step at least.
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

    /// A client connects anew: its first set-point is compared with rest, not with the last one of the client before.
    pub fn forget_client(&mut self) {
        self.last = None;
    }

    /// One control step.
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
        let at_rest = fastest < REST && s.target_qd.iter().all(|v| v.abs() < REST);
        match (&mut self.moving, at_rest) {
            (None, false) => {
                self.moving = Some(Episode { moved_ns: s.at_ns, peak_rate: fastest, ..Episode::default() });
            }
            (Some(episode), false) => episode.peak_rate = episode.peak_rate.max(fastest),
            (Some(episode), true) => {
                (episode.rest_ns, episode.last_heartbeat_ns) = (s.at_ns, self.summary.last_heartbeat_ns);
                if self.summary.episodes.len() == 64 {
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
        if self.summary.violations.len() < KEPT {
            let value = value.is_finite().then_some(value);
            self.summary.violations.push(Violation { at_ns, rule, joint, value });
        }
    }

    /// What was seen so far; a movement under way is the last episode, with `rest_ns` 0.
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
