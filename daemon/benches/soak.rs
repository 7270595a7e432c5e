//! Soak test of the command thread against the mock controller:
//! `cargo bench -p graspd --bench soak -- SECONDS [robot] [ur5]`.
//!
//! The daemon's command thread (command cycle and UR link) swings a wrist over RTDE against `graspd-mock-ur` in a
//! separate process. Printed: gaps by the controller's clock with their causes (steps that the mock missed because the
//! host stalled, packages that the mock left out because the client did not read, packages that the client lost); a
//! histogram of the round trip from a command to its echo; memory and descriptors of both processes over time. Exits
//! with code 1 when the client lost a package or memory grows.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a failure must panic

#[path = "../tests/cell/wire.rs"]
mod wire;

use graspd::arm::{ArmLink, LinkFault, LinkPoll, LinkStats, UrLink};
use graspd::config::{Clock, Config, cycle_config, ur_config};
use graspd::realtime::{RealtimeReport, ThreadSettings, enter, now_ns};
use graspd::threads::{CommandWorker, Shared};
use graspd_hil::scenario::{Options, Scenario};
use graspd_rt::arm::{ArmCommand, ArmMode, Dh};
use graspd_rt::cycle::CommandCycle;
use graspd_rt::rtde::script_state;
use std::io::{BufRead, BufReader};
use std::net::TcpListener;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};
use wire::{Entry, Wire};

/// Swings wrist 3 in place of the cycle's commands: without cameras the cycle commands idle.
struct Swing {
    link: UrLink,
    phase: f64,
    period_s: f64,
}

impl ArmLink for Swing {
    fn poll(&mut self, now_ns: u64) -> LinkPoll {
        self.link.poll(now_ns)
    }

    fn send(&mut self, command: &ArmCommand) -> Result<(), LinkFault> {
        let ready =
            self.link.state().is_some_and(|s| matches!(s.script_state, script_state::IDLE | script_state::VELOCITY));
        if !ready {
            return self.link.send(command);
        }
        self.phase += 2.0 * std::f64::consts::PI * 0.25 * self.period_s;
        let mut rates = [0.0; 6];
        rates[5] = 0.3 * self.phase.sin();
        self.link.send(&ArmCommand { mode: ArmMode::Velocity, rates, ..*command })
    }

    fn token(&self) -> i32 {
        self.link.token()
    }

    fn rate_hz(&self) -> f64 {
        self.link.rate_hz()
    }

    fn stats(&self) -> LinkStats {
        self.link.stats()
    }

    fn fault(&self) -> Option<LinkFault> {
        self.link.fault()
    }

    fn wait(&mut self, deadline_ns: u64) -> bool {
        self.link.wait(deadline_ns)
    }
}

/// Resident memory, kB, and open descriptors of a process.
fn held(pid: u32) -> (u64, usize) {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
    let rss = status.lines().find_map(|l| l.strip_prefix("VmRSS:")?.split_whitespace().next()?.parse().ok());
    (rss.unwrap_or(0), std::fs::read_dir(format!("/proc/{pid}/fd")).map_or(0, Iterator::count))
}

fn bars(title: &str, values: &mut [u64], width_us: u64) {
    values.sort_unstable();
    let at = |q: f64| values.get((q * (values.len() - 1) as f64) as usize).map_or(0.0, |v| *v as f64 * 1e-3);
    println!("\n{title}: {} values, us", values.len());
    println!(
        "  p50 {:.0}  p99 {:.0}  p99.9 {:.0}  p99.99 {:.0}  max {:.0}",
        at(0.5),
        at(0.99),
        at(0.999),
        at(0.9999),
        at(1.0)
    );
    let mut bins = std::collections::BTreeMap::<u64, u64>::new();
    for v in values.iter() {
        *bins.entry((v / 1000 / width_us).min(40)).or_default() += 1;
    }
    let most = bins.values().copied().max().unwrap_or(1) as f64;
    for (bin, n) in bins {
        // Square root, so that rare values are visible.
        let bar = "#".repeat(((n as f64 / most).sqrt() * 60.0).ceil() as usize);
        let more = if bin == 40 { "+" } else { " " };
        println!("  {:6}{more} {n:8} {bar}", bin * width_us);
    }
}

fn main() {
    let args: Vec<String> = std::env::args().collect();
    let seconds: f64 = args.iter().filter_map(|a| a.parse().ok()).next().unwrap_or(10.0);
    let clock = if args.iter().any(|a| a == "robot") { "robot" } else { "timer" };
    let model = args.iter().find(|a| a.starts_with("ur")).map_or("ur5e", String::as_str);
    let folder = std::env::temp_dir().join(format!("graspd-soak-{}", std::process::id()));
    Scenario::from_seed(1, &Options::default()).unwrap().save(&folder.join("world")).unwrap();
    let offset = (0..200u16)
        .map(|k| 3000 + (std::process::id() as u16).wrapping_mul(13).wrapping_add(k * 41) % 30_000)
        .find(|o| (29_999..=30_004).all(|p: u16| TcpListener::bind(("127.0.0.1", p + o)).is_ok()))
        .unwrap();
    let text = format!(
        "[files]\nrig = \"world/rig.toml\"\ngripper = \"world/gripper.toml\"\n[arm]\nmodel = \"{model}\"\nport_offset = {offset}\n\
         [loop]\nbest_effort = true\nclock = \"{clock}\"\n"
    );
    std::fs::write(folder.join("graspd.toml"), text).unwrap();
    let config = Config::load(&folder.join("graspd.toml")).unwrap();
    let record = folder.join("wire");
    let mut mock = Command::new(env!("CARGO_BIN_EXE_graspd"))
        .args(["mock-ur", "--model", model, "--port-offset", &offset.to_string(), "--exit-with-stdin", "--record"])
        .arg(&record)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut output = BufReader::new(mock.stdout.take().unwrap()).lines();
    output.next().unwrap().unwrap();
    let code = soak(&config, seconds, mock.id(), &record);
    drop(mock.stdin.take());
    println!("mock: {}", output.next().unwrap().unwrap());
    mock.wait().unwrap();
    let _ = std::fs::remove_dir_all(&folder);
    std::process::exit(code);
}

