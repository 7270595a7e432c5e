//! A mock controller on a thread of this process, for tests: real sockets, real time, a separate loopback address.

use super::command::Command;
use super::record::Recorder;
use super::robot::{Robot, Setup};
use super::server::{ListenError, Server};
use super::world::World;
use serde_json::Value as Json;
use std::io::{BufRead, BufReader, Write};
use std::net::{IpAddr, Ipv4Addr, TcpStream};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

/// A running mock; dropping it stops it.
pub struct Hosted {
    /// Where it listens, with the robot's own port numbers.
    pub address: IpAddr,
    control: BufReader<TcpStream>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<Server>>,
}

/// Errors of a hosted mock.
#[derive(Debug, thiserror::Error)]
pub enum HostedError {
    /// A port could not be opened.
    #[error(transparent)]
    Listen(#[from] ListenError),
    /// The record, the control connection or the thread could not be created.
    #[error("mock controller: {0}")]
    Io(#[from] std::io::Error),
    /// The control port refused a command.
    #[error("mock controller refused: {0}")]
    Refused(String),
}

/// The `n`th address of 127.64.0.0/10, without those that end in 0 or 255. Consecutive numbers have different addresses.
fn address(n: u32) -> IpAddr {
    const HOSTS: u32 = 254;
    let (host, net) = (n % HOSTS + 1, n / HOSTS);
    IpAddr::V4(Ipv4Addr::new(127, 64 + (net >> 8 & 63) as u8, net as u8, host as u8))
}

/// Mocks started by this process; part of their addresses.
static COUNT: AtomicU32 = AtomicU32::new(0);

impl Hosted {
    /// Starts a mock on a loopback address that no other test uses. `limits` are the rate and acceleration that its
    /// client promises (rad/s, rad/s^2).
    ///
    /// # Errors
    /// When the ports are taken or the record cannot be written.
    pub fn start(setup: Setup, limits: Option<(f64, f64)>, record: Option<PathBuf>) -> Result<Self, HostedError> {
        // By process id and count, so that tests of several processes can run in parallel.
        let n = COUNT.fetch_add(1, Ordering::Relaxed);
        let address = address(std::process::id().wrapping_mul(61).wrapping_add(n));
        let recorder = record.map(|path| Recorder::create(&path)).transpose()?;
        let world = World::new(Robot::new(setup), limits, recorder);
        let mut server = Server::bind(world, address, 0, Some(0))?;
        let port = server.control_port().unwrap_or(0);
        let stop = Arc::new(AtomicBool::new(false));
        let thread = {
            let stop = Arc::clone(&stop);
            std::thread::Builder::new().name("mock-ur".to_owned()).spawn(move || {
                server.run(&stop);
                server
            })?
        };
        let control = TcpStream::connect((address, port))?;
        control.set_read_timeout(Some(Duration::from_secs(10)))?;
        control.set_nodelay(true)?;
        Ok(Hosted { address, control: BufReader::new(control), stop, thread: Some(thread) })
    }

    /// A connection to one of the robot's ports, with a read timeout of five seconds.
    ///
    /// # Errors
    /// When it is refused.
    pub fn connect(&self, port: u16) -> std::io::Result<TcpStream> {
        let stream = TcpStream::connect((self.address, port))?;
        stream.set_read_timeout(Some(Duration::from_secs(5)))?;
        stream.set_nodelay(true)?;
        Ok(stream)
    }

    /// Carries out a command of the control port and returns its result.
    ///
    /// # Errors
    /// When it is refused, or the mock does not answer.
    pub fn ask(&mut self, command: &Command) -> Result<Json, HostedError> {
        let mut line = serde_json::to_string(command).map_err(std::io::Error::other)?;
        line.push('\n');
        self.control.get_mut().write_all(line.as_bytes())?;
        let mut answer = String::new();
        self.control.read_line(&mut answer)?;
        let answer: Json = serde_json::from_str(&answer).map_err(std::io::Error::other)?;
        match answer.get("ok").and_then(Json::as_bool) {
            Some(true) => Ok(answer.get("result").cloned().unwrap_or(Json::Null)),
            _ => Err(HostedError::Refused(answer.to_string())),
        }
    }

    /// Stops the mock and returns its world.
    pub fn stop(mut self) -> Option<World> {
        self.join()
    }

    fn join(&mut self) -> Option<World> {
        self.stop.store(true, Ordering::Relaxed);
        let mut world = self.thread.take()?.join().ok()?.world;
        if let Some(recorder) = world.recorder.take() {
            // The caller reads the file next; a failed write shows there as a short record.
            let _ = recorder.finish();
        }
        Some(world)
    }
}

impl Drop for Hosted {
    fn drop(&mut self) {
        self.join();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashSet;

    #[test]
    fn consecutive_mocks_have_different_addresses() {
        for start in [0, 4_000, 61 * 4_194_304] {
            let seen: HashSet<IpAddr> = (start..start + 100_000).map(address).collect();
            assert_eq!(seen.len(), 100_000);
            assert!(seen.iter().all(|a| a.is_loopback()));
        }
    }
}
