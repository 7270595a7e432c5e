//! The phase lock on a virtual clock: jitter, drift, lost and delayed packages, silence, a controller that restarts.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

use graspd_rt::rtde::PhaseLock;

const PERIOD: u64 = 2_000_000;
const START: u64 = 5_000_000_000;

/// Repeatable randomness in [0, 1).
struct Random(u64);

impl Random {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 11) as f64 / (1u64 << 53) as f64
    }
}

/// A robot and the network to it.
struct Robot {
    /// Drift of its clock, relative.
    ppm: f64,
    /// Its first step, ns.
    phase: u64,
    /// Delay of a package: at least this, and up to that much more, ns.
    delay: u64,
    jitter: f64,
    /// Fraction of packages that are lost, and that are 5 ms late.
    lost: f64,
    held: f64,
    /// Silent between these times, ns.
    silence: (u64, u64),
    /// From this time on its steps are this much later, ns: it was restarted.
    restart: (u64, u64),
}

impl Default for Robot {
    fn default() -> Self {
        Robot {
            ppm: 0.0,
            phase: START + 900_000,
            delay: 150_000,
            jitter: 300_000.0,
            lost: 0.0,
            held: 0.0,
            silence: (u64::MAX, u64::MAX),
            restart: (u64::MAX, 0),
        }
    }
}

/// One cycle.
#[derive(Clone, Copy, Debug)]
struct Cycle {
    at: u64,
    /// Its grid point.
    place: u64,
    locked: bool,
    /// Time from the mean arrival of the package to that grid point, ns, wrapped to half a period.
    phase: f64,
}

/// Runs a phase lock with a robot for a number of cycles of `compute` ns.
fn run(robot: &Robot, cycles: usize, compute: u64, seed: u64) -> (PhaseLock, Vec<Cycle>) {
    let mut random = Random(seed);
    let period = PERIOD as f64 * (1.0 + robot.ppm * 1e-6);
    // Arrivals in order, as TCP delivers them: a delayed package delays those after it.
    let mut arrivals = Vec::new();
    let mut held_until = 0u64;
    for k in 0..2 * cycles {
        let mut step = robot.phase + (k as f64 * period) as u64;
        if step >= robot.restart.0 {
            step += robot.restart.1;
        }
        let mut at = step + robot.delay + (random.next() * robot.jitter) as u64;
        if random.next() < robot.held {
            at += 5_000_000;
        }
        held_until = held_until.max(at);
        if random.next() >= robot.lost && !(robot.silence.0..robot.silence.1).contains(&step) {
            arrivals.push((held_until, 100.0 + k as f64 * 0.002, step));
        }
    }
    let mut lock = PhaseLock::new(PERIOD, START);
    let (mut now, mut read, mut seen) = (START, 0, Vec::new());
    for _ in 0..cycles {
        // Sleep, wait, sleep, as the command thread does.
        now = now.max(lock.listen_ns());
        let come = arrivals.get(read).map_or(u64::MAX, |a| a.0.max(now));
        let package = come <= lock.give_up_ns();
        now = if package { come } else { now.max(lock.give_up_ns()) };
        now = now.max(lock.arrived(now, package));
        let usual = robot.phase as f64 + robot.delay as f64 + 0.5 * robot.jitter;
        let turns = (lock.next_ns() as f64 - usual) / period;
        let cycle =
            Cycle { at: now, place: lock.next_ns(), locked: lock.is_locked(), phase: (turns - turns.round()) * period };
        seen.push(cycle);
        // Take the newest package.
        let from = read;
        while arrivals.get(read).is_some_and(|a| a.0 <= now) {
            read += 1;
        }
        let stamp = (read == from + 1).then(|| arrivals[from].1);
        now += compute;
        lock.advance(now, stamp);
    }
    (lock, seen)
}

/// Properties of every cycle of every run, locked or not.
fn check_bounds(lock: &PhaseLock, cycles: &[Cycle]) {
    let tolerance = lock.tolerance_ns();
    for pair in cycles.windows(2) {
        let [a, b] = [pair[0], pair[1]];
        assert!(b.at.abs_diff(b.place) <= tolerance, "a cycle left its place: {b:?}");
        let step = b.place as f64 - a.place as f64;
        // Slew and drift together move the grid by less than 2.2 % of a period.
        assert!((step - PERIOD as f64).abs() <= 0.022 * PERIOD as f64, "the grid jumped by {step} ns");
    }
}

