//! Every stop path and every end of the daemon, on real processes: with the log blocked, closed or on a full disk, by
//! socket, signal and verb, and with a second publisher. Stops are measured in the mock controller's wire record.
#![cfg(feature = "demo")]
#![allow(clippy::unwrap_used)] // a failure must panic

mod cell;
#[path = "cell/stops.rs"]
mod stops;
#[path = "cell/wire.rs"]
mod wire;

use cell::{Extra, Process, World, ask, summary};
use rustix::process::Signal;
use std::process::{Command, Stdio};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};
use stops::{Cell, by_socket, closed_pipe, daemon_on, end_by, full_disk, full_pipe};

/// One cell at a time: two would share the processors, and the bounds are on time.
static ONE: Mutex<()> = Mutex::new(());

/// The status reports the motion, whatever state the log is in.
fn status_reports_motion(cell: &mut Cell) {
    for _ in 0..5 {
        cell.drive(Duration::from_millis(400));
        let (_, status) = cell.world.verb(&["status"]);
        if status["state"] == "servoing" {
            assert_eq!(status["moving"], true, "{status}");
            assert!(cell.world.verb(&["stop"]).0);
            return;
        }
        println!("skipped: {} {}", status["state"], status["cause"]);
        cell.world.verb(&["stop"]);
    }
    panic!("the status never reported servoing");
}

#[test]
fn a_blocked_closed_or_full_log_does_not_prevent_a_stop() {
    let _one = ONE.lock().unwrap_or_else(PoisonError::into_inner);
    let mut cell = Cell::new(31);
    let names = cell.names();
    for what in ["full pipe", "closed pipe", "full disk"] {
        let mut kept = Vec::new();
        let mut stream = || match what {
            "full pipe" => {
                let (end, reader) = full_pipe();
                kept.push(reader);
                end
            }
            "closed pipe" => closed_pipe(),
            _ => full_disk(),
        };
        let mut daemon = daemon_on(&cell.world, stream(), stream());
        status_reports_motion(&mut cell);
        let (_, status) = cell.world.verb(&["status"]);
        if what == "full pipe" {
            assert_eq!(status["log_blocked"], true, "{status}");
        } else {
            assert!(status["log_lines_lost"].as_u64().unwrap() > 0, "{status}");
        }
        let (stop, _) = cell.stop(&mut |_| by_socket(&names));
        stop.check(&format!("{what}, socket"));
        end_by(&mut cell, &mut daemon, Signal::TERM, &format!("{what}, SIGTERM"));
    }
    cell.check_limits();
    cell.clean();
}

/// Lines beyond the capacity of the queue are counted, and logging does not wait.
#[test]
fn lines_beyond_the_capacity_of_the_log_are_dropped_and_counted() {
    let (end, reader) = full_pipe();
    let mut child = Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "many_lines_helper", "--include-ignored", "--nocapture"])
        .env("GRASPD_MANY_LINES", "1")
        .stdout(Stdio::null())
        .stderr(end)
        .spawn()
        .unwrap();
    let started = Instant::now();
    let status = loop {
        if let Some(status) = child.try_wait().unwrap() {
            break status;
        }
        if started.elapsed() > Duration::from_secs(10) {
            child.kill().unwrap();
            panic!("logging waits for an unread pipe");
        }
        std::thread::sleep(Duration::from_millis(10));
    };
    assert!(status.success(), "{status}");
    drop(reader);
}

/// Runs in a separate process whose standard error is blocked; does nothing otherwise.
#[test]
fn many_lines_helper() {
    if std::env::var_os("GRASPD_MANY_LINES").is_none() {
        return;
    }
    graspd::log::start().unwrap();
    let started = Instant::now();
    for n in 0..5000 {
        graspd::log::message(format_args!("line {n}"));
    }
    assert!(started.elapsed() < Duration::from_millis(500), "{:?}", started.elapsed());
    graspd::log::flush(Duration::from_millis(600));
    let lost = graspd::log::lost();
    // 1024 lines wait, and the log thread may be writing one.
    assert!((5000 - 1025..=5000 - 1024).contains(&lost.dropped) && lost.blocked, "{lost:?}");
    graspd::realtime::exit_now(0);
}

