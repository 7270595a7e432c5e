//! The vision thread: newest pair, track, gripper pose. It owns the frame subscriber, and nothing it does can delay the arm's cycle.

use super::refusal::Refusal;
use super::shared::{RigSeen, Seed, Shared};
use crate::config::Config;
use crate::realtime::{CycleTimer, now_ns};
use crate::stop::By;
use graspd_rt::arm::Dh;
use graspd_rt::geom::Pose;
use graspd_rt::image::ImageView;
use graspd_rt::online::predict::{JointHistory, left_from_gripper_now};
use graspd_rt::online::rig_watch::RigWatchSettings;
use graspd_rt::online::{FrameLimits, StereoFrame, VisionCycle, VisionSettings};
use graspd_shm::frame::{FramePolicy, FrameSubscriber, SourceEvent};
use graspd_shm::{ShmError, ShmNode};
use std::sync::atomic::Ordering;

/// Equal images in a row that are no accident any more.
const FROZEN_FRAMES: u32 = 5;
/// Joint motion within the last tenth of a second that an image has to show, rad.
const SEEN_MOTION: f64 = 1e-3;

/// Joints this much older than a pair say nothing about where the arm was then, ns: ten packages of 500 Hz.
const JOINTS_OLD_NS: u64 = 20_000_000;

/// Whether the arm moved before `at_ns`, by its encoders.
fn moves(history: &JointHistory, at_ns: u64) -> bool {
    let (Some(now), Some(then)) = (history.at(at_ns), history.at(at_ns.saturating_sub(100_000_000))) else {
        return false;
    };
    now.iter().zip(then).any(|(a, b)| (a - b).abs() > SEEN_MOTION)
}

/// The vision thread's state; made on the thread that runs it.
#[derive(Debug)]
pub struct VisionWorker<'a> {
    shared: &'a Shared,
    subscriber: FrameSubscriber,
    cycle: VisionCycle,
    history: JointHistory,
    dh: Dh,
    flange_from_gripper: Pose,
    /// Mono8 copies for formats that are not; empty when the camera sends mono8.
    converted: [Vec<u8>; 2],
}

/// What the frame topic has to carry for this rig.
pub fn policy(config: &Config) -> FramePolicy {
    let rig = &config.rig.rig;
    FramePolicy {
        size: Some((rig.left.width, rig.left.height)),
        // A driver that says which calibration it was set up with has to mean this one (G08).
        calibration: config.rig.id(),
        ..FramePolicy::default()
    }
}

impl<'a> VisionWorker<'a> {
    /// Joins the frame topic and allocates everything the loop needs.
    ///
    /// # Errors
    /// When the frame topic cannot be joined.
    pub fn new(config: &Config, dh: Dh, node: &ShmNode, shared: &'a Shared) -> Result<Self, ShmError> {
        let subscriber = FrameSubscriber::new(node, policy(config))?;
        let settings = VisionSettings {
            rig: RigWatchSettings { rig_error: config.rig.error(), ..RigWatchSettings::default() },
            frame: FrameLimits { max_skew_ns: (config.raw.vision.max_skew_ms * 1e6) as u64, ..FrameLimits::default() },
            ..VisionSettings::default()
        };
        let gripper = config.gripper.gripper.clone();
        let flange_from_gripper = gripper.flange_from_gripper;
        let pixels = |c: &graspd_rt::geom::Camera| vec![0_u8; c.width as usize * c.height as usize];
        Ok(Self {
            shared,
            subscriber,
            cycle: VisionCycle::new(config.rig.rig, gripper, settings),
            history: JointHistory::default(),
            dh,
            flange_from_gripper,
            converted: [pixels(&config.rig.rig.left), pixels(&config.rig.rig.right)],
        })
    }

