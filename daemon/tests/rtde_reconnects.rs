//! The link manager against a controller behind a hostile wire: resets and closes at random points of the handshake, sizes that lie,
//! single bytes, drips, silence, refused inputs, a peer that never reads. Whatever happens: no panic, nothing left behind, a named
//! reason each time, bounded time, and never a command to move.
//!
//! Sixty connections by default, `GRASPD_RECONNECTS=1000 cargo test --release -p graspd --test rtde_reconnects -- --nocapture` for all.
#![cfg(feature = "demo")]
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test: a failure is to be seen at once

#[path = "cell/hostile.rs"]
mod hostile;

use graspd::arm::RecoverTimes;
use graspd::config::{Config, cycle_config};
use graspd::links::{LinkManager, Pace};
use graspd::threads::{CommandWorker, Report, Shared};
use graspd_hil::controller::{Hosted, Setup};
use graspd_hil::scenario::{Options, Scenario};
use graspd_rt::arm::Dh;
use graspd_rt::cycle::CommandCycle;
use graspd_rt::mode::ModeName;
use hostile::Wires;
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Reasons that an operator can do something with, by their beginnings.
const REASONS: [&str; 12] = [
    "up",
    "connecting",
    "lost after ",
    "down: cannot reach ",
    "down: Rtde connection failed: ",
    "down: RTDE: ",
    "down: no answer to the RTDE handshake from the controller within ",
    "down: no robot state from the controller within ",
    "down: another program runs on the robot",
    "down: the control script did not start within ",
    "down: the robot is not ready",
    "down: Secondary connection failed: ",
];

fn resident_kb() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    status.lines().find_map(|l| l.strip_prefix("VmRSS:")?.split_whitespace().next()?.parse().ok()).unwrap()
}

fn descriptors() -> usize {
    std::fs::read_dir("/proc/self/fd").unwrap().count()
}

fn config(address: &str) -> Config {
    let folder = std::env::temp_dir().join(format!("graspd-reconnects-{}", std::process::id()));
    Scenario::from_seed(1, &Options::default()).unwrap().save(&folder.join("world")).unwrap();
    let text = format!(
        "[files]\nrig = \"world/rig.toml\"\ngripper = \"world/gripper.toml\"\n[arm]\nmodel = \"ur5e\"\naddress = \"{address}\"\n\
         kinematics = \"nominal\"\n[loop]\nbest_effort = true\n"
    );
    std::fs::write(folder.join("graspd.toml"), text).unwrap();
    let config = Config::load(&folder.join("graspd.toml")).unwrap();
    std::fs::remove_dir_all(&folder).unwrap();
    config
}

#[test]
fn a_hostile_wire_leaves_nothing_behind_and_moves_nothing() {
    let rounds: usize = std::env::var("GRASPD_RECONNECTS").ok().and_then(|v| v.parse().ok()).unwrap_or(60);
    let mock = Hosted::start(Setup::new(graspd_hil::plant::Model::by_name("ur5e").unwrap()), None, None).unwrap();
    let wires = Wires::start(mock.address, 7);
    let config = config(&wires.address.to_string());
    let (shared, report, recover) = (Shared::default(), Report::default(), AtomicBool::new(false));
    let pace = Pace {
        timeout: Duration::from_millis(500),
        // Long enough to be seen by the loop below, short enough for a thousand.
        backoff: |_| Duration::from_millis(20),
        recover: RecoverTimes::default(),
    };
    let cycle = CommandCycle::new(cycle_config(&config, Dh::nominal(config.model), false)).unwrap();
    let mut reasons: BTreeMap<String, usize> = BTreeMap::new();
    let mut before = None;
    let start = Instant::now();
    std::thread::scope(|scope| {
        scope.spawn(|| LinkManager::with_pace(&config, &shared, &report, &recover, pace).run());
        scope.spawn(|| CommandWorker::new(cycle, &shared).run(config.period_ns(), 0));
        let (mut last, mut lost) = (String::new(), String::new());
        let limit = Duration::from_secs(60 + 3 * rounds as u64);
        while wires.connections() < rounds && start.elapsed() < limit {
            while let Some(note) = shared.records.pop() {
                assert_eq!(note.record.mode, ModeName::Idle, "a new link arms nothing");
            }
            let said: serde_json::Value =
                serde_json::from_str(&report.json(true, None, "", &shared.live, serde_json::Value::Null)).unwrap();
            let words = |key: &str| said[key].as_str().unwrap().to_owned();
            // A loss is followed by the next attempt at once, and is remembered.
            for (robot, last) in [(words("robot"), &mut last), (words("robot_last_loss"), &mut lost)] {
                if robot != *last && !robot.is_empty() {
                    let key = REASONS.iter().find(|r| robot.starts_with(**r));
                    let key = key.unwrap_or_else(|| panic!("not a reason that anybody knows: {robot}"));
                    // What follows the general words tells them apart.
                    let tail = if key.ends_with("RTDE: ") || key.ends_with("failed: ") { 44 } else { 0 };
                    let mut words: String = robot.chars().take(key.chars().count() + tail).collect();
                    if let (true, Some((_, why))) = (key.starts_with("lost"), robot.split_once("missed): ")) {
                        words.push_str(why);
                    }
                    *reasons.entry(words).or_default() += 1;
                }
                *last = robot;
            }
            if before.is_none() && wires.connections() >= rounds / 4 {
                before = Some((resident_kb(), descriptors()));
            }
            std::thread::sleep(Duration::from_millis(2));
        }
        shared.shutdown.store(true, Ordering::Release);
    });
    let took = start.elapsed();
    drop(shared.link_dead.take());
    drop(shared.link_ready.take());
    wires.settle();
    let (before, after) = (before.unwrap(), (resident_kb(), descriptors()));
    println!("{} connections in {:.0} s: {:?}", wires.connections(), took.as_secs_f64(), wires.kinds());
    println!("reasons:");
    for (words, n) in &reasons {
        println!("  {n:6} {words}");
    }
    println!("memory {} kB, then {} kB; descriptors {}, then {}", before.0, after.0, before.1, after.1);
    assert!(wires.connections() >= rounds, "only {} connections in time", wires.connections());
    assert_eq!(wires.commands_to_move(), 0, "nobody armed anything");
    assert!(wires.commands() > 0, "some sessions came as far as commands");
    assert!(reasons.keys().filter(|r| r.starts_with("down") || r.starts_with("lost")).count() >= 4, "{reasons:?}");
    assert!(after.1 <= before.1 + 4, "descriptors are left open");
    assert!(after.0 <= before.0 + 8192, "memory grows");
}
