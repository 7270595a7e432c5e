//! What scripts may ask about earlier control steps, and small states that only scripts use.

use crate::plant::Joints;
use std::collections::VecDeque;

/// Control steps kept for `get_actual_joint_positions_history`: two seconds at 500 Hz.
const HISTORY: usize = 1000;
/// A force at the tool that counts as contact, N.
const CONTACT_N: f64 = 5.0;

/// What scripts may ask about the past, and small states that only scripts know.
#[derive(Clone, Debug, Default)]
pub(super) struct Memory {
    /// Measured joint positions, newest last.
    pub(super) history: VecDeque<Joints>,
    /// Control steps since the tool touched something; 0 while it touches nothing.
    pub(super) contact_steps: u32,
    /// `set_flag`.
    pub(super) flags: u32,
    random: u64,
}

impl Memory {
    /// One control step passed.
    pub(super) fn note(&mut self, q: &Joints, force: &[f64; 6]) {
        if self.history.len() == HISTORY {
            self.history.pop_front();
        }
        self.history.push_back(*q);
        let touching = force.iter().take(3).map(|f| f * f).sum::<f64>().sqrt() > CONTACT_N;
        self.contact_steps = if touching { self.contact_steps.saturating_add(1) } else { 0 };
    }

    pub(super) fn random(&mut self) -> f64 {
        self.random = self.random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.random >> 11) as f64 / (1u64 << 53) as f64
    }
}
