//! A cycle locked to the robot's packages, without a clock of its own: a bounded phase-locked loop on a fixed grid.
//!
//! With a free-running timer the two cycles drift through each other, and now and then the controller sees two commands in one
//! step and none in the next. Here the cycle comes when the robot's package does, so a command always lands in the step after it.
//! The loop decides when to listen and when to stop waiting. A package that is late or lost never moves a cycle by more than the
//! tolerance, and a robot that falls silent leaves a plain timer behind.

/// Share of the period that a cycle may lie from its place on the grid.
const TOLERANCE: f64 = 0.25;
/// Share of the phase error that one cycle corrects.
const PROPORTIONAL: f64 = 0.02;
/// Share of the phase error that one cycle adds to the learnt drift: with the proportional part damped critically.
const INTEGRAL: f64 = 0.0001;
/// Most that one cycle moves the grid, share of the period.
const SLEW: f64 = 0.02;
/// Most that the robot's clock may run off ours, share of the period: quartz is within 100 ppm.
const MAX_DRIFT: f64 = 1e-3;
/// Cycles with a package in place before the lock is claimed.
const LOCK_CYCLES: u32 = 50;
/// Cycles without one after which it is given up.
const LOST_CYCLES: u32 = 25;

/// The phase-locked grid. Times are CLOCK_MONOTONIC nanoseconds.
///
/// Each cycle: sleep until [`listen_ns`](Self::listen_ns); wait for the robot's package until [`give_up_ns`](Self::give_up_ns);
/// hand both to [`arrived`](Self::arrived), which says when to run; run, and call [`advance`](Self::advance).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PhaseLock {
    period_ns: f64,
    /// The place of the coming cycle on the grid, and what is left of it below a nanosecond.
    next_ns: u64,
    rest_ns: f64,
    /// How much longer the robot's period is than ours, ns.
    drift_ns: f64,
    /// When the package of this cycle was seen.
    seen_ns: Option<u64>,
    /// Arrival and time stamp of the newest package that was used.
    last: Option<(u64, f64)>,
    in_place: u32,
    silent: u32,
    locked: bool,
}

impl PhaseLock {
    /// A grid of this period whose first cycle comes a period after `now_ns`. It starts as a timer.
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

    /// Whether the cycle follows the robot; otherwise it is a timer that looks for it.
    pub fn is_locked(&self) -> bool {
        self.locked
    }

    /// Most that a cycle lies from its place on the grid, ns.
    pub fn tolerance_ns(&self) -> u64 {
        (self.period_ns * TOLERANCE) as u64
    }

    /// The place of the coming cycle on the grid.
    pub fn next_ns(&self) -> u64 {
        self.next_ns
    }

    /// How much faster or slower the robot's clock runs than ours, parts per million.
    pub fn drift_ppm(&self) -> f64 {
        self.drift_ns / self.period_ns * 1e6
    }

    /// From when on to wait for the package. Earlier ones are waiting then.
    pub fn listen_ns(&self) -> u64 {
        if self.locked { self.next_ns.saturating_sub(self.tolerance_ns()) } else { 0 }
    }

    /// When to stop waiting: the cycle then comes without a package.
    pub fn give_up_ns(&self) -> u64 {
        if self.locked { self.next_ns.saturating_add(self.tolerance_ns()) } else { self.next_ns }
    }

    /// The wait ended at `now_ns`, with a package or without. Returns when to run the cycle: now, or, while the phase is being
    /// looked for, at its place on the grid.
    pub fn arrived(&mut self, now_ns: u64, package: bool) -> u64 {
        self.seen_ns = package.then_some(now_ns);
        let early = now_ns < self.next_ns.saturating_sub(self.tolerance_ns());
        if self.locked && !early { now_ns } else { self.next_ns.max(now_ns) }
    }

    /// The cycle has run at `now_ns`; `stamp_s` is the controller's time in the package if exactly one was read in it. Moves the
    /// grid on and returns how many whole periods were missed.
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
        self.move_on(step);
        // A late cycle is counted and the grid kept: no burst to catch up.
        let missed = now_ns.saturating_sub(self.next_ns) / self.period_ns as u64;
        let missed = if now_ns >= self.next_ns { missed + 1 } else { 0 };
        if missed > 0 {
            self.move_on(missed as f64 * (self.period_ns + self.drift_ns));
        }
        missed
    }

    fn move_on(&mut self, by_ns: f64) {
        let by = by_ns + self.rest_ns;
        let whole = crate::math::floor(by.max(0.0));
        self.rest_ns = by.max(0.0) - whole;
        self.next_ns = self.next_ns.saturating_add(whole as u64);
    }

    /// What the grid has to move, ns, for a package with this stamp that was seen at `at`.
    fn correct(&mut self, at: u64, stamp_s: f64) -> f64 {
        // A package that was held back on the way comes too late for its stamp, and the ones behind it too early: such a pair
        // says nothing about the phase.
        let honest = self.last.is_none_or(|(then, stamp)| {
            let passed = at.saturating_sub(then) as f64 - (stamp_s - stamp) * 1e9;
            stamp_s > stamp && crate::math::fabs(passed) < 0.5 * self.period_ns
        });
        self.last = Some((at, stamp_s));
        if !honest {
            return 0.0;
        }
        let half = 0.5 * self.period_ns;
        let mut error = if at >= self.next_ns { (at - self.next_ns) as f64 } else { -((self.next_ns - at) as f64) };
        // Just after the cycle before is late for that one, not early for this one.
        if error < -half {
            error += self.period_ns;
        }
        let error = error.clamp(-half, half);
        let place = crate::math::fabs(error) <= self.period_ns * TOLERANCE;
        self.in_place = if place { self.in_place.saturating_add(1) } else { self.in_place.saturating_sub(10) };
        match self.in_place {
            0 => self.locked = false,
            n if n >= LOCK_CYCLES => {
                self.in_place = LOCK_CYCLES;
                self.locked = true;
            }
            _ => {}
        }
        let most = self.period_ns * SLEW;
        if place {
            let drift = self.period_ns * MAX_DRIFT;
            self.drift_ns = (self.drift_ns + INTEGRAL * error).clamp(-drift, drift);
        }
        // Far away only the slew counts: it gets there in fifty cycles.
        let gain = if place { PROPORTIONAL } else { 1.0 };
        (gain * error).clamp(-most, most)
    }
}
