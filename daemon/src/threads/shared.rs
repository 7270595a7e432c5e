//! What the threads share: mailboxes and bounded queues, made before the threads start.

use super::cycle_report::CycleReport;
use super::mailbox::Mailbox;
use crate::arm::ArmLink;
use crate::log;
use crate::stop::LiveState;
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

/// Joint positions at a time, from the command thread to the vision thread.
#[derive(Clone, Copy, Debug)]
pub struct JointSample {
    /// CLOCK_MONOTONIC, ns.
    pub at_ns: u64,
    /// Joint positions, rad.
    pub q: Joints,
}

/// An acquired gripper pose, and the exposure time of its stereo pair.
#[derive(Clone, Copy, Debug)]
pub struct Seed {
    /// Gripper in the left camera's frame.
    pub left_from_gripper: Pose,
    /// Mid-exposure time of the pair, CLOCK_MONOTONIC, ns.
    pub capture_ns: u64,
}

/// State of the rig in the newest pair, for the status verb.
#[derive(Clone, Copy, Debug)]
pub struct RigSeen {
    /// The rig's state by the marks.
    pub rig: RigHealth,
    /// Marks seen, left and right.
    pub seen: [u8; 2],
    /// Residual of the marks, px, and its part that an error of the rig does not explain.
    pub residual_px: [f64; 2],
}

/// Counters of the vision thread, for telemetry.
#[derive(Debug, Default)]
pub struct VisionCounters {
    /// Pairs tracked.
    pub frames: AtomicU64,
    /// Pairs that were superseded by a newer one, or that never arrived.
    pub skipped: AtomicU64,
    /// Pairs refused.
    pub refused: AtomicU64,
    /// Acquisitions from which tracking started.
    pub acquired: AtomicU64,
    /// Why the last pair was refused, as [`super::FrameRefusal::number`] gives it; 0 before the first one.
    pub refusal: AtomicU32,
}

/// Everything the threads share.
pub struct Shared {
    /// Vision to command: the newest result.
    pub vision: Mailbox<Vision>,
    /// Vision to telemetry: the newest result.
    pub vision_seen: Mailbox<Vision>,
    /// Vision to acquisition, which formats it: the rig's state in the newest pair.
    pub rig_seen: Mailbox<RigSeen>,
    /// Command to vision: joint positions.
    pub joints: ArrayQueue<JointSample>,
    /// Acquisition to vision: an acquired pose.
    pub seed: Mailbox<Seed>,
    /// Set while the vision thread has no track.
    pub needs_seed: AtomicBool,
    /// Service to command: a set-point.
    pub setpoint: Mailbox<SetPoint>,
    /// Command to service: the answer to an offered set-point.
    pub setpoint_reply: Mailbox<Result<(), Reject>>,
    /// Service to command: requests, of which each cycle takes one.
    pub requests: ArrayQueue<CommandRequest>,
    /// Command to service: answers.
    pub replies: ArrayQueue<Reply>,
    /// The stop latch, which precedes every queued request, and the state after the last cycle.
    pub live: Arc<LiveState>,
    /// Command to telemetry: one record a cycle.
    pub records: ArrayQueue<CycleReport>,
    /// Link manager to command: a link that is up.
    pub link_ready: Mailbox<Box<dyn ArmLink>>,
    /// Command to link manager: a link that failed.
    pub link_dead: Mailbox<Box<dyn ArmLink>>,
    /// Set by the link manager when the command thread has to return its link.
    pub drop_link: AtomicBool,
    /// Counters of the vision thread.
    pub counters: VisionCounters,
    /// Number of polls of the vision thread.
    pub vision_cycles: AtomicU64,
    /// Set when a thread failed: the command thread stops the arm, and the process ends with a fault.
    pub broken: AtomicBool,
    /// What happened to the shared memory, once it is damaged.
    pub damage: OnceLock<String>,
    /// Set when all threads have to end.
    pub shutdown: AtomicBool,
}

impl Default for Shared {
    fn default() -> Self {
        Self {
            vision: Mailbox::default(),
            vision_seen: Mailbox::default(),
            rig_seen: Mailbox::default(),
            joints: ArrayQueue::new(256),
            seed: Mailbox::default(),
            needs_seed: AtomicBool::new(true),
            setpoint: Mailbox::default(),
            setpoint_reply: Mailbox::default(),
            requests: ArrayQueue::new(8),
            replies: ArrayQueue::new(8),
            live: Arc::default(),
            records: ArrayQueue::new(2048),
            link_ready: Mailbox::default(),
            link_dead: Mailbox::default(),
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

    /// Runs a thread's work; a panic in it sets [`Shared::broken`].
    pub fn guarded(&self, name: &str, work: impl FnOnce()) {
        if std::panic::catch_unwind(std::panic::AssertUnwindSafe(work)).is_err() {
            self.broken.store(true, Ordering::Release);
            log::message(format_args!(
                "thread {name} panicked, which is a bug of graspd; the arm is being stopped. Please report the lines above."
            ));
        }
    }
}

impl std::fmt::Debug for Shared {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Shared").field("broken", &self.broken).field("shutdown", &self.shutdown).finish_non_exhaustive()
    }
}
