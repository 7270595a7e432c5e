//! The program `graspd-mock-ur` as a separate process with hostile clients: slow ones, ones that reset, ones that never
//! read, and a thousand reconnects. Its open files, threads and memory are measured from outside.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

use serde_json::Value as Json;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{Ipv4Addr, TcpStream};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

const PORTS: [u16; 8] = [29999, 30001, 30002, 30003, 30004, 30011, 30012, 30013];

/// A mock that ends with this test.
struct Mock {
    child: Child,
    address: Ipv4Addr,
    control: u16,
}

impl Mock {
    fn start() -> Mock {
        let id = std::process::id();
        for n in 1..200u8 {
            let address = Ipv4Addr::new(127, 200 + (id >> 8) as u8 % 50, id as u8, n);
            let mut child = Command::new(env!("CARGO_BIN_EXE_graspd-mock-ur"))
                .args([
                    "--bind",
                    &address.to_string(),
                    "--control-port",
                    "0",
                    "--exit-with-stdin",
                    "--max-seconds",
                    "120",
                ])
                .stdin(Stdio::piped())
                .stdout(Stdio::piped())
                .stderr(Stdio::null())
                .spawn()
                .unwrap();
            let mut line = String::new();
            BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
            match serde_json::from_str::<Json>(&line) {
                Ok(ready) => return Mock { child, address, control: ready["control"].as_u64().unwrap() as u16 },
                // Another mock uses this address.
                Err(_) => drop(child.wait()),
            }
        }
        panic!("no free loopback address");
    }

