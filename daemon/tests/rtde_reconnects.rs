//! The link manager against a controller behind a hostile connection: resets and closes at random points of the
//! handshake, wrong sizes, single bytes, slow bytes, silence, refused inputs, a peer that never reads. In all cases: no
//! panic, no leaked memory or descriptors, a reason for each failure, bounded time, and no command to move.
//!
//! Sixty connections by default, `GRASPD_RECONNECTS=1000 cargo test --release -p graspd --test rtde_reconnects --
//! --nocapture` for all.
#![cfg(feature = "demo")]
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a failure must panic

#[path = "cell/hostile.rs"]
mod hostile;

use graspd::arm::RecoverTimes;
use graspd::config::{Config, cycle_config};
use graspd::links::{LinkManager, LinkTimes};
use graspd::threads::{CommandWorker, Report, Shared};
use graspd_hil::controller::{Hosted, Setup};
use graspd_hil::scenario::{Options, Scenario};
use graspd_rt::arm::Dh;
use graspd_rt::cycle::CommandCycle;
use graspd_rt::mode::ModeName;
use hostile::Proxy;
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// The states that the link may report, by their beginnings.
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
fn a_hostile_connection_leaks_nothing_and_moves_nothing() {
    let rounds: usize = std::env::var("GRASPD_RECONNECTS").ok().and_then(|v| v.parse().ok()).unwrap_or(60);
    let mock = Hosted::start(Setup::new(graspd_hil::plant::Model::by_name("ur5e").unwrap()), None, None).unwrap();
    let proxy = Proxy::start(mock.address, 7);
    let config = config(&proxy.address.to_string());
    let (shared, report, recover) = (Shared::default(), Report::default(), AtomicBool::new(false));
    let times = LinkTimes {
        timeout: Duration::from_millis(500),
        // Long enough for the loop below to see each state, short enough for a thousand connections.
        backoff: |_| Duration::from_millis(20),
        recover: RecoverTimes::default(),
    };
    let cycle = CommandCycle::new(cycle_config(&config, Dh::nominal(config.arm.model), false)).unwrap();
    let mut reasons: BTreeMap<String, usize> = BTreeMap::new();
    let mut before = None;
    let start = Instant::now();
    std::thread::scope(|scope| {
        scope.spawn(|| LinkManager::with_times(&config, &shared, &report, &recover, times).run());
        scope.spawn(|| CommandWorker::new(cycle, &shared).run(config.threads.period_ns(), 0));
        let (mut last, mut lost) = (String::new(), String::new());
        let limit = Duration::from_secs(60 + 3 * rounds as u64);
        while proxy.connections() < rounds && start.elapsed() < limit {
            while let Some(cycle) = shared.records.pop() {
                assert_eq!(cycle.record.mode, ModeName::Idle, "a new link does not arm");
            }
            let status: serde_json::Value =
                serde_json::from_str(&report.json(true, None, "", &shared.live, serde_json::Value::Null)).unwrap();
            let text = |key: &str| status[key].as_str().unwrap().to_owned();
            // The next attempt follows a loss immediately; `robot_last_loss` keeps the loss.
            for (robot, last) in [(text("robot"), &mut last), (text("robot_last_loss"), &mut lost)] {
                if robot != *last && !robot.is_empty() {
                    let key = REASONS.iter().find(|r| robot.starts_with(**r));
                    let key = key.unwrap_or_else(|| panic!("unknown reason: {robot}"));
                    // The text after these beginnings distinguishes the reasons.
                    let tail = if key.ends_with("RTDE: ") || key.ends_with("failed: ") { 44 } else { 0 };
                    let mut reason: String = robot.chars().take(key.chars().count() + tail).collect();
                    if let (true, Some((_, why))) = (key.starts_with("lost"), robot.split_once("missed): ")) {
                        reason.push_str(why);
                    }
                    *reasons.entry(reason).or_default() += 1;
                }
                *last = robot;
            }
            if before.is_none() && proxy.connections() >= rounds / 4 {
                before = Some((resident_kb(), descriptors()));
            }
            std::thread::sleep(Duration::from_millis(2));
        }
        shared.shutdown.store(true, Ordering::Release);
    });
    let took = start.elapsed();
    drop(shared.link_dead.take());
    drop(shared.link_ready.take());
    proxy.settle();
    let (before, after) = (before.unwrap(), (resident_kb(), descriptors()));
    println!("{} connections in {:.0} s: {:?}", proxy.connections(), took.as_secs_f64(), proxy.kinds());
    println!("reasons:");
    for (reason, n) in &reasons {
        println!("  {n:6} {reason}");
    }
    println!("memory {} kB, then {} kB; descriptors {}, then {}", before.0, after.0, before.1, after.1);
    assert!(proxy.connections() >= rounds, "only {} connections in time", proxy.connections());
    assert_eq!(proxy.commands_to_move(), 0, "a command to move was sent");
    assert!(proxy.commands() > 0, "no session sent a command");
    assert!(reasons.keys().filter(|r| r.starts_with("down") || r.starts_with("lost")).count() >= 4, "{reasons:?}");
    assert!(after.1 <= before.1 + 4, "descriptors are left open");
    assert!(after.0 <= before.0 + 8192, "memory grows");
}
