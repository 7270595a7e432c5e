//! Killing any one of the three processes at a random instant of the motion stops the arm, leaves the others alive with a named reason,
//! and what comes back never moves by itself.
//!
//! One round in a test run; `GRASPD_KILLS=30 cargo test --release -p graspd --test kill_any_process -- --nocapture` plays more.
#![cfg(feature = "demo")]
#![allow(clippy::unwrap_used)] // a test: a failure is to be seen at once

mod cell;

use cell::{Process, World, ask, summary};
use std::time::{Duration, SystemTime};

/// Instants of the motion: SplitMix64 from the time of day, which is printed.
struct Instants(u64);

impl Instants {
    fn next(&mut self) -> Duration {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        Duration::from_millis(100 + (z ^ (z >> 31)) % 2000)
    }
}

/// The last episode of motion, which must be over: when it began to rest, and the last heartbeat before that, ms apart.
fn time_to_rest(mock: &Process) -> f64 {
    let seen = summary(mock);
    let last = seen["episodes"].as_array().unwrap().last().unwrap().clone();
    assert!(last["peak_rate"].as_f64().unwrap() > 0.005, "it was moving: {last}");
    let (rest, heartbeat) = (last["rest_ns"].as_u64().unwrap(), last["last_heartbeat_ns"].as_u64().unwrap());
    assert!(rest > 0, "the arm is at rest: {last}");
    rest.saturating_sub(heartbeat) as f64 * 1e-6
}

fn episodes(mock: &Process) -> u64 {
    summary(mock)["episode_count"].as_u64().unwrap()
}

/// Back to the start of the way, so that every round has one.
fn rewind(world: &World, mock: &Process) {
    let said = ask(mock, &format!(r#"{{"cmd":"teleport","q":[{}]}}"#, world.joints));
    assert_eq!(said["ok"], true, "{said}");
    std::thread::sleep(Duration::from_millis(300));
    if world.state().0 == "fault" {
        world.clear();
    }
}

/// The text that the daemon's log has gained since.
fn since(log: &str, before: usize) -> &str {
    log.get(before..).unwrap_or(log)
}

#[test]
fn any_process_may_be_killed_at_any_moment_of_the_motion() {
    let rounds = std::env::var("GRASPD_KILLS").ok().and_then(|n| n.parse().ok()).unwrap_or(1);
    let seed = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap().as_nanos() as u64;
    println!("instants from {seed}");
    let mut instants = Instants(seed);
    let world = World::new(11);
    let (mut mock, mut scene, mut daemon) = (world.mock(), world.scene(), world.daemon());
    for round in 0..rounds {
        // The daemon: the robot's own side stops the arm.
        let at = instants.next();
        world.servo(at);
        daemon.kill();
        std::thread::sleep(Duration::from_millis(700));
        let stop_ms = time_to_rest(&mock);
        println!("round {round}: daemon killed after {at:?}: at rest {stop_ms:.1} ms after its last heartbeat");
        // 50 ms watchdog, 125 ms ramp from full speed, and what a stalled host adds to the mock's own heartbeat.
        assert!(stop_ms < 50.0 + 125.0 + 125.0, "{stop_ms} ms");
        assert!(mock.alive() && scene.alive());
        // A restart is idle and moves nothing by itself.
        let before = episodes(&mock);
        daemon = world.daemon();
        std::thread::sleep(Duration::from_secs(2));
        let (state, _) = world.state();
        assert!(matches!(state.as_str(), "idle" | "tracking"), "{state}");
        assert_eq!(episodes(&mock), before, "a restart must not move the arm");
        rewind(&world, &mock);

        // The cameras: a named reason, the others alive.
        let at = instants.next();
        let before = world.log().len();
        world.servo(at);
        scene.kill();
        let log = world.stopped();
        let new = since(&log, before);
        assert!(["F-CAM-01", "H-01", "H-10"].iter().any(|c| new.contains(c)), "{new}");
        println!("round {round}: cameras killed after {at:?}: {}", world.state().1);
        assert!(daemon.alive() && mock.alive());
        scene = world.scene();
        std::thread::sleep(Duration::from_millis(500));
        assert_ne!(world.state().0, "servoing", "images that come back start nothing");
        if world.state().0 == "fault" {
            world.clear();
        }
        rewind(&world, &mock);

        // The controller: a named reason, the others alive.
        let at = instants.next();
        let before = world.log().len();
        world.servo(at);
        assert_eq!(summary(&mock)["limit_violations"].as_u64(), Some(0));
        mock.kill();
        let log = world.stopped();
        let new = since(&log, before);
        assert!(["F-ARM-01", "F-ARM-02", "F-ARM-03"].iter().any(|c| new.contains(c)), "{new}");
        println!("round {round}: controller killed after {at:?}: {}", world.state().1);
        assert!(daemon.alive() && scene.alive());
        // And back: it connects again, and stays where it is.
        mock = world.mock();
        std::thread::sleep(Duration::from_secs(3));
        assert_eq!(episodes(&mock), 0, "a controller that comes back is not moved");
        world.clear();
    }
    drop((daemon, scene, mock));
    let _ = std::fs::remove_dir_all(&world.folder);
}
