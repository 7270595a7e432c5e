//! The report of a calibration as one page.

use super::rig::Calibration;
use super::target::{Collected, Target};

/// The page.
pub fn html(_target: &Target, _collected: &Collected, k: &Calibration) -> String {
    k.verdict.text.clone()
}
