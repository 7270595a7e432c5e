//! A hostile connection: a proxy between client and controller that forwards data and breaks each RTDE connection in
//! one of several ways.

use graspd_rt::rtde::Framer;
use std::collections::BTreeMap;
use std::io::{ErrorKind, Read, Write};
use std::net::{IpAddr, Ipv4Addr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// How a connection is broken.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Harm {
    /// Reset before any data.
    Refuse,
    /// No answer.
    Silence,
    /// Reset after this many bytes to the client.
    Reset(usize),
    /// Closed after this many bytes.
    Close(usize),
    /// A wrong package size after this many bytes.
    WrongSize(usize),
    /// Noise after this many bytes.
    Noise(usize),
    /// One byte in each write, then a reset.
    Bytes,
    /// A byte every 15 ms.
    SlowBytes,
    /// Data from the client is never read.
    NeverReads,
    /// Inputs are answered with IN_USE.
    InUse,
    /// Forwarded unchanged for this long, then a reset.
    Forward(Duration),
}

#[derive(Default)]
struct Counts {
    stop: AtomicBool,
    connections: AtomicUsize,
    open: AtomicUsize,
    commands: AtomicUsize,
    moving: AtomicUsize,
    kinds: Mutex<BTreeMap<String, usize>>,
}

/// The proxy of one controller.
pub(crate) struct Proxy {
    /// Address for the client; the ports are the robot's.
    pub(crate) address: IpAddr,
    counts: Arc<Counts>,
}

impl Proxy {
    pub(crate) fn start(controller: IpAddr, seed: u64) -> Self {
        let id = std::process::id();
        let address = IpAddr::V4(Ipv4Addr::new(127, 40, (id >> 8) as u8, (id as u8).max(1)));
        let counts = Arc::new(Counts::default());
        for port in [29_999u16, 30_001, 30_002, 30_004] {
            let listener = TcpListener::bind((address, port)).unwrap();
            listener.set_nonblocking(true).unwrap();
            let counts = Arc::clone(&counts);
            let mut random = seed;
            std::thread::spawn(move || {
                while !counts.stop.load(Ordering::Relaxed) {
                    let Ok((client, _)) = listener.accept() else {
                        std::thread::sleep(Duration::from_millis(1));
                        continue;
                    };
                    let harm = if port == 30_004 {
                        counts.connections.fetch_add(1, Ordering::Relaxed);
                        let harm = draw(&mut random);
                        let name = format!("{harm:?}").split('(').next().unwrap_or_default().to_owned();
                        *counts.kinds.lock().unwrap().entry(name).or_default() += 1;
                        harm
                    } else {
                        Harm::Forward(Duration::from_secs(3600))
                    };
                    let counts = Arc::clone(&counts);
                    counts.open.fetch_add(1, Ordering::Relaxed);
                    std::thread::spawn(move || {
                        if let Ok(server) = TcpStream::connect((controller, port)) {
                            let _ = forward(&client, &server, harm, port == 30_004, &counts);
                        }
                        if !matches!(harm, Harm::Close(_)) {
                            let _ = rustix::net::sockopt::set_socket_linger(&client, Some(Duration::ZERO));
                        }
                        drop(client);
                        counts.open.fetch_sub(1, Ordering::Relaxed);
                    });
                }
            });
        }
        Self { address, counts }
    }

    /// RTDE connections so far.
    pub(crate) fn connections(&self) -> usize {
        self.counts.connections.load(Ordering::Relaxed)
    }

    /// Number of commands from clients.
    pub(crate) fn commands(&self) -> usize {
        self.counts.commands.load(Ordering::Relaxed)
    }

    /// Number of commands with a mode other than idle.
    pub(crate) fn commands_to_move(&self) -> usize {
        self.counts.moving.load(Ordering::Relaxed)
    }

    pub(crate) fn kinds(&self) -> BTreeMap<String, usize> {
        self.counts.kinds.lock().unwrap().clone()
    }

    /// Waits until the connections that the client has closed are closed here as well.
    pub(crate) fn settle(&self) {
        let start = Instant::now();
        while self.counts.open.load(Ordering::Relaxed) > 1 && start.elapsed() < Duration::from_secs(5) {
            std::thread::sleep(Duration::from_millis(10));
        }
    }
}

impl Drop for Proxy {
    fn drop(&mut self) {
        self.counts.stop.store(true, Ordering::Relaxed);
    }
}

fn draw(random: &mut u64) -> Harm {
    let mut next = |n: u64| {
        *random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (*random >> 33) % n
    };
    // The handshake is about 300 bytes to the client, a state 330.
    let at = next(1500) as usize;
    match next(16) {
        0 => Harm::Refuse,
        1 => Harm::Silence,
        2..=4 => Harm::Reset(at),
        5 | 6 => Harm::Close(at),
        7 | 8 => Harm::WrongSize(at),
        9 => Harm::Noise(at),
        10 => Harm::Bytes,
        11 => Harm::SlowBytes,
        12 => Harm::NeverReads,
        13 => Harm::InUse,
        _ => Harm::Forward(Duration::from_millis(500 + next(700))),
    }
}

