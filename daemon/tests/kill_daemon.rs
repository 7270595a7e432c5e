//! SIGKILL and SIGSTOP of the real daemon at random times of the motion: the arm starts to decelerate within 50 ms and
//! comes to rest, by the mock's wire record and clock, and a daemon that is continued reports the cause and does not
//! move the arm.
//!
//! Two of each by default; `GRASPD_KILLS=100 cargo test --release -p graspd --test kill_daemon -- --nocapture` for the
//! full run, `GRASPD_MOTION=position` for the same with `servoj`.
#![cfg(feature = "demo")]
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a failure must panic

mod cell;
#[path = "cell/wire.rs"]
mod wire;

use cell::{Extra, Process, World, ask};
use rustix::process::Signal;
use std::collections::BTreeMap;
use std::time::{Duration, Instant};
use wire::{Entry, Wire};

/// Maximum time from the last heartbeat to the start of the ramp, s.
const MAX_REACTION_S: f64 = 0.050;
/// Maximum speed of an arm at rest, rad/s.
const MAX_REST_SPEED: f64 = 1e-3;
/// Deceleration of the ramp, rad/s2: `limits.joint_accel_rad_s2`.
const RAMP: f64 = 4.0;
/// Maximum time from the targets' rest to the drives' rest, s.
const MAX_SETTLE_S: f64 = 0.070;

/// One stop, by the wire record.
#[derive(Clone, Copy, Debug)]
struct Stop {
    /// Fastest joint's target speed at the last heartbeat, rad/s.
    speed: f64,
    /// Time from the last heartbeat to the first step of the ramp, s.
    reaction_s: f64,
    /// Time from there to rest, s.
    ramp_s: f64,
}

/// Measures the stop after the last heartbeat of `entries`. An error that begins with a capital letter is a failure;
/// any other says that the arm was not in motion.
fn judge(entries: &[Entry]) -> Result<Stop, String> {
    let mut last = (None, 0);
    for (i, e) in entries.iter().enumerate() {
        if let Entry::Heartbeat { heartbeat, .. } = e
            && last.0 != Some(*heartbeat)
        {
            last = (Some(*heartbeat), i);
        }
    }
    let steps = |part: &[Entry]| -> Vec<(f64, f64, f64)> {
        part.iter()
            .filter_map(|e| match e {
                Entry::Step { clock_s, target, speed, .. } => Some((*clock_s, *target, *speed)),
                _ => None,
            })
            .collect()
    };
    let (before, after) = entries.split_at(last.1);
    // The step that takes the last heartbeat is the first one after it.
    let heartbeat = steps(before).last().copied().ok_or("no step before the last heartbeat")?;
    let after = steps(after);
    let speed = after.first().ok_or("no step after the last heartbeat")?.1;
    if speed < 0.02 {
        return Err(format!("the arm was at rest or slow: {speed:.4} rad/s"));
    }
    let rest = after.iter().position(|s| s.1 < MAX_REST_SPEED && s.2 < MAX_REST_SPEED);
    let rest =
        rest.ok_or_else(|| format!("NOT AT REST within {:.3} s", after.last().map_or(0.0, |s| s.0) - heartbeat.0))?;
    // One encoder count in a step is 3 mrad/s: the last counts arrive while the drives settle.
    if let Some(again) = after[rest..].iter().find(|s| s.1 >= MAX_REST_SPEED || s.2 >= 20.0 * MAX_REST_SPEED) {
        return Err(format!("MOVED AGAIN: {again:?}"));
    }
    // Back from rest along the slope: the ramp begins where the speed was last constant.
    let begin =
        (1..=rest).rev().find(|&k| after[k].1 > MAX_REST_SPEED && after[k - 1].1 < after[k].1 + 0.3 * RAMP * 0.002);
    let begin = begin.unwrap_or(0);
    let reaction_s = after[begin].0 - heartbeat.0;
    if reaction_s < 0.010 {
        return Err(format!("it was already stopping: the ramp began after {:.0} ms", reaction_s * 1e3));
    }
    Ok(Stop { speed, reaction_s, ramp_s: after[rest].0 - after[begin].0 })
}

/// Reads until the controller's clock is 0.6 s past the last heartbeat: a stalled host stalls that clock as well.
fn read_past_the_stop(wire: &mut Wire) -> Vec<Entry> {
    let (mut entries, start) = (wire.read(), Instant::now());
    loop {
        let clock = |e: &Entry| match e {
            Entry::Step { clock_s, .. } => Some(*clock_s),
            _ => None,
        };
        let last_heartbeat = entries.iter().rposition(|e| matches!(e, Entry::Heartbeat { .. })).unwrap_or(0);
        let after: Vec<f64> = entries.iter().skip(last_heartbeat).filter_map(clock).collect();
        let passed = after.last().zip(after.first()).map_or(0.0, |(b, a)| b - a);
        if passed > 0.6 || start.elapsed() > Duration::from_secs(20) {
            return entries;
        }
        std::thread::sleep(Duration::from_millis(50));
        entries.extend(wire.read());
    }
}

/// Seeded random numbers.
struct Random(u64);

impl Random {
    fn within(&mut self, low: f64, high: f64) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        low + (high - low) * ((self.0 >> 11) as f64 / (1u64 << 53) as f64)
    }
}

