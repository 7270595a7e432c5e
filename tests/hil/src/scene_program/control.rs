//! Commands as lines of JSON, on standard input and on a TCP port.

use super::faults::Timed;
use super::joints::{Arm, now_ns};
use super::publish::Shared;
use crate::scenario::STANDOFF_M;
use serde_json::{Value, json};
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{Ipv4Addr, TcpListener};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// Longest line.
const MAX_LINE_BYTES: u64 = 65_536;

/// Answers command lines; shared by standard input and all connections.
#[derive(Clone, Debug)]
pub(super) struct Console {
    pub(super) shared: Arc<Shared>,
    pub(super) arm: Arm,
    pub(super) stop: Arc<AtomicBool>,
}

impl Console {
    /// Answers one line.
    pub(super) fn answer(&self, line: &str) -> Value {
        let refuse = |e: String| json!({ "ok": false, "error": e });
        let value: Value = match serde_json::from_str(line) {
            Ok(v) => v,
            Err(e) => return refuse(format!("not JSON: {e}")),
        };
        if value.get("fault").is_some() {
            return match Timed::parse(&value, now_ns()) {
                Ok(f) => {
                    self.shared.add(f);
                    json!({ "ok": true })
                }
                Err(e) => refuse(e),
            };
        }
        if value.get("clear").is_some() {
            self.shared.clear();
            return json!({ "ok": true });
        }
        if value.get("quit").is_some() {
            self.stop.store(true, Ordering::Relaxed);
            return json!({ "ok": true });
        }
        match value.get("ask").and_then(Value::as_str) {
            Some("truth") => self.truth(&value).unwrap_or_else(|| refuse("no joint positions received from the controller yet".into())),
            Some("status") => self.status(),
            Some("faults") => json!({ "ok": true, "faults": self.shared.faults() }),
            _ => refuse(
                "expected {\"ask\":\"truth\"}, {\"ask\":\"status\"}, {\"ask\":\"faults\"}, {\"fault\":NAME,..}, {\"clear\":true} or \
                 {\"quit\":true}"
                    .into(),
            ),
        }
    }

    /// True misalignment of the gripper with grasp and pre-grasp.
    fn truth(&self, question: &Value) -> Option<Value> {
        let scenario = self.shared.scenario()?;
        let sample = self.arm.newest()?;
        let number = |key: &str, default: f64| question.get(key).and_then(Value::as_f64).unwrap_or(default);
        let (depth, standoff) = (number("grasp_m", 0.0), number("standoff_m", STANDOFF_M));
        let pose = scenario.object_from_gripper(&sample.q);
        let (t, q) = (pose.translation.vector, pose.rotation.quaternion());
        Some(json!({
            "ok": true,
            "grasp": scenario.truth(&sample.q, depth),
            "pregrasp": scenario.truth(&sample.q, depth + standoff),
            "joints_rad": sample.q,
            "age_s": now_ns().saturating_sub(sample.at_ns) as f64 * 1e-9,
            "object_from_gripper": { "translation_m": [t.x, t.y, t.z], "quaternion_wxyz": [q.w, q.i, q.j, q.k] },
        }))
    }

    fn status(&self) -> Value {
        let (connected, packages) = self.arm.link();
        let mut s = self.shared.status();
        if let Some(map) = s.as_object_mut() {
            map.insert("ok".into(), json!(true));
            map.insert("arm_connected".into(), json!(connected));
            map.insert("arm_packages".into(), json!(packages));
        }
        s
    }

    /// Reads standard input on a separate thread; with `end` the program stops when it is closed.
    pub(super) fn listen_on_stdin(&self, end: bool) {
        let console = self.clone();
        std::thread::spawn(move || {
            let mut input = BufReader::new(std::io::stdin());
            let mut line = String::new();
            loop {
                line.clear();
                match input.by_ref().take(MAX_LINE_BYTES).read_line(&mut line) {
                    Ok(n) if n > 0 => {
                        if !line.trim().is_empty() {
                            let mut out = std::io::stdout().lock();
                            let _ = writeln!(out, "{}", console.answer(&line)).and_then(|()| out.flush());
                        }
                    }
                    _ => break,
                }
            }
            if end {
                console.stop.store(true, Ordering::Relaxed);
            }
        });
    }

    /// Listens on a loopback port with one thread per connection. Returns the port number.
    pub(super) fn listen_on_port(&self, port: u16) -> std::io::Result<u16> {
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, port))?;
        let port = listener.local_addr()?.port();
        let console = self.clone();
        std::thread::spawn(move || {
            for stream in listener.incoming() {
                let Ok(mut stream) = stream else { continue };
                let _ = stream.set_read_timeout(Some(Duration::from_secs(60)));
                let _ = stream.set_nodelay(true);
                let Ok(copy) = stream.try_clone() else { continue };
                let console = console.clone();
                std::thread::spawn(move || {
                    let mut input = BufReader::new(copy);
                    let mut line = String::new();
                    while input.by_ref().take(MAX_LINE_BYTES).read_line(&mut line).is_ok_and(|n| n > 0) {
                        if writeln!(stream, "{}", console.answer(&line)).is_err() {
                            break;
                        }
                        line.clear();
                    }
                });
            }
        });
        Ok(port)
    }
}
