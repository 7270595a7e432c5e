//! One cycle of the command thread: newest robot state and images in, one set-point out.
//!
//! A cycle gathers facts (`watch_arm`, `watch_vision`), decides (`mode::step`), drives (`servo`) and passes everything through
//! the guard. It reads no clock and does no IO; the same inputs give the same outputs to the bit.

mod check;
mod grip;
mod io;
mod probe;
mod servo;
mod settings;
mod watch_arm;
mod watch_vision;
mod work;

pub use grip::{Grip, same_words};
pub use io::{
    CommandInput, CommandOutput, Counters, CycleRecord, LinkStatus, Reply, Request, RequestKind, Stage, Transition, Why,
};
pub use settings::{ConvergeSettings, CycleConfig, CycleSettings, TaskSettings, WatchSettings};

use crate::arm::{ArmCommand, ArmMode, Joints};
use crate::geom::{Pose, Twist};
use crate::guard::{Guard, Held, LimitError, Limits};
use crate::math;
use crate::mode::{Action, Event, FaultCause, HoldCause, Mode, Reject, step};
use crate::online::predict::JointHistory;
use crate::online::screw::Screw;
use crate::setpoint::SetPoint;
use grip::Fingers;
use probe::Probe;
use servo::{Drive, Motion, Pace};
use watch_arm::ArmWatch;
use watch_vision::{Taken, VisionWatch};
use work::Work;

/// The command half of the loop.
#[derive(Clone, Debug)]
pub struct CommandCycle {
    config: CycleConfig,
    limits: Limits,
    mode: Mode,
    guard: Guard,
    arm: ArmWatch,
    vision: VisionWatch,
    history: JointHistory,
    setpoint: Option<SetPoint>,
    /// How many times a camera had been found moved when the set-point was given.
    setpoint_moves: Option<u32>,
    motion: Option<Motion>,
    probe: Option<Probe>,
    work: Work,
    fingers: Fingers,
    last_ns: Option<u64>,
    /// Low-passed correction, for convergence.
    filtered: Twist,
    steady: u32,
    best_left_m: f64,
    progress_ns: u64,
    cornered_since_ns: Option<u64>,
    missed: MissedCycles,
    broken_cycles: u32,
    outputs: u32,
    cycle: i32,
    counters: Counters,
    last_drive: Option<Drive>,
    new_frame: bool,
}

/// Cycles missed in the present and the previous second.
#[derive(Clone, Copy, Debug, Default)]
struct MissedCycles {
    second: u64,
    now: u32,
    before: u32,
}

impl MissedCycles {
    fn add(&mut self, now_ns: u64, n: u32) -> u32 {
        let second = now_ns / 1_000_000_000;
        if second != self.second {
            self.before = if second == self.second + 1 { self.now } else { 0 };
            self.now = 0;
            self.second = second;
        }
        self.now = self.now.saturating_add(n);
        self.now.saturating_add(self.before)
    }
}

impl CommandCycle {
    /// A cycle at rest in [`Mode::Idle`].
    ///
    /// # Errors
    /// [`LimitError`]: a limit is outside what is compiled in.
    pub fn new(config: CycleConfig) -> Result<Self, LimitError> {
        let s = &config.settings;
        let limits = Limits::new(&s.limits, config.model, s.period_ns)?;
        Ok(Self {
            guard: Guard::new(limits),
            arm: ArmWatch::new(s.watch),
            vision: VisionWatch::new(s.watch, s.law, s.frame_period_ns),
            history: JointHistory::default(),
            limits,
            mode: Mode::Idle,
            setpoint: None,
            setpoint_moves: None,
            motion: None,
            probe: None,
            work: Work::default(),
            fingers: Fingers::new(&s.task),
            last_ns: None,
            filtered: Twist::zeros(),
            steady: 0,
            best_left_m: f64::INFINITY,
            progress_ns: 0,
            cornered_since_ns: None,
            missed: MissedCycles::default(),
            broken_cycles: 0,
            outputs: 0,
            cycle: 0,
            counters: Counters::default(),
            last_drive: None,
            new_frame: false,
            config,
        })
    }

    /// The mode now.
    pub fn mode(&self) -> &Mode {
        &self.mode
    }

    /// The limits in force.
    pub fn limits(&self) -> &Limits {
        &self.limits
    }