/// The results of all stops.
#[derive(Default)]
struct Tally {
    stops: BTreeMap<&'static str, Vec<Stop>>,
    reasons: BTreeMap<String, u32>,
    skipped: BTreeMap<String, u32>,
}

impl Tally {
    /// Records one result. Fails on a failure; a stop without motion is skipped.
    fn record(&mut self, signal: &'static str, result: Result<Stop, String>) -> bool {
        match result {
            Ok(s) => {
                let n = self.stops.get(signal).map_or(0, Vec::len) + 1;
                println!(
                    "{signal} {n}: {:.3} rad/s, ramp after {:.0} ms, rest {:.0} ms later",
                    s.speed,
                    s.reaction_s * 1e3,
                    s.ramp_s * 1e3
                );
                assert!(s.reaction_s <= MAX_REACTION_S + 1e-9, "{signal}: {s:?}");
                assert!(s.ramp_s <= s.speed / RAMP + MAX_SETTLE_S, "{signal}: {s:?}");
                self.stops.entry(signal).or_default().push(s);
                true
            }
            Err(e) => {
                assert!(!e.starts_with(char::is_uppercase), "{signal}: {e}");
                println!("{signal}: skipped, {e}");
                *self.skipped.entry(e.split(':').next().unwrap_or_default().to_owned()).or_default() += 1;
                false
            }
        }
    }

    fn print(&self) {
        for (signal, stops) in &self.stops {
            let column = |name: &str, value: &dyn Fn(&Stop) -> f64| {
                let mut v: Vec<f64> = stops.iter().map(value).collect();
                v.sort_by(f64::total_cmp);
                println!("{signal} {name}: min {:.1}  median {:.1}  max {:.1}", v[0], v[v.len() / 2], v[v.len() - 1]);
            };
            println!("{signal}: {} stops in motion, all within bounds", stops.len());
            column("speed at the last heartbeat, mrad/s", &|s| s.speed * 1e3);
            column("last heartbeat to ramp, ms", &|s| s.reaction_s * 1e3);
            column("ramp to rest, ms", &|s| s.ramp_s * 1e3);
            column("last heartbeat to rest, ms", &|s| (s.reaction_s + s.ramp_s) * 1e3);
        }
        println!("causes after SIGCONT: {:?}", self.reasons);
        println!("skipped: {:?}", self.skipped);
    }
}

/// Continues a stopped daemon: the arm stays at rest, and the cause has a code. Then the daemon is brought back to
/// idle.
fn resume(world: &World, daemon: &Process, wire: &mut Wire, tally: &mut Tally) {
    daemon.signal(Signal::CONT);
    std::thread::sleep(Duration::from_millis(500));
    let (state, cause) = world.state();
    assert_eq!(state, "fault", "after SIGCONT: {cause}");
    let code = cause.split(':').next().unwrap_or_default();
    assert!(code.starts_with("F-"), "a fault has a code: {cause}");
    *tally.reasons.entry(code.to_owned()).or_default() += 1;
    world.insist(&["recover"]);
    world.clear();
    std::thread::sleep(Duration::from_millis(100));
    let moved = wire.read().into_iter().find(|e| matches!(e, Entry::Step { target, .. } if *target >= MAX_REST_SPEED));
    assert_eq!(moved, None, "the arm moved by SIGCONT, recovery or reset");
}

#[test]
fn the_arm_comes_to_rest_within_bounds_when_the_daemon_is_killed_or_stopped() {
    let number = |name: &str| std::env::var(name).ok().and_then(|v| v.parse::<usize>().ok());
    let count = number("GRASPD_KILLS").unwrap_or(2);
    let mut random = Random(number("GRASPD_SEED").unwrap_or(20) as u64);
    let motion = std::env::var("GRASPD_MOTION").unwrap_or_else(|_| "velocity".to_owned());
    let world = World::with(
        11,
        Extra { frame_rate: 30.0, arm: format!("motion = \"{motion}\"\n"), record: true, ..Extra::default() },
    );
    let mock = world.mock();
    let scene = world.scene();
    let mut wire = Wire::open(world.folder.join("wire"));
    let mut tally = Tally::default();
    let (mut killed, mut frozen) = (0, 0);
    for _ in 0..4 * count + 8 {
        if killed >= count && frozen >= count {
            break;
        }
        // Every daemon starts with the arm at the start of its path.
        ask(&mock, &format!(r#"{{"cmd":"teleport","q":[{}]}}"#, world.joints));
        let mut daemon = world.daemon();
        if frozen < count {
            world.servo(Duration::from_secs_f64(random.within(0.3, 2.2)));
            daemon.signal(Signal::STOP);
            if !tally.record("SIGSTOP", judge(&read_past_the_stop(&mut wire))) {
                daemon.kill();
                continue;
            }
            frozen += 1;
            resume(&world, &daemon, &mut wire, &mut tally);
        }
        if killed < count {
            world.servo(Duration::from_secs_f64(random.within(0.3, 2.2)));
            daemon.kill();
            killed += usize::from(tally.record("SIGKILL", judge(&read_past_the_stop(&mut wire))));
        }
        daemon.kill();
        wire.read();
    }
    tally.print();
    assert_eq!((killed, frozen), (count, count), "too few stops in motion");
    let folder = world.folder.clone();
    drop((mock, scene));
    let _ = std::fs::remove_dir_all(folder);
}
