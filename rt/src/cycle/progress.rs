//! What follows from a cycle of the law: probe, convergence, the next leg, and holds where nothing moves on.

use super::io::{Stage, Transition, Why};
use super::servo::Drive;
use super::{CommandCycle, Grip};
use crate::arm::Joints;
use crate::guard::Held;
use crate::mode::{Event, HoldCause, Mode};

impl CommandCycle {
    /// Judges probe, convergence and progress after a cycle of the law.
    pub(super) fn judge_motion(&mut self, now: u64, d: &Drive, held: Held, q: &Joints, event: &mut Option<Transition>) {
        // The law keeps its rates finite and within the caps; anything else is a defect of the program.
        if held.has(Held::NOT_FINITE) || held.has(Held::CEILING) {
            self.broken_cycles = self.broken_cycles.saturating_add(1);
        }
        let range = (&self.limits.min, &self.limits.max);
        if let Some(cause) = self.joint_end.observe(now, &d.rates, self.guard.last(), held, q, range) {
            self.apply(Event::Hold(cause), Why::Hold(cause), now, event);
            return;
        }
        if !self.new_frame {
            return;
        }
        let Some(motion) = &self.motion else { return };
        let goal = motion.reference.leg().pose(1.0);
        let left_m = motion.left_m(&self.config, &d.pose);
        let ended = motion.reference.ended();
        let stage = motion.stage;
        let s = &self.config.settings;
        if let (Some(p), Some(seen)) = (&mut self.probe, self.vision.seen())
            && let Some(cause) = p.judge(&seen.vision.left_from_gripper, &goal, &s.watch, &s.law)
        {
            self.apply(Event::Fault(cause), Why::Fault(cause), now, event);
            return;
        }
        let c = s.converge;
        let (factor, needed) =
            if stage == Stage::Pregrasp { (c.pregrasp_factor, c.pregrasp_frames) } else { (1.0, c.frames) };
        self.convergence.observe(&d.screw, ended, factor);
        if self.mode == Mode::Converged {
            if !self.convergence.within(&d.screw, c.leave_factor) && self.work.idle() {
                self.start_leg(now);
                self.apply(Event::Receded, Why::Progress, now, event);
            } else {
                self.continue_work(now);
            }
            return;
        }
        if self.convergence.steady() >= needed {
            self.next_leg(stage, now, event);
            return;
        }
        let left_m = self.convergence.note_distance(&s.law, left_m, ended, now);
        if self.convergence.stalled_ns(now) > s.watch.progress_ns {
            let cause = HoldCause::NoProgress { left_m };
            self.apply(Event::Hold(cause), Why::Hold(cause), now, event);
        }
    }

    fn next_leg(&mut self, stage: Stage, now: u64, event: &mut Option<Transition>) {
        let (Some(s), Some(m)) = (&self.setpoint, &self.motion) else { return };
        if stage == Stage::Pregrasp {
            self.motion = Some(m.to_grasp(&self.config, s));
            self.start_leg(now);
            return;
        }
        self.apply(Event::Reached, Why::Progress, now, event);
        let arrived = self.mode == Mode::Converged && stage == Stage::Grasp;
        if arrived && self.config.settings.task.close_on_arrival && self.fingers.grip() != Grip::Closed {
            // Never refused in this mode.
            let _ = self.grip(true, now);
        }
    }
}
