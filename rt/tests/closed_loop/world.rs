//! A world in lock step with the cycle: an arm that differs from its model, a rig at a random pose, marks as points.
#![allow(clippy::unwrap_used)] // a test

use graspd_rt::arm::{ArmCommand, ArmMode, Dh, Joints, Model, READY, RobotState, ToolPoint};
use graspd_rt::cycle::{
    CommandCycle, CommandInput, CommandOutput, CommandRequest, CycleConfig, CycleSettings, LinkStatus, RequestKind,
};
use graspd_rt::geom::{Camera, Distortion, Pixel, Pose, Rig, Twist, Vec3, View, exp_twist, log_pose};
use graspd_rt::gripper::{Gripper, MAX_MARKS, Mark};
use graspd_rt::online::interaction::PlacedView;
use graspd_rt::online::pose::{self, MarkTable, PoseSettings};
use graspd_rt::online::rig_fit::Evidence;
use graspd_rt::online::rig_watch::{RigWatch, RigWatchSettings};
use graspd_rt::online::screw::{LawSettings, MarkError, Stack};
use graspd_rt::online::{MarkObservation, Vision, VisionStatus};
use graspd_rt::setpoint::{Goal, SetPoint};
use nalgebra::{Matrix2, Matrix6};
use std::collections::VecDeque;

/// SplitMix64: a seed reproduces a run on every platform.
pub(crate) struct Rng(pub(crate) u64);

impl Rng {
    pub(crate) fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }
    /// Uniform in -m..m.
    pub(crate) fn even(&mut self, m: f64) -> f64 {
        ((self.next() >> 11) as f64 / (1_u64 << 52) as f64 - 1.0) * m
    }
    /// Normal with standard deviation `s`.
    pub(crate) fn normal(&mut self, s: f64) -> f64 {
        let mut t = 0.0;
        for _ in 0..12 {
            t += self.even(0.5);
        }
        t * s
    }
}

pub(crate) const MS: u64 = 1_000_000;

/// Faults that the world simulates.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Faults {
    pub(crate) no_vision: bool,
    pub(crate) frozen_vision: bool,
    pub(crate) lost_marks: bool,
    /// The right view shows no marks.
    pub(crate) one_view: bool,
    pub(crate) no_state: bool,
    pub(crate) link_down: bool,
    pub(crate) echo_stuck: bool,
    pub(crate) safety_bits: Option<u32>,
    pub(crate) robot_mode: Option<i32>,
    pub(crate) runtime: Option<u32>,
    pub(crate) nan_state: bool,
    pub(crate) jump_state: bool,
    pub(crate) clock_back: bool,
    pub(crate) token: bool,
    pub(crate) stuck_arm: bool,
    pub(crate) drift_arm: bool,
    pub(crate) nan_marks: bool,
    pub(crate) jump_marks: bool,
    pub(crate) stall: bool,
    pub(crate) blocked: bool,
    pub(crate) script_fault: bool,
    pub(crate) internal: bool,
    pub(crate) old_stamps: bool,
    pub(crate) skewed: bool,
    /// Cycles are up to this fraction of a period early or late.
    pub(crate) jitter: f64,
    pub(crate) slider_zero: bool,
}

