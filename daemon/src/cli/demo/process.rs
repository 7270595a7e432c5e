//! The processes of the demo: started, awaited, and ended by their id when dropped.

use crate::exit::Failure;
use rustix::process::{Pid, Signal, kill_process};
use std::fs::File;
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, Command, ExitStatus, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::{Duration, Instant};

/// A process of the demo. Dropping it ends the process, by SIGTERM and then by SIGKILL.
#[derive(Debug)]
pub(super) struct DemoProcess {
    name: &'static str,
    child: Child,
    stdin: Option<ChildStdin>,
    lines: Receiver<String>,
}

impl DemoProcess {
    /// Starts this program with other arguments. Standard error goes to `NAME.log` in `folder`.
    ///
    /// # Errors
    /// When the program or its log cannot be opened.
    pub(super) fn start(name: &'static str, args: &[String], folder: &Path) -> Result<Self, Failure> {
        let program = std::env::current_exe().map_err(|e| {
            Failure::link(format!("this program's own path is unknown ({e}); start graspd by its full path"))
        })?;
        let log_path = folder.join(format!("{name}.log"));
        let log = File::create(&log_path).map_err(|e| {
            Failure::input(format!("{}: cannot be written ({e}); choose another folder with --out", log_path.display()))
        })?;
        let mut child = Command::new(program)
            .args(args)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::from(log))
            .spawn()
            .map_err(|e| Failure::link(format!("{name} could not be started ({e})")))?;
        let stdin = child.stdin.take();
        let (send, lines) = channel();
        if let Some(out) = child.stdout.take() {
            std::thread::spawn(move || {
                for line in BufReader::new(out).lines() {
                    let Ok(line) = line else { break };
                    if send.send(line).is_err() {
                        break;
                    }
                }
            });
        }
        Ok(Self { name, child, stdin, lines })
    }

    /// The next line of its standard output that is a JSON object.
    ///
    /// # Errors
    /// When the process ended, or printed no such line within `timeout`.
    pub(super) fn json_line(&mut self, timeout: Duration) -> Result<serde_json::Value, Failure> {
        let until = Instant::now() + timeout;
        loop {
            let left = until.saturating_duration_since(Instant::now());
            match self.lines.recv_timeout(left) {
                Ok(line) => {
                    if let Ok(v @ serde_json::Value::Object(_)) = serde_json::from_str(&line) {
                        return Ok(v);
                    }
                }
                Err(RecvTimeoutError::Timeout) => {
                    return Err(Failure::link(format!(
                        "{} printed nothing for {:.0} s; see its log",
                        self.name,
                        timeout.as_secs_f64()
                    )));
                }
                Err(RecvTimeoutError::Disconnected) => {
                    let how = self.child.wait().map(|s| s.to_string()).unwrap_or_else(|e| e.to_string());
                    return Err(Failure::link(format!("{} ended before it was ready ({how}); see its log", self.name)));
                }
            }
        }
    }

    /// Sends a line to its standard input and waits for the JSON object that answers it.
    ///
    /// # Errors
    /// As [`DemoProcess::json_line`], and when the pipe is broken.
    pub(super) fn ask(&mut self, line: &str, timeout: Duration) -> Result<serde_json::Value, Failure> {
        while self.lines.try_recv().is_ok() {}
        let pipe = self.stdin.as_mut().ok_or_else(|| Failure::link(format!("{} has no standard input", self.name)))?;
        writeln!(pipe, "{line}")
            .and_then(|()| pipe.flush())
            .map_err(|e| Failure::link(format!("{} does not read its standard input ({e})", self.name)))?;
        self.json_line(timeout)
    }

    /// Its exit status, if it has ended.
    pub(super) fn ended(&mut self) -> Option<ExitStatus> {
        self.child.try_wait().ok().flatten()
    }

    /// Ends it by SIGTERM, and by SIGKILL after `timeout`. Returns its exit status, if it had one.
    pub(super) fn end(&mut self, timeout: Duration) -> Option<ExitStatus> {
        if let Some(status) = self.ended() {
            return Some(status);
        }
        if let Some(pid) = i32::try_from(self.child.id()).ok().and_then(Pid::from_raw) {
            let _ = kill_process(pid, Signal::TERM);
        }
        let until = Instant::now() + timeout;
        while Instant::now() < until {
            if let Some(status) = self.ended() {
                return Some(status);
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        let _ = self.child.kill();
        self.child.wait().ok()
    }
}

impl Drop for DemoProcess {
    fn drop(&mut self) {
        self.end(Duration::from_secs(2));
    }
}
