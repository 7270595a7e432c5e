//! One cycle of the command thread: newest robot state and vision result in, one set-point out.
//!
//! [`CommandCycle::step`] gathers, decides, moves, and records. It reads no clock and does no IO; the same inputs give
//! the same outputs to the bit. In reading order:
//!
//! | file | content |
//! |---|---|
//! | `io` | [`CommandInput`], [`CommandOutput`], and the values in them |
//! | `settings` | every setting, with its default and its reason |
//! | `watch_arm`, `watch_vision` | gather: what is known of the robot and of the images, and what is wrong with them |
//! | `stops`, `requests`, `check` | decide: faults and holds, then the operator's requests |
//! | `servo` | move: the law, from marks to joint rates |
//! | `progress`, `probe`, `convergence`, `joint_end`, `missed` | judge the motion |
//! | `work`, `grip` | what follows convergence: close, turn, open, retreat |
//! | `record` | what is sent and recorded |
//!
//! Every rate that is sent comes out of [`Guard::step`] or [`Guard::stop`]; [`CommandCycle::step`] is their only
//! caller.

mod check;
mod convergence;
mod grip;
mod io;
mod joint_end;
mod missed;
mod probe;
mod progress;
mod record;
mod requests;
mod servo;
mod settings;
mod stops;
mod watch_arm;
mod watch_vision;
mod work;

pub use grip::{Grip, same_words};
pub use io::{
    CommandInput, CommandOutput, CommandRequest, Counters, CycleRecord, LinkStatus, Reply, RequestKind, Stage,
    Transition, Why,
};
pub use settings::{ConvergeSettings, CycleConfig, CycleSettings, TaskSettings, WatchSettings};

use crate::arm::Joints;
use crate::guard::{Guard, Held, LimitError, Limits};
use crate::mode::{Action, Event, HoldCause, Mode, step};
use crate::online::predict::JointHistory;
use crate::setpoint::SetPoint;
use convergence::Convergence;
use grip::Fingers;
use joint_end::JointEndStop;
use missed::MissedCycles;
use nalgebra::Matrix6;
use probe::Probe;
use servo::{Drive, Motion, Pace};
use watch_arm::ArmWatch;
use watch_vision::{Taken, VisionWatch};
use work::Work;

/// Fraction of the gripper's speed cap that the law aims at: below the guard's own 0.95, so that the guard, which keeps
/// the cap, rarely has to slow the motion.
const TCP_AIM: f64 = 0.9;

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
    /// Number of camera moves that had been detected when the set-point was given.
    setpoint_moves: Option<u32>,
    motion: Option<Motion>,
    probe: Option<Probe>,
    convergence: Convergence,
    joint_end: JointEndStop,
    work: Work,
    fingers: Fingers,
    last_ns: Option<u64>,
    missed: MissedCycles,
    /// Cycles in which the law's rates were unusable.
    broken_cycles: u32,
    /// Output bits to set, as in [`crate::arm::ArmCommand::outputs`].
    outputs: u32,
    heartbeat: i32,
    counters: Counters,
    last_drive: Option<Drive>,
    /// Whether this cycle brought a usable vision result.
    new_frame: bool,
}

/// Time of a cycle.
#[derive(Clone, Copy, Debug)]
struct Tick {
    now_ns: u64,
    /// Time since the last cycle, ns.
    dt_ns: u64,
    /// The same in seconds, at most one period.
    dt_s: f64,
    /// Whether time went back.
    back: bool,
    /// Cycles missed in the last one to two seconds.
    missed: u32,
}

/// What the law asked for in a cycle, and what the guard made of it.
#[derive(Clone, Copy, Debug, Default)]
struct Moved {
    /// Joint rates before the guard, rad/s.
    wanted: Joints,
    held: Held,
    /// Fraction of the full speed, 0 to 1.
    scale: f64,
}

