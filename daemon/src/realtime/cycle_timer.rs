//! A fixed-rate timer with absolute deadlines.

use rustix::thread::{ClockId, clock_nanosleep_absolute};
use rustix::time::{Timespec, clock_gettime};

/// CLOCK_MONOTONIC now, in nanoseconds.
pub fn now_ns() -> u64 {
    let t = clock_gettime(ClockId::Monotonic);
    u64::try_from(t.tv_sec).unwrap_or(0) * 1_000_000_000 + u64::try_from(t.tv_nsec).unwrap_or(0)
}

/// The start of one cycle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tick {
    /// Deadline, CLOCK_MONOTONIC, ns.
    pub deadline_ns: u64,
    /// Time at which the thread woke, ns.
    pub woke_ns: u64,
    /// Number of whole periods missed since the last cycle.
    pub skipped: u64,
}

impl Tick {
    /// Delay of the wake-up, ns.
    pub fn lateness_ns(&self) -> u64 {
        self.woke_ns.saturating_sub(self.deadline_ns)
    }
}

/// A periodic timer on a fixed grid: missed periods are counted and never made up by a burst of cycles.
#[derive(Debug)]
pub struct CycleTimer {
    period_ns: u64,
    spin_ns: u64,
    next_ns: u64,
}

impl CycleTimer {
    /// A timer with this period; the first deadline is one period from now. With `spin_ns` above zero the thread wakes
    /// that much earlier and spins to the deadline. At most a fifth of the period is used: the kernel throttles FIFO
    /// threads that never sleep.
    pub fn new(period_ns: u64, spin_ns: u64) -> Self {
        let period_ns = period_ns.max(1);
        Self { period_ns, spin_ns: spin_ns.min(period_ns / 5), next_ns: now_ns() + period_ns }
    }

    /// Sleeps until the next deadline.
    pub fn wait(&mut self) -> Tick {
        let deadline = self.next_ns;
        sleep_until(deadline.saturating_sub(self.spin_ns));
        while self.spin_ns > 0 && now_ns() < deadline {
            std::hint::spin_loop();
        }
        let woke = now_ns();
        let skipped = woke.saturating_sub(deadline) / self.period_ns;
        self.next_ns = deadline + (skipped + 1) * self.period_ns;
        Tick { deadline_ns: deadline, woke_ns: woke, skipped }
    }
}

/// Sleeps until a time of CLOCK_MONOTONIC, ns; returns immediately when it has passed.
pub fn sleep_until(until_ns: u64) {
    let ts = Timespec {
        tv_sec: i64::try_from(until_ns / 1_000_000_000).unwrap_or(i64::MAX),
        tv_nsec: i64::try_from(until_ns % 1_000_000_000).unwrap_or(0),
    };
    // After EINTR the sleep continues to the same deadline. No other error is possible for a valid time on this clock;
    // it would only make this cycle early, and no cycle late.
    while let Err(rustix::io::Errno::INTR) = clock_nanosleep_absolute(ClockId::Monotonic, &ts) {}
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stall_does_not_shift_the_grid() {
        let mut timer = CycleTimer::new(2_000_000, 0);
        let first = timer.wait();
        std::thread::sleep(std::time::Duration::from_millis(9));
        let late = timer.wait();
        assert!(late.skipped >= 2, "a stall of 4.5 periods skips whole periods: {late:?}");
        let next = timer.wait();
        assert_eq!((next.deadline_ns - first.deadline_ns) % 2_000_000, 0, "deadlines stay on one grid");
        assert!(next.deadline_ns > late.woke_ns, "no burst of cycles to catch up");
    }
}
