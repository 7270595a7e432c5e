//! Stops measured in the mock's wire record, and streams that block a log.
#![allow(dead_code)] // no test uses all of it

use super::wire::{Entry, Wire};
use super::{Extra, Process, World, ask, summary};
use graspd::realtime::now_ns;
use graspd::stop::{StopAnswer, ask as request_stop};
use graspd_shm::control::{RequestClient, Verb};
use graspd_shm::{Names, create_node};
use rustix::process::Signal;
use serde_json::Value;
use std::io::{PipeReader, Write};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// Maximum time from the request to the first decelerating set-point, ms.
pub(crate) const MAX_LATENCY_MS: f64 = 20.0;
/// Maximum time between two set-points without a missed deadline, ms; the daemon's period is 2 ms.
pub(crate) const MAX_PAUSE_MS: f64 = 4.5;
/// Minimum speed of a motion to stop, rad/s.
const MIN_SPEED: f64 = 0.02;

/// One stop, by the wire record.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Stop {
    /// Time from the request to the first decelerating set-point, ms.
    pub(crate) latency_ms: f64,
    /// Maximum time between two set-points meanwhile, ms.
    pub(crate) pause_ms: f64,
    /// Speed of the fastest joint before it, rad/s.
    pub(crate) speed: f64,
    /// Time from the first decelerating set-point to rest, ms.
    pub(crate) ramp_ms: f64,
}

impl Stop {
    /// Whether the daemon's cycle missed a deadline meanwhile.
    pub(crate) fn missed(&self) -> bool {
        self.pause_ms > MAX_PAUSE_MS
    }

    /// Compares the latency with its bound, which grows by the pause when the host stalled the cycle.
    pub(crate) fn check(&self, what: &str) {
        let stalled = if self.missed() { " (the host stalled the cycle)" } else { "" };
        println!(
            "{what:<34} {:.3} rad/s, first decelerating after {:.1} ms, rest {:.0} ms later, longest pause {:.1} ms{stalled}",
            self.speed, self.latency_ms, self.ramp_ms, self.pause_ms
        );
        let allowed = MAX_LATENCY_MS + if self.missed() { self.pause_ms } else { 0.0 };
        assert!(self.latency_ms <= allowed, "{what}: {self:?}");
    }
}

fn norm(v: &[f64; 6]) -> f64 {
    v.iter().map(|x| x * x).sum::<f64>().sqrt()
}

/// Whether the rates are parallel to the previous ones and smaller, as on a stop ramp. The control law changes their
/// direction.
fn shrinks(from: &[f64; 6], to: &[f64; 6]) -> bool {
    let (a, b) = (norm(from), norm(to));
    let off = (0..6).map(|i| (to[i] - from[i] * b / a).abs()).fold(0.0, f64::max);
    b < a && off <= 1e-9 * a
}

/// Measures the last stop in `entries`. An error that begins with a capital letter is a failure; any other says that
/// the arm was not in motion.
pub(crate) fn judge(entries: &[Entry], asked_ns: u64) -> Result<Stop, String> {
    let sent: Vec<(u64, [f64; 6])> = entries
        .iter()
        .filter_map(|e| match e {
            Entry::Heartbeat { at_ns, rates, .. } => Some((*at_ns, *rates)),
            _ => None,
        })
        .collect();
    let last = sent.iter().rposition(|s| norm(&s.1) > 0.0).ok_or("the arm did not move")?;
    if last + 1 >= sent.len() {
        return Err(format!("STILL MOVING: {:?}", sent[last].1));
    }
    let mut first = last + 1;
    while first > 1 && shrinks(&sent[first - 2].1, &sent[first - 1].1) {
        first -= 1;
    }
    let (at, before) = (sent[first].0, &sent[first - 1].1);
    let speed = before.iter().fold(0.0f64, |m, r| m.max(r.abs()));
    if at <= asked_ns {
        return Err("it was already stopping".to_owned());
    }
    if speed < MIN_SPEED {
        return Err(format!("the arm was at rest or slow: {speed:.4} rad/s"));
    }
    let ms = |a: u64, b: u64| b.saturating_sub(a) as f64 * 1e-6;
    let from = sent.iter().rposition(|s| s.0 <= asked_ns).unwrap_or(0);
    let pause_ms = sent[from..=first].windows(2).map(|w| ms(w[0].0, w[1].0)).fold(0.0, f64::max);
    Ok(Stop { latency_ms: ms(asked_ns, at), pause_ms, speed, ramp_ms: ms(at, sent[last + 1].0) })
}