    /// One cycle. Bounded work: at most 64 marks projected a few times each, three 6x6 eigenvalue problems; once per accepted
    /// `servo` request, 16 short Newton iterations.
    pub fn step(&mut self, input: &CommandInput) -> CommandOutput {
        let now = input.now_ns;
        let period = self.config.settings.period_ns;
        let dt_ns = self.last_ns.map_or(period, |t| now.saturating_sub(t));
        let back = self.last_ns.is_some_and(|t| now < t);
        self.last_ns = Some(now);
        self.counters.cycles += 1;
        let missed = if dt_ns >= 2 * period { u32::try_from(dt_ns / period - 1).unwrap_or(u32::MAX) } else { 0 };
        self.counters.overruns += u64::from(missed);
        let missed_lately = self.missed.add(now, missed);

        self.gather(input);
        let mut event = None;
        let watched = !matches!(self.mode, Mode::Idle | Mode::Tracking | Mode::Fault(_));
        if matches!(self.mode, Mode::Idle | Mode::Tracking) {
            self.arm.outlive_event(now);
        }
        self.arm.note_good(now, watched);

        // Decide: faults first, then holds, then a stop, then progress, then whatever else was asked.
        if let Some(cause) = self.fault(now, dt_ns, back, input.internal_fault) {
            self.apply(Event::Fault(cause), Why::Fault(cause), now, &mut event);
        }
        if let Some(cause) = self.hold(missed_lately).filter(|_| self.mode.drives()) {
            self.apply(Event::Hold(cause), Why::Hold(cause), now, &mut event);
        }
        let reply = input.request.map(|r| Reply { id: r.id, result: self.request(r.kind, now, &mut event) });
        let setpoint_reply = input.setpoint.map(|s| self.offer(s, now, &mut event));
        let ready = self.arm.fault(now, false).is_none() && self.vision.tracking(now);
        self.apply(if ready { Event::Ready } else { Event::NotReady }, Why::Readiness, now, &mut event);

        // Drive.
        let dt_s = dt_ns.min(period) as f64 * 1e-9;
        let q = self.arm.state().map(|s| s.q);
        let jacobian = q.map(|q| self.config.dh.body_jacobian(&q, &self.config.gripper.flange_from_gripper));
        let mut wanted = [0.0; 6];
        let mut held = Held::default();
        let mut scale = 0.0;
        self.last_drive = None;
        // One step of the guard a cycle, whatever happens to the mode after it.
        let mut stepped = false;
        if let (true, Some(q), Some(jacobian)) = (self.mode.drives(), q, jacobian) {
            match self.drive(now, dt_s, &q, &jacobian) {
                Ok(drive) => {
                    let share = self.share();
                    stepped = true;
                    let guarded = self.guard.step(&drive.rates, &q, &jacobian, share, dt_s);
                    (wanted, held, scale) = (drive.rates, guarded.held, drive.scale * guarded.scale);
                    let sent = servo::screw_of(&jacobian, &guarded.rates);
                    let slider = self.arm.slider();
                    if let Some(p) = &mut self.probe {
                        p.note_sent(&sent, slider, dt_s);
                    }
                    self.last_drive = Some(drive);
                    self.after_drive(now, &drive, held, &q, &mut event);
                }
                Err(cause) => {
                    self.apply(Event::Hold(cause), Why::Hold(cause), now, &mut event);
                }
            }
        }
        if !stepped {
            self.guard.stop(dt_s);
            if matches!(self.mode, Mode::Stopping(_)) && self.guard.at_rest() {
                self.apply(Event::AtRest, Why::AtRest, now, &mut event);
                self.motion = None;
                self.probe = None;
            }
        }
        if held != Held::default() {
            self.counters.held += 1;
        }
        let command = self.command();
        self.arm.note_sent(now, &command.rates);
        let record = self.record(now, dt_ns, wanted, held, scale, command);
        CommandOutput { command, record, event, reply, setpoint_reply }
    }

    /// Takes robot state and images.
    fn gather(&mut self, input: &CommandInput) {
        let now = input.now_ns;
        if input.link.connected && !self.arm.connected() {
            // A new script acts on the first outputs that it is told: what was told to the last one is over.
            self.outputs = 0;
        }
        if self.arm.observe(now, input.robot.as_ref(), input.link) {
            self.counters.states += 1;
            if let Some(s) = self.arm.state() {
                self.history.push(s.received_ns, &s.q);
                self.fingers.see(&self.config.settings.task, s.output_levels(), now);
                let tool = s.tool.map(|t| (t, self.config.dh.tool_speed(&s.q, &s.qd, &t.offset)));
                self.arm.compare_tool(now, tool);
            }
        }
        self.new_frame = false;
        if let Some(v) = input.vision {
            // A set-point that was given before the first result holds for the rig which that one shows.
            self.setpoint_moves = self.setpoint_moves.or(Some(v.rig.moves));
            let mount = &self.config.gripper.flange_from_gripper;
            let driven = self.mode.drives();
            match self.vision.offer(now, v, &self.history, &self.config.dh, mount, driven) {
                Taken::Used => {
                    self.counters.frames += 1;
                    self.new_frame = true;
                }
                Taken::Refused => self.counters.frames_refused += 1,
            }
        }
    }

