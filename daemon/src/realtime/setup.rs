//! Real-time scheduling of threads, with a message for everything that the host refuses.

use super::sys;
use rustix::mm::{MlockAllFlags, mlockall};
use rustix::thread::{CpuSet, sched_setaffinity};

/// Priority and CPU of one real-time thread.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ThreadSettings {
    /// SCHED_FIFO priority; 0 leaves the thread under the ordinary scheduler.
    pub priority: u8,
    /// CPU to pin the thread to.
    pub core: Option<usize>,
}

/// What the host refused.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RealtimeReport {
    /// One message for each refused setting, with what to do. Empty where nothing was refused.
    pub refused: Vec<String>,
}

impl RealtimeReport {
    /// Whether nothing was refused.
    pub fn complete(&self) -> bool {
        self.refused.is_empty()
    }
}

/// Locks the present and future memory of the process. Future mappings are locked page by page on first access, so that
/// a camera that reconnects does not stall the mapping thread until its whole segment is resident.
pub fn lock_memory(report: &mut RealtimeReport) {
    if let Err(e) = mlockall(MlockAllFlags::CURRENT | MlockAllFlags::FUTURE | MlockAllFlags::ONFAULT) {
        report.refused.push(format!(
            "memory could not be locked ({e}): a page fault may delay a cycle; raise RLIMIT_MEMLOCK (systemd: LimitMEMLOCK=infinity)"
        ));
    }
}

/// Sets priority and CPU of the calling thread, and touches the pages of its stack.
pub fn enter(name: &str, settings: &ThreadSettings, report: &mut RealtimeReport) {
    if let Some(core) = settings.core {
        if core >= CpuSet::MAX_CPU {
            report
                .refused
                .push(format!("thread {name}: core {core} does not exist; change loop.{name}_core in graspd.toml"));
        } else {
            let mut set = CpuSet::new();
            set.set(core);
            if let Err(e) = sched_setaffinity(None, &set) {
                report.refused.push(format!(
                    "thread {name} could not be pinned to core {core} ({e}); change loop.{name}_core in graspd.toml"
                ));
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

/// Touches 256 KiB of stack, so that no call of a cycle touches a stack page for the first time.
#[inline(never)]
fn prefault_stack() {
    let mut page = [0u8; 256 * 1024];
    for i in (0..page.len()).step_by(4096) {
        page[i] = 1;
        std::hint::black_box(&page[i]);
    }
}
