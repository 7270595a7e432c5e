//! Asking the host for precedence: a simulated controller and a simulated camera stand for machines of their own, which do not wait
//! for whatever else a computer does.

use std::num::NonZeroU64;
use thread_priority::unix::{set_thread_priority_and_policy, thread_native_id};
use thread_priority::{RealtimeThreadSchedulePolicy, ThreadPriority, ThreadPriorityValue, ThreadSchedulePolicy};

/// SCHED_FIFO priority of the mock controller's servo: above the daemon's threads, as a controller is no part of the daemon's machine.
pub(crate) const CONTROLLER: u8 = 92;
/// Of the camera's look at the arm, which gives every image its joints.
pub(crate) const EXPOSURE: u8 = 90;

/// Niceness of rendering. It takes a third of a processor, and the kernel stops *all* real-time threads of a processor for 50 ms when
/// they take more than 95 % of a second: so it may ask for precedence among ordinary programs only.
pub(crate) const RENDERER: i32 = -10;

/// Asks for niceness against everything else on the host. Where the kernel schedules whole sessions against each other, that takes a
/// session of one's own.
pub(crate) fn prefer_this_process(nice: i32) {
    let _ = rustix::process::setsid();
    let own_session = rustix::process::getsid(None).is_ok_and(|s| s == rustix::process::getpid());
    if own_session {
        let _ = std::fs::write("/proc/self/autogroup", nice.to_string());
    }
    let _ = rustix::process::setpriority_process(None, nice);
}

/// Puts the calling thread under SCHED_FIFO, or, where an ordinary user may not ask for that, asks for the niceness `nice` instead.
/// Best effort: on a quiet host neither is needed.
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
