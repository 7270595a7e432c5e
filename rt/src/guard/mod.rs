//! The last stage before the wire: every joint rate that is sent comes out of [`Guard::step`] or [`Guard::stop`].
//!
//! The guard does not trust the code that computed the rates. Whatever comes in, including NaN and infinite values,
//! what goes out is finite and within the limits of joint speed, joint acceleration and gripper speed, and the arm can
//! always stop before the end of every joint's range. Limits are kept by slowing all joints together, never by clipping
//! single joints, so that the direction of the motion is preserved.
//!
//! Why the arm can always stop: the *stop ramp* scales all rates together to zero at the acceleration limit. A step
//! towards the requested rates is taken only if the stop ramp from there ends inside the joints' ranges; otherwise the
//! step is that of the stop ramp. A ramp that was possible at the last step is possible now, so by induction there is
//! always one. A mean over the last steps bounds the jerk; the mean of vectors within a convex limit is within that
//! limit.

mod limits;

pub use limits::{LimitError, LimitSettings, Limits, MAX_FILTER, StopFigures, ceiling, stop_bound};

use crate::arm::Joints;
use crate::math;
use nalgebra::{Matrix6, Vector6};

/// Limits that held a motion back in one step, as bits.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Held(pub u16);

impl Held {
    /// The requested rates were above a joint's speed cap.
    pub const VELOCITY: Held = Held(1);
    /// The requested rates were above the gripper's speed cap.
    pub const TCP: Held = Held(2);
    /// A joint is close to the end of its range.
    pub const POSITION: Held = Held(4);
    /// The change of rates was above the acceleration limit.
    pub const ACCELERATION: Held = Held(8);
    /// The requested rates were not finite; the step was one of the stop ramp.
    pub const NOT_FINITE: Held = Held(16);
    /// No step towards the requested rates was safe; the step was one of the stop ramp.
    pub const FALLBACK: Held = Held(32);
    /// The requested rates were above a compiled ceiling.
    pub const CEILING: Held = Held(64);

    /// Whether all bits of `other` are set.
    pub const fn has(self, other: Held) -> bool {
        self.0 & other.0 == other.0
    }

    fn add(&mut self, other: Held) {
        self.0 |= other.0;
    }
}

/// Rates to send, and the limits that held them back.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Guarded {
    /// Joint rates for the wire, rad/s.
    pub rates: Joints,
    /// Limits that held the motion back.
    pub held: Held,
    /// Fraction of the requested speed that was possible, 0 to 1.
    pub scale: f64,
}

/// The last stage before the wire; the module documentation states what it guarantees.
#[derive(Clone, Debug)]
pub struct Guard {
    limits: Limits,
    /// Rates within all limits, before the mean.
    raw: Joints,
    /// The rates sent last.
    out: Joints,
    ring: [Joints; MAX_FILTER],
    at: usize,
    stopping: bool,
}

/// Fraction of the gripper's speed cap that a step aims at. The rest is for the change of the Jacobian within one
/// length of the filter.
const TCP_AIM: f64 = 0.95;
/// Fraction of the room to a joint's end within which a motion must be able to stop, so that it slows down before the
/// stop ramp has to take over.
const POSITION_AIM: f64 = 0.8;

impl Guard {
    /// A guard at rest.
    pub fn new(limits: Limits) -> Self {
        Self { limits, raw: [0.0; 6], out: [0.0; 6], ring: [[0.0; 6]; MAX_FILTER], at: 0, stopping: false }
    }

    /// The limits in force.
    pub fn limits(&self) -> &Limits {
        &self.limits
    }

    /// The rates sent last, rad/s.
    pub fn last(&self) -> &Joints {
        &self.out
    }

    /// Whether the rates sent last are zero.
    pub fn at_rest(&self) -> bool {
        self.out == [0.0; 6]
    }

    /// One step towards the rates `wanted` (rad/s).
    ///
    /// `q` are the measured joint positions (rad) and `jacobian` the gripper's body Jacobian there. `share` (0 to 1)
    /// lowers the speed caps (reduced mode, probe). `dt_s` is the time since the last step, seconds; more than one
    /// period counts as one.
    pub fn step(&mut self, wanted: &Joints, q: &Joints, jacobian: &Matrix6<f64>, share: f64, dt_s: f64) -> Guarded {
        self.stopping = false;
        let dt = self.usable(dt_s);
        let mut held = Held::default();
        let share = if share.is_finite() { share.clamp(0.0, 1.0) } else { 0.0 };
        let known = q.iter().chain(jacobian.iter()).all(|v| v.is_finite());
        if !known || wanted.iter().any(|v| !v.is_finite()) {
            held.add(Held::NOT_FINITE);
            self.raw = ramp(&self.raw, self.limits.acceleration * dt);
            return Guarded { rates: self.emit(dt), held, scale: 0.0 };
        }
        let scale = self.possible(wanted, q, jacobian, share, &mut held);
        let target: Joints = core::array::from_fn(|i| wanted[i] * scale);
        let step = self.limits.acceleration * dt;
        let change = (0..6).fold(0.0_f64, |m, i| m.max(math::fabs(target[i] - self.raw[i])));
        let k = if change > step {
            held.add(Held::ACCELERATION);
            step / change
        } else {
            1.0
        };
        let candidate: Joints =
            core::array::from_fn(|i| if k < 1.0 { self.raw[i] + k * (target[i] - self.raw[i]) } else { target[i] });
        self.raw = if self.can_stop(&candidate, q) && self.tcp(&candidate, jacobian) <= self.limits.tcp_speed * TCP_AIM
        {
            candidate
        } else {
            held.add(Held::FALLBACK);
            ramp(&self.raw, step)
        };
        Guarded { rates: self.emit(dt), held, scale }
    }

