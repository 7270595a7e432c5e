//! Operator requests and offered set-points: which of them are granted, and why not.

use super::io::{RequestKind, Transition, Why};
use super::{CommandCycle, check};
use crate::mode::{Action, Event, HoldCause, Mode, Reject};
use crate::setpoint::SetPoint;

impl CommandCycle {
    /// Grants or refuses a request.
    pub(super) fn request(
        &mut self,
        kind: RequestKind,
        now: u64,
        event: &mut Option<Transition>,
    ) -> Result<(), Reject> {
        let e = match kind {
            RequestKind::Arm => Event::Arm(self.may_arm(now)),
            RequestKind::Disarm => Event::Disarm,
            RequestKind::Servo => Event::Servo(self.may_servo(now)),
            RequestKind::Stop => Event::Stop,
            RequestKind::Reset => Event::Reset { cause_gone: self.arm.lasting_fault(now).is_none() },
            RequestKind::LeaseLost => Event::Hold(HoldCause::LeaseLost),
            RequestKind::Gripper { close } => return self.grip(close, now),
            RequestKind::Turn { .. } | RequestKind::Retreat => return self.start_work(kind, now),
        };
        match self.apply(e, Why::Request(kind), now, event) {
            Action::Refuse(reject) => Err(reject),
            _ => Ok(()),
        }
    }

    fn may_arm(&self, now: u64) -> Result<(), Reject> {
        if self.arm.fault(now, false).is_some() {
            return Err(Reject::RobotNotReady);
        }
        if !self.vision.tracking(now) {
            return Err(Reject::NoMarks);
        }
        if self.setpoint.is_none() {
            return Err(Reject::NoSetPoint);
        }
        if self.camera_moved().is_some() {
            return Err(Reject::CameraMoved);
        }
        if self.vision.one_view() { Err(Reject::OneView) } else { Ok(()) }
    }

    fn may_servo(&self, now: u64) -> Result<(), Reject> {
        if !matches!(self.mode, Mode::Armed) {
            return Err(Reject::WrongMode);
        }
        self.may_arm(now)?;
        if self.fingers.may_hold() {
            return Err(Reject::GripperClosed);
        }
        if self.arm.states_missing().is_some() {
            return Err(Reject::StatesMissing);
        }
        if self.vision.rig().is_some_and(|r| r.suspicious) {
            return Err(Reject::Settling);
        }
        let good = self.config.settings.watch.good_ns;
        let (arm, vision) = (self.arm.good_for_ns(now), self.vision.good_for_ns(now));
        if arm.is_none_or(|t| t < good) || vision.is_none_or(|t| t < good) {
            return Err(Reject::Settling);
        }
        let (Some(s), Some((pose, q))) = (&self.setpoint, self.gripper_now()) else { return Err(Reject::NoMarks) };
        check::path(&self.config, &self.limits, &pose, &q, s)
    }

    /// Takes a set-point over; refused while the arm moves.
    pub(super) fn offer(&mut self, s: &SetPoint, now: u64, event: &mut Option<Transition>) -> Result<(), Reject> {
        if !matches!(self.mode, Mode::Idle | Mode::Tracking | Mode::Armed | Mode::Fault(_)) {
            return Err(Reject::Moving);
        }
        check::setpoint(&self.config, s)?;
        self.setpoint = Some(*s);
        self.setpoint_moves = self.vision.rig().map(|r| r.moves);
        // The operator armed for the old goal.
        if matches!(self.mode, Mode::Armed) {
            self.apply(Event::Disarm, Why::Request(RequestKind::Disarm), now, event);
        }
        Ok(())
    }
}
