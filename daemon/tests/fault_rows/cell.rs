//! The daemon's link and command cycle against the mock controller's server in lock step: loopback TCP, RTDE, the
//! control script, and a clock that the test controls, so that a stall of the host does not matter.

use std::collections::VecDeque;
use std::net::{IpAddr, Ipv4Addr};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};
use std::time::{Duration, Instant};

use graspd::arm::{ArmError, ArmLink, LinkFault, UrConfig, UrLink};
use graspd::realtime::now_ns;
use graspd_hil::controller::{Command, Port, Robot, Server, Setup, World};
use graspd_rt::arm::{Dh, Joints, Model, READY};
use graspd_rt::cycle::{
    CommandCycle, CommandInput, CommandOutput, CommandRequest, CycleConfig, CycleSettings, LinkStatus, RequestKind,
};
use graspd_rt::geom::{Camera, Distortion, Pose, Rig, Twist, Vec3, View, exp_twist};
use graspd_rt::gripper::{Gripper, MAX_MARKS, Mark};
use graspd_rt::online::{MarkObservation, Vision, VisionStatus};
use graspd_rt::setpoint::{Goal, SetPoint};
use nalgebra::{Matrix2, Matrix6};

pub(crate) const MS: u64 = 1_000_000;
const CYCLE: u64 = 2 * MS;
/// Time from exposure to result, ns.
const DELAY: u64 = 30 * MS;

/// The daemon's default limits of rates (rad/s) and accelerations (rad/s²), which the mock checks.
const LIMITS: (f64, f64) = (0.5, 4.0);

/// One cell: robot, link, command cycle, and ideal cameras.
pub(crate) struct Cell {
    pub(crate) server: Server,
    pub(crate) link: Option<UrLink>,
    /// Why the link ended.
    pub(crate) ended: Option<LinkFault>,
    pub(crate) cycle: CommandCycle,
    pub(crate) now: u64,
    /// The client sends nothing, but stays connected.
    pub(crate) silent: bool,
    /// Every set-point: time and rates.
    pub(crate) sent: Vec<(u64, Joints)>,
    status: LinkStatus,
    config: CycleConfig,
    setpoint: SetPoint,
    base_from_left: Pose,
    pipeline: VecDeque<(u64, Vision)>,
    next_capture: u64,
    sequence: u64,
    /// Number of packages written in the last cycle, which the server receives in this one.
    in_transit: u64,
}

/// Runs the server in real time during `act`.
pub(crate) fn while_serving<T>(server: Server, act: impl FnOnce() -> T) -> (Server, T) {
    let stop = Arc::new(AtomicBool::new(false));
    let stopped = Arc::clone(&stop);
    let mut server = server;
    let thread = std::thread::spawn(move || {
        server.run(&stopped);
        server
    });
    let done = act();
    stop.store(true, Ordering::Relaxed);
    (thread.join().unwrap(), done)
}

/// A mock on a free loopback address, and the configuration of its client.
pub(crate) fn mock(before: &[Command]) -> (Server, UrConfig) {
    static NEXT: AtomicU8 = AtomicU8::new(1);
    let id = std::process::id();
    let mut setup = Setup { power_time_s: 0.05, ..Setup::new(graspd_hil::plant::Model::by_name("ur5e").unwrap()) };
    setup.start_joints = start_joints();
    for _ in 0..250 {
        let n = NEXT.fetch_add(1, Ordering::Relaxed);
        let address = Ipv4Addr::new(127, 64 + (id >> 8) as u8 % 128, id as u8, n.max(1));
        let mut world = World::new(Robot::new(setup.clone()), Some(LIMITS), None);
        for command in before {
            world.command(command.clone(), now_ns()).unwrap();
        }
        // Another mock may use the address already.
        if let Ok(server) = Server::bind(world, IpAddr::V4(address), 0, None) {
            let config = UrConfig { acceleration: 40.0, ..UrConfig::new(address.to_string(), Model::Ur5e) };
            return (server, UrConfig { stop_acceleration: 4.0, timeout: Duration::from_secs(20), ..config });
        }
    }
    panic!("no free loopback address");
}

/// A second of the robot's own time for every real one is enough for a link to come up; what it must answer is in
/// `ArmError`.
pub(crate) fn bring_up(config: &UrConfig) -> Result<UrLink, ArmError> {
    let mut link = UrLink::connect(config)?;
    link.bring_up(config)?;
    Ok(link)
}

fn start_joints() -> Joints {
    let away = [0.10, -0.08, 0.09, 0.05, -0.07, 0.1];
    std::array::from_fn(|i| READY[i] + away[i])
}