#[test]
fn signals_and_the_command_line_stop_the_arm_and_end_the_daemon() {
    let _one = ONE.lock().unwrap_or_else(PoisonError::into_inner);
    let mut cell = Cell::new(32);
    let mut daemon = cell.world.daemon();
    let (stop, _) = cell.stop(&mut |_| daemon.signal(Signal::USR1));
    stop.check("SIGUSR1");
    let (state, cause) = cell.world.state();
    assert_eq!((state.as_str(), cause.contains("by a signal")), ("tracking", true), "{cause}");
    // The complete program, including its start; and with a configuration that has become invalid.
    let config = cell.world.path("graspd.toml");
    let good = std::fs::read_to_string(&config).unwrap();
    for text in [good.clone(), good.replace("[vision]", "[nonsense]\nx = 1\n[vision]").replace("rig.toml", "gone.toml")]
    {
        let (stop, _) = cell.stop(&mut |c| {
            std::fs::write(&config, &text).unwrap();
            let (accepted, answer) = c.world.verb(&["stop"]);
            assert!(accepted && answer["by"] == "socket", "{answer}");
            std::fs::write(&config, &good).unwrap();
        });
        println!("graspd stop as a program: {:.1} ms", stop.latency_ms);
    }
    assert!(cell.world.state().1.contains("the stop socket"));
    // Without the socket the signal goes to the process that holds the lock. The daemon then ends, because clients can
    // no longer find it.
    let names = cell.names();
    let socket = names.root().join(graspd::stop::socket_name("kill"));
    let (stop, _) = cell.stop(&mut |_| {
        std::fs::remove_file(&socket).unwrap();
        let answer = graspd::stop::ask(&names);
        assert!(matches!(answer, graspd::stop::StopAnswer::Signal { .. }), "{answer:?}");
    });
    stop.check("socket deleted, signal by the lock");
    assert_eq!(stops::ended(&mut daemon, Duration::from_secs(4)), Some(4));
    assert!(cell.world.log().contains("kill.stop is gone"), "{}", cell.world.log());
    for (signal, name) in [(Signal::HUP, "SIGHUP"), (Signal::INT, "SIGINT")] {
        let mut daemon = cell.world.daemon();
        end_by(&mut cell, &mut daemon, signal, name);
    }
    // Without a daemon the command fails quickly.
    let started = Instant::now();
    assert!(!cell.world.verb(&["stop"]).0);
    assert!(started.elapsed() < Duration::from_secs(5), "{:?}", started.elapsed());
    cell.check_limits();
    cell.clean();
}

#[test]
fn a_second_publisher_stops_the_arm() {
    let _one = ONE.lock().unwrap_or_else(PoisonError::into_inner);
    let mut cell = Cell::new(33);
    let daemon = cell.world.daemon();
    let mut second: Option<Process> = None;
    cell.drive(Duration::from_millis(300));
    // If its start takes longer than the motion, the next arming is refused.
    second.replace(cell.world.scene());
    let until = Instant::now() + Duration::from_secs(10);
    let cause = loop {
        let (state, cause) = cell.world.state();
        if cause.contains("second program") {
            assert_ne!(state, "servoing");
            break cause;
        }
        if state == "tracking" || state == "armed" {
            // At rest before the second publisher started: arm again.
            cell.world.verb(&["setpoint", &cell.world.path("plan.toml")]);
            cell.world.verb(&["arm"]);
        }
        assert!(Instant::now() < until, "still {state}: {cause}\n{}", cell.world.log());
        std::thread::sleep(Duration::from_millis(30));
    };
    println!("second publisher: {cause}");
    std::thread::sleep(Duration::from_millis(300));
    let (accepted, answer) = cell.world.verb(&["servo"]);
    assert!(!accepted, "{answer}");
    // The connection of the second scene resets the mock's own limit check: the record is checked here instead.
    let sent: Vec<_> = (cell.wire.read().into_iter())
        .filter_map(|e| match e {
            wire::Entry::Heartbeat { heartbeat, mode, rates, .. } => {
                Some((heartbeat, if mode == 1 { rates } else { [0.0; 6] }))
            }
            _ => None,
        })
        .collect();
    for w in sent.windows(2) {
        let room = 4.0 * 0.002 * 1.01 * f64::from((w[1].0 - w[0].0).max(1)) + 1e-9;
        assert!((0..6).all(|i| (w[1].1[i] - w[0].1[i]).abs() <= room && w[1].1[i].abs() <= 0.5 + 1e-9), "{w:?}");
    }
    assert!(sent.iter().any(|s| s.1 != [0.0; 6]), "the arm moved before");
    assert_eq!(sent.last().unwrap().1, [0.0; 6], "at rest");
    drop((daemon, second));
    cell.clean();
}

/// Four clients send requests continuously, and the log is blocked: a connected console stops by its verb, other
/// clients by the socket.
#[test]
fn many_requests_a_second_do_not_delay_a_stop() {
    let _one = ONE.lock().unwrap_or_else(PoisonError::into_inner);
    let mut cell = Cell::new(34);
    let (err, _kept) = full_pipe();
    let _daemon = daemon_on(&cell.world, Stdio::null(), err);
    let names = cell.names();
    let node = graspd_shm::create_node(&names, "graspd-console").unwrap();
    let console = graspd_shm::control::RequestClient::new(&node).unwrap();
    std::thread::scope(|scope| {
        let load = stops::Load::start(scope, &names, 1000);
        for _ in 0..3 {
            let (stop, _) = cell.stop(&mut |_| by_socket(&names));
            stop.check("1,000 requests a second, socket");
            let (stop, _) = cell.stop(&mut |_| stops::by_verb_of(&console));
            stop.check("1,000 requests a second, verb");
        }
        let answered = load.end();
        println!("{answered:.0} requests a second were answered");
        assert!(answered > 300.0, "no load: {answered:.0} requests a second");
    });
    cell.check_limits();
    cell.clean();
}
