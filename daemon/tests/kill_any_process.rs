//! One of the three processes is killed at a random time of the motion: the arm stops, the others stay alive and report
//! the cause, and a restarted process does not move the arm.
//!
//! One round by default; `GRASPD_KILLS=30 cargo test --release -p graspd --test kill_any_process -- --nocapture` for
//! more.
#![cfg(feature = "demo")]
#![allow(clippy::unwrap_used)] // a failure must panic

mod cell;

use cell::{Process, World, ask, summary};
use std::time::{Duration, SystemTime};

/// Random times of the motion: SplitMix64, seeded with the time of day, which is printed.
struct Times(u64);

impl Times {
    fn next(&mut self) -> Duration {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        Duration::from_millis(100 + (z ^ (z >> 31)) % 2000)
    }
}

/// Time from the last heartbeat to rest in the last episode of motion, ms.
fn time_to_rest(mock: &Process) -> f64 {
    let seen = summary(mock);
    let last = seen["episodes"].as_array().unwrap().last().unwrap().clone();
    assert!(last["peak_rate"].as_f64().unwrap() > 0.005, "the arm moved: {last}");
    let (rest, heartbeat) = (last["rest_ns"].as_u64().unwrap(), last["last_heartbeat_ns"].as_u64().unwrap());
    assert!(rest > 0, "the arm is at rest: {last}");
    rest.saturating_sub(heartbeat) as f64 * 1e-6
}

fn episodes(mock: &Process) -> u64 {
    summary(mock)["episode_count"].as_u64().unwrap()
}

/// Moves the arm to its start, so that every round has a motion.
fn rewind(world: &World, mock: &Process) {
    let answer = ask(mock, &format!(r#"{{"cmd":"teleport","q":[{}]}}"#, world.joints));
    assert_eq!(answer["ok"], true, "{answer}");
    std::thread::sleep(Duration::from_millis(300));
    if world.state().0 == "fault" {
        world.clear();
    }
}

/// The text that was added to the daemon's log.
fn since(log: &str, before: usize) -> &str {
    log.get(before..).unwrap_or(log)
}

#[test]
fn any_process_may_be_killed_at_any_time_of_the_motion() {
    let rounds = std::env::var("GRASPD_KILLS").ok().and_then(|n| n.parse().ok()).unwrap_or(1);
    let seed = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap().as_nanos() as u64;
    println!("seed {seed}");
    let mut times = Times(seed);
    let world = World::new(11);
    let (mut mock, mut scene, mut daemon) = (world.mock(), world.scene(), world.daemon());
    for round in 0..rounds {
        // The daemon: the control script and the watchdog stop the arm.
        let at = times.next();
        world.servo(at);
        daemon.kill();
        std::thread::sleep(Duration::from_millis(700));
        let stop_ms = time_to_rest(&mock);
        println!("round {round}: daemon killed after {at:?}: at rest {stop_ms:.1} ms after its last heartbeat");
        // 50 ms watchdog, 125 ms ramp from full speed, and a margin for a stalled host.
        assert!(stop_ms < 50.0 + 125.0 + 125.0, "{stop_ms} ms");
        assert!(mock.alive() && scene.alive());
        // A restarted daemon is idle and does not move the arm.
        let before = episodes(&mock);
        daemon = world.daemon();
        std::thread::sleep(Duration::from_secs(2));
        let (state, _) = world.state();
        assert!(matches!(state.as_str(), "idle" | "tracking"), "{state}");
        assert_eq!(episodes(&mock), before, "a restart must not move the arm");
        rewind(&world, &mock);

        // The cameras: the cause is reported, the others stay alive.
        let at = times.next();
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
        assert_ne!(world.state().0, "servoing", "new images do not start a motion");
        if world.state().0 == "fault" {
            world.clear();
        }
        rewind(&world, &mock);

        // The controller: the cause is reported, the others stay alive.
        let at = times.next();
        let before = world.log().len();
        world.servo(at);
        assert_eq!(summary(&mock)["limit_violations"].as_u64(), Some(0));
        mock.kill();
        let log = world.stopped();
        let new = since(&log, before);
        assert!(["F-ARM-01", "F-ARM-02", "F-ARM-03"].iter().any(|c| new.contains(c)), "{new}");
        println!("round {round}: controller killed after {at:?}: {}", world.state().1);
        assert!(daemon.alive() && scene.alive());
        // The daemon connects to a new controller and does not move it.
        mock = world.mock();
        std::thread::sleep(Duration::from_secs(3));
        assert_eq!(episodes(&mock), 0, "a restarted controller is not moved");
        world.clear();
    }
    drop((daemon, scene, mock));
    let _ = std::fs::remove_dir_all(&world.folder);
}