impl CommandCycle {
    /// A cycle at rest in [`Mode::Idle`].
    ///
    /// # Errors
    /// [`LimitError`]: a limit is above its compiled ceiling, or a stop from full speed would take too long or go too
    /// far.
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
            convergence: Convergence::new(s.converge),
            joint_end: JointEndStop::default(),
            work: Work::default(),
            fingers: Fingers::new(&s.task),
            last_ns: None,
            missed: MissedCycles::default(),
            broken_cycles: 0,
            outputs: 0,
            heartbeat: 0,
            counters: Counters::default(),
            last_drive: None,
            new_frame: false,
            config,
        })
    }

    /// The current mode.
    pub fn mode(&self) -> &Mode {
        &self.mode
    }

    /// The limits in force.
    pub fn limits(&self) -> &Limits {
        &self.limits
    }

    /// Runs one cycle: the only function of graspd whose result may set the arm in motion.
    ///
    /// Bounded work: at most 64 marks projected a few times each, three 6x6 eigenvalue problems; once per accepted
    /// `servo` request, 16 short Newton iterations.
    pub fn step(&mut self, input: &CommandInput) -> CommandOutput {
        let tick = self.tick(input.now_ns);
        let now = tick.now_ns;
        self.gather(input);
        let mut event = None;
        // Faults first, then holds, then the operator's request, then readiness.
        if let Some(cause) = self.fault(&tick, input.internal_fault) {
            self.apply(Event::Fault(cause), Why::Fault(cause), now, &mut event);
        }
        if let Some(cause) = self.hold(tick.missed).filter(|_| self.mode.drives()) {
            self.apply(Event::Hold(cause), Why::Hold(cause), now, &mut event);
        }
        let reply = input.request.map(|r| Reply { id: r.id, result: self.request(r.kind, now, &mut event) });
        let setpoint_reply = input.setpoint.map(|s| self.offer(s, now, &mut event));
        let ready = self.arm.fault(now, false).is_none() && self.vision.tracking(now);
        self.apply(if ready { Event::Ready } else { Event::NotReady }, Why::Readiness, now, &mut event);

        let moved = self.move_arm(&tick, &mut event);
        if moved.held != Held::default() {
            self.counters.held += 1;
        }
        let command = self.command();
        self.arm.note_sent(now, &command.rates);
        let record = self.record(&tick, &moved, command);
        CommandOutput { command, record, event, reply, setpoint_reply }
    }

    fn tick(&mut self, now_ns: u64) -> Tick {
        let period = self.config.settings.period_ns;
        let dt_ns = self.last_ns.map_or(period, |t| now_ns.saturating_sub(t));
        let back = self.last_ns.is_some_and(|t| now_ns < t);
        self.last_ns = Some(now_ns);
        self.counters.cycles += 1;
        let missed = if dt_ns >= 2 * period { u32::try_from(dt_ns / period - 1).unwrap_or(u32::MAX) } else { 0 };
        self.counters.overruns += u64::from(missed);
        let missed = self.missed.add(now_ns, missed);
        Tick { now_ns, dt_ns, dt_s: dt_ns.min(period) as f64 * 1e-9, back, missed }
    }

    /// Takes robot state and vision result.
    fn gather(&mut self, input: &CommandInput) {
        let now = input.now_ns;
        if input.link.connected && !self.arm.connected() {
            // A new script acts on the first outputs that it receives, so those of the last session must not be
            // repeated.
            self.outputs = 0;
        }
        if self.arm.observe(now, input.robot.as_ref(), input.link) {
            self.counters.states += 1;
            if let Some(s) = self.arm.state() {
                self.history.push(s.received_ns, &s.q);
                self.fingers.observe(&self.config.settings.task, s.output_levels(), now);
                let tool = s.tool.map(|t| (t, self.config.dh.tool_speed(&s.q, &s.qd, &t.offset)));
                self.arm.compare_tool(now, tool);
            }
        }
        self.new_frame = false;
        if let Some(v) = input.vision {
            // A set-point given before the first result belongs to the rig that this result shows.
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
        if matches!(self.mode, Mode::Idle | Mode::Tracking) {
            self.arm.outlive_event(now);
        }
        let watched = !matches!(self.mode, Mode::Idle | Mode::Tracking | Mode::Fault(_));
        self.arm.note_good(now, watched);
    }

    /// Advances the mode by an event and carries out the action.
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

    fn begin(&mut self, now: u64) {
        let (Some(s), Some((pose, _))) = (&self.setpoint, self.gripper_now()) else { return };
        self.motion = Some(Motion::to_pregrasp(&self.config, &pose, s));
        self.probe = Some(Probe::new(&pose));
        self.vision.clear_events();
        self.start_leg(now);
    }

    fn start_leg(&mut self, now: u64) {
        self.convergence.restart(now);
        self.joint_end.restart();
    }

    /// One step of the guard: towards the law's rates where the mode drives the arm, else of the stop ramp.
    fn move_arm(&mut self, tick: &Tick, event: &mut Option<Transition>) -> Moved {
        let now = tick.now_ns;
        self.last_drive = None;
        let q = self.arm.state().map(|s| s.q).filter(|_| self.mode.drives());
        if let Some(q) = q {
            let jacobian = self.config.dh.body_jacobian(&q, &self.config.gripper.flange_from_gripper);
            match self.drive(tick, &q, &jacobian) {
                Ok(drive) => {
                    let guarded = self.guard.step(&drive.rates, &q, &jacobian, self.speed_fraction(), tick.dt_s);
                    let sent = servo::screw_of(&jacobian, &guarded.rates);
                    let slider = self.arm.slider();
                    if let Some(p) = &mut self.probe {
                        p.note_sent(&sent, slider, tick.dt_s);
                    }
                    self.last_drive = Some(drive);
                    // Whatever this does to the mode, the guard has taken its one step of this cycle.
                    self.judge_motion(now, &drive, guarded.held, &q, event);
                    return Moved { wanted: drive.rates, held: guarded.held, scale: drive.scale * guarded.scale };
                }
                Err(cause) => {
                    self.apply(Event::Hold(cause), Why::Hold(cause), now, event);
                }
            }
        }
        self.guard.stop(tick.dt_s);
        if matches!(self.mode, Mode::Stopping(_)) && self.guard.at_rest() {
            self.apply(Event::AtRest, Why::AtRest, now, event);
            self.motion = None;
            self.probe = None;
        }
        Moved::default()
    }

    /// Fraction of the speed caps in force: reduced mode and probe.
    fn speed_fraction(&self) -> f64 {
        let reduced = if self.arm.reduced() { self.limits.reduced_share } else { 1.0 };
        let probing = self.probe.is_some_and(|p| !p.passed());
        let probe = if probing { self.config.settings.watch.probe_share } else { 1.0 };
        reduced.min(probe)
    }

    /// One cycle of the law; a hold where no marks are known.
    fn drive(&mut self, tick: &Tick, q: &Joints, jacobian: &Matrix6<f64>) -> Result<Drive, HoldCause> {
        let pace = Pace {
            dt_s: tick.dt_s,
            scale: self.vision.scale(tick.now_ns),
            share: self.speed_fraction(),
            slider: self.arm.slider(),
            tcp_cap: self.limits.tcp_speed * TCP_AIM,
            velocity: self.limits.velocity,
        };
        let best = self.setpoint.map_or(crate::geom::View::Left, |s| s.best_view);
        let (Some(seen), Some(motion)) = (self.vision.seen(), &mut self.motion) else {
            return Err(HoldCause::MarksLost);
        };
        motion.drive(&self.config, seen, q, jacobian, pace, best)
    }
}