#[test]
fn locks_within_a_second_and_stays_locked_with_jitter_drift_and_losses() {
    for (seed, ppm) in [100.0, -100.0, 0.0, 30.0].into_iter().enumerate() {
        let robot = Robot { ppm, lost: 0.05, ..Robot::default() };
        let (lock, cycles) = run(&robot, 60_000, 200_000, seed as u64);
        check_bounds(&lock, &cycles);
        let first = cycles.iter().position(|b| b.locked).unwrap();
        assert!(first < 500, "locked only at cycle {first}");
        for b in &cycles[first..] {
            assert!(b.locked, "lost the lock at {ppm} ppm");
        }
        for b in &cycles[1000..] {
            assert!(b.phase.abs() <= 0.5 * lock.tolerance_ns() as f64, "{ppm} ppm: {b:?}");
        }
        assert!((lock.drift_ppm() - ppm).abs() < 70.0, "learnt {} ppm of {ppm}", lock.drift_ppm());
    }
}

#[test]
fn every_phase_at_the_start_is_found() {
    for k in 0..40 {
        let robot = Robot { phase: START + k * PERIOD / 40, ppm: 50.0, ..Robot::default() };
        let (lock, cycles) = run(&robot, 2000, 150_000, k);
        check_bounds(&lock, &cycles);
        let first = cycles.iter().position(|b| b.locked).unwrap();
        assert!(first < 500, "phase {k}/40: locked at cycle {first}");
        assert!(cycles[1000..].iter().all(|b| b.locked && b.phase.abs() < 250_000.0), "phase {k}/40");
    }
}

#[test]
fn delayed_packages_do_not_shift_the_grid() {
    let robot = Robot { ppm: -80.0, held: 0.01, ..Robot::default() };
    let (lock, cycles) = run(&robot, 30_000, 200_000, 3);
    check_bounds(&lock, &cycles);
    let first = cycles.iter().position(|b| b.locked).unwrap();
    let locked = cycles[first..].iter().filter(|b| b.locked).count();
    assert!(locked * 100 > 98 * (cycles.len() - first), "{locked} of {}", cycles.len() - first);
}

#[test]
fn without_packages_it_is_a_timer_and_locks_again_afterwards() {
    let silence = (START + 4_000_000_000, START + 8_000_000_000);
    let robot = Robot { ppm: 100.0, silence, ..Robot::default() };
    let (lock, cycles) = run(&robot, 8000, 200_000, 9);
    check_bounds(&lock, &cycles);
    let at = |t: u64| cycles.iter().find(|b| b.at > t).unwrap();
    assert!(at(silence.0 - 1_000_000_000).locked);
    let given_up = at(silence.0 + 100_000_000);
    assert!(!given_up.locked, "25 silent cycles end the lock: {given_up:?}");
    // It continues with the estimated drift.
    let during: Vec<_> = cycles.iter().filter(|b| b.at > silence.0 + 100_000_000 && b.at < silence.1).collect();
    let mean = (during.last().unwrap().at - during[0].at) as f64 / (during.len() - 1) as f64;
    assert!((mean - PERIOD as f64).abs() < 400.0, "{mean} ns");
    assert!(at(silence.1 + 1_000_000_000).locked && cycles.last().unwrap().locked);
}

#[test]
fn a_restart_at_another_phase_is_followed_without_a_jump() {
    for shift in [300_000, 1_000_000, 1_700_000] {
        let robot = Robot { restart: (START + 3_000_000_000, shift), ..Robot::default() };
        let (lock, cycles) = run(&robot, 5000, 200_000, shift);
        check_bounds(&lock, &cycles);
        assert!(cycles.last().unwrap().locked, "shift {shift}");
    }
}

#[test]
fn missed_periods_are_counted_and_the_grid_is_kept() {
    let mut lock = PhaseLock::new(PERIOD, START);
    let first = lock.next_ns();
    assert_eq!(lock.arrived(first, false), first);
    assert_eq!(lock.advance(first + 9_000_000, None), 4);
    assert_eq!((lock.next_ns() - first) % PERIOD, 0);
    assert!(lock.next_ns() > first + 9_000_000);
}

#[test]
fn nan_stamps_and_jumping_clocks_keep_the_bounds() {
    let mut lock = PhaseLock::new(PERIOD, START);
    let mut now = START;
    let mut last = lock.next_ns();
    for (k, stamp) in
        [f64::NAN, f64::INFINITY, -1.0, 1e300, 0.0, 5.0, f64::MIN].into_iter().cycle().take(500).enumerate()
    {
        now = now.max(lock.listen_ns()) + (k as u64 * 7919) % 1_500_000;
        now = now.max(lock.arrived(now, true));
        lock.advance(now, Some(stamp));
        assert!(lock.next_ns() > last);
        last = lock.next_ns();
    }
    assert!(lock.drift_ppm().abs() <= 1000.0);
}
