//! The UR link against peers that misbehave, over loopback TCP. Every wait is bounded; no time is asserted from below.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a failure must panic

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use graspd::arm::{ArmError, ArmLink, LinkFault, UrConfig, UrLink};
use graspd_rt::arm::{ArmCommand, ArmMode, Model};
use graspd_rt::rtde::*;

const LIMIT: Duration = Duration::from_secs(5);

/// Behaviour of a peer.
#[derive(Clone)]
struct Peer {
    /// Bytes in one write.
    piece: usize,
    /// Pause between writes of the handshake.
    drip: Duration,
    /// The answer for every input variable.
    input_answer: Option<Answer>,
    /// Sent after the handshake and one valid state.
    then: Vec<u8>,
    /// How the connection ends: by a reset, by closing, or held open without reading until the client closes.
    end: End,
    connections: usize,
}

#[derive(Clone, Copy, PartialEq)]
enum End {
    Reset,
    Close,
    Hold,
}

impl Default for Peer {
    fn default() -> Self {
        let drip = Duration::ZERO;
        Peer { piece: 4096, drip, input_answer: None, then: Vec::new(), end: End::Hold, connections: 1 }
    }
}

/// A data package of the control recipe.
fn state(timestamp_s: f64, token: i32) -> Vec<u8> {
    let recipe = Recipe::<64>::resolve(Side::Output, &STATE_FIELDS).unwrap();
    let mut values = vec![0u8; recipe.size()];
    recipe.slot("timestamp").unwrap().write(&mut values, timestamp_s).unwrap();
    recipe.slot("output_int_register_27").unwrap().write(&mut values, token).unwrap();
    emit(ControllerMessage::Data { recipe: Some(1), values: &values })
}

fn emit(message: ControllerMessage<'_>) -> Vec<u8> {
    let mut out = vec![0u8; 8192];
    let n = message.emit(Version::V2, &mut out).unwrap();
    out.truncate(n);
    out
}

impl Peer {
    /// Serves on a free port; returns the configuration of a client for it.
    fn serve(self) -> (UrConfig, JoinHandle<()>) {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let offset = listener.local_addr().unwrap().port().wrapping_sub(30004);
        let mut config = UrConfig::new("127.0.0.1", Model::Ur5e);
        config.port_offset = offset;
        let thread = std::thread::spawn(move || {
            for _ in 0..self.connections {
                let (stream, _) = listener.accept().unwrap();
                self.talk(stream);
            }
        });
        (config, thread)
    }

    fn send(&self, stream: &mut TcpStream, bytes: &[u8]) -> bool {
        bytes.chunks(self.piece).all(|chunk| {
            std::thread::sleep(self.drip);
            stream.write_all(chunk).is_ok()
        })
    }

