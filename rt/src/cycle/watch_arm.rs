//! Watches the robot: link, safety, program, and whether the arm follows its set-points.

use super::io::LinkStatus;
use super::settings::WatchSettings;
use crate::arm::{Joints, ROBOT_MODE_RUNNING, RobotState, ToolPoint};
use crate::math;
use crate::mode::FaultCause;

/// Set-points kept for the comparison with the measured motion: 64 cycles cover [`DELAY_NS`] at every cycle rate.
const SENT: usize = 64;
/// Longest delay between a set-point and the motion, ns.
const DELAY_NS: u64 = 60_000_000;
/// `runtime_state` of a program that runs.
const RUNTIME_STATE_PLAYING: u32 = 2;
/// Largest plausible joint position, rad.
const MAX_POSITION_RAD: f64 = 1e3;
/// Largest plausible joint velocity, rad/s: three times the fastest joint of all models.
const MAX_VELOCITY_RAD_PER_S: f64 = 20.0;
/// Largest plausible change of a joint position between two states: this angle, rad, plus the speed below times the
/// time between them.
const MAX_STEP_RAD: f64 = 0.02;
/// Above the 6.3 rad/s of the fastest joint, rad/s.
const MAX_STEP_RAD_PER_S: f64 = 7.5;
/// Time after which an implausible state no longer counts while the arm is not armed, ns.
const EVENT_NS: u64 = 1_000_000_000;

/// Bits of `safety_status_bits`.
mod bit {
    pub(super) const REDUCED: u32 = 1 << 1;
    pub(super) const PROTECTIVE: u32 = 1 << 2;
    pub(super) const RECOVERY: u32 = 1 << 3;
    pub(super) const SAFEGUARD: u32 = 1 << 4;
    pub(super) const EMERGENCY: u32 = 1 << 5 | 1 << 6 | 1 << 7;
    pub(super) const BROKEN: u32 = 1 << 8 | 1 << 9;
    pub(super) const STOPPED: u32 = 1 << 10;
}

/// Received and missing states over the last whole second.
#[derive(Clone, Copy, Debug)]
struct StateRate {
    since_ns: u64,
    /// Counts of received and missing states at the beginning of the second.
    begin: [u32; 2],
    /// Fraction received in the second before.
    fraction: f64,
}

impl Default for StateRate {
    fn default() -> Self {
        Self { since_ns: 0, begin: [0; 2], fraction: 1.0 }
    }
}

impl StateRate {
    fn note(&mut self, now_ns: u64, link: &LinkStatus) {
        if now_ns.saturating_sub(self.since_ns) < 1_000_000_000 {
            return;
        }
        let counts = [link.states, link.states_missing];
        let [received, missing] = core::array::from_fn(|i| counts[i].wrapping_sub(self.begin[i]));
        let all = received.saturating_add(missing);
        self.fraction = if all == 0 { 1.0 } else { f64::from(received) / f64::from(all) };
        (self.since_ns, self.begin) = (now_ns, counts);
    }
}

/// What is known of the robot.
#[derive(Clone, Debug)]
pub(super) struct ArmWatch {
    settings: WatchSettings,
    state: Option<RobotState>,
    link: LinkStatus,
    echo_changed_ns: u64,
    blocked_since_ns: Option<u64>,
    state_rate: StateRate,
    /// A fault that only one state shows: an implausible value, a clock that went back.
    event: Option<FaultCause>,
    event_ns: u64,
    sent: [(u64, Joints); SENT],
    sent_at: usize,
    moving_cmd_ns: u64,
    off_since_ns: Option<u64>,
    drift: Joints,
    creeping_since_ns: Option<u64>,
    /// Since when the controller's tool speed has differed from the computed one.
    tool_off_since_ns: Option<u64>,
    /// Both at the last state, m/s.
    tool: [f64; 2],
    good_since_ns: Option<u64>,
}

impl ArmWatch {
    pub(super) fn new(settings: WatchSettings) -> Self {
        Self {
            settings,
            state: None,
            link: LinkStatus::default(),
            echo_changed_ns: 0,
            blocked_since_ns: None,
            state_rate: StateRate::default(),
            event: None,
            event_ns: 0,
            sent: [(0, [0.0; 6]); SENT],
            sent_at: 0,
            moving_cmd_ns: 0,
            off_since_ns: None,
            drift: [0.0; 6],
            creeping_since_ns: None,
            tool_off_since_ns: None,
            tool: [0.0; 2],
            good_since_ns: None,
        }
    }

