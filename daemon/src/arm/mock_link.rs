//! An arm simulated in the process, without sockets or threads, on the caller's clock.

use graspd_rt::arm::{ArmCommand, ArmMode, Joints, Model, ROBOT_MODE_RUNNING, RobotState};
use graspd_rt::rtde::{ClockStep, script_state};

use super::link::{ArmLink, LinkFault, LinkPoll, LinkStats};

/// Dynamics of the simulated arm.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MockLimits {
    /// Speed that the script refuses to exceed, rad/s.
    pub speed: Joints,
    /// Acceleration of the leading axis, rad/s2.
    pub acceleration: f64,
    /// Time constant of the drives, s.
    pub lag_s: f64,
    /// The arm ramps down when the heartbeat has not changed for this long, s.
    pub patience_s: f64,
    /// Controller step, s.
    pub step_s: f64,
}

impl MockLimits {
    /// Those of a model under the control script.
    pub fn of(model: Model) -> MockLimits {
        let step_s = if model.is_e_series() { 0.002 } else { 0.008 };
        MockLimits {
            speed: model.joints().map(|j| j.speed),
            acceleration: 10.0,
            lag_s: 0.008,
            patience_s: 0.020,
            step_s,
        }
    }
}

/// Maximum number of steps in one poll; in a longer pause of the caller's clock the arm's clock pauses as well.
const MAX_STEPS: u32 = 500;

/// A link to the simulated arm: joint rates with acceleration limit and lag, states and faults of the control script,
/// no kinematics.
#[derive(Clone, Debug, PartialEq)]
pub struct MockLink {
    limits: MockLimits,
    q: Joints,
    qd: Joints,
    target_q: Joints,
    target_qd: Joints,
    command: ArmCommand,
    script: (i32, i32),
    heartbeat_still_s: f64,
    last_heartbeat: i32,
    safety: u32,
    mode: i32,
    outputs: u64,
    clock_s: f64,
    stepped_ns: Option<u64>,
    token: i32,
    cut: Option<LinkFault>,
    stats: LinkStats,
}

impl MockLink {
    /// At rest at `q`, rad.
    pub fn new(q: Joints, limits: MockLimits) -> MockLink {
        MockLink {
            limits,
            q,
            qd: [0.0; 6],
            target_q: q,
            target_qd: [0.0; 6],
            command: ArmCommand::default(),
            script: (script_state::IDLE, 0),
            heartbeat_still_s: 0.0,
            last_heartbeat: 0,
            safety: 1,
            mode: ROBOT_MODE_RUNNING,
            outputs: 0,
            clock_s: 100.0,
            stepped_ns: None,
            token: 1,
            cut: None,
            stats: LinkStats::default(),
        }
    }

    /// Sets `safety_status_bits`: any bit other than normal (0) and reduced (1) stops the arm.
    pub fn set_safety(&mut self, bits: u32) {
        self.safety = bits;
    }

    /// Sets `robot_mode`: any mode other than running stops the arm.
    pub fn set_mode(&mut self, mode: i32) {
        self.mode = mode;
    }

    /// Makes the link fail.
    pub fn cut(&mut self, fault: LinkFault) {
        self.cut = Some(fault);
    }

    /// The state as it is now.
    pub fn state(&self, now_ns: u64) -> RobotState {
        let running = self.can_move();
        RobotState {
            timestamp_s: self.clock_s,
            received_ns: now_ns,
            q: self.q,
            qd: self.qd,
            target_q: self.target_q,
            target_qd: self.target_qd,
            robot_mode: self.mode,
            safety_status_bits: self.safety,
            robot_status_bits: 1 | if running { 2 } else { 0 },
            runtime_state: if running { 2 } else { 1 },
            speed_scaling: 1.0,
            target_speed_fraction: 1.0,
            // As in a controller, the tool's outputs follow the configurable ones.
            digital_outputs: self.outputs & 0xff | (self.outputs & 0x300) << 8,
            tool: None,
            echo: self.last_heartbeat,
            script_state: self.script.0,
            script_fault: self.script.1,
            script_token: self.token,
        }
    }

    fn can_move(&self) -> bool {
        self.mode == ROBOT_MODE_RUNNING && self.safety & !0b11 == 0
    }

    /// One step of the control script; returns the rates that it commands.
    fn script_step(&mut self) -> Joints {
        let zero = [0.0; 6];
        let c = self.command;
        if c.heartbeat == self.last_heartbeat {
            self.heartbeat_still_s += self.limits.step_s;
        } else {
            self.heartbeat_still_s = 0.0;
            self.last_heartbeat = c.heartbeat;
        }
        let refused = c.rates.iter().zip(self.limits.speed).any(|(r, max)| !(r.abs() <= max));
        self.script = if self.heartbeat_still_s >= self.limits.patience_s
            && (c.mode != ArmMode::Idle || self.script.0 == script_state::FAULT)
        {
            (script_state::FAULT, 4)
        } else if self.script.0 == script_state::FAULT && c.mode != ArmMode::Idle {
            self.script
        } else {
            match c.mode {
                ArmMode::Idle => (script_state::IDLE, 0),
                ArmMode::Stop => (script_state::STOPPING, 0),
                ArmMode::Velocity if refused => (script_state::FAULT, 1),
                ArmMode::Velocity => (script_state::VELOCITY, 0),
            }
        };
        let (mask, values) = (u64::from(c.outputs >> 16), u64::from(c.outputs & 0xffff));
        self.outputs = (self.outputs & !mask) | (values & mask);
        if self.script.0 == script_state::VELOCITY { c.rates } else { zero }
    }

