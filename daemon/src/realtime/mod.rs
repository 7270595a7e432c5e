//! What makes a thread a real-time thread: priority, place, locked memory, and a beat on an absolute grid.

mod beat;
mod setup;
mod sys;

pub use beat::{Beat, Tick, now_ns, sleep_until};
pub use setup::{RealtimeReport, ThreadSettings, enter, lock_memory};
pub use sys::{exit_now, ignore_background_writes, thread_faults};