pub(crate) struct World {
    pub(crate) rng: Rng,
    pub(crate) now: u64,
    pub(crate) period: u64,
    pub(crate) frame_period: u64,
    pub(crate) cycle: CommandCycle,
    pub(crate) config: CycleConfig,
    pub(crate) true_dh: Dh,
    pub(crate) true_rig: Rig,
    pub(crate) base_from_left: Pose,
    pub(crate) q: Joints,
    pub(crate) qd: Joints,
    /// Factor on the arm's rates: -1 is an arm that moves in the opposite direction.
    pub(crate) sense: f64,
    pub(crate) setpoint: SetPoint,
    pub(crate) faults: Faults,
    pub(crate) slider: f64,
    pub(crate) noise_px: f64,
    pub(crate) watch: RigWatch,
    /// True goal of the gripper in the left camera's frame at the start.
    pub(crate) aim: Pose,
    /// Gripper in the calibrated rig and in the base at the last image in which the marks were found.
    tracked: Option<(Pose, Pose)>,
    pipeline: VecDeque<(u64, Vision)>,
    next_capture: u64,
    sequence: u64,
    last_vision: Option<Vision>,
    pending: ArmCommand,
    pub(crate) sent: Vec<(u64, Joints)>,
    pub(crate) outputs: u32,
    /// Numbers of states received and left out by the controller.
    states: [u32; 2],
    /// One of so many states is received.
    pub(crate) one_of: u32,
    /// `actual_digital_output_bits`.
    pub(crate) levels: u64,
    /// The controller reports this many times the true speed of its tool point.
    pub(crate) tool: Option<f64>,
    /// Duration of each step of the cycle, ns.
    pub(crate) step_ns: Vec<u64>,
}

/// The script's output bits at their positions on the wire: those of the tool follow the configurable ones.
fn wire(word: u64) -> u64 {
    word & 0xff | (word & 0x300) << 8
}

fn gripper() -> Gripper {
    let mut marks = heapless::Vec::new();
    for k in 0..8 {
        let a = f64::from(k) * 0.785;
        let position = Vec3::new(0.05 * a.cos(), 0.03 + 0.015 * f64::from(k % 3), -0.06 + 0.05 * a.sin());
        marks.push(Mark { position, normal: Vec3::y(), radius: 0.006, dark: true }).unwrap();
    }
    Gripper { marks, flange_from_gripper: exp_twist(&Twist::new(0.0, 0.01, 0.16, 0.0, 0.0, 0.3)) }
}

fn camera(k: f64) -> Camera {
    let distortion = Distortion { k1: -0.12, k2: 0.05, p1: 2e-4 * k, ..Default::default() };
    Camera { width: 1280, height: 1024, fx: 1200.0 + 3.0 * k, fy: 1199.0, cx: 640.0 - k, cy: 512.0 + k, distortion }
}

impl World {
    pub(crate) fn new(seed: u64, tune: impl Fn(&mut CycleSettings)) -> Self {
        let mut rng = Rng(seed.wrapping_mul(77).wrapping_add(5));
        let model = [Model::Ur5e, Model::Ur10e, Model::Ur5, Model::Ur3e][(seed % 4) as usize];
        let dh = Dh::nominal(model);
        // Errors of half a millimetre and a tenth of a degree on every link.
        let mut small = |m: f64| -> [f64; 6] { std::array::from_fn(|_| rng.even(m)) };
        let angle = 0.1_f64.to_radians();
        let delta = Dh { a: small(5e-4), d: small(5e-4), alpha: small(angle), theta: small(angle) };
        let true_dh = dh.plus(&delta);
        let gripper = gripper();
        let q_goal: Joints = std::array::from_fn(|i| READY[i] + rng.even(0.25));
        let turned = exp_twist(&Twist::new(0.0, 0.0, 0.0, rng.even(0.35), rng.even(0.8), rng.even(0.35)));
        // The side of the marks (y of the gripper) faces the cameras.
        let facing = exp_twist(&Twist::new(0.0, 0.0, 0.0, -std::f64::consts::FRAC_PI_2, 0.0, 0.0));
        let goal = Pose::translation(0.2 + rng.even(0.05), rng.even(0.05), 1.45 + rng.even(0.1)) * turned * facing;
        let base_from_left = true_dh.base_from_gripper(&q_goal, &gripper.flange_from_gripper) * goal.inverse();
        let right_from_left = exp_twist(&Twist::new(-0.48, 0.01, 0.06, 0.01, 0.3 + rng.even(0.03), -0.01));
        let rig = Rig { left: camera(1.0), right: camera(-2.0), right_from_left };
        let mut settings = CycleSettings::default();
        tune(&mut settings);
        let open = settings.task.open_outputs;
        let config = CycleConfig { model, dh, rig, gripper, settings };
        let pregrasp = goal * Pose::translation(0.0, 0.0, -0.07);
        let setpoint = SetPoint {
            id: seed + 1,
            pregrasp: plan(&config, pregrasp),
            grasp: plan(&config, goal),
            object_centre: goal.translation.vector,
            object_normal: goal.rotation * -Vec3::z(),
            best_view: View::Left,
        };
        let q = std::array::from_fn(|i| q_goal[i] + rng.even(0.12));
        let period = config.settings.period_ns;
        let frame_period = config.settings.frame_period_ns;
        Self {
            rng,
            now: 10_000 * MS,
            period,
            frame_period,
            cycle: CommandCycle::new(config.clone()).unwrap(),
            true_rig: config.rig,
            config,
            true_dh,
            base_from_left,
            q,
            qd: [0.0; 6],
            sense: 1.0,
            setpoint,
            faults: Faults::default(),
            slider: 1.0,
            noise_px: 0.1,
            aim: goal,
            watch: RigWatch::new(RigWatchSettings::default()),
            tracked: None,
            pipeline: VecDeque::new(),
            next_capture: 10_000 * MS,
            sequence: 0,
            last_vision: None,
            pending: ArmCommand::default(),
            sent: Vec::new(),
            outputs: 0,
            states: [0; 2],
            one_of: 1,
            // The gripper is open at the start.
            levels: wire(u64::from(open & 0xffff)),
            tool: None,
            step_ns: Vec::new(),
        }
    }

