//! Synchronizes the command thread with the robot's packages: a bounded phase-locked loop on a fixed grid, without a
//! clock.
//!
//! With a free-running timer the two cycles drift relative to each other, and occasionally the controller sees two
//! commands in one step and none in the next. Here a cycle runs when the robot's package arrives, so that its command
//! reaches the next step. The loop decides when to listen and when to stop waiting. A package that is late or lost
//! never shifts a cycle by more than the tolerance, and without packages the loop is a plain timer.

/// Largest distance of a cycle from its grid point, as a fraction of the period.
const TOLERANCE: f64 = 0.25;
/// Fraction of the phase error that one cycle corrects.
const PROPORTIONAL: f64 = 0.02;
/// Fraction of the phase error that one cycle adds to the estimated drift: critical damping with the proportional part.
const INTEGRAL: f64 = 0.0001;
/// Largest shift of the grid in one cycle, as a fraction of the period.
const SLEW: f64 = 0.02;
/// Largest drift between the two clocks, as a fraction of the period: quartz is within 100 ppm.
const MAX_DRIFT: f64 = 1e-3;
/// Cycles with a package within the tolerance before the loop is locked.
const LOCK_CYCLES: u32 = 50;
/// Cycles without a package after which the lock is lost.
const LOST_CYCLES: u32 = 25;

/// The phase-locked grid. Times are CLOCK_MONOTONIC nanoseconds.
///
/// Each cycle: sleep until [`listen_ns`](Self::listen_ns); wait for the robot's package until
/// [`give_up_ns`](Self::give_up_ns); pass the result to [`arrived`](Self::arrived), which returns when to run; run, and
/// call [`advance`](Self::advance).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PhaseLock {
    period_ns: f64,
    /// Grid point of the next cycle.
    next_ns: u64,
    /// Its fraction of a nanosecond.
    rest_ns: f64,
    /// Difference between the robot's period and that of the grid, ns.
    drift_ns: f64,
    /// Arrival of this cycle's package.
    seen_ns: Option<u64>,
    /// Arrival and time stamp of the newest package that was used.
    last: Option<(u64, f64)>,
    in_place: u32,
    silent: u32,
    locked: bool,
}

impl PhaseLock {
    /// A grid of this period whose first cycle is one period after `now_ns`. It starts unlocked, as a timer.
    pub fn new(period_ns: u64, now_ns: u64) -> PhaseLock {
        let period_ns = period_ns.max(1);
        PhaseLock {
            period_ns: period_ns as f64,
            next_ns: now_ns.saturating_add(period_ns),
            rest_ns: 0.0,
            drift_ns: 0.0,
            seen_ns: None,
            last: None,
            in_place: 0,
            silent: 0,
            locked: false,
        }
    }

    /// Whether the grid is locked to the robot; otherwise it is a timer that searches for the phase.
    pub fn is_locked(&self) -> bool {
        self.locked
    }

    /// Largest distance of a cycle from its grid point, ns.
    pub fn tolerance_ns(&self) -> u64 {
        (self.period_ns * TOLERANCE) as u64
    }

    /// Grid point of the next cycle, ns.
    pub fn next_ns(&self) -> u64 {
        self.next_ns
    }

    /// Estimated drift of the robot's clock, parts per million.
    pub fn drift_ppm(&self) -> f64 {
        self.drift_ns / self.period_ns * 1e6
    }

    /// Time from which to wait for the package, ns. Earlier packages are in the receive buffer by then.
    pub fn listen_ns(&self) -> u64 {
        if self.locked { self.next_ns.saturating_sub(self.tolerance_ns()) } else { 0 }
    }

    /// Time at which to stop waiting, ns: the cycle then runs without a package.
    pub fn give_up_ns(&self) -> u64 {
        if self.locked { self.next_ns.saturating_add(self.tolerance_ns()) } else { self.next_ns }
    }

    /// The wait ended at `now_ns`, with a package or without. Returns when to run the cycle: now, or at its grid point
    /// while the phase is not locked.
    pub fn arrived(&mut self, now_ns: u64, package: bool) -> u64 {
        self.seen_ns = package.then_some(now_ns);
        let early = now_ns < self.next_ns.saturating_sub(self.tolerance_ns());
        if self.locked && !early { now_ns } else { self.next_ns.max(now_ns) }
    }

    /// The cycle has run at `now_ns`; `stamp_s` is the controller's time stamp if exactly one package was read.
    /// Advances the grid and returns the number of missed periods.
    pub fn advance(&mut self, now_ns: u64, stamp_s: Option<f64>) -> u64 {
        let mut step = self.period_ns + self.drift_ns;
        match self.seen_ns.take().zip(stamp_s.filter(|s| s.is_finite())) {
            Some((at, stamp)) => {
                self.silent = 0;
                step += self.correct(at, stamp);
            }
            None => {
                self.silent = self.silent.saturating_add(1);
                if self.silent >= LOST_CYCLES {
                    (self.locked, self.in_place, self.last) = (false, 0, None);
                }
            }
        }
        self.shift(step);
        // Missed periods are counted and skipped: no burst of cycles to catch up.
        let missed = now_ns.saturating_sub(self.next_ns) / self.period_ns as u64;
        let missed = if now_ns >= self.next_ns { missed + 1 } else { 0 };
        if missed > 0 {
            self.shift(missed as f64 * (self.period_ns + self.drift_ns));
        }
        missed
    }

    fn shift(&mut self, by_ns: f64) {
        let by = by_ns + self.rest_ns;
        let whole = crate::math::floor(by.max(0.0));
        self.rest_ns = by.max(0.0) - whole;
        self.next_ns = self.next_ns.saturating_add(whole as u64);
    }

    /// Shift of the grid, ns, for a package with this stamp that arrived at `at`.
    fn correct(&mut self, at: u64, stamp_s: f64) -> f64 {
        // A package delayed by the network arrives late for its stamp, and the next ones early: such a pair carries no
        // information about the phase.
        let consistent = self.last.is_none_or(|(then, stamp)| {
            let passed = at.saturating_sub(then) as f64 - (stamp_s - stamp) * 1e9;
            stamp_s > stamp && crate::math::fabs(passed) < 0.5 * self.period_ns
        });
        self.last = Some((at, stamp_s));
        if !consistent {
            return 0.0;
        }
        let half = 0.5 * self.period_ns;
        let mut error = if at >= self.next_ns { (at - self.next_ns) as f64 } else { -((self.next_ns - at) as f64) };
        // More than half a period early is late for the cycle before.
        if error < -half {
            error += self.period_ns;
        }
        let error = error.clamp(-half, half);
        let in_place = crate::math::fabs(error) <= self.period_ns * TOLERANCE;
        self.in_place = if in_place { self.in_place.saturating_add(1) } else { self.in_place.saturating_sub(10) };
        match self.in_place {
            0 => self.locked = false,
            n if n >= LOCK_CYCLES => {
                self.in_place = LOCK_CYCLES;
                self.locked = true;
            }
            _ => {}
        }
        let most = self.period_ns * SLEW;
        if in_place {
            let drift = self.period_ns * MAX_DRIFT;
            self.drift_ns = (self.drift_ns + INTEGRAL * error).clamp(-drift, drift);
        }
        // Outside the tolerance the slew limit decides: at most 25 cycles for half a period.
        let gain = if in_place { PROPORTIONAL } else { 1.0 };
        (gain * error).clamp(-most, most)
    }
}
