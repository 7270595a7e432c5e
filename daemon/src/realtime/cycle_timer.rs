//! A fixed-rate cycle on absolute deadlines.

use rustix::thread::{ClockId, clock_nanosleep_absolute};
use rustix::time::{Timespec, clock_gettime};

/// CLOCK_MONOTONIC now, in nanoseconds.
pub fn now_ns() -> u64 {
    let t = clock_gettime(ClockId::Monotonic);
    u64::try_from(t.tv_sec).unwrap_or(0) * 1_000_000_000 + u64::try_from(t.tv_nsec).unwrap_or(0)
}

/// One cycle, as it really came.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tick {
    /// When the thread should have woken.
    pub deadline_ns: u64,
    /// When it woke.
    pub woke_ns: u64,
    /// Whole periods of the grid that were missed since the last cycle; 0 in good health.
    pub skipped: u64,
}

impl Tick {
    /// How late the thread woke.
    pub fn lateness_ns(&self) -> u64 {
        self.woke_ns.saturating_sub(self.deadline_ns)
    }
}

/// A periodic cycle that keeps its grid: a late cycle is counted, never caught up with a burst.
#[derive(Debug)]
pub struct CycleTimer {
    period_ns: u64,
    spin_ns: u64,
    next_ns: u64,
}

impl CycleTimer {
    /// A cycle of this period, the first one a period from now. With `spin_ns` above zero the thread wakes that much earlier and
    /// spins to the deadline; it must stay a small share of the period (the kernel throttles FIFO threads that never sleep).
    pub fn new(period_ns: u64, spin_ns: u64) -> Self {
        let period_ns = period_ns.max(1);
        Self { period_ns, spin_ns: spin_ns.min(period_ns / 5), next_ns: now_ns() + period_ns }
    }

    /// Sleeps to the next deadline of the grid.
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

/// Sleeps to an instant of CLOCK_MONOTONIC, ns; returns at once when it has passed.
pub fn sleep_until(until_ns: u64) {
    let ts = Timespec {
        tv_sec: i64::try_from(until_ns / 1_000_000_000).unwrap_or(i64::MAX),
        tv_nsec: i64::try_from(until_ns % 1_000_000_000).unwrap_or(0),
    };
    // EINTR returns early; the deadline stands, so ask again. Any other error cannot happen for a valid time on this clock,
    // and falling through then only makes this cycle early, never the next one late.
    while let Err(rustix::io::Errno::INTR) = clock_nanosleep_absolute(ClockId::Monotonic, &ts) {}
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_grid_is_kept_after_a_stall() {
        let mut b = CycleTimer::new(2_000_000, 0);
        let first = b.wait();
        std::thread::sleep(std::time::Duration::from_millis(9));
        let late = b.wait();
        assert!(late.skipped >= 2, "a stall of 4.5 periods skips whole periods: {late:?}");
        let next = b.wait();
        assert_eq!((next.deadline_ns - first.deadline_ns) % 2_000_000, 0, "deadlines stay on one grid");
        assert!(next.deadline_ns > late.woke_ns, "no burst of cycles to catch up");
    }
}
