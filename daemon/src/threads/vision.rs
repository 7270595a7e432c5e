//! The vision thread: takes the newest stereo pair, tracks it and passes the gripper pose on. It owns the frame
//! subscriber, and nothing that it does can delay the command cycle.

use super::frame_refusal::FrameRefusal;
use super::shared::{RigSeen, Seed, Shared};
use crate::config::Config;
use crate::realtime::{CycleTimer, now_ns};
use crate::stop::StopSource;
use graspd_rt::arm::Dh;
use graspd_rt::image::ImageView;
use graspd_rt::online::rig_watch::RigWatchSettings;
use graspd_rt::online::{ArmMotion, FrameLimits, StereoFrame, VisionCycle, VisionSettings, mid_exposure_ns};
use graspd_shm::frame::{FramePolicy, FrameSubscriber, SourceEvent};
use graspd_shm::{ShmError, ShmNode};
use std::sync::atomic::Ordering;

/// Number of consecutive identical images at which the camera counts as frozen, if the arm moves. Fewer may be equal by
/// chance when the marks hardly move.
const MIN_FROZEN_FRAMES: u32 = 5;

/// The vision thread's state; created on the thread that runs it.
#[derive(Debug)]
pub struct VisionWorker<'a> {
    shared: &'a Shared,
    subscriber: FrameSubscriber,
    cycle: VisionCycle,
    arm: ArmMotion,
    /// Mono8 copies of images in other formats; unused when the camera sends mono8.
    converted: [Vec<u8>; 2],
}

/// What the frame topic has to carry for the configured rig.
pub fn policy(config: &Config) -> FramePolicy {
    let rig = &config.rig.rig;
    FramePolicy {
        size: Some((rig.left.width, rig.left.height)),
        // A driver that states a calibration has to state this one.
        calibration: config.rig.id(),
        ..FramePolicy::default()
    }
}

impl<'a> VisionWorker<'a> {
    /// Joins the frame topic and allocates everything that the thread needs.
    ///
    /// # Errors
    /// When the frame topic cannot be joined.
    pub fn new(config: &Config, dh: Dh, node: &ShmNode, shared: &'a Shared) -> Result<Self, ShmError> {
        let subscriber = FrameSubscriber::new(node, policy(config))?;
        let settings = VisionSettings {
            rig: RigWatchSettings { rig_error: config.rig.error(), ..RigWatchSettings::default() },
            frame: FrameLimits { max_skew_ns: config.frames.max_skew_ns, ..FrameLimits::default() },
            ..VisionSettings::default()
        };
        let gripper = config.gripper.gripper.clone();
        let pixels = |c: &graspd_rt::geom::Camera| vec![0_u8; c.width as usize * c.height as usize];
        Ok(Self {
            shared,
            subscriber,
            arm: ArmMotion::new(dh, gripper.flange_from_gripper),
            cycle: VisionCycle::new(config.rig.rig, gripper, settings),
            converted: [pixels(&config.rig.rig.left), pixels(&config.rig.rig.right)],
        })
    }

    /// Runs until shutdown.
    pub fn run(&mut self, poll_ns: u64) {
        let mut timer = CycleTimer::new(poll_ns, 0);
        while !self.shared.ending() {
            timer.wait();
            self.poll();
            self.shared.vision_cycles.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Polls the frame topic once, and tracks the newest pair if there is a new one.
    pub fn poll(&mut self) {
        while let Some(s) = self.shared.joints.pop() {
            self.arm.push(s.at_ns, &s.q);
        }
        let now = now_ns();
        let Self { subscriber, cycle, arm, converted, shared } = self;
        let received = subscriber.newest(now);
        let counters = &shared.counters;
        counters.skipped.fetch_add(received.skipped, Ordering::Relaxed);
        if let Some(reject) = received.last_error {
            counters.refused.fetch_add(u64::from(received.rejected), Ordering::Relaxed);
            counters.refusal.store(FrameRefusal::Topic(reject).number(), Ordering::Relaxed);
        }
        let refuse = |why: FrameRefusal| {
            counters.refused.fetch_add(1, Ordering::Relaxed);
            counters.refusal.store(why.number(), Ordering::Relaxed);
        };
        match received.source {
            Some(SourceEvent::First | SourceEvent::TakenOver) => cycle.reset(),
            // It is unknown which of the two publishers shows this rig: the arm must not move by either.
            Some(SourceEvent::SecondPublisher) => shared.live.stop(StopSource::SecondPublisher),
            None => {}
        }
        let Some(frame) = received.frame else {
            shared.needs_seed.store(cycle.needs_acquisition(), Ordering::Release);
            return;
        };
        let (w, h, stride) = (frame.width(), frame.height(), frame.stride());
        // Stride of the view's grey image, and whether it is read in place.
        let mut grey = |view: usize| -> Option<(usize, bool)> {
            if frame.mono8(view).is_some() {
                return Some((stride, true));
            }
            frame.write_mono8(view, &mut converted[view]).then_some((w, false))
        };
        let (Some(l), Some(r)) = (grey(0), grey(1)) else {
            refuse(FrameRefusal::Images);
            return;
        };
        let bytes = |view: usize, in_place: bool| {
            if in_place { frame.mono8(view).unwrap_or(&[]) } else { &converted[view][..] }
        };
        let images = (ImageView::new(bytes(0, l.1), w, h, l.0), ImageView::new(bytes(1, r.1), w, h, r.0));
        let (Some(left), Some(right)) = images else {
            refuse(FrameRefusal::Images);
            return;
        };
        let capture_ns = frame.capture_ns();
        let exposed_ns = mid_exposure_ns(capture_ns);
        if let Some(Seed { left_from_gripper, capture_ns }) = shared.seed.take()
            && cycle.needs_acquisition()
        {
            cycle.seed(arm.carried(&left_from_gripper, capture_ns, exposed_ns).unwrap_or(left_from_gripper));
            counters.acquired.fetch_add(1, Ordering::Relaxed);
        }
        let pair = StereoFrame { left, right, sequence: frame.sequence(), capture_ns, now_ns: now };
        match cycle.step(&pair, arm.base_from_gripper(exposed_ns)) {
            // A frozen image is old, whatever its stamps say: without a new result the last one ages.
            Ok(_) if cycle.health().frozen_run >= MIN_FROZEN_FRAMES && arm.moved_before(exposed_ns) => {
                refuse(FrameRefusal::Frozen);
            }
            Ok(vision) => {
                counters.frames.fetch_add(1, Ordering::Relaxed);
                let residual_px = [vision.residual_px, vision.inner_residual_px];
                shared.rig_seen.put(RigSeen { rig: vision.rig, seen: vision.seen, residual_px });
                shared.vision.put(vision);
                shared.vision_seen.put(vision);
            }
            Err(reject) => refuse(FrameRefusal::Tracker(reject)),
        }
        shared.needs_seed.store(cycle.needs_acquisition(), Ordering::Release);
    }
}
