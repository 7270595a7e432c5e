//! Stops measured by the mock's wire record, and streams that a log can be stuck on.
#![allow(dead_code)] // every test uses its own part of it

use super::wire::{Entry, Wire};
use super::{Extra, Process, World, ask, summary};
use graspd::realtime::now_ns;
use graspd::stop::{Heard, ask as ask_to_stop};
use graspd_shm::control::{RequestClient, Verb};
use graspd_shm::{Names, create_node};
use rustix::process::Signal;
use serde_json::Value;
use std::io::{PipeReader, Write};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// From asking to the first set-point that slows down, ms (O09).
pub(crate) const BOUND_MS: f64 = 20.0;
/// Cycles of the daemon come every 2 ms; a longer pause between two of them, ms, is a deadline that its cycle missed.
pub(crate) const MISSED_MS: f64 = 4.5;
/// Slower than this is no motion to stop, rad/s.
const MOVING: f64 = 0.02;

/// One stop by the wire record.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Stop {
    /// From asking to the first decelerating set-point, ms.
    pub(crate) latency_ms: f64,
    /// Longest pause between two set-points meanwhile, ms.
    pub(crate) pause_ms: f64,
    /// Fastest joint before it, rad/s.
    pub(crate) speed: f64,
    /// From the first decelerating set-point to rest, ms.
    pub(crate) ramp_ms: f64,
}

impl Stop {
    /// Whether the daemon's cycle itself missed a deadline meanwhile.
    pub(crate) fn missed(&self) -> bool {
        self.pause_ms > MISSED_MS
    }

    /// Holds one stop against the bound; one in which the host stalled the cycle is held against the bound and that
    /// stall.
    pub(crate) fn check(&self, what: &str) {
        let stalled = if self.missed() { " (the host stalled the cycle)" } else { "" };
        println!(
            "{what:<34} {:.3} rad/s, first decelerating after {:.1} ms, rest {:.0} ms later, longest pause {:.1} ms{stalled}",
            self.speed, self.latency_ms, self.ramp_ms, self.pause_ms
        );
        let allowed = BOUND_MS + if self.missed() { self.pause_ms } else { 0.0 };
        assert!(self.latency_ms <= allowed, "{what}: {self:?}");
    }
}

fn norm(v: &[f64; 6]) -> f64 {
    v.iter().map(|x| x * x).sum::<f64>().sqrt()
}

/// The stop ramp shrinks all rates alike: parallel to the ones before, and smaller. The law's set-points change their
/// direction.
fn shrinks(from: &[f64; 6], to: &[f64; 6]) -> bool {
    let (a, b) = (norm(from), norm(to));
    let off = (0..6).map(|i| (to[i] - from[i] * b / a).abs()).fold(0.0, f64::max);
    b < a && off <= 1e-9 * a
}

/// Judges the last stop in `entries`; in words why there is none to judge.
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
        return Err("it was being stopped already".to_owned());
    }
    if speed < MOVING {
        return Err(format!("the arm stood still or crept: {speed:.4} rad/s"));
    }
    let ms = |a: u64, b: u64| b.saturating_sub(a) as f64 * 1e-6;
    let from = sent.iter().rposition(|s| s.0 <= asked_ns).unwrap_or(0);
    let pause_ms = sent[from..=first].windows(2).map(|w| ms(w[0].0, w[1].0)).fold(0.0, f64::max);
    Ok(Stop { latency_ms: ms(asked_ns, at), pause_ms, speed, ramp_ms: ms(at, sent[last + 1].0) })
}

/// A world with controller and cameras, and the controller's record.
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

    /// From the start of the way, moving for `after`; what was recorded until then is forgotten.
    pub(crate) fn drive(&mut self, after: Duration) {
        // An arm that is put elsewhere while it moves would be a fault.
        self.world.verb(&["stop"]);
        std::thread::sleep(Duration::from_millis(200));
        ask(&self.mock, &format!(r#"{{"cmd":"teleport","q":[{}]}}"#, self.world.joints));
        std::thread::sleep(Duration::from_millis(300));
        self.world.servo(after);
        self.wire.read();
    }

    /// Drives, does `act`, and judges what follows; an instant without motion is passed over.
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
                    println!("passed over: {e}");
                    self.world.verb(&["stop"]);
                }
            }
        }
        panic!("eight times no motion to stop\n{}", self.world.log());
    }

    /// The mock's oracle has seen no limit broken.
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

/// A daemon whose standard output and error go where the test wants them; ready when it answers.
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

/// The end of a pipe that takes no byte more, and its other end, to be kept and not read: a terminal after Ctrl-S.
pub(crate) fn full_pipe() -> (Stdio, PipeReader) {
    let (reader, mut writer) = std::io::pipe().unwrap();
    rustix::io::ioctl_fionbio(&writer, true).unwrap();
    for size in [4096, 1] {
        while writer.write(&vec![b'.'; size]).is_ok() {}
    }
    rustix::io::ioctl_fionbio(&writer, false).unwrap();
    (Stdio::from(writer), reader)
}

/// A pipe whose reader is gone: `| head`.
pub(crate) fn closed_pipe() -> Stdio {
    Stdio::from(std::io::pipe().unwrap().1)
}

/// A disk without room.
pub(crate) fn full_disk() -> Stdio {
    Stdio::from(std::fs::File::options().write(true).open("/dev/full").unwrap())
}

/// A stop by the socket, which must have been taken.
pub(crate) fn by_socket(names: &Names) {
    match ask_to_stop(names) {
        Heard::Socket { .. } => {}
        other => panic!("{other:?}"),
    }
}

/// Waits for the end of a process, at most so long; its exit code, `None` after a signal.
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

/// Ends a daemon by a signal out of motion: it ramps down, leaves nothing to the controller's watchdog, and ends with
/// code 0.
pub(crate) fn end_by(cell: &mut Cell, daemon: &mut Process, signal: Signal, what: &str) {
    let (stop, entries) = cell.stop(&mut |_| daemon.signal(signal));
    stop.check(what);
    assert_eq!(ended(daemon, Duration::from_secs(3)), Some(0), "{what}");
    let mut notes = entries;
    notes.extend(cell.wire.read());
    let watchdog = notes.iter().find(|e| matches!(e, Entry::Note(n) if n.to_lowercase().contains("watchdog")));
    assert_eq!(watchdog, None, "{what}: the end was left to the watchdog");
}

/// A stop by the verb over shared memory, of a client that is there already.
pub(crate) fn by_verb_of(client: &RequestClient) {
    assert!(client.ask(Verb::Stop, b"", now_ns(), Duration::from_secs(2)).unwrap().accepted);
}

/// Programs that ask for the status without rest.
pub(crate) struct Load {
    end: Arc<AtomicBool>,
    answered: Arc<AtomicU64>,
    begun: Instant,
}

impl Load {
    /// Four clients that together ask `per_second` times.
    pub(crate) fn start<'scope>(scope: &'scope std::thread::Scope<'scope, '_>, names: &Names, per_second: u32) -> Self {
        let load = Self { end: Arc::default(), answered: Arc::default(), begun: Instant::now() };
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
                    // What a stalled host has missed is not caught up with.
                    next = next.max(Instant::now() - period);
                }
            });
        }
        load
    }

    /// Ends it; requests answered a second.
    pub(crate) fn end(self) -> f64 {
        self.end.store(true, Ordering::Relaxed);
        self.answered.load(Ordering::Relaxed) as f64 / self.begun.elapsed().as_secs_f64()
    }
}

impl Drop for Load {
    fn drop(&mut self) {
        self.end.store(true, Ordering::Relaxed);
    }
}
