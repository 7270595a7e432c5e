//! The command thread: one cycle a period, robot state in, one set-point out. It does not use iceoryx2, locks or the
//! heap.

use super::cycle_report::CycleReport;
use super::shared::{JointSample, Shared};
use crate::arm::{ArmLink, LinkPoll};
use crate::realtime::{CycleTimer, Tick, now_ns, sleep_until};
use graspd_rt::arm::RobotState;
use graspd_rt::cycle::{CommandCycle, CommandInput, LinkStatus};
use graspd_rt::online::mid_exposure_ns;
use graspd_rt::rtde::PhaseLock;
use std::sync::atomic::Ordering;

/// Number of commands whose sending time is kept, to measure the round trip by the echoed heartbeat.
const SENT_TIMES: usize = 256;

/// The command thread's state.
pub struct CommandWorker<'a> {
    shared: &'a Shared,
    cycle: CommandCycle,
    link: Option<Box<dyn ArmLink>>,
    status: LinkStatus,
    robot: Option<RobotState>,
    /// State packages that the last poll received.
    packages: u32,
    /// Mid-exposure time of the newest pair that no command has used yet, ns.
    unused_frame_ns: Option<u64>,
    sent_ns: [(i32, u64); SENT_TIMES],
    echo: i32,
}

impl std::fmt::Debug for CommandWorker<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("CommandWorker").field("status", &self.status).finish_non_exhaustive()
    }
}

impl<'a> CommandWorker<'a> {
    /// A worker without a link; the link manager provides it.
    pub fn new(cycle: CommandCycle, shared: &'a Shared) -> Self {
        Self {
            shared,
            cycle,
            link: None,
            status: LinkStatus::default(),
            robot: None,
            packages: 0,
            unused_frame_ns: None,
            sent_ns: [(0, 0); SENT_TIMES],
            echo: 0,
        }
    }

    /// Runs until shutdown.
    pub fn run(&mut self, period_ns: u64, spin_ns: u64) {
        let mut timer = CycleTimer::new(period_ns, spin_ns);
        while !self.shared.ending() {
            let tick = timer.wait();
            self.cycle(&tick);
        }
    }

    /// Runs until shutdown with the robot as the clock: each cycle waits for the robot's package, and its command takes
    /// effect in the robot's next step. Without packages the cycle runs by a timer.
    pub fn run_with_robot(&mut self, period_ns: u64) {
        let mut lock = PhaseLock::new(period_ns, now_ns());
        let mut skipped = 0;
        while !self.shared.ending() {
            let deadline_ns = lock.next_ns();
            sleep_until(lock.listen_ns());
            let arrived = match self.link.as_mut() {
                Some(link) => link.wait(lock.give_up_ns()),
                None => false,
            };
            if !arrived {
                sleep_until(lock.give_up_ns());
            }
            sleep_until(lock.arrived(now_ns(), arrived));
            self.cycle(&Tick { deadline_ns, woke_ns: now_ns(), skipped });
            let stamp = self.robot.filter(|_| self.packages == 1).map(|r| r.timestamp_s);
            skipped = lock.advance(now_ns(), stamp);
        }
    }

    /// One cycle.
    pub fn cycle(&mut self, tick: &Tick) {
        if self.link.is_none()
            && let Some(link) = self.shared.link_ready.take()
        {
            self.status = LinkStatus { connected: true, token: link.token(), ..LinkStatus::default() };
            self.link = Some(link);
        }
        if self.shared.drop_link.swap(false, Ordering::AcqRel) {
            self.drop_link();
        }
        let now = now_ns();
        let state = self.poll(now);
        let mut round_trip_ns = None;
        if let Some(s) = &state {
            // The queue is full when the vision thread does not read; the age limits of the images detect that.
            let _ = self.shared.joints.push(JointSample { at_ns: s.received_ns, q: s.q });
            if s.echo != self.echo {
                self.echo = s.echo;
                let (cycle, at) = self.sent_ns[s.echo.rem_euclid(SENT_TIMES as i32) as usize];
                round_trip_ns = (cycle == s.echo && at > 0).then(|| s.received_ns.saturating_sub(at));
            }
            self.robot = Some(*s);
        }
        let vision = self.shared.vision.take();
        if let Some(v) = &vision {
            self.unused_frame_ns = Some(mid_exposure_ns(v.capture_ns));
        }
        let setpoint = self.shared.setpoint.take();
        let request = if self.shared.live.take() {
            Some(graspd_rt::cycle::CommandRequest { id: 0, kind: graspd_rt::cycle::RequestKind::Stop })
        } else {
            self.shared.requests.pop()
        };
        let out = self.cycle.step(&CommandInput {
            now_ns: now,
            robot: state,
            link: self.status,
            vision: vision.as_ref(),
            request,
            setpoint: setpoint.as_ref(),
            internal_fault: self.shared.broken.load(Ordering::Acquire),
        });
        self.send(&out.command);
        let done = now_ns();
        let moving = out.command.rates.iter().any(|r| *r != 0.0);
        self.shared.live.record(out.record.mode, moving, self.link.is_some());
        if let Some(reply) = out.reply {
            let _ = self.shared.replies.force_push(reply);
        }
        if let Some(reply) = out.setpoint_reply {
            self.shared.setpoint_reply.put(reply);
        }
        let report = CycleReport {
            record: out.record,
            event: out.event,
            wakeup_ns: tick.lateness_ns(),
            compute_ns: done.saturating_sub(tick.woke_ns),
            skipped: tick.skipped,
            frame_to_command_ns: self.unused_frame_ns.take().map(|at| done.saturating_sub(at)),
            round_trip_ns,
            link: if self.link.is_some() { 2 } else { 1 },
            robot: self.robot.map_or((-1, 0), |r| (r.robot_mode, r.safety_status_bits)),
        };
        // The ring is full when the telemetry thread does not read: the oldest record is dropped, and the cycle does
        // not wait.
        let _ = self.shared.records.force_push(report);
    }

    fn poll(&mut self, now: u64) -> Option<RobotState> {
        self.packages = 0;
        let link = self.link.as_mut()?;
        match link.poll(now) {
            LinkPoll { fault: None, state, packages, missing, .. } => {
                self.packages = packages;
                self.status.states = self.status.states.wrapping_add(packages);
                self.status.states_missing = self.status.states_missing.wrapping_add(missing);
                state
            }
            LinkPoll { .. } => {
                self.drop_link();
                None
            }
        }
    }

    fn send(&mut self, command: &graspd_rt::arm::ArmCommand) {
        let Some(link) = self.link.as_mut() else { return };
        let dropped = link.stats().dropped;
        match link.send(command) {
            Ok(()) if link.stats().dropped == dropped => {
                self.status.blocked_sends = 0;
                self.sent_ns[command.heartbeat.rem_euclid(SENT_TIMES as i32) as usize] = (command.heartbeat, now_ns());
            }
            Ok(()) => self.status.blocked_sends = self.status.blocked_sends.saturating_add(1),
            Err(_) => self.drop_link(),
        }
    }

    /// Hands a failed link to the link manager, which closes it and makes a new one: both may block.
    fn drop_link(&mut self) {
        if let Some(link) = self.link.take() {
            self.shared.link_dead.put(link);
        }
        self.status = LinkStatus::default();
        self.robot = None;
    }
}