    fn talk(&self, mut stream: TcpStream) {
        stream.set_nodelay(true).unwrap();
        stream.set_read_timeout(Some(LIMIT)).unwrap();
        let mut framer = Framer::new(vec![0u8; 8192]);
        let mut started = false;
        let start = Instant::now();
        while !started && start.elapsed() < LIMIT {
            let Ok(n @ 1..) = stream.read(framer.space()) else { return };
            framer.commit(n);
            while let Ok(Some(package)) = framer.next() {
                let types = |side, list| {
                    let answers: Vec<_> = names(list)
                        .map(|n| match (side, self.input_answer) {
                            (Side::Input, Some(answer)) => answer,
                            _ => Answer::Type(Field::find(side, n).unwrap().kind()),
                        })
                        .collect();
                    let mut out = vec![0u8; 4096];
                    join(answers, &mut out).unwrap().to_owned()
                };
                let answer = match ClientMessage::parse(Version::V2, package).unwrap() {
                    ClientMessage::RequestVersion(_) => emit(ControllerMessage::VersionAccepted(true)),
                    ClientMessage::GetControllerVersion => {
                        let v = ControllerVersion { major: 5, minor: 11, bugfix: 0, build: 1 };
                        emit(ControllerMessage::ControllerVersion(v))
                    }
                    ClientMessage::SetupOutputs { names, .. } => {
                        let types = types(Side::Output, names);
                        emit(ControllerMessage::OutputsSetUp { recipe: Some(1), types: &types })
                    }
                    ClientMessage::SetupInputs { names } => {
                        let types = types(Side::Input, names);
                        emit(ControllerMessage::InputsSetUp { recipe: 1, types: &types })
                    }
                    ClientMessage::Start => {
                        started = true;
                        // In one write on purpose: the first state arrives together with the answer.
                        [emit(ControllerMessage::Started(true)), state(100.0, 7)].concat()
                    }
                    _ => Vec::new(),
                };
                if !self.send(&mut stream, &answer) {
                    return;
                }
            }
        }
        // The misbehaviour begins after the first command, when the link is set up.
        let mut command = [0u8; CommandWriter::PACKAGE];
        if stream.read_exact(&mut command).is_err() {
            return;
        }
        self.send(&mut stream, &self.then);
        match self.end {
            End::Close => {}
            End::Reset => {
                rustix::net::sockopt::set_socket_linger(&stream, Some(Duration::ZERO)).unwrap();
            }
            End::Hold => {
                // Polls for the hang-up without reading, so that the receive buffer stays full.
                stream.set_read_timeout(Some(Duration::from_millis(20))).unwrap();
                while start.elapsed() < LIMIT && !hung_up(&stream) {
                    std::thread::sleep(Duration::from_millis(5));
                }
            }
        }
    }
}

/// Whether the client has closed.
fn hung_up(stream: &TcpStream) -> bool {
    use rustix::event::{PollFd, PollFlags, poll};
    let mut fds = [PollFd::new(stream, PollFlags::RDHUP)];
    let now = rustix::time::Timespec { tv_sec: 0, tv_nsec: 0 };
    poll(&mut fds, Some(&now)).is_ok() && !fds[0].revents().is_empty()
}

/// A link that is set up and has sent its first command.
fn connect(config: &UrConfig) -> UrLink {
    let mut link = UrLink::connect(config).unwrap();
    link.send(&ArmCommand::default()).unwrap();
    link
}

/// Polls until the link fails.
fn until_fault(link: &mut UrLink) -> LinkFault {
    let start = Instant::now();
    let mut now = 1_000_000;
    while start.elapsed() < LIMIT {
        now += 2_000_000;
        if let Some(fault) = link.poll(now).fault {
            let command = ArmCommand { mode: ArmMode::Velocity, ..ArmCommand::default() };
            assert_eq!(link.send(&command), Err(fault), "a failed link sends nothing");
            assert_eq!(link.poll(now).fault, Some(fault), "a failed link stays failed");
            return fault;
        }
        link.wait(graspd::realtime::now_ns() + 10_000_000);
    }
    panic!("no fault within {LIMIT:?}");
}

#[test]
fn a_stream_in_single_bytes_is_read() {
    let then = [state(100.002, 8), state(100.010, 9)].concat();
    let (config, peer) = Peer { piece: 1, then, ..Peer::default() }.serve();
    let mut link = connect(&config);
    let start = Instant::now();
    while link.state().unwrap().script_token != 9 {
        assert!(start.elapsed() < LIMIT);
        link.poll(5);
        link.wait(graspd::realtime::now_ns() + 5_000_000);
    }
    assert_eq!(link.stats().missing, 3, "gaps are counted by the controller's clock");
    assert_eq!((link.stats().sent, link.rate_hz()), (1, 500.0));
    drop(link);
    peer.join().unwrap();
}

