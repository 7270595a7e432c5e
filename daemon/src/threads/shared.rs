//! What the threads share: bounded slots and queues, made before the loop starts.

use super::slot::Slot;
use super::telemetry::CycleReport;
use crate::arm::ArmLink;
use crate::log;
use crate::stop::Live;
use crossbeam::queue::ArrayQueue;
use graspd_rt::arm::Joints;
use graspd_rt::cycle::{CommandRequest, Reply};
use graspd_rt::geom::Pose;
use graspd_rt::mode::Reject;
use graspd_rt::online::Vision;
use graspd_rt::online::rig_watch::RigHealth;
use graspd_rt::setpoint::SetPoint;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};

/// Joint positions at an instant, from the command thread to the vision thread.
#[derive(Clone, Copy, Debug)]
pub struct JointSample {
    /// CLOCK_MONOTONIC nanoseconds.
    pub at_ns: u64,
    /// Joint positions, rad.
    pub q: Joints,
}

/// An acquired pose and the pair it was found in.
#[derive(Clone, Copy, Debug)]
pub struct Seed {
    /// Gripper in the rig.
    pub left_from_gripper: Pose,
    /// Mid-exposure of the pair, CLOCK_MONOTONIC nanoseconds.
    pub capture_ns: u64,
}

/// What the newest pair says about the rig, for the status verb.
#[derive(Clone, Copy, Debug)]
pub struct RigSeen {
    /// The rig as the marks show it.
    pub rig: RigHealth,
    /// Marks seen, left and right.
    pub seen: [u8; 2],
    /// Residual of the marks, pixels, and what of it the rig's error does not explain.
    pub residual_px: [f64; 2],
}

/// Counters of the vision thread, for telemetry.
#[derive(Debug, Default)]
pub struct VisionCounters {
    /// Pairs tracked.
    pub frames: AtomicU64,
    /// Pairs that were never seen because a newer one was there, or that never arrived.
    pub skipped: AtomicU64,
    /// Pairs refused.
    pub refused: AtomicU64,
    /// Acquisitions taken over.
    pub acquired: AtomicU64,
    /// Why the last pair was refused, as [`super::refusal::Refusal::number`] gives it; 0 before the first one.
    pub refusal: AtomicU32,
}

/// Everything the threads share.
pub struct Shared {
    /// Vision to command: the newest result.
    pub vision: Slot<Vision>,
    /// Vision to telemetry: the newest result.
    pub vision_seen: Slot<Vision>,
    /// Vision to acquisition, which puts it in words: the rig as the newest pair shows it.
    pub rig_seen: Slot<RigSeen>,
    /// Command to vision: joints as they were.
    pub joints: ArrayQueue<JointSample>,
    /// Acquisition to vision.
    pub seed: Slot<Seed>,
    /// Set while the vision thread has no track.
    pub needs_seed: AtomicBool,
    /// Service to command: a set-point.
    pub setpoint: Slot<SetPoint>,
    /// Command to service: the answer to an offered set-point.
    pub setpoint_reply: Slot<Result<(), Reject>>,
    /// Service to command: requests, one taken a cycle.
    pub requests: ArrayQueue<CommandRequest>,
    /// Command to service: answers.
    pub replies: ArrayQueue<Reply>,
    /// The stop latch, ahead of every queued request, and what the last cycle did.
    pub live: Arc<Live>,
    /// Command to telemetry: what was noted.
    pub records: ArrayQueue<CycleReport>,
    /// Link manager to command: a link that is ready.
    pub link_ready: Slot<Box<dyn ArmLink>>,
    /// Command to link manager: a link that died.
    pub link_dead: Slot<Box<dyn ArmLink>>,
    /// Set by the link manager when the command thread has to give its link back.
    pub drop_link: AtomicBool,
    /// Counters of the vision thread.
    pub counters: VisionCounters,
    /// Counts looks of the vision thread.
    pub vision_cycles: AtomicU64,
    /// Set when a thread ended by a panic: the command thread stops the arm, the process ends with a failure.
    pub broken: AtomicBool,
    /// What happened to the shared memory, once something did.
    pub damage: OnceLock<String>,
    /// Set when all threads have to end.
    pub shutdown: AtomicBool,
}

impl Default for Shared {
    fn default() -> Self {
        Self {
            vision: Slot::default(),
            vision_seen: Slot::default(),
            rig_seen: Slot::default(),
            joints: ArrayQueue::new(256),
            seed: Slot::default(),
            needs_seed: AtomicBool::new(true),
            setpoint: Slot::default(),
            setpoint_reply: Slot::default(),
            requests: ArrayQueue::new(8),
            replies: ArrayQueue::new(8),
            live: Arc::default(),
            records: ArrayQueue::new(2048),
            link_ready: Slot::default(),
            link_dead: Slot::default(),
            drop_link: AtomicBool::new(false),
            counters: VisionCounters::default(),
            vision_cycles: AtomicU64::new(0),
            broken: AtomicBool::new(false),
            damage: OnceLock::new(),
            shutdown: AtomicBool::new(false),
        }
    }
}

impl Shared {
    /// Whether all threads have to end.
    pub fn ending(&self) -> bool {
        self.shutdown.load(Ordering::Acquire)
    }

    /// Runs a thread's work; a panic in it marks the process as broken instead of being lost.
    pub fn guarded(&self, name: &str, work: impl FnOnce()) {
        if std::panic::catch_unwind(std::panic::AssertUnwindSafe(work)).is_err() {
            self.broken.store(true, Ordering::Release);
            log::say(format_args!(
                "thread {name} ended by a bug of ours; the arm is being stopped. Please report the lines above."
            ));
        }
    }
}

impl std::fmt::Debug for Shared {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Shared").field("broken", &self.broken).field("shutdown", &self.shutdown).finish_non_exhaustive()
    }
}
