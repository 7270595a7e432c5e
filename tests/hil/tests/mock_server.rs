//! The mock controller over real sockets: hostile clients, slow clients, a thousand reconnects, a client that dies in
//! motion.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

use graspd_hil::controller::{Command, Entry, Hosted, Setup, judge_record, now_ns, read_record};
use graspd_hil::plant::Model;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

fn host() -> Hosted {
    Hosted::start(Setup::new(Model::by_name("ur5e").unwrap()), Some((0.5, 4.0)), None).unwrap()
}

fn package(kind: u8, body: &[u8]) -> Vec<u8> {
    let mut out = ((body.len() + 3) as u16).to_be_bytes().to_vec();
    out.push(kind);
    out.extend_from_slice(body);
    out
}

/// One package from a stream.
fn read_package(stream: &mut TcpStream) -> std::io::Result<(u8, Vec<u8>)> {
    let mut head = [0; 3];
    stream.read_exact(&mut head)?;
    let mut body = vec![0; usize::from(u16::from_be_bytes([head[0], head[1]])).saturating_sub(3)];
    stream.read_exact(&mut body)?;
    Ok((head[2], body))
}

fn ask(stream: &mut TcpStream, kind: u8, body: &[u8]) -> (u8, Vec<u8>) {
    stream.write_all(&package(kind, body)).unwrap();
    read_package(stream).unwrap()
}

/// A client that receives `timestamp` at full rate.
fn receiver(mock: &Hosted) -> TcpStream {
    let mut s = mock.connect(30004).unwrap();
    assert_eq!(ask(&mut s, 86, &[0, 2]), (86, vec![1]));
    let recipe = [&500.0f64.to_be_bytes()[..], b"timestamp"].concat();
    assert_eq!(ask(&mut s, 79, &recipe), (79, b"\x01DOUBLE".to_vec()));
    assert_eq!(ask(&mut s, 83, &[]), (83, vec![1]));
    s
}

fn timestamp(s: &mut TcpStream) -> std::io::Result<f64> {
    loop {
        if let (85, body) = read_package(s)? {
            return Ok(f64::from_be_bytes(body[1..9].try_into().unwrap()));
        }
    }
}

/// Checks that the control port and the dashboard answer.
fn check_alive(mock: &mut Hosted) {
    assert_eq!(mock.ask(&Command::Ping).unwrap(), "done");
    let mut s = receiver(mock);
    let first = timestamp(&mut s).unwrap();
    assert!(timestamp(&mut s).unwrap() > first);
}

fn open_files() -> usize {
    std::fs::read_dir("/proc/self/fd").unwrap().count()
}

fn threads() -> usize {
    std::fs::read_dir("/proc/self/task").unwrap().count()
}

#[test]
fn the_clock_has_no_gaps_and_several_clients_see_the_same() {
    let mock = host();
    let (mut a, mut b) = (receiver(&mock), receiver(&mock));
    let mut last = timestamp(&mut a).unwrap();
    let mut steps = Vec::new();
    for _ in 0..250 {
        let now = timestamp(&mut a).unwrap();
        steps.push(((now - last) / 0.002).round() as i64);
        last = now;
    }
    // After a stall only the newest package is sent: time stamps never repeat or go back.
    assert!(steps.iter().all(|s| *s >= 1), "{steps:?}");
    assert!((timestamp(&mut b).unwrap() - last).abs() < 1.0);
}

