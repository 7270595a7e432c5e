//! The publishing loop: camera timing, the arm at mid-exposure, images and time stamps.

use super::faults::{Fault, Timed, disc};
use super::joints::{Arm, now_ns};
use crate::scenario::Scenario;
use crate::scene::{Snapshot, StereoRenderer};
use graspd_calib::files::RigFile;
use graspd_rt::geom::{Pixel, Pose, View};
use graspd_shm::frame::{ClockSource, FrameGeometry, FramePublisher, FrameStamp, PixelFormat, flags, id_hash};
use graspd_shm::{ShmError, ShmNode};
use nalgebra::{Point3, UnitQuaternion, Vector3};
use rustix::time::{ClockId, Timespec};
use serde_json::{Value, json};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, channel};
use std::sync::{Arc, Mutex, PoisonError};

/// Serial numbers of the simulated cameras.
pub(super) const SERIALS: [&str; 2] = ["sim-left", "sim-right"];
/// Exposure time in the frame header, ns. Images show one instant: at servo speeds motion blur is a fraction of a
/// pixel.
const EXPOSURE_NS: u64 = 2_000_000;
/// Longest wait for an arm sample taken after the exposure, ns.
const MAX_SAMPLE_WAIT_NS: u64 = 8_000_000;
/// Age of the newest sample above which the controller counts as gone rather than late, ns.
const MAX_SAMPLE_AGE_NS: u64 = 60_000_000;
/// Speed of the jaws, m/s.
const JAW_SPEED_M_S: f64 = 0.08;
/// Half the side of the windows that `swap_marks` exchanges, pixels.
const HALF_WINDOW_PX: i64 = 10;

/// State shared with the console.
#[derive(Debug, Default)]
pub(super) struct Shared {
    inner: Mutex<Inner>,
}

#[derive(Debug, Default)]
struct Inner {
    faults: Vec<Timed>,
    published: u64,
    late: u64,
    render_us: f64,
    opening: f64,
    scenario: Option<Box<Scenario>>,
}

impl Shared {
    fn with<T>(&self, f: impl FnOnce(&mut Inner) -> T) -> T {
        f(&mut self.inner.lock().unwrap_or_else(PoisonError::into_inner))
    }

    pub(super) fn add(&self, fault: Timed) {
        self.with(|i| i.faults.push(fault));
    }

    pub(super) fn clear(&self) {
        self.with(|i| i.faults.clear());
    }

    pub(super) fn faults(&self) -> Vec<Fault> {
        self.with(|i| i.faults.iter().map(|t| t.fault.clone()).collect())
    }

    fn active(&self, t: u64) -> Vec<Fault> {
        self.with(|i| {
            i.faults.retain(|f| t < f.until_ns);
            i.faults.iter().filter(|f| f.active(t)).map(|f| f.fault.clone()).collect()
        })
    }

    /// Statistics of the loop.
    pub(super) fn status(&self) -> Value {
        self.with(|i| {
            json!({ "published": i.published, "late": i.late, "render_us": i.render_us.round(), "opening_m": i.opening,
                    "faults": i.faults.len() })
        })
    }

    /// The present scenario, including displaced cameras and objects.
    pub(super) fn scenario(&self) -> Option<Scenario> {
        self.with(|i| i.scenario.as_deref().cloned())
    }

    pub(super) fn set_scenario(&self, s: Scenario) {
        self.with(|i| i.scenario = Some(Box::new(s)));
    }
}

/// State of the loop.
pub(super) struct Loop {
    scenario: Scenario,
    renderer: StereoRenderer,
    arm: Arm,
    shared: Arc<Shared>,
    publisher: FramePublisher,
    rate: f64,
    latency_ns: u64,
    close_output: u32,
    opening: f64,
    /// Image and time stamp of each camera, and the pose, repeated by faults.
    held: [Option<(Vec<u8>, u64)>; 2],
    held_pose: Option<[Option<Pose>; 2]>,
    /// Displacement faults of the newest renderer, and the renderer that is being built.
    moved: Vec<Fault>,
    pending: Option<Receiver<(Scenario, StereoRenderer)>>,
    second: Option<(ShmNode, FramePublisher)>,
}