fn gripper() -> Gripper {
    let flange_from_gripper = exp_twist(&Twist::new(0.0, 0.01, 0.16, 0.0, 0.0, 0.3));
    let mut gripper = Gripper { marks: Default::default(), flange_from_gripper };
    for k in 0..8 {
        let a = f64::from(k) * 0.785;
        let position = Vec3::new(0.05 * a.cos(), 0.03 + 0.015 * f64::from(k % 3), -0.06 + 0.05 * a.sin());
        gripper.marks.push(Mark { position, normal: Vec3::y(), radius: 0.006, dark: true }).unwrap();
    }
    gripper
}

fn camera() -> Camera {
    let distortion = Distortion { k1: -0.12, k2: 0.05, ..Default::default() };
    Camera { width: 1280, height: 1024, fx: 1200.0, fy: 1199.0, cx: 640.0, cy: 512.0, distortion }
}

impl Cell {
    /// A cell whose link is up and whose arm is idle.
    ///
    /// # Errors
    /// Why the link did not come up.
    pub(crate) fn start(before: &[Command], tune: impl FnOnce(&mut CycleSettings)) -> Result<Cell, ArmError> {
        let (server, config) = mock(before);
        let (server, link) = while_serving(server, || bring_up(&config));
        Ok(Cell::with(server, link?, tune))
    }

    /// A cell with a link that is up.
    pub(crate) fn with(server: Server, link: UrLink, tune: impl FnOnce(&mut CycleSettings)) -> Cell {
        let dh = Dh::nominal(Model::Ur5e);
        let gripper = gripper();
        // The marks (y axis of the gripper) face the cameras.
        let facing = exp_twist(&Twist::new(0.0, 0.0, 0.0, -std::f64::consts::FRAC_PI_2, 0.0, 0.0));
        let goal = Pose::translation(0.2, 0.0, 1.45) * facing;
        let base_from_left = dh.base_from_gripper(&READY, &gripper.flange_from_gripper) * goal.inverse();
        let right_from_left = exp_twist(&Twist::new(-0.48, 0.01, 0.06, 0.01, 0.3, -0.01));
        let rig = Rig { left: camera(), right: camera(), right_from_left };
        let mut settings = CycleSettings::default();
        tune(&mut settings);
        let config = CycleConfig { model: Model::Ur5e, dh, rig, gripper, settings };
        let setpoint = SetPoint {
            id: 1,
            pregrasp: plan(&config, goal * Pose::translation(0.0, 0.0, -0.07)),
            grasp: plan(&config, goal),
            object_centre: goal.translation.vector,
            object_normal: goal.rotation * -Vec3::z(),
            best_view: View::Left,
        };
        let now = now_ns();
        Cell {
            status: LinkStatus { connected: true, token: link.token(), ..LinkStatus::default() },
            server,
            link: Some(link),
            ended: None,
            cycle: CommandCycle::new(config.clone()).unwrap(),
            now,
            silent: false,
            sent: Vec::new(),
            config,
            setpoint,
            base_from_left,
            pipeline: VecDeque::new(),
            next_capture: now,
            sequence: 0,
            in_transit: 0,
        }
    }

    /// Scales the lengths of the arm in the cycle's kinematics; the true arm stays as it is.
    pub(crate) fn scale_lengths(&mut self, factor: f64) {
        let mut config = self.config.clone();
        config.dh.a = config.dh.a.map(|v| v * factor);
        config.dh.d = config.dh.d.map(|v| v * factor);
        self.cycle = CommandCycle::new(config).unwrap();
    }

    /// Executes a command of the mock's control port.
    pub(crate) fn inject(&mut self, command: Command) {
        self.server.world.command(command, self.now).unwrap();
    }

    /// True speed of the fastest joint, rad/s.
    pub(crate) fn arm_speed(&self) -> f64 {
        self.server.world.robot.truth.actual_qd.iter().fold(0.0, |m, v| v.abs().max(m))
    }

    /// One cycle: the last packages arrive, the robot steps, its state arrives, the command cycle answers.
    pub(crate) fn cycle(&mut self, request: Option<RequestKind>, offer: bool) -> CommandOutput {
        self.now += CYCLE;
        self.serve();
        self.server.step(self.now);
        self.take_image();
        let robot = self.poll();
        let mut vision = None;
        while self.pipeline.front().is_some_and(|(due, _)| *due <= self.now) {
            vision = self.pipeline.pop_front().map(|(_, v)| v);
        }
        let output = self.cycle.step(&CommandInput {
            now_ns: self.now,
            robot,
            link: self.status,
            vision: vision.as_ref(),
            request: request.map(|kind| CommandRequest { id: 1, kind }),
            setpoint: offer.then_some(&self.setpoint),
            internal_fault: false,
        });
        self.send(&output);
        output
    }

    /// Sends as the command thread does.
    fn send(&mut self, output: &CommandOutput) {
        self.in_transit = 0;
        let Some(link) = self.link.as_mut().filter(|_| !self.silent) else { return };
        let before = link.stats();
        self.sent.push((self.now, output.command.rates));
        match link.send(&output.command) {
            Ok(()) if link.stats().dropped == before.dropped => {
                self.status.blocked_sends = 0;
                self.in_transit = link.stats().sent - before.sent;
            }
            Ok(()) => self.status.blocked_sends += 1,
            Err(fault) => self.drop_link(fault),
        }
    }