#[test]
fn every_kind_of_invalid_data_ends_the_link_with_its_own_fault() {
    type Expected = fn(LinkFault) -> bool;
    let cases: [(&[u8], Expected); 7] = [
        (b"\x00\x02U", |f| matches!(f, LinkFault::Framing(FrameError::TooShort { size: 2 }))),
        (b"\x00\x03Z", |f| matches!(f, LinkFault::Protocol(ClientError::Message(MessageError::UnknownKind(b'Z'))))),
        (b"\x00\x05U\x01\x00", |f| matches!(f, LinkFault::Protocol(ClientError::DataLength { found: 1, .. }))),
        (b"\x00\x05U\x09\x00", |f| matches!(f, LinkFault::Protocol(ClientError::WrongRecipe(9)))),
        (b"\x00\x06O\x01\xff\xfe", |f| {
            matches!(f, LinkFault::Protocol(ClientError::Message(MessageError::NotText(_))))
        }),
        (b"\x00\x05S\x01\x01", |f| matches!(f, LinkFault::Protocol(ClientError::Message(MessageError::Length { .. })))),
        // Truncated: the header states 65535 bytes, and the connection closes after a few.
        (b"\xff\xffU\x01\x00\x00", |f| f == LinkFault::Closed),
    ];
    for (bytes, expected) in cases {
        let (config, peer) = Peer { then: bytes.to_vec(), end: End::Close, ..Peer::default() }.serve();
        let mut link = connect(&config);
        let fault = until_fault(&mut link);
        assert!(expected(fault), "{bytes:?} gave {fault:?}");
        peer.join().unwrap();
    }
    let (config, peer) = Peer { then: state(50.0, 1), ..Peer::default() }.serve();
    let mut link = connect(&config);
    assert_eq!(until_fault(&mut link), LinkFault::ClockBack);
    drop(link);
    peer.join().unwrap();
}

#[test]
fn a_reset_ends_the_link() {
    let (config, peer) = Peer { end: End::Reset, ..Peer::default() }.serve();
    let mut link = connect(&config);
    assert!(matches!(until_fault(&mut link), LinkFault::Io(_) | LinkFault::Closed));
    peer.join().unwrap();
}

#[test]
fn refused_fields_and_slow_peers_fail_to_connect_with_the_reason() {
    let (config, peer) = Peer { input_answer: Some(Answer::InUse), ..Peer::default() }.serve();
    let error = UrLink::connect(&config).unwrap_err();
    assert!(error.to_string().contains("`input_int_register_24` is held by another RTDE client"), "{error}");
    peer.join().unwrap();

    let (mut config, peer) = Peer { piece: 1, drip: Duration::from_millis(60), ..Peer::default() }.serve();
    config.timeout = Duration::from_millis(400);
    assert!(matches!(UrLink::connect(&config), Err(ArmError::Timeout { .. })));
    peer.join().unwrap();
}

#[test]
fn a_peer_that_never_reads_is_a_fault_and_never_blocks() {
    let (config, peer) = Peer::default().serve();
    let mut link = connect(&config);
    let command = ArmCommand { mode: ArmMode::Velocity, rates: [0.1; 6], heartbeat: 1, outputs: 0 };
    let mut now = 1_000_000;
    let fault = loop {
        now += 2_000_000;
        assert_eq!(link.poll(now).fault, None);
        if let Err(fault) = link.send(&command) {
            break fault;
        }
        assert!(link.stats().sent < 1_000_000, "the send buffer never became full");
    };
    assert!(matches!(fault, LinkFault::SendBlocked(20_000_000..=22_000_000)), "{fault:?}");
    assert!(link.stats().dropped >= 10);
    drop(link);
    peer.join().unwrap();
}

#[test]
fn many_reconnects_leave_no_descriptors_open() {
    let rounds = 100;
    let (config, peer) = Peer { end: End::Close, connections: rounds, ..Peer::default() }.serve();
    let mut tokens = std::collections::HashSet::new();
    for _ in 0..rounds {
        let link = connect(&config);
        tokens.insert(link.token());
    }
    assert_eq!(tokens.len(), rounds, "every session has its own token");
    peer.join().unwrap();
    // Other tests of this process open sockets at the same time, but fewer than a hundred.
    let open = std::fs::read_dir("/proc/self/fd").unwrap().count();
    assert!(open < rounds, "{open} descriptors are open");
}