#[test]
fn hostile_bytes_only_end_their_own_connection() {
    let mut mock = host();
    let noise: Vec<u8> = (0..5000u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
    let attacks: [&[u8]; 9] = [
        &[0, 0, 0],
        &[0, 2, 86],
        &[255, 255, 79],
        &package(79, &[b','; 3000]),
        &package(73, &[0xff, 0xfe, b',', 0x80]),
        &package(85, &[1]),
        &package(85, &[]),
        &package(86, &[]),
        &noise,
    ];
    for port in [29999, 30001, 30002, 30003, 30004] {
        for bytes in attacks {
            let mut s = mock.connect(port).unwrap();
            // The mock may already have closed the connection.
            let _ = s.write_all(bytes);
            drop(s);
        }
        // RST instead of FIN.
        let mut s = mock.connect(port).unwrap();
        let _ = s.write_all(&[0, 200, 79, 1]);
        rustix::net::sockopt::set_socket_linger(&s, Some(Duration::ZERO)).unwrap();
        drop(s);
        check_alive(&mut mock);
    }
}

#[test]
fn impossible_package_sizes_close_the_connection() {
    let mock = host();
    let mut s = mock.connect(30004).unwrap();
    s.write_all(&[0, 1, 86]).unwrap();
    let mut rest = Vec::new();
    assert!(matches!(s.read_to_end(&mut rest), Ok(0)), "closed without an answer");
}

#[test]
fn single_bytes_and_merged_packages_are_understood() {
    let mut mock = host();
    let mut s = mock.connect(30004).unwrap();
    for b in package(86, &[0, 2]) {
        s.write_all(&[b]).unwrap();
        std::thread::sleep(Duration::from_millis(1));
    }
    assert_eq!(read_package(&mut s).unwrap(), (86, vec![1]));
    let recipe = [&500.0f64.to_be_bytes()[..], b"timestamp,robot_mode"].concat();
    s.write_all(&[package(118, &[]), package(79, &recipe), package(83, &[])].concat()).unwrap();
    assert_eq!(read_package(&mut s).unwrap().0, 118);
    assert_eq!(read_package(&mut s).unwrap(), (79, b"\x01DOUBLE,INT32".to_vec()));
    assert_eq!(read_package(&mut s).unwrap(), (83, vec![1]));
    // In the other direction the mock sends single bytes.
    mock.ask(&Command::Chunk { port: Default::default(), bytes: 1 }).unwrap();
    assert!(timestamp(&mut s).unwrap() > 60.0);
}

#[test]
fn a_slow_writer_does_not_delay_others() {
    let mut mock = host();
    let slow: Vec<TcpStream> = (0..20)
        .map(|i| {
            let mut s = mock.connect([29999, 30002, 30004][i % 3]).unwrap();
            s.write_all(&[0, 200, 79][..1 + i % 3]).unwrap();
            s
        })
        .collect();
    let begin = Instant::now();
    check_alive(&mut mock);
    assert!(begin.elapsed() < Duration::from_secs(5));
    drop(slow);
}

#[test]
fn a_thousand_reconnects_leak_nothing() {
    let mut mock = host();
    check_alive(&mut mock);
    std::thread::sleep(Duration::from_millis(50));
    let (files, tasks) = (open_files(), threads());
    for i in 0..1000 {
        let mut s = mock.connect([30004, 29999, 30001, 30003, 30002][i % 5]).unwrap();
        if i % 5 == 0 {
            // Owns an input, which must be free for the next client.
            let (kind, body) = ask(&mut s, 73, b"input_int_register_24");
            assert_eq!((kind, &body[1..]), (73, &b"INT32"[..]), "reconnect {i}");
        }
    }
    check_alive(&mut mock);
    let deadline = Instant::now() + Duration::from_secs(5);
    // Other tests of this process also open files; only permanent growth counts.
    while open_files() > files + 60 && Instant::now() < deadline {
        std::thread::sleep(Duration::from_millis(50));
    }
    assert!(open_files() <= files + 60, "{} files, before {files}", open_files());
    assert!(threads() <= tasks + 20, "{} threads, before {tasks}", threads());
}

#[test]
fn a_client_that_does_not_read_is_disconnected_and_a_slow_one_gets_the_newest_package() {
    let mut mock = host();
    let mut s = mock.connect(30004).unwrap();
    rustix::net::sockopt::set_socket_recv_buffer_size(&s, 4096).unwrap();
    let names: Vec<String> =
        graspd_rt::rtde::Field::all(graspd_rt::rtde::Side::Output).map(|f| f.to_string()).collect();
    ask(&mut s, 86, &[0, 2]);
    ask(&mut s, 79, &[&500.0f64.to_be_bytes()[..], names.join(",").as_bytes()].concat());
    ask(&mut s, 83, &[]);
    std::thread::sleep(Duration::from_secs(12));
    let mut sink = vec![0; 1 << 16];
    let ended = loop {
        match s.read(&mut sink) {
            Ok(0) => break true,
            Err(e) if e.kind() == std::io::ErrorKind::ConnectionReset => break true,
            Err(_) => break false,
            Ok(_) => {}
        }
    };
    assert!(ended, "the connection is still there after twelve seconds without a read");
    check_alive(&mut mock);
}

#[test]
fn network_faults_take_effect() {
    let mut mock = host();
    let mut s = receiver(&mock);
    let mut last = timestamp(&mut s).unwrap();
    mock.ask(&Command::LoseDownstream { port: Default::default(), seconds: 0.3 }).unwrap();
    let gap = (0..1500).any(|_| {
        let now = timestamp(&mut s).unwrap();
        let step = now - last;
        last = now;
        step > 0.25
    });
    assert!(gap, "no gap in the data");
    mock.ask(&Command::ClockRestart).unwrap();
    let restarted = (0..500).any(|_| timestamp(&mut s).unwrap() < 30.0);
    assert!(restarted, "the clock did not restart");
    mock.ask(&Command::Refuse { port: Default::default(), on: true }).unwrap();
    let mut refused = mock.connect(30004).unwrap();
    assert!(matches!(refused.read(&mut [0; 8]), Ok(0) | Err(_)));
    mock.ask(&Command::ClearFaults).unwrap();
    mock.ask(&Command::WrongLength { port: Default::default() }).unwrap();
    let impossible = (0..500).any(|_| {
        let mut head = [0; 3];
        s.read_exact(&mut head).unwrap();
        let n = u16::from_be_bytes([head[0], head[1]]);
        if n >= 3 {
            s.read_exact(&mut vec![0; usize::from(n) - 3]).unwrap();
        }
        n < 3
    });
    assert!(impossible);
    mock.ask(&Command::Reset { port: Default::default() }).unwrap();
    let ended = (0..100).any(|_| matches!(s.read(&mut [0; 4096]), Ok(0) | Err(_)));
    assert!(ended);
    assert!(mock.ask(&Command::SpeedSlider { fraction: 2.0 }).is_err());
}

#[test]
fn the_dashboard_and_the_primary_port_greet() {
    let mock = host();
    let mut d = BufReader::new(mock.connect(29999).unwrap());
    let mut line = String::new();
    d.read_line(&mut line).unwrap();
    assert_eq!(line, "Connected: Universal Robots Dashboard Server\n");
    d.get_mut().write_all(b"robotmode\nquit\n").unwrap();
    let rest: Vec<String> = d.lines().map(Result::unwrap).collect();
    assert_eq!(rest, ["Robotmode: RUNNING", "Disconnected"]);
    let mut p = mock.connect(30001).unwrap();
    let mut head = [0; 5];
    p.read_exact(&mut head).unwrap();
    assert_eq!(head[4], 20, "a version message comes first");
    let mut rest = vec![0; i32::from_be_bytes(head[..4].try_into().unwrap()) as usize - 5];
    p.read_exact(&mut rest).unwrap();
    p.read_exact(&mut head).unwrap();
    assert_eq!(head[4], 16, "then the robot's state");
    // A script error is reported with its line.
    let mut rest = vec![0; i32::from_be_bytes(head[..4].try_into().unwrap()) as usize - 5];
    p.read_exact(&mut rest).unwrap();
    p.write_all(b"def f():\n  x = 1\n  nonsense_call(x)\nend\n").unwrap();
    let begin = Instant::now();
    let found = loop {
        p.read_exact(&mut head).unwrap();
        let mut body = vec![0; i32::from_be_bytes(head[..4].try_into().unwrap()) as usize - 5];
        p.read_exact(&mut body).unwrap();
        if head[4] == 20 && body[9] == 10 {
            break i32::from_be_bytes(body[10..14].try_into().unwrap());
        }
        assert!(begin.elapsed() < Duration::from_secs(5), "no runtime message");
    };
    assert_eq!(found, 3);
}

/// A program that follows one float register while an integer register is written.
const FOLLOW: &str = "def follow():
  rtde_set_watchdog(\"input_int_register_25\", 20, \"stop\")
  while True:
    speedj([read_input_float_register(24), 0, 0, 0, 0, 0], 4, get_steptime())
  end
end
";

#[test]
fn the_wire_record_shows_that_the_arm_stops_when_its_client_is_killed() {
    let path = std::env::temp_dir().join(format!("graspd-mock-{}-{}.rec", std::process::id(), now_ns()));
    let setup = Setup::new(Model::by_name("ur5e").unwrap());
    let mock = Hosted::start(setup, Some((0.5, 4.0)), Some(path.clone())).unwrap();
    for kill in 0..5u64 {
        let mut script = mock.connect(30002).unwrap();
        script.write_all(FOLLOW.as_bytes()).unwrap();
        let mut s = mock.connect(30004).unwrap();
        ask(&mut s, 86, &[0, 2]);
        let (_, recipe) = ask(&mut s, 73, b"input_int_register_24,input_int_register_25,input_double_register_24");
        assert_eq!(recipe[0], 1, "{}", String::from_utf8_lossy(&recipe));
        let mut rate = 0.0f64;
        for cycle in 0..(60 + 13 * kill as i32) {
            let mut body = vec![1];
            body.extend_from_slice(&1i32.to_be_bytes());
            body.extend_from_slice(&(1000 * kill as i32 + cycle + 1).to_be_bytes());
            body.extend_from_slice(&rate.to_be_bytes());
            s.write_all(&package(85, &body)).unwrap();
            rate = (rate + 0.008).min(0.4);
            std::thread::sleep(Duration::from_millis(2));
        }
        // A killed process only closes its socket.
        drop(s);
        std::thread::sleep(Duration::from_millis(500));
    }
    let world = mock.stop().unwrap();
    let record = read_record(&path).unwrap();
    std::fs::remove_file(&path).unwrap();
    let summary = judge_record(&record, *world.judge.limits());
    assert_eq!(summary.episode_count, 5, "{:?}", summary.episodes);
    assert_eq!(summary.limit_violations, 0, "{:?}", summary.violations);
    for e in &summary.episodes {
        // Watchdog of 50 ms, ramp of 4 rad/s^2, lag of the drives, and the delay of the host according to the record's
        // clock.
        let late = record_lateness(&record);
        let bound = 0.050 + e.peak_rate / 4.0 + 0.030 + late;
        assert!(e.stop_ns().unwrap() as f64 * 1e-9 <= bound, "{e:?}, host late by {late}");
    }
    assert_eq!(summary.inputs, world.judge.summary().inputs, "the record and the live judge agree");
}

/// The longest gap between two control steps, s.
fn record_lateness(record: &[Entry]) -> f64 {
    let times: Vec<u64> = record
        .iter()
        .filter_map(|e| match e {
            Entry::Step { at_ns, .. } => Some(*at_ns),
            _ => None,
        })
        .collect();
    times.windows(2).map(|w| w[1] - w[0]).max().unwrap_or(0) as f64 * 1e-9
}