    /// Runs until shutdown.
    pub fn run(&mut self, poll_ns: u64) {
        let mut timer = CycleTimer::new(poll_ns, 0);
        while !self.shared.ending() {
            timer.wait();
            self.look();
            self.shared.vision_cycles.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// One look at the frame topic; tracks the newest pair, if there is a new one.
    pub fn look(&mut self) {
        while let Some(s) = self.shared.joints.pop() {
            self.history.push(s.at_ns, &s.q);
        }
        let now = now_ns();
        let Self { subscriber, cycle, history, dh, flange_from_gripper, converted, shared } = self;
        let received = subscriber.newest(now);
        let counters = &shared.counters;
        counters.skipped.fetch_add(received.skipped, Ordering::Relaxed);
        if let Some(reject) = received.last_error {
            counters.refused.fetch_add(u64::from(received.rejected), Ordering::Relaxed);
            counters.refusal.store(Refusal::Topic(reject).number(), Ordering::Relaxed);
        }
        let refuse = |why: Refusal| {
            counters.refused.fetch_add(1, Ordering::Relaxed);
            counters.refusal.store(why.number(), Ordering::Relaxed);
        };
        match received.source {
            Some(SourceEvent::First | SourceEvent::TakenOver) => cycle.reset(),
            // Which of the two shows this rig is not known any more: nothing moves by either (H06).
            Some(SourceEvent::SecondPublisher) => shared.live.stop(By::SecondPublisher),
            None => {}
        }
        let Some(frame) = received.frame else {
            shared.needs_seed.store(cycle.needs_acquisition(), Ordering::Release);
            return;
        };
        let (w, h, stride) = (frame.width(), frame.height(), frame.stride());
        let mut view = |eye: usize| -> Option<(usize, bool)> {
            if frame.mono8(eye).is_some() {
                return Some((stride, true));
            }
            let ok = frame.write_mono8(eye, &mut converted[eye]);
            ok.then_some((w, false))
        };
        let (Some(l), Some(r)) = (view(0), view(1)) else {
            refuse(Refusal::Images);
            return;
        };
        let bytes =
            |eye: usize, direct: bool| if direct { frame.mono8(eye).unwrap_or(&[]) } else { &converted[eye][..] };
        let images = (ImageView::new(bytes(0, l.1), w, h, l.0), ImageView::new(bytes(1, r.1), w, h, r.0));
        let (Some(left), Some(right)) = images else {
            refuse(Refusal::Images);
            return;
        };
        let capture = frame.capture_ns();
        let middle = capture[0].min(capture[1]) + capture[0].abs_diff(capture[1]) / 2;
        let moved = |at: u64, pose: &Pose| -> Option<Pose> {
            let (then, now) = (history.at(at)?, history.at(middle)?);
            Some(left_from_gripper_now(dh, flange_from_gripper, pose, &then, &now))
        };
        if let Some(Seed { left_from_gripper, capture_ns }) = shared.seed.take()
            && cycle.needs_acquisition()
        {
            cycle.seed(moved(capture_ns, &left_from_gripper).unwrap_or(left_from_gripper));
            counters.acquired.fetch_add(1, Ordering::Relaxed);
        }
        let fresh = middle <= history.newest_ns().saturating_add(JOINTS_OLD_NS);
        let joints = history.at(middle).filter(|_| fresh);
        let base_from_gripper = joints.map(|q| dh.base_from_gripper(&q, flange_from_gripper));
        let pair = StereoFrame { left, right, sequence: frame.sequence(), capture_ns: capture, now_ns: now };
        match cycle.step(&pair, base_from_gripper) {
            // What the images say is then old, whatever their stamps say: let it age.
            Ok(_) if cycle.health().frozen_run >= FROZEN_FRAMES && moves(history, middle) => refuse(Refusal::Frozen),
            Ok(vision) => {
                counters.frames.fetch_add(1, Ordering::Relaxed);
                let residual_px = [vision.residual_px, vision.inner_residual_px];
                shared.rig_seen.put(RigSeen { rig: vision.rig, seen: vision.seen, residual_px });
                shared.vision.put(vision);
                shared.vision_seen.put(vision);
            }
            Err(reject) => refuse(Refusal::Tracker(reject)),
        }
        shared.needs_seed.store(cycle.needs_acquisition(), Ordering::Release);
    }
}