    pub(crate) fn left_from_gripper(&self) -> Pose {
        self.base_from_left.inverse()
            * self.true_dh.base_from_gripper(&self.q, &self.config.gripper.flange_from_gripper)
    }

    /// Changes the calibrated rig (of daemon and plan) by 0.5 % in focal length and 0.1 degrees in relative rotation.
    /// The images at the goal are unchanged.
    pub(crate) fn misplace_rig(&mut self) {
        let goal = self.setpoint.grasp.left_from_gripper;
        let seen = plan(&self.config, goal).marks;
        let rig = &mut self.config.rig;
        for c in [&mut rig.left, &mut rig.right] {
            let k = 1.0 + if self.rng.next().is_multiple_of(2) { 5e-3 } else { -5e-3 };
            c.fx *= k;
            c.fy *= k;
        }
        let axis =
            Vec3::new(self.rng.even(1.0), self.rng.even(1.0), self.rng.even(1.0)).normalize() * 0.1_f64.to_radians();
        rig.right_from_left *= exp_twist(&Twist::new(0.0, 0.0, 0.0, axis.x, axis.y, axis.z));
        let estimated = estimate(&self.config, goal, &seen);
        let pregrasp = estimated * Pose::translation(0.0, 0.0, -0.07);
        self.setpoint.grasp = Goal { left_from_gripper: estimated, marks: seen };
        self.setpoint.pregrasp = plan(&self.config, pregrasp);
        self.cycle = CommandCycle::new(self.config.clone()).unwrap();
    }

    /// Moves a camera by a small motion of its own frame.
    pub(crate) fn knock(&mut self, view: View, motion: &Twist) {
        let motion = exp_twist(motion);
        match view {
            View::Left => {
                self.base_from_left *= motion;
                self.true_rig.right_from_left *= motion;
            }
            View::Right => self.true_rig.right_from_left = motion.inverse() * self.true_rig.right_from_left,
        }
    }

