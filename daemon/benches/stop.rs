//! Time from a stop request to the first decelerating set-point, by every path, under load:
//! `cargo bench -p graspd --bench stop -- [TRIES]`.
//!
//! The daemon's log is blocked, clients request the status 1,000 times a second, and two threads use the processors.
//! Stops are measured in the mock controller's wire record. Tries in which the daemon's cycle missed a deadline, which
//! is the host's doing, are listed both with the others and separately.
#![allow(clippy::unwrap_used)] // a failure must panic

#[path = "../tests/cell/mod.rs"]
mod cell;
#[path = "../tests/cell/stops.rs"]
mod stops;
#[path = "../tests/cell/wire.rs"]
mod wire;

use cell::{Extra, Process, World, ask, summary};
use graspd::realtime::now_ns;
use graspd_shm::control::{RequestClient, Verb};
use graspd_shm::create_node;
use rustix::process::Signal;
use std::process::Stdio;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use stops::{Cell, Load, Stop, by_socket, daemon_on, full_pipe, judge};

/// Repeats a request until it is accepted; false after three seconds.
fn insist(client: &RequestClient, verb: Verb, payload: &[u8]) -> bool {
    let until = Instant::now() + Duration::from_secs(3);
    while Instant::now() < until {
        if client.ask(verb, payload, now_ns(), Duration::from_secs(1)).is_ok_and(|a| a.accepted) {
            return true;
        }
        std::thread::sleep(Duration::from_millis(10));
    }
    false
}

fn print(path: &str, what: &str, stops: &[&Stop]) {
    if stops.is_empty() {
        return;
    }
    let mut ms: Vec<f64> = stops.iter().map(|s| s.latency_ms).collect();
    ms.sort_by(f64::total_cmp);
    let at = |q: f64| ms[(q * (ms.len() - 1) as f64).round() as usize];
    let (p50, p99, max) = (at(0.5), at(0.99), at(1.0));
    println!("{path:<8} {what:<26} {:5} tries  p50 {p50:6.2}  p99 {p99:6.2}  max {max:6.2} ms", ms.len());
}

fn main() {
    let tries: usize = std::env::args().filter_map(|a| a.parse().ok()).next().unwrap_or(1000);
    let mut cell = Cell::new(51);
    let names = cell.names();
    let (err, _kept) = full_pipe();
    let daemon = daemon_on(&cell.world, Stdio::null(), err);
    let plan = std::fs::read(cell.world.path("plan.toml")).unwrap();
    let node = create_node(&names, "graspd-bench").unwrap();
    let client = RequestClient::new(&node).unwrap();
    let ends = AtomicBool::new(false);
    let (mut all, mut failed, mut skipped) = ([const { Vec::<Stop>::new() }; 3], 0, 0);
    std::thread::scope(|scope| {
        let load = Load::start(scope, &names, 1000);
        for _ in 0..2 {
            scope.spawn(|| {
                while !ends.load(Ordering::Relaxed) {
                    std::hint::spin_loop();
                }
            });
        }
        let mut wait = 0.37;
        for n in 0..4 * tries.max(1) {
            let path = n % 3;
            if all.iter().all(|v| v.len() >= tries) {
                break;
            }
            if n % 6 == 0 {
                ask(&cell.mock, &format!(r#"{{"cmd":"teleport","q":[{}]}}"#, cell.world.joints));
                std::thread::sleep(Duration::from_millis(250));
            }
            let ready = insist(&client, Verb::Setpoint, &plan)
                && insist(&client, Verb::Arm, b"")
                && insist(&client, Verb::Servo, b"");
            if !ready {
                // A stall of the host may end the control script.
                cell.world.verb(&["recover"]);
                cell.world.verb(&["reset"]);
                skipped += 1;
                continue;
            }
            wait = (wait * 7.31) % 0.3;
            std::thread::sleep(Duration::from_secs_f64(0.25 + wait));
            cell.wire.read();
            let asked = now_ns();
            match path {
                0 => stops::by_verb_of(&client),
                1 => by_socket(&names),
                _ => daemon.signal(Signal::USR1),
            }
            std::thread::sleep(Duration::from_millis(450));
            match judge(&cell.wire.read(), asked) {
                Ok(stop) => all[path].push(stop),
                Err(e) if e.starts_with(char::is_uppercase) => {
                    println!("FAILED: {e}");
                    failed += 1;
                    client.ask(Verb::Stop, b"", now_ns(), Duration::from_secs(1)).ok();
                }
                Err(_) => skipped += 1,
            }
        }
        ends.store(true, Ordering::Relaxed);
        println!("load: {:.0} requests a second answered, two threads spinning, the daemon's log blocked", load.end());
    });
    for (path, stops) in ["verb", "socket", "SIGUSR1"].iter().zip(&all) {
        print(path, "all", &stops.iter().collect::<Vec<_>>());
        print(path, "no missed deadline", &stops.iter().filter(|s| !s.missed()).collect::<Vec<_>>());
        print(path, "with missed deadlines", &stops.iter().filter(|s| s.missed()).collect::<Vec<_>>());
    }
    println!("failed: {failed}; skipped without motion: {skipped}");
    cell.check_limits();
    drop(daemon);
    cell.clean();
    assert_eq!(failed, 0);
}
