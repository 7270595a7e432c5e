//! Real-time threads: priority, CPU, locked memory, and a timer with absolute deadlines.

mod cycle_timer;
mod setup;
mod sys;

pub use cycle_timer::{CycleTimer, Tick, now_ns, sleep_until};
pub use setup::{RealtimeReport, ThreadSettings, enter, lock_memory};
pub use sys::{exit_now, ignore_background_writes, thread_faults};