    /// What latches now, the plainest cause first.
    fn fault(&self, now: u64, dt_ns: u64, back: bool, internal: bool) -> Option<FaultCause> {
        if matches!(self.mode, Mode::Idle | Mode::Tracking | Mode::Fault(_)) {
            return None;
        }
        if internal {
            return Some(FaultCause::Internal);
        }
        if back {
            return Some(FaultCause::TimeBack);
        }
        if let Some(cause) = self.arm.fault(now, true) {
            return Some(cause);
        }
        if dt_ns >= self.config.settings.watch.stall_ns {
            return Some(FaultCause::Stalled { for_ns: dt_ns });
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
        self.vision.fault(now)
    }

    /// How far astray the set-point leads since a camera was moved after it; `None` where none was.
    fn camera_moved(&self) -> Option<f64> {
        let rig = self.vision.rig()?;
        self.setpoint_moves.filter(|then| *then != rig.moves).map(|_| rig.astray_m)
    }

    /// What holds now.
    fn hold(&self, missed_lately: u32) -> Option<HoldCause> {
        let limit = self.config.settings.watch.overruns_per_s;
        if limit > 0 && missed_lately > limit {
            return Some(HoldCause::Overruns { count: missed_lately });
        }
        if let Some(share) = self.arm.thin() {
            return Some(HoldCause::StatesMissing { share });
        }
        if self.arm.slider() < 0.01 {
            return Some(HoldCause::SliderZero);
        }
        self.vision.hold()
    }

    fn request(&mut self, kind: RequestKind, now: u64, event: &mut Option<Transition>) -> Result<(), Reject> {
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

    /// Leads the mode on, and does what the table says.
    fn apply(&mut self, e: Event, why: Why, now: u64, event: &mut Option<Transition>) -> Action {
        let (next, action) = step(self.mode, e, now);
        let (from, to) = (self.mode.name(), next.name());
        if from != to && event.is_none() {
            *event = Some(Transition { from, to, why });
        }
        self.mode = next;
        match (action, e) {
            (Action::Begin, Event::Servo(_)) => self.begin(now),
            (Action::RampDown, _) => {
                self.work.clear();
                if let Some(m) = &mut self.motion {
                    m.reference.halt();
                }
            }
            (Action::Changed, Event::Reset { .. }) => {
                self.arm.clear_events();
                self.vision.clear_events();
                self.broken_cycles = 0;
                self.motion = None;
            }
            _ => {}
        }
        action
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
        if self.arm.thin().is_some() {
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
        check::way(&self.config, &self.limits, &pose, &q, s)
    }

    /// Gripper in the rig now, and the joints.
    fn gripper_now(&self) -> Option<(Pose, Joints)> {
        let (seen, state) = (self.vision.seen()?, self.arm.state()?);
        let motion = self.config.dh.gripper_motion(&seen.q, &state.q, &self.config.gripper.flange_from_gripper);
        Some((seen.vision.left_from_gripper * motion, state.q))
    }

    /// Accepts a set-point where nothing moves.
    fn offer(&mut self, s: &SetPoint, now: u64, event: &mut Option<Transition>) -> Result<(), Reject> {
        if !matches!(self.mode, Mode::Idle | Mode::Tracking | Mode::Armed | Mode::Fault(_)) {
            return Err(Reject::Moving);
        }
        check::setpoint(&self.config, s)?;
        self.setpoint = Some(*s);
        self.setpoint_moves = self.vision.rig().map(|r| r.moves);
        // What was armed was armed for another goal.
        if matches!(self.mode, Mode::Armed) {
            self.apply(Event::Disarm, Why::Request(RequestKind::Disarm), now, event);
        }
        Ok(())
    }

    fn begin(&mut self, now: u64) {
        let (Some(s), Some((pose, _))) = (&self.setpoint, self.gripper_now()) else { return };
        self.motion = Some(Motion::to_pregrasp(&self.config, &pose, s));
        self.probe = Some(Probe::new(&pose));
        self.vision.clear_events();
        self.fresh_leg(now);
    }

    fn fresh_leg(&mut self, now: u64) {
        self.steady = 0;
        self.filtered = Twist::repeat(1.0);
        self.best_left_m = f64::INFINITY;
        self.progress_ns = now;
        self.cornered_since_ns = None;
    }

    /// Share of the speed caps in force.
    fn share(&self) -> f64 {
        let reduced = if self.arm.reduced() { self.limits.reduced_share } else { 1.0 };
        let probing = self.probe.is_some_and(|p| !p.passed());
        let probe = if probing { self.config.settings.watch.probe_share } else { 1.0 };
        reduced.min(probe)
    }

    /// The law's cycle; without an image or a way it holds.
    fn drive(
        &mut self,
        now: u64,
        dt_s: f64,
        q: &Joints,
        jacobian: &nalgebra::Matrix6<f64>,
    ) -> Result<Drive, HoldCause> {
        let share = self.share();
        let pace = Pace {
            dt_s,
            scale: self.vision.scale(now),
            share,
            slider: self.arm.slider(),
            tcp_cap: self.limits.tcp_speed * 0.9,
            velocity: self.limits.velocity,
        };
        let best = self.setpoint.map_or(crate::geom::View::Left, |s| s.best_view);
        let (Some(seen), Some(motion)) = (self.vision.seen(), &mut self.motion) else {
            return Err(HoldCause::MarksLost);
        };
        motion.drive(&self.config, seen, q, jacobian, pace, best)
    }

    /// Judges probe, convergence and progress after a cycle of the law.
    fn after_drive(&mut self, now: u64, d: &Drive, held: Held, q: &Joints, event: &mut Option<Transition>) {
        // The law scales its own rates to the caps, so either of these is a defect of ours.
        if held.has(Held::NOT_FINITE) || held.has(Held::CEILING) {
            self.broken_cycles = self.broken_cycles.saturating_add(1);
        }
        if let Some(cause) = self.cornered(now, d, held, q) {
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
        if let (Some(p), Some(seen)) = (&mut self.probe, self.vision.seen()) {
            let s = &self.config.settings;
            if let Some(cause) = p.judge(&seen.vision.left_from_gripper, &goal, &s.watch, &s.law) {
                self.apply(Event::Fault(cause), Why::Fault(cause), now, event);
                return;
            }
        }
        self.filtered =
            if self.filtered[0] == 1.0 { d.screw.correction } else { self.filtered * 0.7 + d.screw.correction * 0.3 };
        let c = self.config.settings.converge;
        let coarse = if stage == Stage::Pregrasp { c.pregrasp_factor } else { 1.0 };
        let near = |f: f64| self.within(&d.screw, f);
        let (on_goal, gone) = (near(coarse), !near(c.leave_factor));
        self.steady = if ended && on_goal { self.steady + 1 } else { 0 };
        if self.mode == Mode::Converged {
            if gone && self.work.idle() {
                self.fresh_leg(now);
                self.apply(Event::Receded, Why::Progress, now, event);
            } else {
                self.continue_work(now);
            }
            return;
        }
        let needed = if stage == Stage::Pregrasp { c.pregrasp_frames } else { c.frames };
        if self.steady >= needed {
            self.next_leg(stage, now, event);
            return;
        }
        // The reference's own way counts as progress, and so does a probe.
        let left_m = left_m.min(self.config.settings.law.size(&self.filtered) + if ended { 0.0 } else { left_m });
        if left_m < self.best_left_m - 2e-4 {
            self.best_left_m = left_m;
            self.progress_ns = now;
        }
        if now.saturating_sub(self.progress_ns) > self.config.settings.watch.progress_ns {
            let cause = HoldCause::NoProgress { left_m };
            self.apply(Event::Hold(cause), Why::Hold(cause), now, event);
        }
    }

    /// Whether the filtered correction is within `factor` times the tolerance.
    ///
    /// The tolerance is never finer than what the marks' own noise allows (one view resolves depth ten times worse than two),
    /// up to a stated coarseness; noisier marks never converge, and say so.
    fn within(&self, screw: &Screw, factor: f64) -> bool {
        let c = &self.config.settings.converge;
        // The low pass leaves 0.42 of the noise; one and a half of the raw deviation is passed by it nearly always.
        let open = |tolerance: f64, sigma: f64| (1.5 * sigma).clamp(tolerance, tolerance * c.noise_factor) * factor;
        self.filtered.fixed_rows::<3>(0).norm() <= open(c.position_m, screw.sigma_m)
            && self.filtered.fixed_rows::<3>(3).norm() <= open(c.angle_rad, screw.sigma_rad)
            && screw.error_px <= c.error_px * factor.max(1.0)
    }

    /// Whether a joint's end has kept the motion standing for half a second.
    fn cornered(&mut self, now: u64, d: &Drive, held: Held, q: &Joints) -> Option<HoldCause> {
        let wants = d.rates.iter().any(|v| math::fabs(*v) > 1e-3);
        let stands = self.guard.last().iter().all(|v| math::fabs(*v) < 5e-4);
        if !(held.has(Held::POSITION) && wants && stands) {
            self.cornered_since_ns = None;
            return None;
        }
        let since = *self.cornered_since_ns.get_or_insert(now);
        if now.saturating_sub(since) < 500_000_000 {
            return None;
        }
        let room = |i: usize| (self.limits.max[i] - q[i]).min(q[i] - self.limits.min[i]);
        let joint = (0..6).fold(0, |m, i| if room(i) < room(m) { i } else { m });
        Some(HoldCause::JointEnd { joint: joint as u8, position: q[joint] })
    }

    fn next_leg(&mut self, stage: Stage, now: u64, event: &mut Option<Transition>) {
        let (Some(s), Some(m)) = (&self.setpoint, &self.motion) else { return };
        if stage == Stage::Pregrasp {
            self.motion = Some(m.to_grasp(&self.config, s));
            self.fresh_leg(now);
        } else {
            self.apply(Event::Reached, Why::Progress, now, event);
            let arrived = self.mode == Mode::Converged && stage == Stage::Grasp;
            if arrived && self.config.settings.task.close_on_arrival && self.fingers.grip() != Grip::Closed {
                // The mode is the one in which this is never refused.
                let _ = self.grip(true, now);
            }
        }
    }

    fn command(&mut self) -> ArmCommand {
        self.cycle = self.cycle.wrapping_add(1);
        let mode = match self.mode {
            Mode::Servoing | Mode::Converged => ArmMode::Velocity,
            Mode::Stopping(_) => ArmMode::Velocity,
            // A fault is reached at rest, and is latched here. The control script must be able to leave its own: it ends one, and
            // a fresh one begins, with idle alone; asked for anything else no reset would ever find the cause gone.
            Mode::Idle | Mode::Tracking | Mode::Armed | Mode::Fault(_) => ArmMode::Idle,
        };
        let rates = if mode == ArmMode::Velocity { *self.guard.last() } else { [0.0; 6] };
        ArmCommand { mode, rates, heartbeat: self.cycle, outputs: self.outputs }
    }

    fn record(&self, now: u64, dt_ns: u64, wanted: Joints, held: Held, scale: f64, command: ArmCommand) -> CycleRecord {
        let state = self.arm.state();
        let d = self.last_drive.as_ref();
        let pose = d.map(|d| d.pose).or_else(|| self.gripper_now().map(|(p, _)| p));
        CycleRecord {
            now_ns: now,
            dt_ns,
            mode: self.mode.name(),
            lasting: match self.mode {
                Mode::Fault(_) => self.arm.lasting_fault(now),
                Mode::Idle | Mode::Tracking | Mode::Armed => self.arm.fault(now, false),
                Mode::Servoing | Mode::Converged | Mode::Stopping(_) => None,
            },
            stage: self.motion.as_ref().map_or(Stage::Pregrasp, |m| m.stage),
            probing: self.probe.is_some_and(|p| !p.passed()),
            progress: self.motion.as_ref().map_or(0.0, |m| m.reference.progress()),
            vision_sequence: self.vision.seen().map_or(0, |s| s.vision.sequence),
            vision_age_ns: self.vision.age_ns(now),
            state_age_ns: self.arm.age_ns(now),
            q: state.map_or([0.0; 6], |s| s.q),
            qd: state.map_or([0.0; 6], |s| s.qd),
            left_from_gripper: pose,
            grip: self.fingers.grip(),
            reference: self.motion.as_ref().map_or_else(Pose::identity, |m| m.reference.pose()),
            error_px: d.map_or(f64::NAN, |d| d.screw.error_px),
            residual_px: d.map_or(f64::NAN, |d| d.screw.residual_px),
            correction: d.map_or_else(Twist::zeros, |d| d.screw.correction),
            screw: d.map_or_else(Twist::zeros, |d| d.xi),
            wanted,
            command,
            held,
            scale,
            mark_sigma: d.map_or(f64::NAN, |d| d.screw.sigma_min),
            mark_condition: d.map_or(f64::NAN, |d| d.screw.condition),
            arm_sigma: d.map_or(f64::NAN, |d| d.arm_sigma),
            arm_joint: d.map_or(0, |d| d.arm_joint),
            counters: self.counters,
            setpoint_id: self.setpoint.map_or(0, |s| s.id),
        }
    }
}
