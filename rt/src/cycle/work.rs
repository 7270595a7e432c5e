//! The task after convergence, with the loop closed throughout: close, turn, open, retreat.

use super::io::RequestKind;
use super::{CommandCycle, Motion};
use crate::math;
use crate::mode::{Mode, Reject};

/// One step of the task.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Task {
    /// Set the outputs, then wait for the gripper.
    Grip { close: bool },
    /// Turn about the valve's axis, rad.
    Turn(f64),
    /// Back to the standoff.
    Retreat,
}

/// The steps to come and the one in progress.
#[derive(Clone, Debug, Default)]
pub(super) struct Work {
    steps: heapless::Deque<Task, 4>,
    /// Until when the gripper is moving, ns.
    busy_until_ns: u64,
    /// Whether a leg of the task is being driven.
    moving: bool,
}

impl Work {
    pub(super) fn clear(&mut self) {
        self.steps.clear();
        self.moving = false;
    }

    /// Whether no step is queued and no leg is being driven.
    pub(super) fn idle(&self) -> bool {
        self.steps.is_empty() && !self.moving
    }
}

impl CommandCycle {
    /// Closes or opens the gripper; refused while the arm moves.
    pub(super) fn grip(&mut self, close: bool, now: u64) -> Result<(), Reject> {
        let resting =
            matches!(self.mode, Mode::Armed | Mode::Tracking) || self.mode == Mode::Converged && self.work.idle();
        if !resting {
            return Err(Reject::WrongMode);
        }
        self.set_gripper(close, now);
        Ok(())
    }

    fn set_gripper(&mut self, close: bool, now: u64) {
        let t = self.config.settings.task;
        self.outputs = if close { t.close_outputs } else { t.open_outputs };
        self.fingers.command(close, now);
        self.work.busy_until_ns = now.saturating_add(t.grip_ns);
    }

    fn may_turn(&self, angle: f64) -> Result<(), Reject> {
        let max = self.config.settings.task.max_turn_rad;
        if math::fabs(angle) <= max && angle != 0.0 { Ok(()) } else { Err(Reject::BadValue) }
    }

    /// Queues the steps of a request; refused unless the loop has converged and no step is in progress.
    pub(super) fn start_work(&mut self, kind: RequestKind, now: u64) -> Result<(), Reject> {
        if self.mode != Mode::Converged || !self.work.idle() {
            return Err(Reject::WrongMode);
        }
        let steps = match kind {
            RequestKind::Turn { angle_rad } => {
                self.may_turn(angle_rad)?;
                [Task::Grip { close: true }, Task::Turn(angle_rad)]
            }
            _ => [Task::Grip { close: false }, Task::Retreat],
        };
        for s in steps {
            // Two steps into an empty queue of four.
            let _ = self.work.steps.push_back(s);
        }
        self.continue_work(now);
        Ok(())
    }

    /// Starts the next step when the gripper has finished moving and the last leg has converged.
    pub(super) fn continue_work(&mut self, now: u64) {
        if now < self.work.busy_until_ns {
            return;
        }
        if self.work.moving {
            let needed = self.config.settings.converge.frames;
            let done = self.motion.as_ref().is_some_and(|m| m.reference.ended()) && self.convergence.steady() >= needed;
            if !done {
                return;
            }
            self.work.moving = false;
        }
        let Some(task) = self.work.steps.pop_front() else { return };
        let (Some(s), Some(m)) = (&self.setpoint, &self.motion) else { return };
        let next = match task {
            Task::Grip { close } => {
                self.set_gripper(close, now);
                return;
            }
            Task::Turn(angle) => m.turn(&self.config, s, angle),
            Task::Retreat => Some(Motion::retreat(m, &self.config, s)),
        };
        match next {
            Some(leg) => {
                self.motion = Some(leg);
                self.work.moving = true;
                self.start_leg(now);
            }
            None => self.work.clear(),
        }
    }
}
