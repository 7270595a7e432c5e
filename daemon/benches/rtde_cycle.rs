//! Processor time of a 500 Hz cycle of the UR link: `cargo bench -p graspd --bench rtde_cycle [-- SECONDS]`.
//!
//! Two alternating loops with the same system calls in the same order (poll, read until it would block, QUICKACK,
//! write): one only moves bytes, the other is the complete link with framing, session, decoding, gap count and
//! encoding. The peer is a thread that sends a state every 2 ms; only the processor time of the measured thread counts.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a failure must panic

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use graspd::arm::{ArmLink, UrConfig, UrLink};
use graspd::realtime::now_ns;
use graspd_rt::arm::{ArmCommand, ArmMode, Model};
use graspd_rt::rtde::*;

const CYCLE_NS: u64 = 2_000_000;

fn cpu_ns() -> u64 {
    let t = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    t.tv_sec as u64 * 1_000_000_000 + t.tv_nsec as u64
}

/// The peer: an optional handshake, then a state in each cycle until the client closes.
fn peer(listener: TcpListener, handshake: bool, stop: Arc<AtomicBool>) {
    let (mut stream, _) = listener.accept().expect("a client");
    stream.set_nodelay(true).expect("nodelay");
    let mut framer = Framer::new(vec![0u8; 8192]);
    let mut out = vec![0u8; 8192];
    let mut started = !handshake;
    while !started {
        let Ok(n @ 1..) = stream.read(framer.space()) else { return };
        framer.commit(n);
        while let Ok(Some(package)) = framer.next() {
            let list = |side, list| {
                let mut out = vec![0u8; 4096];
                let kinds = names(list).filter_map(|n| Field::find(side, n)).map(|f| f.kind());
                join(kinds, &mut out).expect("room").to_owned()
            };
            let version = ControllerVersion { major: 5, minor: 11, bugfix: 0, build: 1 };
            let types;
            let message = match ClientMessage::parse(Version::V2, package).expect("a message") {
                ClientMessage::RequestVersion(_) => ControllerMessage::VersionAccepted(true),
                ClientMessage::GetControllerVersion => ControllerMessage::ControllerVersion(version),
                ClientMessage::SetupOutputs { names, .. } => {
                    types = list(Side::Output, names);
                    ControllerMessage::OutputsSetUp { recipe: Some(1), types: &types }
                }
                ClientMessage::SetupInputs { names } => {
                    types = list(Side::Input, names);
                    ControllerMessage::InputsSetUp { recipe: 1, types: &types }
                }
                _ => {
                    started = true;
                    ControllerMessage::Started(true)
                }
            };
            let n = message.emit(Version::V2, &mut out).expect("room");
            stream.write_all(&out[..n]).expect("sent");
        }
    }
    let recipe = Recipe::<64>::resolve(Side::Output, &STATE_FIELDS).expect("names");
    let stamp = recipe.slot::<f64>("timestamp").expect("timestamp");
    let mut values = vec![0u8; recipe.size()];
    let mut sink = [0u8; 8192];
    let mut time = 100.0;
    stream.set_nonblocking(true).expect("non-blocking");
    while !stop.load(Ordering::Relaxed) {
        time += 0.002;
        let _ = stamp.write(&mut values, time);
        let package = ControllerMessage::Data { recipe: Some(1), values: &values };
        let n = package.emit(Version::V2, &mut out).expect("room");
        if stream.write_all(&out[..n]).is_err() {
            return;
        }
        let _ = stream.read(&mut sink);
        std::thread::sleep(Duration::from_nanos(CYCLE_NS));
    }
}

fn start(handshake: bool) -> (u16, Arc<AtomicBool>, std::thread::JoinHandle<()>) {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
    let port = listener.local_addr().expect("an address").port();
    let stop = Arc::new(AtomicBool::new(false));
    let stopped = Arc::clone(&stop);
    (port, stop, std::thread::spawn(move || peer(listener, handshake, stopped)))
}

/// Processor time of one cycle of the link, ns.
fn link(cycles: u64) -> f64 {
    let (port, stop, thread) = start(true);
    let mut config = UrConfig::new("127.0.0.1", Model::Ur5e);
    config.port_offset = port.wrapping_sub(30004);
    let mut link = UrLink::connect(&config).expect("a session");
    let (mut before, mut done, mut cycle) = (cpu_ns(), 0, 0);
    while done < cycles {
        link.wait(now_ns() + 10 * CYCLE_NS);
        let poll = link.poll(now_ns());
        if let Some(fault) = poll.fault {
            panic!("{fault}");
        }
        if poll.packages == 0 {
            continue;
        }
        cycle += 1;
        let command = ArmCommand { mode: ArmMode::Velocity, rates: [0.1; 6], heartbeat: cycle, outputs: 0 };
        link.send(&command).expect("sent");
        done += 1;
        if done == 1 {
            before = cpu_ns();
        }
    }
    let cost = (cpu_ns() - before) as f64 / (cycles - 1) as f64;
    stop.store(true, Ordering::Relaxed);
    drop(link);
    let _ = thread.join();
    cost
}

/// Processor time of the same system calls without any decoding, ns.
fn bare(cycles: u64) -> f64 {
    let (port, stop, thread) = start(false);
    let mut stream = TcpStream::connect(("127.0.0.1", port)).expect("a connection");
    stream.set_nodelay(true).expect("nodelay");
    stream.set_nonblocking(true).expect("non-blocking");
    let (mut buffer, command) = (vec![1u8; MAX_PACKAGE], [0u8; CommandWriter::PACKAGE]);
    let (mut before, mut done) = (cpu_ns(), 0);
    while done < cycles {
        // The link reads the clock twice a cycle; so does this loop.
        let left = 10 * CYCLE_NS + now_ns() - now_ns();
        let timeout = rustix::time::Timespec { tv_sec: 0, tv_nsec: left.min(999_999_999) as i64 };
        let mut fds = [rustix::event::PollFd::new(&stream, rustix::event::PollFlags::IN)];
        let _ = rustix::event::poll(&mut fds, Some(&timeout));
        let mut got = 0;
        while let Ok(n @ 1..) = stream.read(&mut buffer) {
            got += n;
        }
        if got == 0 {
            continue;
        }
        let _ = rustix::net::sockopt::set_tcp_quickack(&stream, true);
        stream.write_all(&command).expect("sent");
        done += 1;
        if done == 1 {
            before = cpu_ns();
        }
    }
    let cost = (cpu_ns() - before) as f64 / (cycles - 1) as f64;
    stop.store(true, Ordering::Relaxed);
    drop(stream);
    let _ = thread.join();
    cost
}

fn main() {
    let seconds: f64 = std::env::args().filter_map(|a| a.parse().ok()).next().unwrap_or(12.0);
    let cycles = (seconds / 6.0 * 500.0).max(2.0) as u64;
    let (mut bare_ns, mut link_ns) = ([0.0; 3], [0.0; 3]);
    for (b, l) in bare_ns.iter_mut().zip(&mut link_ns) {
        *b = bare(cycles);
        *l = link(cycles);
        println!("bare loop {:6.2} us  link {:6.2} us  ratio {:.2}", *b * 1e-3, *l * 1e-3, *l / *b);
    }
    bare_ns.sort_by(f64::total_cmp);
    link_ns.sort_by(f64::total_cmp);
    println!(
        "median    {:6.2} us       {:6.2} us  ratio {:.2}",
        bare_ns[1] * 1e-3,
        link_ns[1] * 1e-3,
        link_ns[1] / bare_ns[1]
    );
}
