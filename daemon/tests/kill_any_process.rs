//! Killing any one of the three processes in the middle of the motion stops the arm, leaves the others alive with a named reason, and
//! what comes back never moves by itself.
#![cfg(feature = "demo")]
#![allow(clippy::unwrap_used)] // a test: a failure is to be seen at once

mod cell;

use cell::{World, summary};
use std::time::Duration;

#[test]
fn any_process_may_be_killed_in_motion() {
    let world = World::new(11);
    let mut mock = world.mock();
    let mut scene = world.scene();
    let mut daemon = world.daemon();

    // The daemon: the robot's own side stops the arm.
    world.servo(Duration::from_millis(900));
    daemon.kill();
    std::thread::sleep(Duration::from_millis(700));
    let seen = summary(&mock);
    let last = seen["episodes"].as_array().unwrap().last().unwrap().clone();
    assert!(last["peak_rate"].as_f64().unwrap() > 0.01, "it was moving: {last}");
    let (rest, beat) = (last["rest_ns"].as_u64().unwrap(), last["last_beat_ns"].as_u64().unwrap());
    assert!(rest > 0, "the arm is at rest: {last}");
    // 50 ms watchdog, 125 ms ramp from full speed, and what a stalled host adds to the mock's own beat: 182 ms in quiet.
    let stop_ms = rest.saturating_sub(beat) as f64 * 1e-6;
    println!("SIGKILL of the daemon: at rest {stop_ms:.1} ms after its last beat");
    assert!(stop_ms < 50.0 + 125.0 + 125.0, "{stop_ms} ms");
    assert!(mock.alive() && scene.alive());

    // A restart is idle and moves nothing by itself.
    let before = summary(&mock)["episode_count"].as_u64().unwrap();
    daemon = world.daemon();
    std::thread::sleep(Duration::from_secs(3));
    let (state, _) = world.state();
    assert!(matches!(state.as_str(), "idle" | "tracking"), "{state}");
    assert_eq!(summary(&mock)["episode_count"].as_u64().unwrap(), before, "a restart must not move the arm");

    // The cameras: a named reason, the others alive.
    world.servo(Duration::from_millis(500));
    scene.kill();
    let log = world.stopped();
    assert!(log.contains("F-CAM-01") || log.contains("H-01"), "{log}");
    assert!(daemon.alive() && mock.alive());
    scene = world.scene();
    std::thread::sleep(Duration::from_secs(1));
    assert_ne!(world.state().0, "servoing", "pictures that come back start nothing");
    if world.state().0 == "fault" {
        world.clear();
    }

    // The controller: a named reason, the others alive.
    world.servo(Duration::from_millis(500));
    assert_eq!(summary(&mock)["limit_violations"].as_u64(), Some(0));
    mock.kill();
    let log = world.stopped();
    assert!(log.contains("F-ARM-01") || log.contains("F-ARM-02") || log.contains("F-ARM-03"), "{log}");
    assert!(daemon.alive() && scene.alive());
    // And back: it connects again, and stays where it is.
    mock = world.mock();
    std::thread::sleep(Duration::from_secs(4));
    assert_eq!(summary(&mock)["episode_count"].as_u64(), Some(0), "a controller that comes back is not moved");
    drop((daemon, scene, mock));
    let _ = std::fs::remove_dir_all(&world.folder);
}