/// A world with controller and cameras, and the controller's wire record.
pub(crate) struct Cell {
    pub(crate) world: World,
    pub(crate) mock: Process,
    pub(crate) scene: Option<Process>,
    pub(crate) wire: Wire,
}

impl Cell {
    pub(crate) fn new(seed: u64) -> Self {
        let world = World::with(seed, Extra { frame_rate: 30.0, record: true, ..Extra::default() });
        let (mock, scene) = (world.mock(), world.scene());
        let wire = Wire::open(world.folder.join("wire"));
        Self { world, mock, scene: Some(scene), wire }
    }

    pub(crate) fn names(&self) -> Names {
        Names::new(self.world.folder.join("shm"), &Names::default_prefix(), "kill").unwrap()
    }

    /// Starts a motion, returns after `after`, and discards the record until then.
    pub(crate) fn drive(&mut self, after: Duration) {
        // Teleporting a moving arm would be a fault.
        self.world.verb(&["stop"]);
        std::thread::sleep(Duration::from_millis(200));
        ask(&self.mock, &format!(r#"{{"cmd":"teleport","q":[{}]}}"#, self.world.joints));
        std::thread::sleep(Duration::from_millis(300));
        self.world.servo(after);
        self.wire.read();
    }

    /// Starts a motion, calls `act`, and measures the stop. Repeats when the arm was not in motion.
    pub(crate) fn stop(&mut self, act: &mut dyn FnMut(&Self)) -> (Stop, Vec<Entry>) {
        for _ in 0..8 {
            self.drive(Duration::from_millis(500));
            let asked = now_ns();
            act(self);
            std::thread::sleep(Duration::from_millis(700).saturating_sub(Duration::from_nanos(now_ns() - asked)));
            let entries = self.wire.read();
            match judge(&entries, asked) {
                Ok(stop) => return (stop, entries),
                Err(e) => {
                    assert!(!e.starts_with(char::is_uppercase), "{e}\n{}", self.world.log());
                    println!("skipped: {e}");
                    self.world.verb(&["stop"]);
                }
            }
        }
        panic!("no motion to stop in eight attempts\n{}", self.world.log());
    }

    /// The mock has recorded no limit violation.
    pub(crate) fn check_limits(&self) {
        let seen = summary(&self.mock);
        assert_eq!(seen["limit_violations"], 0, "{}", seen["violations"]);
    }

    pub(crate) fn clean(self) {
        let folder = self.world.folder.clone();
        drop(self);
        let _ = std::fs::remove_dir_all(folder);
    }
}

/// Starts a daemon with these streams and waits until it answers.
pub(crate) fn daemon_on(world: &World, out: Stdio, err: Stdio) -> Process {
    let child = Command::new(env!("CARGO_BIN_EXE_graspd"))
        .args(["run", "--config", &world.path("graspd.toml")])
        .stdin(Stdio::null())
        .stdout(out)
        .stderr(err)
        .spawn()
        .unwrap();
    let process = Process { child, ready: Value::Null };
    let until = Instant::now() + Duration::from_secs(20);
    while !world.verb(&["status"]).0 {
        assert!(Instant::now() < until, "the daemon does not answer");
        std::thread::sleep(Duration::from_millis(50));
    }
    process
}

/// The write end of a full pipe, and its read end, to be kept and not read: like a terminal after Ctrl-S.
pub(crate) fn full_pipe() -> (Stdio, PipeReader) {
    let (reader, mut writer) = std::io::pipe().unwrap();
    rustix::io::ioctl_fionbio(&writer, true).unwrap();
    for size in [4096, 1] {
        while writer.write(&vec![b'.'; size]).is_ok() {}
    }
    rustix::io::ioctl_fionbio(&writer, false).unwrap();
    (Stdio::from(writer), reader)
}

/// A pipe without a reader, as after `| head`.
pub(crate) fn closed_pipe() -> Stdio {
    Stdio::from(std::io::pipe().unwrap().1)
}

/// A full disk.
pub(crate) fn full_disk() -> Stdio {
    Stdio::from(std::fs::File::options().write(true).open("/dev/full").unwrap())
}

/// A stop by the socket, which must answer.
pub(crate) fn by_socket(names: &Names) {
    match request_stop(names) {
        StopAnswer::Socket { .. } => {}
        other => panic!("{other:?}"),
    }
}

/// Waits for the end of a process; returns its exit code, `None` after a signal.
pub(crate) fn ended(process: &mut Process, limit: Duration) -> Option<i32> {
    let until = Instant::now() + limit;
    loop {
        if let Some(status) = process.child.try_wait().unwrap() {
            return status.code();
        }
        assert!(Instant::now() < until, "the process has not ended within {limit:?}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Ends a daemon by a signal during motion: it ramps down, ends the script without the controller's watchdog, and exits
/// with code 0.
pub(crate) fn end_by(cell: &mut Cell, daemon: &mut Process, signal: Signal, what: &str) {
    let (stop, entries) = cell.stop(&mut |_| daemon.signal(signal));
    stop.check(what);
    assert_eq!(ended(daemon, Duration::from_secs(3)), Some(0), "{what}");
    let mut notes = entries;
    notes.extend(cell.wire.read());
    let watchdog = notes.iter().find(|e| matches!(e, Entry::Note(n) if n.to_lowercase().contains("watchdog")));
    assert_eq!(watchdog, None, "{what}: the watchdog ended the script");
}

/// A stop by the verb over shared memory, from a connected client.
pub(crate) fn by_verb_of(client: &RequestClient) {
    assert!(client.ask(Verb::Stop, b"", now_ns(), Duration::from_secs(2)).unwrap().accepted);
}

/// Clients that request the status continuously.
pub(crate) struct Load {
    end: Arc<AtomicBool>,
    answered: Arc<AtomicU64>,
    started: Instant,
}

impl Load {
    /// Starts four clients that together send `per_second` requests a second.
    pub(crate) fn start<'scope>(scope: &'scope std::thread::Scope<'scope, '_>, names: &Names, per_second: u32) -> Self {
        let load = Self { end: Arc::default(), answered: Arc::default(), started: Instant::now() };
        for _ in 0..4 {
            let (end, answered, names) = (Arc::clone(&load.end), Arc::clone(&load.answered), names.clone());
            scope.spawn(move || {
                let node = create_node(&names, "graspd-load").unwrap();
                let client = RequestClient::new(&node).unwrap();
                let period = Duration::from_secs(4) / per_second;
                let mut next = Instant::now();
                while !end.load(Ordering::Relaxed) {
                    next += period;
                    if client.ask(Verb::Status, b"", now_ns(), Duration::from_millis(200)).is_ok() {
                        answered.fetch_add(1, Ordering::Relaxed);
                    }
                    std::thread::sleep(next.saturating_duration_since(Instant::now()));
                    // Requests missed in a stall of the host are not made up.
                    next = next.max(Instant::now() - period);
                }
            });
        }
        load
    }

    /// Ends the clients; returns the number of answers a second.
    pub(crate) fn end(self) -> f64 {
        self.end.store(true, Ordering::Relaxed);
        self.answered.load(Ordering::Relaxed) as f64 / self.started.elapsed().as_secs_f64()
    }
}

impl Drop for Load {
    fn drop(&mut self) {
        self.end.store(true, Ordering::Relaxed);
    }
}
