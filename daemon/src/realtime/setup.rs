//! Entering real time, and saying in words what the host refused.

use super::sys;
use rustix::mm::{MlockAllFlags, mlockall};
use rustix::thread::{CpuSet, sched_setaffinity};

/// Priority and place of one real-time thread.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ThreadSettings {
    /// SCHED_FIFO priority; 0 leaves the thread under the ordinary scheduler.
    pub priority: u8,
    /// CPU to pin the thread to.
    pub core: Option<usize>,
}

/// What was asked of the host and what it gave.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RealtimeReport {
    /// One sentence for each thing that was refused, with what to do about it. Empty on a host that gave everything.
    pub refused: Vec<String>,
}

impl RealtimeReport {
    /// Whether the host gave everything that was asked for.
    pub fn complete(&self) -> bool {
        self.refused.is_empty()
    }
}

/// Locks the process's present and future memory; future mappings are locked only as they are touched, so that a camera that
/// reconnects cannot stall the mapping thread for the time its whole segment takes to fault in.
pub fn lock_memory(report: &mut RealtimeReport) {
    if let Err(e) = mlockall(MlockAllFlags::CURRENT | MlockAllFlags::FUTURE | MlockAllFlags::ONFAULT) {
        report.refused.push(format!(
            "memory could not be locked ({e}): a page fault may delay the loop; raise RLIMIT_MEMLOCK (systemd: LimitMEMLOCK=infinity)"
        ));
    }
}

/// Gives the calling thread its priority and place, and faults in a stack's worth of pages.
pub fn enter(name: &str, settings: &ThreadSettings, report: &mut RealtimeReport) {
    if let Some(core) = settings.core {
        if core >= CpuSet::MAX_CPU {
            report.refused.push(format!("thread {name}: core {core} does not exist; change loop.core in graspd.toml"));
        } else {
            let mut set = CpuSet::new();
            set.set(core);
            if let Err(e) = sched_setaffinity(None, &set) {
                report
                    .refused
                    .push(format!("thread {name} could not be pinned to core {core} ({e}); change the core in [loop]"));
            }
        }
    }
    if settings.priority > 0
        && let Err(e) = sys::set_fifo(settings.priority)
    {
        report.refused.push(format!(
            "thread {name} runs without real-time priority ({e}): latency is not bounded; raise RLIMIT_RTPRIO (systemd: LimitRTPRIO=90)"
        ));
    }
    prefault_stack();
}

/// Touches 256 KiB of stack so that the loop's deepest call never meets a page for the first time.
#[inline(never)]
fn prefault_stack() {
    let mut page = [0u8; 256 * 1024];
    for i in (0..page.len()).step_by(4096) {
        page[i] = 1;
        std::hint::black_box(&page[i]);
    }
}