    /// A model of the tracker: marks near their expected pixels, and the pose fitted robustly to them.
    fn track(&mut self, v: &mut Vision, truth: &Pose) {
        let mount = self.config.gripper.flange_from_gripper;
        let base_from_gripper = self.config.dh.base_from_gripper(&self.q, &mount);
        let expected = self.tracked.map(|(pose, then)| pose * (then.inverse() * base_from_gripper));
        if let Some(pose) = expected {
            let found = |view: View, i: usize, m: &MarkObservation| {
                let x = pose * nalgebra::Point3::from(self.config.gripper.marks[i].position);
                let at = self.config.rig.project(view, &x.coords);
                at.is_some_and(|p| (p - m.pixel).abs().max() < 14.0)
            };
            for view in View::BOTH {
                for (i, m) in v.marks[view.index()].iter_mut().enumerate() {
                    *m = m.filter(|m| found(view, i, m));
                }
            }
        }
        let all: MarkTable = v.marks;
        let (rig, gripper) = (&self.config.rig, &self.config.gripper);
        let start = expected.unwrap_or(*truth);
        let Ok(e) = pose::estimate(rig, gripper, &all, &start, &PoseSettings::default()) else {
            return self.lose(v);
        };
        for (marks, used) in v.marks.iter_mut().zip(&e.used) {
            for (m, used) in marks.iter_mut().zip(used) {
                *m = m.filter(|_| *used);
            }
        }
        let mut shown = v.marks;
        for (k, shown) in shown.iter_mut().enumerate() {
            let (measured, kept) = (all[k].iter().flatten().count(), v.marks[k].iter().flatten().count());
            if measured >= 4 && 2 * kept < measured {
                *shown = all[k];
            }
        }
        v.left_from_gripper = e.left_from_gripper;
        v.residual_px = e.residual_px;
        v.rig = self.watch.update(rig, gripper, &shown, &e.left_from_gripper, Some(&base_from_gripper));
        let settings = RigWatchSettings::default();
        v.inner_residual_px = Evidence::gather(rig, gripper, &v.marks, &e.left_from_gripper, settings.mark_px, None)
            .and_then(|x| x.offset(&settings.rig_error))
            .map_or(e.residual_px, |(_, inner)| inner);
        if v.inner_residual_px > 3.0 {
            return self.lose(v);
        }
        v.seen = View::BOTH.map(|view| e.used_in(view) as u8);
        v.status = if v.seen.iter().all(|n| *n >= 4) { VisionStatus::Tracking } else { VisionStatus::Degraded };
        self.tracked = Some((e.left_from_gripper, base_from_gripper));
    }

    fn lose(&mut self, v: &mut Vision) {
        v.status = VisionStatus::Lost;
        v.marks = [[None; MAX_MARKS]; 2];
        v.seen = [0; 2];
        v.rig = self.watch.health();
    }

    /// True distance (mm) and angle (degrees) to a pose.
    pub(crate) fn error_to(&self, goal: &Pose) -> (f64, f64) {
        let p = self.left_from_gripper();
        let d = (p.translation.vector - goal.translation.vector).norm() * 1e3;
        (d, log_pose(&(p.inverse() * goal)).fixed_rows::<3>(3).norm().to_degrees())
    }

    fn image(&mut self) -> Vision {
        let pose = self.left_from_gripper();
        let mut marks = [[None; MAX_MARKS]; 2];
        let mut seen = [0; 2];
        for view in View::BOTH {
            for i in 0..self.config.gripper.marks.len() {
                let x = pose * nalgebra::Point3::from(self.config.gripper.marks[i].position);
                let Some(p) = self.true_rig.project(view, &x.coords) else { continue };
                if !self.true_rig.camera(view).contains(p, 6.0) {
                    continue;
                }
                let n = nalgebra::Vector2::new(self.rng.normal(self.noise_px), self.rng.normal(self.noise_px));
                marks[view.index()][i] = Some(MarkObservation {
                    pixel: p + n,
                    covariance: Matrix2::identity() * self.noise_px * self.noise_px,
                    quality: 1.0,
                });
                seen[view.index()] += 1;
            }
        }
        self.sequence += 1;
        if self.faults.one_view {
            marks[1] = [None; MAX_MARKS];
        }
        let mut v = Vision {
            sequence: self.sequence,
            capture_ns: [self.now; 2],
            status: VisionStatus::Tracking,
            marks,
            seen,
            left_from_gripper: pose,
            covariance: Matrix6::identity() * 1e-8,
            residual_px: self.noise_px,
            inner_residual_px: self.noise_px,
            rig: self.watch.health(),
        };
        let e = Twist::from_fn(|i, _| self.rng.normal(if i < 3 { 1e-4 } else { 4e-4 }));
        self.track(&mut v, &pose);
        // The pose gets additional noise: a tracker has more errors than those of the marks here.
        if self.true_rig == self.config.rig && v.status != VisionStatus::Lost {
            v.left_from_gripper = pose * exp_twist(&e);
        }
        v
    }

