//! TCP connections opened by the running program. No call blocks the control step.

use crate::urscript::{Connect, Received};
use std::collections::HashMap;
use std::io::{ErrorKind, Read, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::sync::mpsc::{Receiver, TryRecvError, channel};
use std::time::Duration;

/// Connections that a program may hold at a time.
const MAX_SOCKETS: usize = 8;
/// Time after which an attempt to connect fails.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(2);
/// Bytes read from one connection in one call.
const READ_BYTES: usize = 4096;

/// Connections of the running program by socket name.
#[derive(Default)]
pub(super) struct Sockets(HashMap<String, Socket>);

enum Socket {
    /// A helper thread connects; it gives up after [`CONNECT_TIMEOUT`].
    Connecting(Receiver<Option<TcpStream>>),
    Open(TcpStream),
}

impl Sockets {
    /// Opens `name`, or reports how far its connection attempt has got.
    pub(super) fn connect(&mut self, name: &str, address: &str, port: u16) -> Connect {
        match self.0.get(name) {
            Some(Socket::Open(_)) => Connect::Open,
            Some(Socket::Connecting(result)) => match result.try_recv() {
                Ok(Some(stream)) => {
                    self.0.insert(name.to_owned(), Socket::Open(stream));
                    Connect::Open
                }
                Err(TryRecvError::Empty) => Connect::Pending,
                Ok(None) | Err(TryRecvError::Disconnected) => {
                    self.0.remove(name);
                    Connect::Failed
                }
            },
            None if self.0.len() >= MAX_SOCKETS => Connect::Failed,
            None => {
                self.0.insert(name.to_owned(), Socket::Connecting(connect(address, port)));
                Connect::Pending
            }
        }
    }

    /// Closes `name`; unknown names are ignored.
    pub(super) fn close(&mut self, name: &str) {
        self.0.remove(name);
    }

    /// Closes every connection.
    pub(super) fn close_all(&mut self) {
        self.0.clear();
    }

    /// Sends all bytes. On failure closes the connection and returns false.
    pub(super) fn send(&mut self, name: &str, bytes: &[u8]) -> bool {
        let sent = match self.0.get_mut(name) {
            Some(Socket::Open(stream)) => stream.write_all(bytes).is_ok(),
            _ => false,
        };
        if !sent {
            self.0.remove(name);
        }
        sent
    }

    /// Bytes that have arrived on `name` since the last call.
    pub(super) fn receive(&mut self, name: &str) -> Received {
        let Some(Socket::Open(stream)) = self.0.get_mut(name) else { return Received::Closed };
        let mut buffer = [0; READ_BYTES];
        match stream.read(&mut buffer) {
            Ok(n) if n > 0 => Received::Bytes(buffer.iter().copied().take(n).collect()),
            Err(e) if matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => Received::Nothing,
            Ok(_) | Err(_) => {
                self.0.remove(name);
                Received::Closed
            }
        }
    }
}

/// Connects on a helper thread.
fn connect(address: &str, port: u16) -> Receiver<Option<TcpStream>> {
    let (sender, receiver) = channel();
    let address = address.to_owned();
    std::thread::spawn(move || {
        let stream = (address.as_str(), port)
            .to_socket_addrs()
            .ok()
            .and_then(|mut all| all.next())
            .and_then(|a| TcpStream::connect_timeout(&a, CONNECT_TIMEOUT).ok())
            .filter(|s| s.set_nonblocking(true).is_ok() && s.set_nodelay(true).is_ok());
        // The program may have given up meanwhile; the connection then closes here.
        let _ = sender.send(stream);
    });
    receiver
}
