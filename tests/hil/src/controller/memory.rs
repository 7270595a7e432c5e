//! What scripts may ask about earlier control steps, and small states that only scripts use.

use crate::plant::Joints;
use std::collections::VecDeque;

/// Control steps kept for `get_actual_joint_positions_history`: 2 s at 500 Hz.
const HISTORY_STEPS: usize = 1000;
/// Smallest force at the tool that counts as contact, N.
const MIN_CONTACT_N: f64 = 5.0;

/// The joint history, the contact counter, flags and the random generator of scripts.
#[derive(Clone, Debug, Default)]
pub(super) struct Memory {
    /// Measured joint positions, newest last.
    pub(super) history: VecDeque<Joints>,
    /// Control steps since contact began; 0 without contact.
    pub(super) contact_steps: u32,
    /// Flags of `set_flag`, one bit each.
    pub(super) flags: u32,
    random: u64,
}

impl Memory {
    /// Records one control step.
    pub(super) fn note(&mut self, q: &Joints, force: &[f64; 6]) {
        if self.history.len() == HISTORY_STEPS {
            self.history.pop_front();
        }
        self.history.push_back(*q);
        let touching = force.iter().take(3).map(|f| f * f).sum::<f64>().sqrt() > MIN_CONTACT_N;
        self.contact_steps = if touching { self.contact_steps.saturating_add(1) } else { 0 };
    }

    pub(super) fn random(&mut self) -> f64 {
        self.random = self.random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.random >> 11) as f64 / (1u64 << 53) as f64
    }
}