    /// Takes this cycle's state and link; returns whether there is a new, usable state.
    pub(super) fn observe(&mut self, now_ns: u64, robot: Option<&RobotState>, link: LinkStatus) -> bool {
        if link.connected && !self.link.connected {
            // The controller may have been restarted: nothing is comparable with the last connection.
            self.state = None;
            self.echo_changed_ns = now_ns;
            self.state_rate = StateRate { since_ns: now_ns, begin: [link.states, link.states_missing], fraction: 1.0 };
        }
        self.state_rate.note(now_ns, &link);
        self.link = link;
        self.blocked_since_ns = match (link.blocked_sends, self.blocked_since_ns) {
            (0, _) => None,
            (_, None) => Some(now_ns),
            (_, since) => since,
        };
        let Some(new) = robot else { return false };
        if let Some(cause) = self.implausible(new) {
            self.event = Some(cause);
            self.event_ns = now_ns;
            return false;
        }
        if self.state.is_none_or(|old| old.echo != new.echo) {
            self.echo_changed_ns = now_ns;
        }
        if let Some(old) = self.state {
            self.compare_motion(now_ns, &old, new);
        }
        self.state = Some(*new);
        true
    }

    /// The fault of a state with values that no arm can have, or cannot have after the last state.
    fn implausible(&self, new: &RobotState) -> Option<FaultCause> {
        for i in 0..6 {
            for (value, bound) in [(new.q[i], MAX_POSITION_RAD), (new.qd[i], MAX_VELOCITY_RAD_PER_S)] {
                if !(math::fabs(value) <= bound) {
                    return Some(FaultCause::StateAbsurd { joint: i as u8, value });
                }
            }
        }
        for value in [new.timestamp_s, new.speed_scaling, new.target_speed_fraction] {
            if !value.is_finite() {
                return Some(FaultCause::StateAbsurd { joint: 6, value });
            }
        }
        let old = self.state?;
        let dt = new.timestamp_s - old.timestamp_s;
        if dt < -1e-6 {
            return Some(FaultCause::ClockBack { by_s: -dt });
        }
        for i in 0..6 {
            let step = new.q[i] - old.q[i];
            if math::fabs(step) > MAX_STEP_RAD + MAX_STEP_RAD_PER_S * dt.min(0.5) {
                return Some(FaultCause::StateAbsurd { joint: i as u8, value: new.q[i] });
            }
        }
        None
    }

    /// Notes the rates sent in this cycle, rad/s.
    pub(super) fn note_sent(&mut self, now_ns: u64, rates: &Joints) {
        self.sent_at = (self.sent_at + 1) % SENT;
        self.sent[self.sent_at] = (now_ns, *rates);
        if *rates != [0.0; 6] {
            self.moving_cmd_ns = now_ns;
        }
    }

    /// Compares measured velocities with the range of the set-points of the last [`DELAY_NS`]; inside it there is no
    /// error.
    fn compare_motion(&mut self, now_ns: u64, old: &RobotState, new: &RobotState) {
        let dt = (new.timestamp_s - old.timestamp_s).clamp(0.0, 0.05);
        let slow = self.slider_of(new);
        let (mut low, mut high) = (self.sent[self.sent_at].1, self.sent[self.sent_at].1);
        for (at, rates) in &self.sent {
            if now_ns.saturating_sub(*at) > DELAY_NS {
                continue;
            }
            for i in 0..6 {
                // The speed slider may or may not be applied to a set-point yet.
                low[i] = low[i].min(rates[i]).min(rates[i] * slow);
                high[i] = high[i].max(rates[i]).max(rates[i] * slow);
            }
        }
        let mut off = false;
        for i in 0..6 {
            let error = (new.qd[i] - high[i]).max(0.0) + (new.qd[i] - low[i]).min(0.0);
            off |= math::fabs(error) > self.settings.tracking_rad_per_s;
            // Decays in about five seconds, so that a bias of the measurement does not accumulate.
            self.drift[i] = (self.drift[i] + error * dt) * (1.0 - 0.2 * dt);
        }
        self.off_since_ns = if off { self.off_since_ns.or(Some(now_ns)) } else { None };
        let resting = now_ns.saturating_sub(self.moving_cmd_ns) > self.settings.settle_ns;
        let creeping = new.qd.iter().any(|v| math::fabs(*v) > self.settings.uncommanded_rad_per_s);
        self.creeping_since_ns = if resting && creeping { self.creeping_since_ns.or(Some(now_ns)) } else { None };
    }