    /// One controller step of dynamics.
    fn step(&mut self) {
        let commanded = if self.can_move() { self.script_step() } else { [0.0; 6] };
        let dt = self.limits.step_s;
        // `speedj`: the leading axis accelerates at the limit, the others reach their speeds with it.
        let max_change = commanded.iter().zip(self.target_qd).fold(0.0f64, |m, (c, v)| m.max((c - v).abs()));
        let fraction = if max_change > 0.0 { (self.limits.acceleration * dt / max_change).min(1.0) } else { 0.0 };
        let follow = 1.0 - (-dt / self.limits.lag_s.max(1e-6)).exp();
        let targets = self.target_q.iter_mut().zip(&mut self.target_qd).zip(commanded);
        let actual = self.q.iter_mut().zip(&mut self.qd);
        for (((target_q, target_qd), commanded), (q, qd)) in targets.zip(actual) {
            *target_qd += fraction * (commanded - *target_qd);
            *target_q += *target_qd * dt;
            let moved = follow * (*target_q - *q);
            *q += moved;
            *qd = moved / dt;
        }
        self.clock_s += dt;
    }
}

impl ArmLink for MockLink {
    fn poll(&mut self, now_ns: u64) -> LinkPoll {
        if self.cut.is_some() {
            return LinkPoll { fault: self.cut, ..LinkPoll::default() };
        }
        let step_ns = (self.limits.step_s * 1e9) as u64;
        let mut at = self.stepped_ns.unwrap_or(now_ns.saturating_sub(step_ns));
        let mut packages = 0;
        while now_ns.saturating_sub(at) >= step_ns {
            if packages == MAX_STEPS {
                at = now_ns;
                break;
            }
            self.step();
            at += step_ns;
            packages += 1;
        }
        self.stepped_ns = Some(at);
        self.stats.received += u64::from(packages);
        let state = (packages > 0).then(|| self.state(now_ns));
        LinkPoll { state, packages, missing: 0, clock: state.map(|_| ClockStep::Next), fault: None }
    }

    fn send(&mut self, command: &ArmCommand) -> Result<(), LinkFault> {
        if let Some(fault) = self.cut {
            return Err(fault);
        }
        self.command = *command;
        self.stats.sent += 1;
        Ok(())
    }

    fn token(&self) -> i32 {
        self.token
    }

    fn rate_hz(&self) -> f64 {
        1.0 / self.limits.step_s
    }

    fn stats(&self) -> LinkStats {
        self.stats
    }

    fn fault(&self) -> Option<LinkFault> {
        self.cut
    }

    /// Returns immediately: the next poll makes the next package.
    fn wait(&mut self, _deadline_ns: u64) -> bool {
        false
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS2: u64 = 2_000_000;

    fn arm() -> MockLink {
        MockLink::new(graspd_rt::arm::READY, MockLimits::of(Model::Ur5e))
    }

    fn drive(arm: &mut MockLink, now: &mut u64, mode: ArmMode, rate: f64, heartbeats: i32) -> RobotState {
        for heartbeat in 1..=heartbeats {
            arm.send(&ArmCommand { mode, rates: [rate; 6], heartbeat: heartbeat + *now as i32, outputs: 0 }).unwrap();
            *now += MS2;
            arm.poll(*now);
        }
        arm.state(*now)
    }

    #[test]
    fn it_follows_rates_within_its_acceleration_and_integrates_them() {
        let (mut arm, mut now) = (arm(), MS2);
        let start = arm.state(0).q;
        let mut last = 0.0;
        for _ in 0..200 {
            let s = drive(&mut arm, &mut now, ArmMode::Velocity, 0.5, 1);
            assert!((s.target_qd[0] - last).abs() <= 10.0 * 0.002 + 1e-12);
            last = s.target_qd[0];
        }
        // 0.4 s at 0.5 rad/s, minus half the ramp (0.0125 rad); after the stop the lag has decayed.
        let s = drive(&mut arm, &mut now, ArmMode::Stop, 0.0, 200);
        assert!((s.q[0] - start[0] - 0.2).abs() < 2e-3, "{}", s.q[0] - start[0]);
        assert!(s.qd[0].abs() < 1e-6 && s.script_state == script_state::STOPPING);
    }

    #[test]
    fn a_heartbeat_that_stops_is_a_fault_until_idle() {
        let (mut arm, mut now) = (arm(), MS2);
        drive(&mut arm, &mut now, ArmMode::Velocity, 0.5, 100);
        for _ in 0..100 {
            now += MS2;
            arm.poll(now);
        }
        let s = arm.state(now);
        assert!(s.qd[0].abs() < 1e-6 && s.target_qd[0] == 0.0);
        assert_eq!((s.script_state, s.script_fault), (script_state::FAULT, 4));
        let s = drive(&mut arm, &mut now, ArmMode::Velocity, 0.5, 10);
        assert_eq!(s.target_qd, [0.0; 6], "latched");
        drive(&mut arm, &mut now, ArmMode::Idle, 0.0, 2);
        let s = drive(&mut arm, &mut now, ArmMode::Velocity, 0.5, 10);
        assert!(s.target_qd[0] > 0.1);
    }

    #[test]
    fn nan_rates_above_the_limit_and_safety_stops_do_not_move_it() {
        for (rate, bits) in [(f64::NAN, 1), (4.0, 1), (0.5, 0b100)] {
            let (mut arm, mut now) = (arm(), MS2);
            arm.set_safety(bits);
            let s = drive(&mut arm, &mut now, ArmMode::Velocity, rate, 50);
            assert_eq!(s.q, graspd_rt::arm::READY, "{rate} {bits}");
        }
    }
}