    /// The controller's report of a tool point at the flange, with this many times the true speed.
    fn tool_point(&self, scale: f64) -> ToolPoint {
        let speed = self.true_dh.tool_speed(&self.q, &self.qd, &[0.0; 6]);
        ToolPoint { offset: [0.0; 6], speed: [speed * scale, 0.0, 0.0, 0.0, 0.0, 0.0] }
    }

    fn state(&mut self, cycle: i32) -> RobotState {
        let f = self.faults;
        let mut s = RobotState {
            timestamp_s: self.now as f64 * 1e-9,
            received_ns: self.now,
            q: self.q,
            qd: self.qd,
            target_q: self.q,
            target_qd: self.qd,
            robot_mode: f.robot_mode.unwrap_or(7),
            safety_status_bits: f.safety_bits.unwrap_or(1),
            robot_status_bits: 3,
            runtime_state: f.runtime.unwrap_or(2),
            speed_scaling: 1.0,
            target_speed_fraction: if f.slider_zero { 0.0 } else { self.slider },
            digital_outputs: self.levels,
            tool: self.tool.map(|scale| self.tool_point(scale)),
            echo: if f.echo_stuck { 12345 } else { cycle },
            script_state: 1,
            script_fault: i32::from(f.script_fault),
            script_token: if f.token { 99 } else { 42 },
        };
        if f.nan_state {
            s.q[3] = f64::NAN;
        }
        if f.jump_state {
            s.q[2] += 0.3;
        }
        if f.clock_back {
            s.timestamp_s -= 100.0;
        }
        s
    }

    /// One cycle with an optional request.
    pub(crate) fn cycle(&mut self, request: Option<RequestKind>, offer: bool) -> CommandOutput {
        let dt = self.period as f64 * 1e-9;
        let late = self.rng.even(self.faults.jitter) * self.period as f64;
        self.now += if self.faults.stall { 30 * MS } else { (self.period as f64 + late) as u64 };
        // The arm follows the set-point of the last cycle with a first-order lag.
        let mut target = if self.pending.mode == ArmMode::Velocity { self.pending.rates } else { [0.0; 6] };
        let slider = if self.faults.slider_zero { 0.0 } else { self.slider };
        if self.faults.stuck_arm {
            target = [0.0; 6];
        }
        for (i, target) in target.iter().enumerate() {
            let mut rate = target * slider * self.sense;
            if self.faults.drift_arm {
                rate += 0.03;
            }
            self.qd[i] += (rate - self.qd[i]) * (dt / 0.02).min(1.0);
            self.q[i] += self.qd[i] * dt;
        }
        while self.now >= self.next_capture {
            self.next_capture += self.frame_period;
            let v = self.image();
            if !self.faults.no_vision {
                self.pipeline.push_back((self.now + 30 * MS, v));
            }
        }
        let mut vision = None;
        while self.pipeline.front().is_some_and(|(t, _)| *t <= self.now) {
            vision = self.pipeline.pop_front().map(|(_, v)| v);
        }
        if let Some(v) = &mut vision {
            if let Some(old) = self.last_vision.as_ref().filter(|_| self.faults.frozen_vision) {
                let (sequence, capture_ns) = (v.sequence, v.capture_ns);
                *v = Vision { sequence, capture_ns, ..*old };
            }
            if self.faults.old_stamps {
                v.capture_ns = [self.now + 50 * MS; 2];
            }
            if self.faults.skewed {
                v.capture_ns[1] -= 6 * MS;
            }
            if self.faults.lost_marks {
                v.status = VisionStatus::Lost;
                v.marks = [[None; MAX_MARKS]; 2];
            }
            if self.faults.nan_marks {
                for m in v.marks.iter_mut().flatten().flatten() {
                    m.pixel.x = f64::NAN;
                }
            }
            if self.faults.jump_marks {
                v.left_from_gripper.translation.vector.x += 0.05;
                for m in v.marks.iter_mut().flatten().flatten() {
                    m.pixel.x += 40.0;
                }
            }
            self.last_vision = Some(*v);
        }
        let cycle = self.pending.heartbeat;
        let state = self.state(cycle);
        // One state per cycle is received; states between two of them count as left out.
        self.states[0] += 1;
        self.states[1] += self.one_of - 1;
        let before = std::time::Instant::now();
        let heap = crate::heap::calls();
        let output = self.cycle.step(&CommandInput {
            now_ns: self.now,
            robot: (!self.faults.no_state && !self.faults.link_down).then_some(state),
            link: LinkStatus {
                connected: !self.faults.link_down,
                token: 42,
                blocked_sends: u32::from(self.faults.blocked),
                states: self.states[0],
                states_missing: self.states[1],
            },
            vision: vision.as_ref(),
            request: request.map(|kind| CommandRequest { id: 1, kind }),
            setpoint: offer.then_some(&self.setpoint),
            internal_fault: self.faults.internal,
        });
        assert_eq!(crate::heap::calls(), heap, "a cycle used the heap");
        self.step_ns.push(before.elapsed().as_nanos() as u64);
        self.pending = output.command;
        self.outputs = output.command.outputs;
        let (mask, values) = (u64::from(self.outputs >> 16), u64::from(self.outputs & 0xffff));
        self.levels = self.levels & !wire(mask) | wire(values & mask);
        self.sent.push((self.now, output.command.rates));
        output
    }

