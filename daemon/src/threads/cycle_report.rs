//! The record of one command cycle, from the command thread to the telemetry thread.

use graspd_rt::cycle::{CycleRecord, Transition};

/// What the command thread records about one cycle.
#[derive(Clone, Copy, Debug)]
pub struct CycleReport {
    /// Input and result of the cycle.
    pub record: CycleRecord,
    /// A change of mode.
    pub event: Option<Transition>,
    /// How late the thread woke, ns.
    pub wakeup_ns: u64,
    /// Time from waking to the command sent, ns.
    pub compute_ns: u64,
    /// Whole periods missed before this cycle.
    pub skipped: u64,
    /// Time from the exposure of a pair to this command, ns, in the first cycle that used the pair.
    pub frame_to_command_ns: Option<u64>,
    /// Time from a command to its echo, ns, when a new echo arrived.
    pub round_trip_ns: Option<u64>,
    /// 0 down, 1 connecting, 2 up.
    pub link: u32,
    /// The controller's robot mode and safety status bits.
    pub robot: (i32, u32),
}