fn soak(config: &Config, seconds: f64, mock: u32, record: &Path) -> i32 {
    let mut ur = ur_config(config);
    // A stall of the host of 50 ms must not end the script and the measurement.
    ur.watchdog_ms = 1000.0;
    let mut link = UrLink::connect(&ur).unwrap();
    link.bring_up(&ur).unwrap();
    let period_s = config.threads.period_ns() as f64 * 1e-9;
    let swing: Box<dyn ArmLink> = Box::new(Swing { link, phase: 0.0, period_s });
    let started = now_ns();
    let (shared, cycle) =
        (Shared::default(), CommandCycle::new(cycle_config(config, Dh::nominal(config.arm.model), false)).unwrap());
    shared.link_ready.put(swing);
    let expected = (seconds / period_s) as usize;
    let (mut trips, mut wakes, mut skipped) = (Vec::with_capacity(expected), Vec::with_capacity(expected), 0);
    let mut memory = Vec::new();
    // The memory is touched once, so that filling it does not count as growth.
    trips.resize(expected, 1u64);
    wakes.resize(expected, 1u64);
    trips.clear();
    wakes.clear();
    let stats = std::thread::scope(|scope| {
        scope.spawn(|| {
            let mut host = RealtimeReport::default();
            enter("command", &ThreadSettings { priority: 80, core: None }, &mut host);
            host.refused.iter().for_each(|r| println!("not real-time: {r}"));
            let mut worker = CommandWorker::new(cycle, &shared);
            if config.threads.clock == Clock::Robot {
                worker.run_with_robot(config.threads.period_ns());
            } else {
                worker.run(config.threads.period_ns(), 0);
            }
        });
        let start = Instant::now();
        let mut next = 0.0;
        while start.elapsed().as_secs_f64() < seconds {
            while let Some(cycle) = shared.records.pop() {
                if trips.len() < expected && wakes.len() < expected {
                    trips.extend(cycle.round_trip_ns);
                    wakes.push(cycle.wakeup_ns);
                }
                skipped += cycle.skipped;
            }
            if start.elapsed().as_secs_f64() >= next {
                memory.push((next, held(std::process::id()), held(mock)));
                next += (seconds / 20.0).max(1.0);
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        memory.push((seconds, held(std::process::id()), held(mock)));
        let failed = shared.link_dead.take();
        shared.drop_link.store(true, Ordering::Release);
        std::thread::sleep(Duration::from_millis(100));
        let link = failed.or_else(|| shared.link_dead.take());
        shared.shutdown.store(true, Ordering::Release);
        link.map(|l| (l.stats(), l.fault()))
    });
    let ended = now_ns();
    std::thread::sleep(Duration::from_millis(500));
    let Some((stats, fault)) = stats else {
        println!("the command thread did not return its link");
        return 1;
    };
    // Steps with the same time were made up after a stall of the host: only the last of them was sent.
    let entries = Wire::open(record.to_owned()).read();
    let steps: Vec<u64> = entries
        .iter()
        .filter_map(|e| match e {
            Entry::Step { at_ns, .. } if (started..ended).contains(at_ns) => Some(*at_ns),
            _ => None,
        })
        .collect();
    let stalled = steps.windows(2).filter(|w| w[0] == w[1]).count() as u64;
    let left_out: u64 = entries
        .iter()
        .filter_map(|e| match e {
            Entry::Note(text) if text.contains(" Rtde over") => {
                text.rsplit("; ").next()?.split(' ').next()?.parse::<u64>().ok()
            }
            _ => None,
        })
        .sum();
    let lost = stats.missing.saturating_sub(stalled + left_out);
    println!("{seconds:.0} s at {:.0} Hz, clock {:?}", 1.0 / period_s, config.threads.clock);
    println!(
        "states received {}, commands sent {}, dropped {}, link fault {fault:?}",
        stats.received, stats.sent, stats.dropped
    );
    println!(
        "gaps by the controller's clock: {} packages; {stalled} steps missed by the mock in stalls of the host, {left_out} left out by the mock, {lost} lost by the client",
        stats.missing
    );
    println!("cycles that the client missed: {skipped}");
    bars("round trip, command to echo", &mut trips, 250);
    bars("wake-up delay", &mut wakes, 50);
    println!("\n   time s   client kB  fds     mock kB  fds");
    for (at, client, mock) in &memory {
        println!("  {at:7.0} {:11} {:4} {:11} {:4}", client.0, client.1, mock.0, mock.1);
    }
    // The first tenth is a warm-up: lazily loaded code, allocator pools.
    let early = memory[(memory.len() / 10).max(1).min(memory.len() - 1)];
    let last = memory[memory.len() - 1];
    let grown = (last.1.0.saturating_sub(early.1.0), last.2.0.saturating_sub(early.2.0));
    println!("growth after the first tenth: client {} kB, mock {} kB", grown.0, grown.1);
    let passed = lost == 0 && fault.is_none() && grown.0 < 1024 && grown.1 < 4096 && last.1.1 <= early.1.1;
    println!("{}", if passed { "passed" } else { "FAILED" });
    i32::from(!passed)
}