    pub(crate) fn run(&mut self, ms: u64) -> CommandOutput {
        let end = self.now + ms * MS;
        let mut out = self.cycle(None, false);
        while self.now < end {
            out = self.cycle(None, false);
        }
        out
    }

    /// Loads the set-point, arms and starts; panics with the reason if refused.
    pub(crate) fn start(&mut self) {
        self.run(500);
        assert_eq!(self.cycle(None, true).setpoint_reply, Some(Ok(())));
        assert_eq!(self.cycle(Some(RequestKind::Arm), false).reply.unwrap().result, Ok(()));
        assert_eq!(self.cycle(Some(RequestKind::Servo), false).reply.unwrap().result, Ok(()));
    }

    /// Checks every set-point sent: finite, within the limits of speed, acceleration and position.
    pub(crate) fn judge_wire(&self) {
        let l = self.cycle.limits();
        let (v, a) = (l.velocity(), l.acceleration());
        for pair in self.sent.windows(2) {
            let dt = ((pair[1].0 - pair[0].0) as f64 * 1e-9).min(self.period as f64 * 1e-9);
            for (i, v) in v.iter().enumerate() {
                let (x, y) = (pair[0].1[i], pair[1].1[i]);
                assert!(y.is_finite() && y.abs() <= v * (1.0 + 1e-9), "joint {i} at {y}");
                assert!((y - x).abs() <= a * dt * (1.0 + 1e-9), "joint {i}: {x} to {y} in {dt}");
            }
        }
    }
}

/// Pose that fits the pixels best in the calibrated rig, from a start close to it.
fn estimate(c: &CycleConfig, start: Pose, pixels: &[[Option<Pixel>; MAX_MARKS]; 2]) -> Pose {
    let mut pose = start;
    let law = LawSettings { damping_px_per_m: 0.0, ..Default::default() };
    for _ in 0..8 {
        let mut stack = Stack::new(&law);
        for view in View::BOTH {
            let placed = PlacedView::new(c.rig.camera(view), &(c.rig.view_from_left(view) * pose));
            for (m, pixel) in c.gripper.marks.iter().zip(&pixels[view.index()]) {
                let (Some(reference), Some(now)) = (*pixel, placed.project(&m.position)) else { continue };
                let error = MarkError { now, reference, covariance: Matrix2::identity(), factor: 1.0 };
                stack.add(&placed, &placed, &m.position, &error);
            }
        }
        pose *= exp_twist(&stack.solve().unwrap().correction);
    }
    pose
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