    /// Compares the controller's speed of its tool point with the one that the configured kinematics give for the same
    /// point (`tool.1`, m/s). If they differ, the kinematics are wrong, and the gripper's speed cap does not hold.
    pub(super) fn compare_tool(&mut self, now_ns: u64, tool: Option<(ToolPoint, f64)>) {
        let Some((point, computed)) = tool else {
            self.tool_off_since_ns = None;
            return;
        };
        let [x, y, z, ..] = point.speed;
        let reported = math::sqrt(x * x + y * y + z * z);
        self.tool = [reported, computed];
        let w = &self.settings;
        let allowed = w.tool_m_per_s + w.tool_share * reported.max(computed);
        // Negated so that NaN counts as a difference.
        let off = !(math::fabs(reported - computed) <= allowed);
        self.tool_off_since_ns = if off { self.tool_off_since_ns.or(Some(now_ns)) } else { None };
    }

    fn slider_of(&self, s: &RobotState) -> f64 {
        (s.speed_scaling.clamp(0.0, 1.0) * s.target_speed_fraction.clamp(0.0, 1.0)).clamp(0.0, 1.0)
    }

    /// Fraction of the commanded rates that the controller lets through, 0 to 1.
    pub(super) fn slider(&self) -> f64 {
        self.state.map_or(0.0, |s| self.slider_of(&s))
    }

    /// The newest usable state.
    pub(super) fn state(&self) -> Option<&RobotState> {
        self.state.as_ref()
    }

    /// Fraction of the controller's states received in the last second, if it is below the limit.
    pub(super) fn states_missing(&self) -> Option<f64> {
        let fraction = self.state_rate.fraction;
        (fraction < self.settings.state_share).then_some(fraction)
    }

    /// Whether there was a link in the last cycle.
    pub(super) fn connected(&self) -> bool {
        self.link.connected
    }

    /// Whether the controller is in reduced mode.
    pub(super) fn reduced(&self) -> bool {
        self.state.is_some_and(|s| s.safety_status_bits & bit::REDUCED != 0)
    }

    /// Age of the robot state, ns; `u64::MAX` without one.
    pub(super) fn age_ns(&self, now_ns: u64) -> u64 {
        self.state.map_or(u64::MAX, |s| now_ns.saturating_sub(s.received_ns))
    }

    /// The fault of the robot now, the most fundamental first; `None` when the arm may be driven.
    ///
    /// `watched` adds what matters only while the arm is armed or driven: whether it follows its set-points and rests
    /// without them.
    pub(super) fn fault(&self, now_ns: u64, watched: bool) -> Option<FaultCause> {
        let w = &self.settings;
        if let Some(s) = &self.state {
            let bits = s.safety_status_bits;
            let safety = [
                (bit::EMERGENCY, FaultCause::EmergencyStop),
                (bit::BROKEN | bit::RECOVERY, FaultCause::SafetyFault { bits }),
                (bit::PROTECTIVE, FaultCause::ProtectiveStop),
                (bit::SAFEGUARD, FaultCause::SafeguardStop),
                (bit::STOPPED, FaultCause::SafetyFault { bits }),
            ];
            if let Some((_, cause)) = safety.into_iter().find(|(mask, _)| bits & mask != 0) {
                return Some(cause);
            }
        }
        if !self.link.connected {
            return Some(FaultCause::LinkLost);
        }
        if self.event.is_some() {
            return self.event;
        }
        let Some(s) = &self.state else {
            return Some(FaultCause::StateStale { age_ns: u64::MAX, limit_ns: w.state_age_ns });
        };
        let age_ns = now_ns.saturating_sub(s.received_ns);
        if age_ns > w.state_age_ns {
            return Some(FaultCause::StateStale { age_ns, limit_ns: w.state_age_ns });
        }
        if s.robot_mode != ROBOT_MODE_RUNNING {
            return Some(FaultCause::NotRunning { mode: s.robot_mode });
        }
        if s.script_fault != 0 {
            return Some(FaultCause::ScriptFault { word: s.script_fault });
        }
        if s.runtime_state != RUNTIME_STATE_PLAYING {
            return Some(FaultCause::ProgramStopped { runtime_state: s.runtime_state });
        }
        if self.link.token != 0 && s.script_token != self.link.token {
            return Some(FaultCause::TokenChanged { expected: self.link.token, found: s.script_token });
        }
        let for_ns = now_ns.saturating_sub(self.echo_changed_ns);
        if for_ns > w.echo_ns {
            return Some(FaultCause::EchoStopped { for_ns });
        }
        if self.blocked_since_ns.is_some_and(|t| now_ns.saturating_sub(t) >= w.blocked_ns) {
            return Some(FaultCause::SendBlocked { count: self.link.blocked_sends });
        }
        if watched { self.motion_fault(now_ns, s) } else { None }
    }