impl Loop {
    /// Opens the topic. Must run on the publishing thread.
    pub(super) fn new(
        scenario: Scenario,
        renderer: StereoRenderer,
        arm: Arm,
        shared: Arc<Shared>,
        node: &ShmNode,
        (rate, latency_ms, close_output): (f64, f64, u32),
    ) -> Result<Self, ShmError> {
        let (w, h) = renderer.size();
        let mut publisher = FramePublisher::new(node, FrameGeometry::packed(w as u32, h as u32, PixelFormat::Mono8))?;
        let calibration = RigFile::new(scenario.given_rig).id();
        publisher.identify(SERIALS.map(id_hash), calibration, ClockSource::Simulated);
        let opening = scenario.gripper.opening[1];
        shared.set_scenario(scenario.clone());
        Ok(Self {
            scenario,
            renderer,
            arm,
            shared,
            publisher,
            rate,
            latency_ns: (latency_ms.clamp(0.0, 500.0) * 1e6) as u64,
            close_output,
            opening,
            held: [None, None],
            held_pose: None,
            moved: Vec::new(),
            pending: None,
            second: None,
        })
    }

    /// Publishes until `stop`; calls `ready` once, after the first pair.
    pub(super) fn run(mut self, node: &ShmNode, stop: &AtomicBool, ready: impl FnOnce()) -> Result<(), ShmError> {
        let start = now_ns();
        let mut capture = start;
        let mut trigger = 0u64;
        let mut ready = Some(ready);
        while !stop.load(Ordering::Relaxed) {
            trigger += 1;
            let active = self.shared.active(now_ns());
            let rate = active.iter().find_map(|f| if let Fault::Rate { hz } = f { Some(*hz) } else { None });
            let period = (1e9 / rate.unwrap_or(self.rate).clamp(0.5, 2000.0)) as u64;
            capture += period;
            let now = now_ns();
            if capture < now.saturating_sub(self.latency_ns) {
                // Too late for this cycle: skip whole cycles and keep the time grid.
                let lost = (now - self.latency_ns - capture).div_ceil(period);
                for _ in 0..lost.min(1000) {
                    self.publisher.skip();
                }
                trigger += lost;
                capture += lost * period;
                self.shared.with(|i| i.late += lost);
            }
            sleep_until(capture + self.latency_ns);
            if !self.wait_for_arm(capture) {
                // The arm's pose at the exposure is unknown: a missing pair is better than a wrong one.
                self.publisher.skip();
                self.shared.with(|i| i.late += 1);
                continue;
            }
            self.pair(node, &active, capture, trigger, (now_ns() - start) as f64 * 1e-9)?;
            if let Some(ready) = ready.take() {
                ready();
            }
        }
        Ok(())
    }

    /// Waits for an arm sample taken after the exposure, so that the joints can be interpolated. False if a connected
    /// and sending controller was late.
    fn wait_for_arm(&self, capture: u64) -> bool {
        if !self.arm.link().0 {
            return true;
        }
        let end = capture + self.latency_ns + MAX_SAMPLE_WAIT_NS;
        while now_ns() < end && self.arm.newest().is_none_or(|s| s.at_ns < capture) {
            sleep_until(now_ns() + 500_000);
        }
        // A longer silence is a fault of the robot; the cameras continue.
        self.arm.newest().is_none_or(|s| s.at_ns >= capture || capture - s.at_ns > MAX_SAMPLE_AGE_NS)
    }

