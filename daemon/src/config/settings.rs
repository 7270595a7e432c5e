//! The checked configuration.

use crate::arm::Motion;
use crate::realtime::ThreadSettings;
use graspd_calib::files::{ContentHash, GripperFile, RigFile};
use graspd_rt::arm::{Dh, Model};
use graspd_rt::cycle::{ConvergeSettings, TaskSettings};
use graspd_rt::guard::{LimitSettings, StopFigures};
use graspd_rt::online::path::PathSettings;
use graspd_rt::online::screw::LawSettings;
use graspd_shm::Names;
use std::path::PathBuf;

/// Which arm.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LinkKind {
    /// A UR controller over RTDE.
    Rtde,
    /// The arm inside the daemon.
    Mock,
}

/// Where the arm's kinematics come from.
#[derive(Clone, Debug, PartialEq)]
pub enum Kinematics {
    /// The controller's own calibration, read from its primary interface.
    Controller,
    /// The model's published values.
    Nominal,
    /// A file, checked against the model.
    File(PathBuf, Box<Dh>),
}

/// What starts a cycle of the command thread.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Clock {
    /// A timer of the host.
    Timer,
    /// The controller's packages, phase-locked.
    Robot,
}

/// `[arm]`
#[derive(Clone, Debug, PartialEq)]
pub struct ArmSettings {
    /// Which arm.
    pub link: LinkKind,
    /// The controller's host name or address.
    pub address: String,
    /// Added to every controller port; 0 on a real robot.
    pub port_offset: u16,
    /// Which model.
    pub model: Model,
    /// Where its kinematics come from.
    pub kinematics: Kinematics,
    /// How motion is commanded.
    pub motion: Motion,
    /// The robot stops when no command came for this long, ms.
    pub watchdog_ms: f64,
}

/// `[loop]`: the two real-time threads.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LoopSettings {
    /// Rate of the command thread, Hz.
    pub rate_hz: f64,
    /// What starts its cycle.
    pub clock: Clock,
    /// Priority and CPU of the command thread.
    pub command: ThreadSettings,
    /// Priority and CPU of the vision thread.
    pub vision: ThreadSettings,
    /// Time for which the command thread spins before its deadline, ns.
    pub spin_ns: u64,
    /// Whether a host without priority or locked memory is refused.
    pub require_realtime: bool,
    /// Whether missed cycles are only counted.
    pub best_effort: bool,
}

impl LoopSettings {
    /// Period of the command cycle, ns.
    pub fn period_ns(&self) -> u64 {
        // The rate was checked: 50 to 1000 Hz.
        (1e9 / self.rate_hz).round() as u64
    }
}

/// `[vision]`: the stereo pairs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FrameSettings {
    /// Period with which the vision thread polls the frame topic, ns.
    pub poll_ns: u64,
    /// Expected time between pairs, ns.
    pub period_ns: u64,
    /// Maximum time between the exposures of the two views, ns.
    pub max_skew_ns: u64,
}

/// A configuration in which every value is in range and every named file was read.
#[derive(Clone, Debug)]
pub struct Config {
    /// Names of the shared-memory services.
    pub names: Names,
    /// The rig.
    pub rig: RigFile,
    /// Path of the rig file.
    pub rig_path: PathBuf,
    /// The gripper.
    pub gripper: GripperFile,
    /// Path of the gripper file.
    pub gripper_path: PathBuf,
    /// The arm.
    pub arm: ArmSettings,
    /// The two real-time threads.
    pub threads: LoopSettings,
    /// The stereo pairs.
    pub frames: FrameSettings,
    /// The control law.
    pub law: LawSettings,
    /// The path to the goal.
    pub path: PathSettings,
    /// When the goal counts as reached.
    pub converge: ConvergeSettings,
    /// The gripper's outputs, and when they are switched.
    pub task: TaskSettings,
    /// Limits of the motion; [`graspd_rt::guard::Limits`] accepts them.
    pub limits: LimitSettings,
    /// The stop from full speed that the limits allow.
    pub stop: StopFigures,
    /// Every file that was read, as it was read.
    pub files: Vec<ReadFile>,
}

/// A file of the configuration: its path and the hash of what was read.
#[derive(Clone, Debug, PartialEq)]
pub struct ReadFile {
    /// Its path.
    pub path: PathBuf,
    /// Hash of its bytes; `None` where they could not be read a second time.
    pub hash: Option<ContentHash>,
}

impl ReadFile {
    /// The file as it is now.
    pub(super) fn read(path: PathBuf) -> Self {
        let hash = std::fs::read(&path).ok().map(|bytes| ContentHash::of(&bytes));
        Self { path, hash }
    }

    /// Whether the contents have changed since.
    pub fn changed(&self) -> bool {
        Self::read(self.path.clone()).hash != self.hash
    }
}
