//! Detects a motion that a joint's range has stopped for good.

use crate::arm::Joints;
use crate::guard::Held;
use crate::math;
use crate::mode::HoldCause;

/// How long the motion must have been stopped, ns: several reaction times of the arm.
const STOPPED_NS: u64 = 500_000_000;
/// Rate above which the law asks for motion, rad/s.
const MIN_WANTED_RAD_PER_S: f64 = 1e-3;
/// Rate below which a sent rate is rest, rad/s: half of the rate that counts as a request.
const MAX_REST_RAD_PER_S: f64 = 5e-4;

/// Since when the law has asked for motion that the guard stops at a joint's end.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct JointEndStop {
    since_ns: Option<u64>,
}

impl JointEndStop {
    /// Starts a new leg.
    pub(super) fn restart(&mut self) {
        self.since_ns = None;
    }

    /// Takes one cycle: the rates that the law asks for and those that the guard lets through (rad/s), what held them
    /// back, joint positions and their ranges (rad). Returns the joint closest to its end once the motion has been
    /// stopped for half a second.
    pub(super) fn observe(
        &mut self,
        now_ns: u64,
        wanted: &Joints,
        sent: &Joints,
        held: Held,
        q: &Joints,
        (min, max): (&Joints, &Joints),
    ) -> Option<HoldCause> {
        let asked = wanted.iter().any(|v| math::fabs(*v) > MIN_WANTED_RAD_PER_S);
        let resting = sent.iter().all(|v| math::fabs(*v) < MAX_REST_RAD_PER_S);
        if !(held.has(Held::POSITION) && asked && resting) {
            self.since_ns = None;
            return None;
        }
        let since = *self.since_ns.get_or_insert(now_ns);
        if now_ns.saturating_sub(since) < STOPPED_NS {
            return None;
        }
        let room = |i: usize| (max[i] - q[i]).min(q[i] - min[i]);
        let joint = (0..6).fold(0, |m, i| if room(i) < room(m) { i } else { m });
        Some(HoldCause::JointEnd { joint: joint as u8, position: q[joint] })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RANGE: (&Joints, &Joints) = (&[-1.0; 6], &[1.0; 6]);
    const Q: Joints = [0.0, 0.5, 0.99, 0.0, 0.0, 0.0];

    #[test]
    fn a_motion_stopped_for_half_a_second_names_the_joint() {
        let mut s = JointEndStop::default();
        let mut at = |now_ns| s.observe(now_ns, &[0.1; 6], &[0.0; 6], Held::POSITION, &Q, RANGE);
        assert_eq!(at(0), None);
        assert_eq!(at(STOPPED_NS - 1), None);
        assert_eq!(at(STOPPED_NS), Some(HoldCause::JointEnd { joint: 2, position: 0.99 }));
    }

    #[test]
    fn motion_no_request_or_another_limit_starts_over() {
        for (wanted, sent, held) in
            [(0.1, 0.001, Held::POSITION), (1e-4, 0.0, Held::POSITION), (0.1, 0.0, Held::ACCELERATION)]
        {
            let mut s = JointEndStop::default();
            s.observe(0, &[0.1; 6], &[0.0; 6], Held::POSITION, &Q, RANGE);
            assert_eq!(s.observe(1, &[wanted; 6], &[sent; 6], held, &Q, RANGE), None);
            assert_eq!(s.observe(STOPPED_NS, &[0.1; 6], &[0.0; 6], Held::POSITION, &Q, RANGE), None);
        }
    }

    #[test]
    fn a_new_leg_starts_over() {
        let mut s = JointEndStop::default();
        s.observe(0, &[0.1; 6], &[0.0; 6], Held::POSITION, &Q, RANGE);
        s.restart();
        assert_eq!(s.observe(STOPPED_NS, &[0.1; 6], &[0.0; 6], Held::POSITION, &Q, RANGE), None);
    }
}
