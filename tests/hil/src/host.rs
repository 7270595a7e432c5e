//! Scheduling priority. The simulated controller and cameras stand for separate machines, so they must not wait for
//! other work of the host.

use std::num::NonZeroU64;
use thread_priority::unix::{set_thread_priority_and_policy, thread_native_id};
use thread_priority::{RealtimeThreadSchedulePolicy, ThreadPriority, ThreadPriorityValue, ThreadSchedulePolicy};

/// SCHED_FIFO priority of the mock controller. It is above the daemon's threads, because the real controller is
/// another machine.
pub(crate) const CONTROLLER_FIFO: u8 = 92;
/// SCHED_FIFO priority of the thread that samples the joints for the images.
pub(crate) const EXPOSURE_FIFO: u8 = 90;

/// Niceness of the renderer. It uses a third of a processor. The kernel stops *all* real-time threads of a processor
/// for 50 ms when they use more than 95 % of a second, so the renderer only gets a priority among ordinary programs.
pub(crate) const RENDERER_NICE: i32 = -10;

/// Requests a niceness for this process. With session autogrouping the kernel schedules sessions against each other, so
/// the process first becomes a session leader.
pub(crate) fn prefer_this_process(nice: i32) {
    let _ = rustix::process::setsid();
    let own_session = rustix::process::getsid(None).is_ok_and(|s| s == rustix::process::getpid());
    if own_session {
        let _ = std::fs::write("/proc/self/autogroup", nice.to_string());
    }
    let _ = rustix::process::setpriority_process(None, nice);
}

/// Puts the calling thread under SCHED_FIFO. Without the privilege for that it requests the niceness `nice` instead.
/// Failures are ignored: an idle host needs neither.
pub(crate) fn prefer_this_thread(fifo: u8, nice: i32) {
    let _ = rustix::thread::set_current_timer_slack(NonZeroU64::new(1));
    let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
    let granted = ThreadPriorityValue::try_from(fifo).is_ok_and(|value| {
        set_thread_priority_and_policy(thread_native_id(), ThreadPriority::Crossplatform(value), policy).is_ok()
    });
    if !granted {
        let _ = rustix::process::setpriority_process(None, nice);
    }
}