    /// Renders and publishes one pair.
    fn pair(&mut self, node: &ShmNode, active: &[Fault], capture: u64, trigger: u64, t_s: f64) -> Result<(), ShmError> {
        self.follow_moves(active);
        let mut stamps = [capture; 2];
        for f in active {
            if let Fault::Skew { ms } = f {
                stamps[1] = capture.saturating_add_signed((-ms * 1e6) as i64);
            }
        }
        let shot = self.snapshot(active, stamps, trigger);
        if active.iter().any(|f| matches!(f, Fault::Stop { eye: None })) {
            return Ok(());
        }
        if active.iter().any(|f| matches!(f, Fault::Drop { every } if trigger.is_multiple_of((*every).max(1)))) {
            self.publisher.skip();
            return Ok(());
        }
        let before = now_ns();
        let (w, h) = self.renderer.size();
        let mut loan = self.publisher.loan()?;
        let (left, right) = loan.images();
        let swap = active.iter().any(|f| matches!(f, Fault::Swap { .. }));
        let targets = if swap { [right, left] } else { [left, right] };
        for view in View::BOTH {
            let camera = view.index();
            let image = &mut *targets[camera];
            let freeze = active.iter().any(|f| matches!(f, Fault::Freeze { eye } if eye.is_none_or(|e| e == camera)));
            let stopped = active.iter().any(|f| matches!(f, Fault::Stop { eye: Some(e) } if *e == camera));
            if let Some((old, stamp)) = self.held[camera].as_ref().filter(|_| freeze || stopped) {
                image.copy_from_slice(old);
                if stopped {
                    stamps[camera] = *stamp;
                }
                continue;
            }
            self.renderer.draw(view, &shot, image, w);
            for f in active {
                f.degrade_image(camera, image, w, h, t_s, trigger * 2 + camera as u64);
                degrade_marks(f, &self.scenario, view, &shot, image, (w, h));
            }
            self.held[camera] = if freeze || stopped { Some((image.to_vec(), stamps[camera])) } else { None };
        }
        let render_us = (now_ns() - before) as f64 * 1e-3;
        let stamp = FrameStamp {
            capture_ns: stamps,
            publish_ns: now_ns(),
            exposure_ns: EXPOSURE_NS,
            gain_db: 0.0,
            trigger,
            flags: flags::SYNCHRONISED,
        };
        loan.send_with(&stamp, |h| active.iter().for_each(|f| f.corrupt_header(h, t_s)))?;
        self.second_publisher(node, active, &stamp)?;
        let opening = self.opening;
        self.shared.with(|i| {
            i.published += 1;
            i.opening = opening;
            i.render_us += (render_us - i.render_us) * if i.published < 20 { 0.5 } else { 0.02 };
        });
        Ok(())
    }

    /// Gripper pose and jaw opening at the cameras' time stamps, including faults.
    fn snapshot(&mut self, active: &[Fault], stamps: [u64; 2], frame: u64) -> Snapshot {
        let mut pose = stamps.map(|t| self.arm.at(t).map(|s| self.scenario.object_from_gripper(&s.q)));
        let outputs = self.arm.at(stamps[0]).map_or(0, |s| s.outputs);
        // The jaws close to the rim if it is between them, else completely.
        let [least, most] = self.scenario.gripper.opening;
        let close = outputs >> self.close_output.min(63) & 1 == 1;
        let grasped = pose[0].is_some_and(|p| p.translation.vector.norm() < 0.02);
        let rim = 2.0 * self.scenario.stage.wheel.outer_radius();
        let goal = if !close {
            most
        } else if grasped {
            rim.clamp(least, most)
        } else {
            least
        };
        let step = JAW_SPEED_M_S / self.rate;
        self.opening += (goal - self.opening).clamp(-step, step);
        let mut hidden_marks = 0;
        let mut hold = false;
        for f in active {
            match f {
                Fault::OccludeMark { mark } if *mark < 32 => hidden_marks |= 1 << mark,
                Fault::HideGripper {} => pose = [None, None],
                Fault::Teleport { mm } => {
                    pose = pose.map(|p| p.map(|p| p * Pose::translation(mm * 1e-3, 0.0, 0.0)));
                }
                Fault::HoldPose {} => hold = true,
                _ => {}
            }
        }
        if hold {
            pose = *self.held_pose.get_or_insert(pose);
        } else {
            self.held_pose = None;
        }
        Snapshot { object_from_gripper: pose, opening: self.opening, frame, hidden_marks }
    }

    /// Starts rendering new fixed layers when a camera or the object is displaced, and takes them over when finished.
    fn follow_moves(&mut self, active: &[Fault]) {
        if let Some((scenario, renderer)) = self.pending.as_ref().and_then(|p| p.try_recv().ok()) {
            (self.scenario, self.renderer) = (scenario, renderer);
            self.shared.set_scenario(self.scenario.clone());
            self.pending = None;
        }
        let moves: Vec<Fault> = active
            .iter()
            .filter(|f| matches!(f, Fault::KnockCamera { .. } | Fault::MoveObject { .. }))
            .cloned()
            .collect();
        if moves == self.moved || self.pending.is_some() {
            return;
        }
        // Revert the previous displacements, apply the present ones.
        let mut s = self.scenario.clone();
        for (list, sign) in [(&self.moved, -1.0), (&moves, 1.0)] {
            let order: Vec<&Fault> = if sign < 0.0 { list.iter().rev().collect() } else { list.iter().collect() };
            for f in order {
                displace(&mut s, f, sign);
            }
        }
        self.moved = moves;
        let (send, receive) = channel();
        std::thread::spawn(move || {
            let renderer = s.renderer();
            let _ = send.send((s, renderer));
        });
        self.pending = Some(receive);
    }

