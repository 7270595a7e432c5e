//! What stops the arm in this cycle: faults, which latch, and holds, which an operator may end.

use super::{CommandCycle, Tick};
use crate::mode::{FaultCause, HoldCause, Mode};

/// Speed slider below which the arm practically does not move, as a fraction of full speed.
const MIN_SLIDER: f64 = 0.01;

impl CommandCycle {
    /// The fault that latches now, the most fundamental cause first.
    pub(super) fn fault(&self, tick: &Tick, internal: bool) -> Option<FaultCause> {
        if matches!(self.mode, Mode::Idle | Mode::Tracking | Mode::Fault(_)) {
            return None;
        }
        if internal {
            return Some(FaultCause::Internal);
        }
        if tick.back {
            return Some(FaultCause::TimeBack);
        }
        if let Some(cause) = self.arm.fault(tick.now_ns, true) {
            return Some(cause);
        }
        if tick.dt_ns >= self.config.settings.watch.stall_ns {
            return Some(FaultCause::Stalled { for_ns: tick.dt_ns });
        }
        if !self.mode.drives() {
            return None;
        }
        if self.broken_cycles > 0 {
            return Some(FaultCause::LawBroken { cycles: self.broken_cycles });
        }
        if let Some(astray_m) = self.camera_moved() {
            return Some(FaultCause::CameraMoved { astray_m });
        }
        self.vision.fault(tick.now_ns)
    }

    /// How far the set-point would lead the gripper astray because a camera moved after it was given, metres
    /// (unit-scaled); `None` if none moved.
    pub(super) fn camera_moved(&self) -> Option<f64> {
        let rig = self.vision.rig()?;
        self.setpoint_moves.filter(|then| *then != rig.moves).map(|_| rig.astray_m)
    }

    /// The cause that stops the motion now without latching.
    pub(super) fn hold(&self, missed: u32) -> Option<HoldCause> {
        let limit = self.config.settings.watch.overruns_per_s;
        if limit > 0 && missed > limit {
            return Some(HoldCause::Overruns { count: missed });
        }
        if let Some(share) = self.arm.states_missing() {
            return Some(HoldCause::StatesMissing { share });
        }
        if self.arm.slider() < MIN_SLIDER {
            return Some(HoldCause::SliderZero);
        }
        self.vision.hold()
    }
}
