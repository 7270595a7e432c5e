//! Dashboard client: each command is one line, each answer is one line.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use super::ur_config::{ArmError, Port, UrConfig};

/// Maximum length of a line, bytes; the controller's lines are much shorter.
const MAX_LINE_BYTES: u64 = 4096;

/// A connection to the dashboard server (port 29999; PolyScope 3 and 5).
#[derive(Debug)]
pub struct Dashboard {
    stream: BufReader<TcpStream>,
    timeout: Duration,
}

impl Dashboard {
    /// Connects and reads the greeting.
    pub fn open(config: &UrConfig) -> Result<Dashboard, ArmError> {
        let stream = config.open(Port::Dashboard)?;
        let mut dashboard = Dashboard { stream: BufReader::new(stream), timeout: config.timeout };
        dashboard.line()?;
        Ok(dashboard)
    }

    /// Sends a command and returns its answer without the line end.
    pub fn ask(&mut self, command: &str) -> Result<String, ArmError> {
        let line = format!("{command}\n");
        self.stream.get_mut().write_all(line.as_bytes()).map_err(|e| io(e, self.timeout))?;
        self.line()
    }

    /// Sends a command whose answer must start with one of `success`, ignoring case.
    ///
    /// # Errors
    /// Any other answer, with `fix`.
    pub fn demand(&mut self, command: &str, success: &[&str], fix: &'static str) -> Result<String, ArmError> {
        let answer = self.ask(command)?;
        let lower = answer.to_ascii_lowercase();
        if success.iter().any(|s| lower.starts_with(&s.to_ascii_lowercase())) {
            Ok(answer)
        } else {
            Err(ArmError::Dashboard { command: command.to_owned(), answer, fix })
        }
    }

    /// Repeats a command every 0.1 s until the answer contains `expected`.
    ///
    /// # Errors
    /// The last answer, with `fix`, when `limit` has passed.
    pub fn wait_for(
        &mut self,
        command: &'static str,
        expected: &str,
        limit: Duration,
        fix: &'static str,
    ) -> Result<String, ArmError> {
        let start = Instant::now();
        loop {
            let answer = self.ask(command)?;
            if answer.to_ascii_uppercase().contains(expected) {
                return Ok(answer);
            }
            if start.elapsed() >= limit {
                return Err(ArmError::Dashboard { command: command.to_owned(), answer, fix });
            }
            std::thread::sleep(Duration::from_millis(100));
        }
    }

    /// Reads one line, bounded in length and in total time, also when single bytes arrive slowly.
    fn line(&mut self) -> Result<String, ArmError> {
        let deadline = Instant::now() + self.timeout;
        let mut line = Vec::new();
        while !line.ends_with(b"\n") {
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() || line.len() as u64 >= MAX_LINE_BYTES {
                return Err(ArmError::Timeout { what: "dashboard answer", seconds: self.timeout.as_secs_f64() });
            }
            let fail = |e| io(e, self.timeout);
            self.stream.get_ref().set_read_timeout(Some(left)).map_err(fail)?;
            // `fill_buf` reads once; `read_until` alone would not return while bytes keep arriving.
            let available = self.stream.fill_buf().map_err(fail)?;
            if available.is_empty() {
                return Err(fail(std::io::ErrorKind::UnexpectedEof.into()));
            }
            let n = available.len() as u64;
            self.stream.by_ref().take(n).read_until(b'\n', &mut line).map_err(fail)?;
        }
        Ok(String::from_utf8_lossy(&line).trim_end().to_owned())
    }
}

fn io(source: std::io::Error, timeout: Duration) -> ArmError {
    match source.kind() {
        std::io::ErrorKind::WouldBlock | std::io::ErrorKind::TimedOut => {
            ArmError::Timeout { what: "dashboard answer", seconds: timeout.as_secs_f64() }
        }
        _ => ArmError::Io { service: Port::Dashboard, source },
    }
}