    fn connect(&self, port: u16) -> TcpStream {
        let begin = Instant::now();
        loop {
            match TcpStream::connect((self.address, port)) {
                Ok(s) => {
                    s.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
                    return s;
                }
                // After thousands of connections the local ports are exhausted for a short time.
                Err(e) => assert!(begin.elapsed() < Duration::from_secs(20), "{port}: {e}"),
            }
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    /// Checks that the control port and the RTDE port answer and that the clock runs.
    fn check_alive(&self) {
        let mut control = BufReader::new(self.connect(self.control));
        let mut clocks = Vec::new();
        for _ in 0..2 {
            control.get_mut().write_all(b"{\"cmd\":\"state\"}\n").unwrap();
            let mut line = String::new();
            control.read_line(&mut line).unwrap();
            let state: Json = serde_json::from_str(&line).unwrap();
            clocks.push(state["result"]["clock_s"].as_f64().unwrap());
            std::thread::sleep(Duration::from_millis(20));
        }
        assert!(clocks[1] > clocks[0], "{clocks:?}");
        let mut s = self.connect(30004);
        s.write_all(&[0, 5, 86, 0, 2]).unwrap();
        let mut answer = [0; 4];
        s.read_exact(&mut answer).unwrap();
        assert_eq!(answer, [0, 4, 86, 1]);
    }

    fn count(&self, what: &str) -> usize {
        std::fs::read_dir(format!("/proc/{}/{what}", self.child.id())).unwrap().count()
    }

    /// Resident memory, KiB.
    fn resident(&self) -> u64 {
        let text = std::fs::read_to_string(format!("/proc/{}/status", self.child.id())).unwrap();
        let line = text.lines().find(|l| l.starts_with("VmRSS:")).unwrap();
        line.split_whitespace().nth(1).unwrap().parse().unwrap()
    }

    /// Waits until the files of the clients are closed.
    fn settles(&self, files: usize) {
        let begin = Instant::now();
        while self.count("fd") > files {
            assert!(begin.elapsed() < Duration::from_secs(30), "{} files, before {files}", self.count("fd"));
            std::thread::sleep(Duration::from_millis(20));
        }
    }
}

impl Drop for Mock {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn reset(s: TcpStream) {
    rustix::net::sockopt::set_socket_linger(&s, Some(Duration::ZERO)).unwrap();
    drop(s);
}

/// The first bytes of a client for each port; the tests cut them at any position.
fn talk(port: u16) -> Vec<u8> {
    let mut out = Vec::new();
    let mut put = |kind: u8, body: &[u8]| {
        out.extend_from_slice(&((body.len() + 3) as u16).to_be_bytes());
        out.push(kind);
        out.extend_from_slice(body);
    };
    match port {
        29999 => b"PolyscopeVersion\nrobotmode\nprogramState\nload x.urp\nplay\n".to_vec(),
        30004 => {
            put(86, &[0, 2]);
            put(118, &[]);
            put(79, &[&500.0f64.to_be_bytes()[..], b"timestamp,actual_q,actual_qd,robot_mode"].concat());
            put(73, b"input_int_register_24,input_double_register_24");
            put(83, &[]);
            put(85, &[&[1][..], &7i32.to_be_bytes(), &0.1f64.to_be_bytes()].concat());
            out
        }
        _ => b"def f():\n  while True:\n    speedj([0.1, 0, 0, 0, 0, 0], 1, get_steptime())\n  end\nend\n".to_vec(),
    }
}

#[test]
fn a_thousand_reconnects_leak_no_files_threads_or_memory() {
    let mock = Mock::start();
    let round = |from: usize, n: usize| {
        for k in from..from + n {
            let port = PORTS[k % PORTS.len()];
            let words = talk(port);
            let mut s = mock.connect(port);
            // The mock may have closed the connection already.
            let _ = s.write_all(&words[..(k * 7919) % (words.len() + 1)]);
            if k % 3 == 0 {
                let _ = s.read(&mut [0; 512]);
            }
            if k % 2 == 0 { reset(s) } else { drop(s) }
        }
    };
    // After this all one-time allocations are done.
    round(0, 200);
    mock.check_alive();
    mock.settles(mock.count("fd").min(24));
    let (files, threads, before) = (mock.count("fd"), mock.count("task"), mock.resident());
    round(200, 1000);
    mock.check_alive();
    mock.settles(files);
    let after = mock.resident();
    println!("1000 reconnects: {files} files, {threads} threads, {before} -> {after} KiB");
    assert!(mock.count("task") <= threads, "{} threads, before {threads}", mock.count("task"));
    assert!(after < before + 4096, "{before} KiB before, {after} KiB after");
}

#[test]
fn a_reset_after_any_byte_does_no_harm() {
    let mock = Mock::start();
    for port in [29999, 30002, 30004] {
        let words = talk(port);
        for n in 0..=words.len() {
            let mut s = mock.connect(port);
            let _ = s.write_all(&words[..n]);
            reset(s);
        }
        mock.check_alive();
    }
}

#[test]
fn slow_writers_and_clients_that_never_read_do_not_delay_others_and_cost_little() {
    let mock = Mock::start();
    mock.check_alive();
    let before = mock.resident();
    // Sixty clients: each writes a byte from time to time and never reads.
    let mut clients: Vec<(TcpStream, Vec<u8>, usize)> = (0..60)
        .map(|k| {
            let port = PORTS[k % 5];
            let s = mock.connect(port);
            rustix::net::sockopt::set_socket_recv_buffer_size(&s, 4096).unwrap();
            s.set_nonblocking(true).unwrap();
            (s, talk(port), 0)
        })
        .collect();
    let begin = Instant::now();
    let mut rounds = 0;
    while begin.elapsed() < Duration::from_secs(3) {
        for (s, words, at) in &mut clients {
            if let Some(b) = words.get(*at) {
                let _ = s.write(&[*b]);
                *at += 1;
            }
        }
        rounds += 1;
        if rounds % 30 == 0 {
            mock.check_alive();
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    mock.check_alive();
    let after = mock.resident();
    println!("60 clients that never read: {before} -> {after} KiB");
    // Queues are bounded: a client costs its session and the kernel's buffers.
    assert!(after < before + 60 * 512, "{before} KiB before, {after} KiB after");
}

#[test]
fn clients_that_send_endless_lines_or_programs_are_disconnected() {
    let mock = Mock::start();
    let before = mock.resident();
    for (port, most) in [(29999u16, 1 << 20), (30002, 4 << 20), (mock.control, 4 << 20)] {
        let mut s = mock.connect(port);
        let block = [b'x'; 65_536];
        let mut sent = 0usize;
        let begin = Instant::now();
        while s.write_all(&block).is_ok() {
            sent += block.len();
            assert!(sent < most + (8 << 20) && begin.elapsed() < Duration::from_secs(30), "{port}: takes {sent} bytes");
        }
        mock.check_alive();
    }
    assert!(mock.resident() < before + 16_384, "{before} KiB before, {} KiB after", mock.resident());
}