    fn drop_link(&mut self, fault: LinkFault) {
        self.ended = self.ended.or(Some(fault));
        self.link = None;
        self.status = LinkStatus::default();
    }

    fn poll(&mut self) -> Option<graspd_rt::arm::RobotState> {
        let wire = self.server.world.wire(Port::Rtde);
        let thinned = self.server.world.rtde_faults.keep_one_of > 1;
        let open = wire.mute_until <= self.now && wire.hold_until <= self.now && wire.delay_ns == 0 && !thinned;
        let link = self.link.as_mut()?;
        if open {
            // The state was sent and arrives within a moment of real time.
            link.wait(now_ns() + 20 * MS);
        }
        let poll = link.poll(self.now);
        self.status.states = self.status.states.wrapping_add(poll.packages);
        self.status.states_missing = self.status.states_missing.wrapping_add(poll.missing);
        match poll.fault {
            None => poll.state,
            Some(fault) => {
                self.drop_link(fault);
                None
            }
        }
    }

    /// Lets the server read the packages of the last cycle.
    fn serve(&mut self) {
        let wire = self.server.world.wire(Port::Rtde);
        let reads = wire.deaf_until <= self.now && wire.unread_until <= self.now;
        let goal = self.server.world.judge.summary().inputs + self.in_transit;
        let begin = Instant::now();
        loop {
            self.server.serve(self.now);
            if !reads || self.server.world.judge.summary().inputs >= goal || begin.elapsed() > Duration::from_secs(1) {
                return;
            }
            std::thread::yield_now();
        }
    }

    fn take_image(&mut self) {
        if self.now < self.next_capture {
            return;
        }
        self.next_capture += self.config.settings.frame_period_ns;
        let c = &self.config;
        let base_from_gripper =
            c.dh.base_from_gripper(&self.server.world.robot.truth.actual_q, &c.gripper.flange_from_gripper);
        let pose = self.base_from_left.inverse() * base_from_gripper;
        let mut marks = [[None; MAX_MARKS]; 2];
        let mut seen = [0; 2];
        for view in View::BOTH {
            for (i, pixel) in plan(c, pose).marks[view.index()].into_iter().enumerate() {
                let Some(pixel) = pixel else { continue };
                marks[view.index()][i] =
                    Some(MarkObservation { pixel, covariance: Matrix2::identity() * 0.01, quality: 1.0 });
                seen[view.index()] += 1;
            }
        }
        self.sequence += 1;
        let vision = Vision {
            sequence: self.sequence,
            capture_ns: [self.now; 2],
            status: VisionStatus::Tracking,
            marks,
            seen,
            left_from_gripper: pose,
            covariance: Matrix6::identity() * 1e-8,
            residual_px: 0.05,
            inner_residual_px: 0.05,
            rig: graspd_rt::online::rig_watch::RigHealth::default(),
        };
        self.pipeline.push_back((self.now + DELAY, vision));
    }

    /// Runs cycles for this time.
    pub(crate) fn run(&mut self, ms: u64) {
        for _ in 0..ms * MS / CYCLE {
            self.cycle(None, false);
        }
    }

    /// Sends the set-point, arms, and returns the answer to the servo request.
    pub(crate) fn ask_servo(&mut self) -> Result<(), graspd_rt::mode::Reject> {
        self.run(600);
        assert_eq!(self.cycle(None, true).setpoint_reply, Some(Ok(())));
        let armed = self.cycle(Some(RequestKind::Arm), false).reply.unwrap().result;
        assert_eq!(armed, Ok(()), "{:?}", self.cycle.mode());
        self.cycle(Some(RequestKind::Servo), false).reply.unwrap().result
    }

    /// Starts a motion and waits until a joint moves faster than 0.1 rad/s.
    pub(crate) fn move_off(&mut self) {
        assert_eq!(self.ask_servo(), Ok(()));
        for _ in 0..5_000 {
            let out = self.cycle(None, false);
            assert!(self.cycle.mode().drives(), "{:?}", self.cycle.mode());
            if out.command.rates.iter().any(|r| r.abs() > 0.1) {
                return;
            }
        }
        panic!("the arm did not reach 0.1 rad/s");
    }
}

fn plan(c: &CycleConfig, pose: Pose) -> Goal {
    let mut marks = [[None; MAX_MARKS]; 2];
    for view in View::BOTH {
        for (i, m) in c.gripper.marks.iter().enumerate() {
            let x = pose * nalgebra::Point3::from(m.position);
            marks[view.index()][i] = c.rig.project(view, &x.coords).filter(|p| c.rig.camera(view).contains(*p, 0.0));
        }
    }
    Goal { left_from_gripper: pose, marks }
}