    fn second_publisher(&mut self, node: &ShmNode, active: &[Fault], stamp: &FrameStamp) -> Result<(), ShmError> {
        if !active.iter().any(|f| matches!(f, Fault::SecondPublisher {})) {
            self.second = None;
            return Ok(());
        }
        if self.second.is_none() {
            let own = graspd_shm::create_node(node.names(), "graspd-scene-second")?;
            let publisher = FramePublisher::new(&own, self.publisher.geometry())?;
            self.second = Some((own, publisher));
        }
        if let Some((_, p)) = &mut self.second {
            let mut loan = p.loan()?;
            let (l, r) = loan.images();
            l.fill(0);
            r.fill(0);
            loan.send(stamp)?;
        }
        Ok(())
    }
}

/// Displaces a camera or the object (`sign` 1), or reverts that (-1).
fn displace(s: &mut Scenario, f: &Fault, sign: f64) {
    match f {
        Fault::KnockCamera { eye, mm, deg } => {
            let turn = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), deg.to_radians());
            let knock = Pose::from_parts(Vector3::new(mm * 1e-3, 0.0, 0.0).into(), turn);
            // new_from_old coordinates of the camera.
            let knock = if sign > 0.0 { knock } else { knock.inverse() };
            if *eye == 0 {
                s.base_from_left *= knock.inverse();
                s.true_rig.right_from_left *= knock.inverse();
            } else {
                s.true_rig.right_from_left = knock * s.true_rig.right_from_left;
            }
        }
        Fault::MoveObject { mm } => s.base_from_object *= Pose::translation(sign * mm * 1e-3, 0.0, 0.0),
        _ => {}
    }
}

/// Applies the faults that depend on the positions of marks.
fn degrade_marks(f: &Fault, s: &Scenario, view: View, shot: &Snapshot, image: &mut [u8], (w, h): (usize, usize)) {
    let at = |mark: usize| -> Option<Pixel> {
        let m = s.gripper.gripper.marks.get(mark)?;
        let left = s.left_from_object() * shot.object_from_gripper[view.index()]?;
        s.true_rig.project(view, &(left * Point3::from(m.position)).coords)
    };
    match f {
        Fault::Blob { mark, du, dv, radius, grey } => {
            if let Some(p) = at(*mark) {
                disc(image, w, h, (p.x + du, p.y + dv), radius.clamp(0.5, 200.0), *grey);
            }
        }
        Fault::SwapMarks { a, b } => {
            if let (Some(p), Some(q)) = (at(*a), at(*b)) {
                swap_windows(image, (w, h), p, q, HALF_WINDOW_PX);
            }
        }
        _ => {}
    }
}

fn swap_windows(image: &mut [u8], (w, h): (usize, usize), p: Pixel, q: Pixel, half: i64) {
    let corner = |c: Pixel| (c.x.round() as i64 - half, c.y.round() as i64 - half);
    let ((px, py), (qx, qy)) = (corner(p), corner(q));
    let index = |x: i64, y: i64| {
        let inside = x >= 0 && y >= 0 && x < w as i64 && y < h as i64;
        inside.then(|| y as usize * w + x as usize)
    };
    for j in 0..=2 * half {
        for i in 0..=2 * half {
            if let (Some(a), Some(b)) = (index(px + i, py + j), index(qx + i, qy + j)) {
                image.swap(a, b);
            }
        }
    }
}

/// Sleeps until an instant of CLOCK_MONOTONIC.
fn sleep_until(t_ns: u64) {
    let at = Timespec { tv_sec: (t_ns / 1_000_000_000) as i64, tv_nsec: (t_ns % 1_000_000_000) as i64 };
    let _ = rustix::thread::clock_nanosleep_absolute(ClockId::Monotonic, &at);
}