    fn motion_fault(&self, now_ns: u64, s: &RobotState) -> Option<FaultCause> {
        let w = &self.settings;
        let since = |t: Option<u64>, limit: u64| t.is_some_and(|t| now_ns.saturating_sub(t) >= limit);
        let worst = |v: &Joints| (0..6).fold(0, |m, i| if math::fabs(v[i]) > math::fabs(v[m]) { i } else { m });
        if since(self.creeping_since_ns, w.uncommanded_ns) {
            let joint = worst(&s.qd);
            return Some(FaultCause::Uncommanded { joint: joint as u8, velocity: s.qd[joint] });
        }
        if since(self.tool_off_since_ns, w.tool_ns) {
            let [controller_m_per_s, ours_m_per_s] = self.tool;
            return Some(FaultCause::ToolSpeed { controller_m_per_s, ours_m_per_s });
        }
        let joint = worst(&self.drift);
        if since(self.off_since_ns, w.tracking_ns) || math::fabs(self.drift[joint]) > w.tracking_rad {
            let error: Joints = core::array::from_fn(|i| s.qd[i] - self.sent[self.sent_at].1[i]);
            let joint = if math::fabs(self.drift[joint]) > w.tracking_rad { joint } else { worst(&error) };
            return Some(FaultCause::TrackingError {
                joint: joint as u8,
                velocity: error[joint],
                position: self.drift[joint],
            });
        }
        None
    }

    /// Notes whether the robot is without a fault. Call it once a cycle.
    pub(super) fn note_good(&mut self, now_ns: u64, watched: bool) {
        self.good_since_ns =
            if self.fault(now_ns, watched).is_none() { self.good_since_ns.or(Some(now_ns)) } else { None };
    }

    /// For how long the robot has been without a fault, ns.
    pub(super) fn good_for_ns(&self, now_ns: u64) -> Option<u64> {
        self.good_since_ns.map(|t| now_ns.saturating_sub(t))
    }

    /// Forgets an implausible state after a second of plausible ones. Only while the arm is not armed: then nothing has
    /// latched that an operator would reset.
    pub(super) fn outlive_event(&mut self, now_ns: u64) {
        if now_ns.saturating_sub(self.event_ns) > EVENT_NS {
            self.event = None;
        }
    }

    /// Forgets past events, as a reset does; present conditions remain.
    pub(super) fn clear_events(&mut self) {
        self.event = None;
        self.state = None;
        self.drift = [0.0; 6];
        self.off_since_ns = None;
        self.creeping_since_ns = None;
        self.tool_off_since_ns = None;
    }

    /// The fault that would remain after a reset.
    pub(super) fn lasting_fault(&self, now_ns: u64) -> Option<FaultCause> {
        let mut after = self.clone();
        after.event = None;
        // The control script clears its fault when it is commanded to idle, which a reset does.
        if let Some(state) = &mut after.state {
            state.script_fault = 0;
        }
        after.fault(now_ns, false)
    }
}