/// Number of bytes read without waiting; `None` when the connection has ended.
fn take(stream: &mut &TcpStream, buffer: &mut [u8]) -> Option<usize> {
    match stream.read(buffer) {
        Ok(0) => None,
        Ok(n) => Some(n),
        Err(e) if matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => Some(0),
        Err(_) => None,
    }
}

/// Writes all bytes, for at most a second.
fn put(mut stream: &TcpStream, mut bytes: &[u8]) -> Option<()> {
    let start = Instant::now();
    while !bytes.is_empty() {
        match stream.write(bytes) {
            Ok(n) => bytes = bytes.get(n..)?,
            Err(e) if e.kind() == ErrorKind::WouldBlock && start.elapsed() < Duration::from_secs(1) => {
                std::thread::sleep(Duration::from_millis(1));
            }
            Err(_) => return None,
        }
    }
    Some(())
}

/// Forwards one connection until it ends.
fn forward(client: &TcpStream, server: &TcpStream, harm: Harm, rtde: bool, counts: &Counts) -> Option<()> {
    for s in [client, server] {
        s.set_nodelay(true).ok()?;
        s.set_nonblocking(true).ok()?;
    }
    let (start, mut buffer, mut down) = (Instant::now(), vec![0u8; 8192], 0usize);
    let (mut up, mut answers) = (Framer::new(vec![0u8; 1 << 16]), Framer::new(vec![0u8; 1 << 16]));
    // Maximum duration; the client's timeout is shorter.
    let max_duration = match harm {
        Harm::Refuse => return None,
        Harm::Forward(d) => d,
        Harm::Bytes | Harm::NeverReads => Duration::from_millis(900),
        _ => Duration::from_secs(3),
    };
    while start.elapsed() < max_duration && !counts.stop.load(Ordering::Relaxed) {
        std::thread::sleep(Duration::from_millis(1));
        let n = if harm == Harm::NeverReads && down > 800 { 0 } else { take(&mut &*client, &mut buffer)? };
        let sent = buffer.get(..n)?.to_vec();
        if rtde {
            count_commands(&mut up, &sent, counts);
        }
        if harm == Harm::Silence {
            continue;
        }
        put(server, &sent)?;
        let n = take(&mut &*server, &mut buffer)?;
        let mut bytes = buffer.get(..n)?.to_vec();
        if harm == Harm::InUse {
            bytes = refuse_inputs(&mut answers, &bytes);
        }
        // Index among these bytes at which the connection is broken.
        let index = match harm {
            Harm::Reset(at) | Harm::Close(at) | Harm::WrongSize(at) | Harm::Noise(at) => {
                at.checked_sub(down).filter(|left| *left < bytes.len())
            }
            _ => None,
        };
        match (harm, index) {
            (Harm::Reset(_) | Harm::Close(_), Some(at)) => {
                put(client, bytes.get(..at)?);
                return None;
            }
            (Harm::WrongSize(_), Some(at)) => drop(bytes.splice(at..at, [0, 1, 0xff, 0xff])),
            (Harm::Noise(_), Some(at)) => {
                let noise = (0..200u32).map(|k| (k.wrapping_mul(2_654_435_761) >> 13) as u8);
                drop(bytes.splice(at..at, noise));
            }
            _ => {}
        }
        down += bytes.len();
        match harm {
            Harm::Bytes => bytes.chunks(1).try_for_each(|b| put(client, b))?,
            Harm::SlowBytes => {
                for b in bytes.chunks(1) {
                    put(client, b)?;
                    std::thread::sleep(Duration::from_millis(15));
                    if start.elapsed() > max_duration {
                        return None;
                    }
                }
            }
            _ => put(client, &bytes)?,
        }
    }
    None
}

fn count_commands(framer: &mut Framer<Vec<u8>>, mut bytes: &[u8], counts: &Counts) {
    while !bytes.is_empty() {
        let taken = framer.feed(bytes);
        if taken == 0 {
            return;
        }
        bytes = &bytes[taken..];
        while let Ok(Some(package)) = framer.next() {
            // Recipe id, then the mode word.
            if package.kind == b'U' && package.body.len() > 5 {
                counts.commands.fetch_add(1, Ordering::Relaxed);
                counts.moving.fetch_add(usize::from(package.body[1..5] != [0; 4]), Ordering::Relaxed);
            }
        }
    }
}

/// Replaces the answer to the input recipe: another client holds the first variable.
fn refuse_inputs(framer: &mut Framer<Vec<u8>>, mut bytes: &[u8]) -> Vec<u8> {
    let mut out = Vec::new();
    while !bytes.is_empty() {
        let taken = framer.feed(bytes);
        if taken == 0 {
            return out;
        }
        bytes = &bytes[taken..];
        while let Ok(Some(package)) = framer.next() {
            let mut body = package.body.to_vec();
            if package.kind == b'I' {
                let rest = body.iter().position(|b| *b == b',').unwrap_or(body.len());
                body = [&[0u8][..], b"IN_USE", &body[rest..]].concat();
            }
            out.extend((body.len() as u16 + 3).to_be_bytes());
            out.push(package.kind);
            out.extend(body);
        }
    }
    out
}