    /// One step of the stop ramp from the rates sent last: all rates shrink together at the acceleration limit, and
    /// rest is reached within [`Limits::ramp_ns`].
    ///
    /// The first step starts from the rates on the wire, not from the input of the jerk filter, so that an accelerating
    /// arm slows down immediately. That one step may exceed the jerk limit.
    pub fn stop(&mut self, dt_s: f64) -> Guarded {
        let dt = self.usable(dt_s);
        if !self.stopping {
            self.stopping = true;
            self.raw = self.out;
            self.ring = [self.out; MAX_FILTER];
        }
        self.raw = ramp(&self.raw, self.limits.acceleration * dt);
        Guarded { rates: self.emit(dt), held: Held::default(), scale: 0.0 }
    }

    fn usable(&self, dt_s: f64) -> f64 {
        if dt_s.is_finite() { dt_s.clamp(0.0, self.limits.period_s) } else { 0.0 }
    }

    /// Largest fraction of `wanted` (at most 1) within the speed caps from which the arm can stop before the joints'
    /// ends.
    fn possible(&self, wanted: &Joints, q: &Joints, jacobian: &Matrix6<f64>, share: f64, held: &mut Held) -> f64 {
        let l = &self.limits;
        let mut scale = 1.0_f64;
        let mut fastest = 0.0_f64;
        for (v, cap) in wanted.iter().zip(l.velocity) {
            let speed = math::fabs(*v);
            fastest = fastest.max(speed);
            let cap = cap * share;
            if speed * scale > cap {
                scale = cap / speed;
                held.add(Held::VELOCITY);
            }
            if speed > ceiling::VELOCITY {
                held.add(Held::CEILING);
            }
        }
        let tcp = self.tcp(wanted, jacobian);
        let cap = l.tcp_speed * share * TCP_AIM;
        if tcp * scale > cap {
            scale = cap / tcp;
            held.add(Held::TCP);
        }
        for (i, &v) in wanted.iter().enumerate() {
            if v == 0.0 {
                continue;
            }
            let room = if v > 0.0 { l.max[i] - q[i] } else { q[i] - l.min[i] } * POSITION_AIM;
            if !room.is_finite() {
                continue;
            }
            // With the fraction s, the ramp travels s² v f / 2A + s v dead (f: fastest joint), at most the room.
            let speed = math::fabs(v);
            let a = speed * fastest / (2.0 * l.acceleration);
            let b = speed * self.dead_s();
            let s = if room <= 0.0 { 0.0 } else { 2.0 * room / (b + math::sqrt(b * b + 4.0 * a * room)) };
            if s < scale {
                scale = s;
                held.add(Held::POSITION);
            }
        }
        if scale.is_finite() { scale.clamp(0.0, 1.0) } else { 0.0 }
    }

    /// Time at full speed before a stop takes effect, seconds: the arm's reaction, a cycle each way, the delay of the
    /// filter.
    fn dead_s(&self) -> f64 {
        self.limits.reaction_s + self.limits.period_s * (2.0 + 0.5 * self.limits.filter as f64)
    }

    /// Whether a stop ramp from `rates` at `q` ends inside every joint's range. Motion away from an end is always
    /// allowed.
    fn can_stop(&self, rates: &Joints, q: &Joints) -> bool {
        let fastest = rates.iter().fold(0.0_f64, |m, v| m.max(math::fabs(*v)));
        let seconds = fastest / (2.0 * self.limits.acceleration) + self.dead_s();
        (0..6).all(|i| {
            let end = q[i] + rates[i] * seconds;
            (rates[i] <= 0.0 || end <= self.limits.max[i]) && (rates[i] >= 0.0 || end >= self.limits.min[i])
        })
    }

    fn tcp(&self, rates: &Joints, jacobian: &Matrix6<f64>) -> f64 {
        let xi = jacobian * Vector6::from_column_slice(rates);
        math::sqrt(xi[0] * xi[0] + xi[1] * xi[1] + xi[2] * xi[2])
    }

    /// Filters: the mean over the last steps, its change bounded by the acceleration limit times `dt`.
    fn emit(&mut self, dt: f64) -> Joints {
        let n = self.limits.filter.clamp(1, MAX_FILTER);
        self.at = (self.at + 1) % n;
        self.ring[self.at] = self.raw;
        let mean: Joints = if self.ring[..n].iter().all(|r| *r == self.raw) {
            self.raw
        } else {
            core::array::from_fn(|i| self.ring[..n].iter().map(|r| r[i]).sum::<f64>() / n as f64)
        };
        let change = (0..6).fold(0.0_f64, |m, i| m.max(math::fabs(mean[i] - self.out[i])));
        let step = self.limits.acceleration * dt;
        if change <= step {
            self.out = mean;
        } else {
            let k = step / change;
            self.out = core::array::from_fn(|i| self.out[i] + k * (mean[i] - self.out[i]));
        }
        self.out
    }
}

/// `rates` scaled so that the fastest is `step` closer to zero; zero when that would cross it.
fn ramp(rates: &Joints, step: f64) -> Joints {
    let fastest = rates.iter().fold(0.0_f64, |m, v| m.max(math::fabs(*v)));
    if !(fastest > step) {
        // No time has passed: the rates stay.
        return if step > 0.0 { [0.0; 6] } else { *rates };
    }
    let k = 1.0 - step / fastest;
    core::array::from_fn(|i| rates[i] * k)
}
