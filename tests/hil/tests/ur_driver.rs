//! The communication of UR's C++ driver, in its order, with a similar control script: RTDE with its recipes, the
//! dashboard, the primary interface, and a script that connects back and receives a stream. Real sockets; every wait is
//! bounded.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

use graspd_hil::controller::{Command, Hosted, Setup};
use graspd_hil::plant::Model;
use serde_json::Value as Json;
use std::io::{BufRead, BufReader, ErrorKind, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::time::{Duration, Instant};

const LIMIT: Duration = Duration::from_secs(30);
/// Read timeout of the script, long enough for a stalled host.
const PATIENCE_MS: i32 = 20_000;
const START: [f64; 6] = [0.3, -1.4, 1.5, -1.2, -1.4, 0.2];

fn host() -> Hosted {
    let mut setup = Setup::new(Model::by_name("ur5e").unwrap());
    setup.start_joints = START;
    Hosted::start(setup, None, None).unwrap()
}

fn until(what: &str, mock: &mut Hosted, done: impl Fn(&Json) -> bool) {
    let begin = Instant::now();
    loop {
        let now = state(mock);
        if done(&now) {
            return;
        }
        assert!(begin.elapsed() < LIMIT, "not within {LIMIT:?}: {what}: {now}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// Prints the robot's messages on the primary interface; shown when the test fails.
fn overhear(mock: &Hosted) {
    let mut s = mock.connect(30001).unwrap();
    std::thread::spawn(move || {
        let mut head = [0; 5];
        while s.read_exact(&mut head).is_ok() {
            let mut body = vec![0; (i32::from_be_bytes(head[..4].try_into().unwrap()) as usize).saturating_sub(5)];
            if s.read_exact(&mut body).is_err() {
                return;
            }
            if head[4] == 20 && matches!(body[9], 0 | 2 | 10) {
                println!("robot: {}", String::from_utf8_lossy(&body[10..]).replace('\0', " "));
            }
        }
    });
}

fn accept(listener: &TcpListener) -> TcpStream {
    listener.set_nonblocking(true).unwrap();
    let begin = Instant::now();
    loop {
        match listener.accept() {
            Ok((s, _)) => {
                s.set_nonblocking(false).unwrap();
                s.set_nodelay(true).unwrap();
                s.set_read_timeout(Some(LIMIT)).unwrap();
                return s;
            }
            Err(e) if e.kind() == ErrorKind::WouldBlock => std::thread::sleep(Duration::from_millis(5)),
            Err(e) => panic!("{e}"),
        }
        assert!(begin.elapsed() < LIMIT, "the script did not connect back");
    }
}

fn words(values: &[i32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_be_bytes()).collect()
}

/// One message of the reverse interface: read timeout, six values by a million, mode.
fn reverse(timeout_ms: i32, values: [f64; 6], mode: i32) -> Vec<u8> {
    let mut all = vec![timeout_ms];
    all.extend(values.map(|v| (v * 1e6).round() as i32));
    all.push(mode);
    words(&all)
}

/// A point of a path: six values, six more, speed, acceleration, four unused, time, blend, kind.
fn point(values: [f64; 6], second: [f64; 6], rest: [f64; 3], time: f64, kind: i32) -> Vec<u8> {
    let scaled = |v: f64| (v * 1e6).round() as i32;
    let mut all: Vec<i32> = values.iter().chain(&second).chain(&rest).map(|v| scaled(*v)).collect();
    all.resize(18, 0);
    all.extend([(time * 1000.0) as i32, 0, kind]);
    words(&all)
}

fn read_int(s: &mut TcpStream) -> i32 {
    let mut b = [0; 4];
    s.read_exact(&mut b).unwrap();
    i32::from_be_bytes(b)
}

fn six(state: &Json, key: &str) -> [f64; 6] {
    std::array::from_fn(|i| state[key][i].as_f64().unwrap())
}

fn near(a: [f64; 6], b: [f64; 6], tolerance: f64) -> bool {
    a.iter().zip(b).all(|(x, y)| (x - y).abs() <= tolerance)
}

fn state(mock: &mut Hosted) -> Json {
    mock.ask(&Command::State).unwrap()
}

/// One RTDE package.
fn send(s: &mut TcpStream, kind: u8, body: &[u8]) {
    let mut out = ((body.len() + 3) as u16).to_be_bytes().to_vec();
    out.push(kind);
    out.extend_from_slice(body);
    s.write_all(&out).unwrap();
}

/// The answer to a package; skips data packages in flight.
fn answer(s: &mut TcpStream, kind: u8) -> Vec<u8> {
    loop {
        let mut head = [0; 3];
        s.read_exact(&mut head).unwrap();
        let mut body = vec![0; usize::from(u16::from_be_bytes([head[0], head[1]])) - 3];
        s.read_exact(&mut body).unwrap();
        if head[2] == kind {
            return body;
        }
        assert_eq!(head[2], 85, "asked {kind}");
    }
}

#[test]
fn the_sessions_of_the_driver_are_served_in_its_order() {
    let mock = host();
    // Primary first: version, then a state with the configuration within ten seconds.
    let mut primary = mock.connect(30001).unwrap();
    let (mut version, mut model) = (false, None);
    let begin = Instant::now();
    while model.is_none() {
        assert!(begin.elapsed() < Duration::from_secs(10), "no configuration");
        let mut head = [0; 5];
        primary.read_exact(&mut head).unwrap();
        let mut body = vec![0; i32::from_be_bytes(head[..4].try_into().unwrap()) as usize - 5];
        primary.read_exact(&mut body).unwrap();
        if head[4] == 20 && body[9] == 3 {
            let name = usize::from(body[10]);
            assert_eq!(&body[11..11 + name], b"URControl");
            assert_eq!(&body[11 + name..13 + name], [5, 11]);
            version = true;
        }
        let mut rest = &body[..];
        while head[4] == 16 && rest.len() >= 5 {
            let n = i32::from_be_bytes(rest[..4].try_into().unwrap()) as usize;
            if rest[4] == 6 {
                // ... board version, box type, robot type, sub type, two 16-bit numbers at the end.
                model = Some(i32::from_be_bytes(rest[n - 12..n - 8].try_into().unwrap()));
            }
            rest = &rest[n..];
        }
    }
    assert!(version);
    assert_eq!(model, Some(1), "a UR5");

    // RTDE: its recipes, then start, pause and start again.
    let mut s = mock.connect(30004).unwrap();
    send(&mut s, 86, &[0, 2]);
    assert_eq!(answer(&mut s, 86), [1]);
    send(&mut s, 118, &[]);
    assert_eq!(answer(&mut s, 118).len(), 16);
    let outputs = "timestamp,actual_q,actual_qd,target_q,target_qd,speed_scaling,target_speed_fraction,runtime_state,actual_TCP_force,\
        actual_TCP_pose,target_TCP_pose,actual_digital_input_bits,actual_digital_output_bits,standard_analog_input0,standard_analog_input1,\
        standard_analog_output0,standard_analog_output1,analog_io_types,tool_mode,tool_analog_input_types,tool_analog_input0,\
        tool_analog_input1,tool_output_voltage,tool_output_current,tool_temperature,robot_mode,safety_mode,safety_status,\
        robot_status_bits,safety_status_bits,actual_current,tcp_offset";
    send(&mut s, 79, &[&500.0f64.to_be_bytes()[..], outputs.as_bytes()].concat());
    let types = String::from_utf8(answer(&mut s, 79)[1..].to_vec()).unwrap();
    assert_eq!(types.split(',').count(), outputs.split(',').count());
    assert!(!types.contains("NOT_FOUND"), "{types}");
    let inputs = "speed_slider_mask,speed_slider_fraction,standard_digital_output_mask,standard_digital_output,\
        configurable_digital_output_mask,configurable_digital_output,standard_analog_output_mask,standard_analog_output_type,\
        standard_analog_output_0,standard_analog_output_1,tool_digital_output_mask,tool_digital_output";
    send(&mut s, 73, inputs.as_bytes());
    let recipe = answer(&mut s, 73);
    assert_eq!(recipe[1..].to_vec(), b"UINT32,DOUBLE,UINT8,UINT8,UINT8,UINT8,UINT8,UINT8,DOUBLE,DOUBLE,UINT8,UINT8");
    for kind in [83, 80, 83] {
        send(&mut s, kind, &[]);
        assert_eq!(answer(&mut s, kind), [1]);
    }
    let size = |t: &str| match t {
        "DOUBLE" | "UINT64" => 8,
        "VECTOR6D" => 48,
        "INT32" | "UINT32" => 4,
        other => panic!("{other}"),
    };
    let data = answer(&mut s, 85);
    assert_eq!(data.len(), 1 + types.split(',').map(size).sum::<usize>());
    let clock = f64::from_be_bytes(data[1..9].try_into().unwrap());
    assert!(clock > 40.0, "controller time is past the boot phase, so that the client does not wait");
    // A second client gets IN_USE for the same inputs.
    let mut other = mock.connect(30004).unwrap();
    send(&mut other, 86, &[0, 2]);
    assert_eq!(answer(&mut other, 86), [1]);
    send(&mut other, 73, inputs.as_bytes());
    let refused = String::from_utf8(answer(&mut other, 73)[1..].to_vec()).unwrap();
    assert!(refused.split(',').all(|w| w == "IN_USE"), "{refused}");

    // Dashboard: its queries, one line each.
    let mut d = BufReader::new(mock.connect(29999).unwrap());
    let mut line = String::new();
    d.read_line(&mut line).unwrap();
    for (command, expected) in [
        ("PolyscopeVersion", "URSoftware 5.11.0"),
        ("is in remote control", "true"),
        ("get robot model", "UR5"),
        ("get serial number", "20"),
        ("robotmode", "Robotmode: RUNNING"),
        ("safetystatus", "Safetystatus: NORMAL"),
        ("close safety popup", "closing safety popup"),
        ("programState", "STOPPED"),
        ("running", "Program running: false"),
        ("load missing.urp", "File not found"),
        ("play", "Failed to execute: play"),
        ("brake release", "Brake releasing"),
        ("get operational mode", "AUTOMATIC"),
        ("generate flight report controller", ""),
        ("what is this", "could not understand:"),
    ] {
        d.get_mut().write_all(format!("{command}\n").as_bytes()).unwrap();
        line.clear();
        d.read_line(&mut line).unwrap();
        assert!(line.starts_with(expected) && line.len() > 1, "{command}: {line}");
    }
}

/// The PC side of a running control script.
struct Driver {
    reverse: TcpStream,
    path: TcpStream,
    command: TcpStream,
}

impl Driver {
    fn start(mock: &Hosted) -> Driver {
        let listen = || TcpListener::bind("127.0.0.1:0").unwrap();
        let (reverse, path, command) = (listen(), listen(), listen());
        let port = |l: &TcpListener| l.local_addr().unwrap().port().to_string();
        let text = include_str!("data/driver.script")
            .replace("{{MULT}}", "1000000")
            .replace("{{MULT_TIME}}", "1000")
            .replace("{{HOST}}", "127.0.0.1")
            .replace("{{REVERSE_PORT}}", &port(&reverse))
            .replace("{{PATH_PORT}}", &port(&path))
            .replace("{{COMMAND_PORT}}", &port(&command));
        // As in headless mode: stop the running program, then upload, with a final newline.
        let mut upload = mock.connect(30001).unwrap();
        upload.write_all(format!("stop program\n{text}\n").as_bytes()).unwrap();
        let (path, command, reverse) = (accept(&path), accept(&command), accept(&reverse));
        Driver { reverse, path, command }
    }

    /// Streams a message every 2 ms until `done`.
    fn stream(
        &mut self,
        mock: &mut Hosted,
        what: &str,
        mode: i32,
        values: [f64; 6],
        done: impl Fn(&Json) -> bool,
    ) -> Json {
        let begin = Instant::now();
        loop {
            self.reverse.write_all(&reverse(PATIENCE_MS, values, mode)).unwrap();
            let now = state(mock);
            if done(&now) {
                return now;
            }
            assert!(begin.elapsed() < LIMIT, "{what}: {now}");
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    /// Sends keep-alive messages until the script reports the result of a path.
    fn result(&mut self, mock: &mut Hosted) -> i32 {
        self.path.set_nonblocking(true).unwrap();
        let begin = Instant::now();
        let mut bytes = Vec::new();
        let mut buffer = [0; 4];
        while bytes.len() < 4 {
            assert!(begin.elapsed() < LIMIT, "the path does not end: {}", state(mock));
            // A keep-alive message: neither a new path nor a cancellation.
            self.reverse.write_all(&reverse(PATIENCE_MS, [0.0; 6], 3)).unwrap();
            match self.path.read(&mut buffer) {
                Ok(0) => panic!("the script closed its path socket"),
                Ok(n) => bytes.extend_from_slice(&buffer[..n]),
                Err(e) if e.kind() == ErrorKind::WouldBlock => {}
                Err(e) => panic!("{e}"),
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        self.path.set_nonblocking(false).unwrap();
        i32::from_be_bytes(bytes.try_into().unwrap())
    }

    fn send_path(&mut self, points: &[Vec<u8>]) {
        let mut head = vec![PATIENCE_MS, 1, points.len() as i32];
        head.resize(7, 0);
        head.push(3);
        self.reverse.write_all(&words(&head)).unwrap();
        for p in points {
            self.path.write_all(p).unwrap();
        }
    }
}

#[test]
fn the_drivers_script_works_in_every_mode() {
    let mut mock = host();
    overhear(&mock);
    let mut d = Driver::start(&mock);
    // Joint speeds.
    let rates = [0.2, 0.0, 0.0, 0.0, 0.0, -0.1];
    d.stream(&mut mock, "speedj", 2, rates, |s| near(six(s, "target_qd"), rates, 1e-6));
    // Tool speed.
    let before = state(&mut mock)["tcp_pose"][2].as_f64().unwrap();
    let z = |s: &Json| s["tcp_pose"][2].as_f64().unwrap();
    d.stream(&mut mock, "speedl", 4, [0.0, 0.0, 0.05, 0.0, 0.0, 0.0], |s| z(s) > before + 0.01);
    // Idle: the thread of the previous mode stops the arm.
    d.stream(&mut mock, "idle", 0, [0.0; 6], |s| s["at_rest"] == true);
    // Joint positions.
    let mut goal = six(&state(&mut mock), "actual_q");
    goal[0] -= 0.004;
    d.stream(&mut mock, "servoj", 1, goal, |s| near(six(s, "actual_q"), goal, 1e-3));
    // A target that cannot be reached within a step is ignored with a popup.
    let mut far = goal;
    far[0] += 1.0;
    for _ in 0..20 {
        d.reverse.write_all(&reverse(PATIENCE_MS, far, 1)).unwrap();
        std::thread::sleep(Duration::from_millis(2));
    }
    assert!(near(six(&state(&mut mock), "actual_q"), goal, 2e-2));
    d.stream(&mut mock, "idle", 0, [0.0; 6], |s| s["at_rest"] == true);
    // A pose.
    let here = state(&mut mock);
    let pose: [f64; 6] = std::array::from_fn(|i| here["tcp_pose"][i].as_f64().unwrap());
    d.stream(&mut mock, "pose", 5, pose, |s| s["at_rest"] == true);
    d.stream(&mut mock, "idle", 0, [0.0; 6], |s| s["at_rest"] == true);
    // A path: joints, pose with a start configuration, straight line, and two spline segments that end at rest.
    let q0 = six(&state(&mut mock), "actual_q");
    let with = |d: [f64; 6]| -> [f64; 6] { std::array::from_fn(|i| q0[i] + d[i]) };
    let (a, b, c) = (
        with([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]),
        with([0.2, 0.05, 0.0, 0.0, 0.0, 0.0]),
        with([0.3, 0.05, -0.05, 0.0, 0.0, 0.0]),
    );
    let speed = [0.2, 0.1, 0.0, 0.0, 0.0, 0.0];
    d.send_path(&[
        point(a, [0.0; 6], [0.8, 1.4, 0.0], 0.0, 0),
        point(pose, q0, [0.8, 1.4, 1.0], 0.0, 6),
        point(pose, [0.0; 6], [0.1, 0.5, 0.0], 0.0, 1),
        point(b, speed, [0.0; 3], 1.0, 51),
        point(c, [0.0; 6], [0.0; 3], 1.0, 51),
    ]);
    assert_eq!(d.result(&mut mock), 0, "the path ends in success");
    let there = six(&state(&mut mock), "actual_q");
    assert!(near(there, c, 2e-3), "{there:?} {c:?}");
    // Single commands in parallel.
    let mut payload = vec![1, 1_500_000, 0, 0, 50_000];
    payload.resize(28, 0);
    d.command.write_all(&words(&payload)).unwrap();
    until("the payload", &mut mock, |s| (s["payload"].as_f64().unwrap() - 1.5).abs() < 1e-9);
    let mut tcp = vec![10, 0, 0, 120_000];
    tcp.resize(28, 0);
    d.command.write_all(&words(&tcp)).unwrap();
    until("the tool", &mut mock, |s| (s["tcp_offset"][2].as_f64().unwrap() - 0.12).abs() < 1e-9);
    for kind in [0, 2, 3, 4, 5, 99] {
        let mut other = vec![kind];
        other.resize(28, 0);
        if kind == 3 {
            // Force mode of type 2 without compliant axes.
            other[19] = 2_000_000;
        }
        d.command.write_all(&words(&other)).unwrap();
    }
    // A path that is cancelled.
    d.send_path(&[point(with([-0.8, 0.0, 0.0, 0.0, 0.0, 0.0]), [0.0; 6], [0.05, 1.0, 0.0], 0.0, 0)]);
    until("the long way", &mut mock, |s| six(s, "target_qd")[0] < -0.04);
    d.reverse.write_all(&words(&[PATIENCE_MS, -1, 0, 0, 0, 0, 0, 3])).unwrap();
    assert_eq!(read_int(&mut d.path), 1, "canceled");
    until("rest", &mut mock, |s| s["at_rest"] == true);
    assert!(six(&state(&mut mock), "actual_q")[0] > c[0] - 0.9);
    // Freedrive on and off, then a regular end.
    d.reverse.write_all(&words(&[PATIENCE_MS, 1, 0, 0, 0, 0, 0, 6])).unwrap();
    d.reverse.write_all(&words(&[PATIENCE_MS, -1, 0, 0, 0, 0, 0, 6])).unwrap();
    assert_eq!(state(&mut mock)["program_running"], true);
    d.reverse.write_all(&reverse(PATIENCE_MS, [0.0; 6], -2)).unwrap();
    until("the end", &mut mock, |s| s["program_running"] == false);
    assert_eq!(mock.ask(&Command::Summary).unwrap()["limit_violations"], 0);
}

#[test]
fn the_script_ends_and_the_arm_stops_when_the_driver_is_silent_or_dies() {
    for dies in [false, true] {
        let mut mock = host();
        let mut d = Driver::start(&mock);
        let rates = [0.3, 0.0, 0.0, 0.0, 0.0, 0.0];
        d.stream(&mut mock, "speedj", 2, rates, |s| near(six(s, "target_qd"), rates, 1e-6));
        d.reverse.write_all(&reverse(200, rates, 2)).unwrap();
        let keep = (!dies).then_some(d);
        until("the end of the program", &mut mock, |s| s["program_running"] == false);
        until("rest", &mut mock, |s| s["at_rest"] == true);
        drop(keep);
    }
}

/// A program on the robot that requests its text from the PC, like the External Control program node.
#[test]
fn a_program_can_request_its_text_from_the_pc() {
    let mut mock = host();
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    let mut upload = mock.connect(30002).unwrap();
    let text = format!(
        "def node():\n  if socket_open(\"127.0.0.1\", {port}, \"sender\"):\n    socket_send_line(\"request_program\", \"sender\")\n    \
         text = socket_read_string(\"sender\", prefix=\"# BEGIN\\n\", suffix=\"# END\", interpret_escape=True, timeout=0)\n    \
         write_output_integer_register(5, str_len(text))\n    socket_close(\"sender\")\n  end\nend\n"
    );
    upload.write_all(text.as_bytes()).unwrap();
    let mut pc = accept(&listener);
    let mut asked = [0; 16];
    pc.read_exact(&mut asked).unwrap();
    assert_eq!(&asked, b"request_program\n");
    for piece in ["# BEG", "IN\ntextmsg(1)\n", "textmsg(2)\n# E", "ND rest"] {
        pc.write_all(piece.as_bytes()).unwrap();
        std::thread::sleep(Duration::from_millis(5));
    }
    until("the text", &mut mock, |s| s["output_int"][5] == "textmsg(1)\ntextmsg(2)\n".len() as i64);
}

/// Upload errors are reported on the primary interface with their line.
#[test]
fn an_invalid_script_is_reported_with_its_line_on_the_primary_port() {
    let mut mock = host();
    let mut primary = mock.connect(30001).unwrap();
    for (text, line) in [
        ("def a():\n  x = 1\n  x = = 2\nend\n", 3),
        ("def b():\n  q = [1, 2]\n\n  y = q[5]\nend\n", 4),
        ("def c():\n  optimovej([0,0,0,0,0,0])\nend\n", 2),
    ] {
        let mut upload = mock.connect(30002).unwrap();
        upload.write_all(text.as_bytes()).unwrap();
        let begin = Instant::now();
        let found = loop {
            assert!(begin.elapsed() < LIMIT, "no message about {text}");
            let mut head = [0; 5];
            primary.read_exact(&mut head).unwrap();
            let mut body = vec![0; i32::from_be_bytes(head[..4].try_into().unwrap()) as usize - 5];
            primary.read_exact(&mut body).unwrap();
            if head[4] == 20 && body[9] == 10 {
                break i32::from_be_bytes(body[10..14].try_into().unwrap());
            }
        };
        assert_eq!(found, line, "{text}");
    }
    assert_eq!(state(&mut mock)["program_running"], false);
}
