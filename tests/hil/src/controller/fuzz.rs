//! Fuzzing of every parser of the controller. `GRASPD_FUZZ_CASES=2500000 cargo test --release -p graspd-hil --lib fuzz`
//! runs 12.5 million cases; the default takes a few seconds.

use super::command::Command;
use super::connection::lines;
use super::dashboard;
use super::link_faults::RtdeFaults;
use super::robot::{Robot, Setup};
use super::rtde_session::{Ownership, RtdeSession};
use super::state::{RobotMode, SafetyMode};
use super::world::World;
use crate::plant::Model;
use crate::urscript::{Collector, Machine, Upload};
use graspd_rt::rtde::{Field, Side};

/// Number of cases per parser.
fn cases(usual: u64) -> u64 {
    std::env::var("GRASPD_FUZZ_CASES").ok().and_then(|v| v.parse().ok()).unwrap_or(usual)
}

/// A reproducible random generator.
struct Dice(u64);

impl Dice {
    fn next(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0.wrapping_mul(0x2545_f491_4f6c_dd1d)
    }
    fn below(&mut self, n: usize) -> usize {
        (self.next() >> 33) as usize % n.max(1)
    }
    fn one_in(&mut self, n: usize) -> bool {
        self.below(n) == 0
    }
    fn pick<'a, T>(&mut self, from: &'a [T]) -> &'a T {
        &from[self.below(from.len())]
    }
    fn noise(&mut self, most: usize) -> Vec<u8> {
        (0..self.below(most)).map(|_| self.next() as u8).collect()
    }
    /// Flips, truncates, repeats or inserts a few bytes.
    fn mutate(&mut self, bytes: &mut Vec<u8>) {
        for _ in 0..self.below(4) {
            let at = self.below(bytes.len() + 1);
            match self.below(5) {
                0 if at < bytes.len() => bytes[at] ^= 1 << self.below(8),
                1 => bytes.truncate(at),
                2 => bytes.insert(at, self.next() as u8),
                3 if at < bytes.len() => bytes[at] = *self.pick(&[0, 1, 2, 3, 255, 127, 128, b',', b'\n', b'"']),
                _ => {
                    let again = bytes[at..].to_vec();
                    if bytes.len() < 4096 {
                        bytes.extend(again);
                    }
                }
            }
        }
    }
    /// The bytes in up to five pieces.
    fn pieces<'a>(&mut self, bytes: &'a [u8]) -> Vec<&'a [u8]> {
        let mut out = Vec::new();
        let mut rest = bytes;
        for _ in 0..self.below(5) {
            let (head, tail) = rest.split_at(self.below(rest.len() + 1));
            out.push(head);
            rest = tail;
        }
        out.push(rest);
        out
    }
}

fn robot() -> Robot {
    Robot::new(Setup::new(Model::by_name("ur5e").unwrap()))
}

/// Joint values are finite and the slider is in range.
fn is_sane(robot: &Robot) {
    assert!(robot.truth.actual_q.iter().chain(&robot.truth.actual_qd).all(|v| v.is_finite()));
    assert!((0.0..=1.0).contains(&robot.slider));
}

fn put(out: &mut Vec<u8>, kind: u8, body: &[u8]) {
    out.extend_from_slice(&((body.len() + 3) as u16).to_be_bytes());
    out.push(kind);
    out.extend_from_slice(body);
}

/// Almost valid packages.
fn rtde_bytes(d: &mut Dice, names: &[String]) -> Vec<u8> {
    let mut out = Vec::new();
    for _ in 0..1 + d.below(3) {
        let mut body = match d.below(8) {
            0 => vec![0, d.below(4) as u8],
            1..=3 => {
                let list: Vec<&str> = (0..d.below(6)).map(|_| d.pick(names).as_str()).collect();
                let frequency = *d.pick(&[500.0, 125.0, 0.0, -1.0, f64::NAN, 1e300, 0.5]);
                let head = if d.one_in(2) { frequency.to_be_bytes().to_vec() } else { Vec::new() };
                [head, list.join(",").into_bytes()].concat()
            }
            4 | 5 => {
                let mut data = vec![d.below(4) as u8];
                data.extend(d.noise(60));
                data
            }
            6 => Vec::new(),
            _ => d.noise(40),
        };
        if d.one_in(3) {
            d.mutate(&mut body);
        }
        let kind = *d.pick(&[86u8, 118, 77, 85, 85, 79, 73, 83, 80, 0, 200]);
        put(&mut out, kind, &body);
    }
    if d.one_in(8) {
        d.mutate(&mut out);
    }
    out
}

#[test]
fn rtde_handles_any_bytes_however_they_are_split() {
    let mut d = Dice(1);
    let names: Vec<String> = Field::all(Side::Input)
        .chain(Field::all(Side::Output))
        .map(|f| f.to_string())
        .chain(["nonsense".into(), String::new()])
        .collect();
    let mut robot = robot();
    let faults = RtdeFaults::default();
    // Two sessions: one receives the bytes at once, the other in pieces. Their answers must be equal.
    let (mut whole, mut cut) = (RtdeSession::new(1), RtdeSession::new(1));
    let (mut owners, mut other_owners) = (Ownership::default(), Ownership::default());
    let (mut out, mut other_out) = (Vec::new(), Vec::new());
    let mut ended = 0u64;
    for case in 0..cases(60_000) {
        let bytes = rtde_bytes(&mut d, &names);
        out.clear();
        other_out.clear();
        let end = whole.receive(&bytes, &mut robot, &mut owners, &faults, &mut out, &mut |_| {});
        let mut other_end = Ok(());
        for piece in d.pieces(&bytes) {
            other_end = cut.receive(piece, &mut robot, &mut other_owners, &faults, &mut other_out, &mut |_| {});
            if other_end.is_err() {
                break;
            }
        }
        assert_eq!((&end, &out), (&other_end, &other_out), "case {case}: {bytes:?}");
        assert!(out.len() < 1 << 20);
        if end.is_err() || d.one_in(500) {
            ended += u64::from(end.is_err());
            (whole, cut) = (RtdeSession::new(1), RtdeSession::new(1));
            owners.release(1);
            other_owners.release(1);
        }
        if case % 64 == 0 {
            robot.step();
            whole.sample(&robot, &mut out);
            cut.sample(&robot, &mut other_out);
            assert_eq!(out, other_out);
            is_sane(&robot);
        }
    }
    assert!(ended > 0, "no case broke the framing");
}

#[test]
fn the_dashboard_answers_any_line_with_one_line() {
    let mut d = Dice(2);
    const WORDS: [&str; 24] = [
        "load",
        "play",
        "stop",
        "pause",
        "quit",
        "shutdown",
        "running",
        "robotmode",
        "get loaded program",
        "popup",
        "close popup",
        "addToLog",
        "isProgramSaved",
        "programState",
        "PolyscopeVersion",
        "set operational mode",
        "power on",
        "power off",
        "brake release",
        "unlock protective stop",
        "close safety popup",
        "restart safety",
        "safetystatus",
        "is in remote control",
    ];
    let mut robot = robot();
    let (mut rest, mut other_rest) = (Vec::new(), Vec::new());
    for case in 0..cases(60_000) {
        let mut bytes = Vec::new();
        for _ in 0..1 + d.below(3) {
            bytes.extend_from_slice(d.pick(&WORDS).as_bytes());
            if d.one_in(2) {
                bytes.push(b' ');
                bytes.extend(d.noise(20));
            }
            bytes.extend_from_slice(d.pick(&["\n", "\r\n", "", "\n\n"]).as_bytes());
        }
        if d.one_in(2) {
            d.mutate(&mut bytes);
        }
        let found = lines(&mut rest, &bytes, 4096);
        let mut pieces = Ok(Vec::new());
        for piece in d.pieces(&bytes) {
            match (lines(&mut other_rest, piece, 4096), &mut pieces) {
                (Ok(more), Ok(all)) => all.extend(more),
                (Err(()), p) => *p = Err(()),
                _ => {}
            }
        }
        assert_eq!(found, pieces, "{bytes:?}");
        for line in found.unwrap_or_default() {
            let reply = dashboard::answer(&mut robot, &line);
            assert!(!reply.line.is_empty() && !reply.line.contains(['\n', '\r']), "{line:?}");
        }
        if rest.len() > 2000 {
            rest.clear();
            other_rest.clear();
        }
        if case % 64 == 0 {
            robot.step();
            is_sane(&robot);
            robot.safety = SafetyMode::Normal;
            robot.set_mode(RobotMode::Running);
        }
    }
}

/// Fragments from which programs are composed at random.
const SCRIPT: [&str; 77] = [
    "def f():",
    "end",
    "\n",
    "thread t():",
    "sec s():",
    "if True:",
    "elif x > 1:",
    "else:",
    "while n < 3:",
    "return x",
    "break",
    "continue",
    "global",
    "local",
    "x",
    "n",
    "x = 1",
    "n = n + 1",
    "x = [1, 2.5, 3]",
    "x[0]",
    "x[1] = 2",
    "p[0,0,0,0,0,0]",
    "p = p[",
    "run t()",
    "kill h",
    "join h",
    "h = run t()",
    "sync()",
    "sleep(0.01)",
    "halt",
    "enter_critical",
    "exit_critical",
    "speedj([0.1,0,0,0,0,0], 1, 0.002)",
    "movej(x, a=1.4, v=1)",
    "movel(p[0.3,0.2,0.4,0,3,0])",
    "servoj(x, t=0.002)",
    "stopj(2)",
    "speedl([0,0,0.1,0,0,0], 1)",
    "textmsg(x)",
    "popup(\"a\", blocking=True)",
    "write_output_integer_register(3, n)",
    "read_input_float_register(24)",
    "get_inverse_kin(p[0.3,0.2,0.4,0,3,0])",
    "get_forward_kin()",
    "str_cat(x, x)",
    "norm(x)",
    "pose_trans(p[1,0,0,0,0,0], p[0,1,0,0,0,1])",
    "integer_to_binary_list(n)",
    "rtde_set_watchdog(\"input_int_register_24\", 10)",
    "set_payload(1)",
    "set_tcp(p[0,0,0.1,0,0,0])",
    "protective_stop()",
    "socket_close()",
    "tool_contact()",
    "s = struct(a=1, b=x)",
    "s.a",
    "s.b[0] = 2",
    "force_mode(p[0,0,0,0,0,0], [1,1,1,0,0,0], [x, n, 3], 2, [1,1,1,1,1,1])",
    "interpreter_mode()",
    "make_list(3)",
    "to_num(\"1\")",
    "(",
    ")",
    "[",
    "]",
    ",",
    "+",
    "-",
    "*",
    "/",
    "%",
    "==",
    "and",
    "not",
    "\"text\"",
    "'",
    "# end\n",
];

fn script_text(d: &mut Dice, bodies: &[&str]) -> Vec<u8> {
    let mut text = match d.below(4) {
        0 => d.pick(bodies).as_bytes().to_vec(),
        1 => d.noise(200),
        _ => {
            let words: Vec<&str> = (0..d.below(24)).map(|_| *d.pick(&SCRIPT)).collect();
            let glue = *d.pick(&["\n", " ", "\n  "]);
            let body = words.join(glue);
            if d.one_in(2) { format!("def main():\n{body}\nend\n") } else { body }.into_bytes()
        }
    };
    if d.one_in(2) {
        d.mutate(&mut text);
    }
    text
}

const PROGRAMS: [&str; 4] = [
    "def a():\n  thread w():\n    while True:\n      speedj([0.1, 0, 0, 0, 0, 0], 1, 0.002)\n    end\n  end\n  h = run w()\n  sync()\n  kill h\nend\n",
    "def b():\n  q = get_actual_joint_positions()\n  q[0] = q[0] + 0.1\n  movej(q, a=1, v=0.5)\n  if norm(q) > 1 and not False:\n    textmsg(\"there \", q)\n  end\nend\n",
    "sec c():\n  set_standard_digital_out(1, True)\nend\n",
    "def d(x=1, y=[1, 2]):\n  global g = x * 2 + y[1] / 3\n  while g < 100:\n    g = g + pow(2, 3)\n  end\n  return g\nend\n",
];

#[test]
fn script_ports_handle_any_bytes_however_they_are_split() {
    let mut d = Dice(3);
    let mut robot = robot();
    let (mut whole, mut cut) = (Collector::default(), Collector::default());
    for case in 0..cases(30_000) {
        let mut bytes = script_text(&mut d, &PROGRAMS);
        if d.one_in(2) {
            bytes.extend_from_slice(d.pick(&["\n", "stop program\n", "end\n", "end\nend\n"]).as_bytes());
        }
        let found = whole.push(&bytes);
        let mut pieces = Ok(Vec::new());
        for piece in d.pieces(&bytes) {
            match (cut.push(piece), &mut pieces) {
                (Ok(more), Ok(all)) => all.extend(more),
                (Err(e), p) => *p = Err(e),
                _ => {}
            }
        }
        assert_eq!(found, pieces, "case {case}: {:?}", String::from_utf8_lossy(&bytes));
        for upload in found.unwrap_or_default() {
            match upload {
                Upload::Program { text, first_line } => drop(robot.upload_at(&text, first_line)),
                Upload::StopProgram => robot.stop_program(),
            }
        }
        if d.one_in(8) {
            // A new connection and a recovered robot.
            (whole, cut) = (Collector::default(), Collector::default());
            robot.stop_program();
            (robot.safety, robot.popup) = (SafetyMode::Normal, None);
            robot.set_mode(RobotMode::Running);
        }
        if d.one_in(4) {
            robot.step();
            is_sane(&robot);
        }
    }
}

#[test]
fn the_interpreter_handles_any_text() {
    let mut d = Dice(4);
    let mut robot = robot();
    let mut ran = 0u64;
    for _ in 0..cases(30_000) {
        let text = script_text(&mut d, &PROGRAMS);
        let text = String::from_utf8_lossy(&text);
        if let Ok(mut machine) = Machine::load(&text) {
            ran += 1;
            for _ in 0..3 {
                machine.step(&mut robot);
            }
            machine.stop(&mut robot);
            (robot.safety, robot.popup) = (SafetyMode::Normal, None);
        }
    }
    assert!(ran > 0, "no text was a program");
}

#[test]
fn interpreter_mode_handles_any_line() {
    let mut d = Dice(6);
    let mut robot = robot();
    let mut accepted = 0u64;
    for _ in 0..cases(30_000) {
        if !robot.is_program_running() {
            (robot.safety, robot.popup) = (SafetyMode::Normal, None);
            robot.set_mode(RobotMode::Running);
            robot.upload("interpreter_mode()\n");
            robot.step();
        }
        let mut line = match d.below(4) {
            0 => d
                .pick(&["skipbuffer", "abort", "statelastexecuted", "clear_interpreter()", "end_interpreter()"])
                .as_bytes()
                .to_vec(),
            _ => (0..1 + d.below(4)).map(|_| *d.pick(&SCRIPT)).collect::<Vec<_>>().join(" ").into_bytes(),
        };
        if d.one_in(3) {
            d.mutate(&mut line);
        }
        let answer = robot.interpret(&String::from_utf8_lossy(&line));
        accepted += u64::from(answer.starts_with("ack: "));
        assert!(["ack: ", "state: ", "discard: "].iter().any(|a| answer.starts_with(a)), "{answer}");
        if d.one_in(4) {
            robot.step();
            is_sane(&robot);
        }
    }
    assert!(accepted > 0, "no line was accepted");
}

#[test]
fn the_control_port_handles_any_line() {
    let mut d = Dice(5);
    const ORDERS: [&str; 16] = [
        r#"{"cmd":"ping"}"#,
        r#"{"cmd":"protective_stop"}"#,
        r#"{"cmd":"limits","rate":0.5,"accel":4}"#,
        r#"{"cmd":"speed_slider","fraction":0.5}"#,
        r#"{"cmd":"jump","joint":1,"rad":0.3,"seconds":0.5}"#,
        r#"{"cmd":"drift","joint":2,"rate":0.1}"#,
        r#"{"cmd":"teleport","q":[0,1,2,3,4,5]}"#,
        r#"{"cmd":"delay","port":"rtde","ms":5,"jitter_ms":2}"#,
        r#"{"cmd":"blackhole","seconds":1e99}"#,
        r#"{"cmd":"in_use","names":["input_int_register_24"]}"#,
        r#"{"cmd":"robot_mode","mode":"idle"}"#,
        r#"{"cmd":"garbage","port":"primary","bytes":99999999}"#,
        r#"{"cmd":"script","text":"def f():\n  sync()\nend\n"}"#,
        r#"{"cmd":"clock_shift","seconds":-1e300}"#,
        r#"{"cmd":"clear_faults"}"#,
        r#"{"cmd":"output_int","index":27,"value":3}"#,
    ];
    let mut world = World::new(robot(), Some((0.5, 4.0)), None);
    let (mut rest, mut taken) = (Vec::new(), 0u64);
    for case in 0..cases(60_000) {
        let mut bytes = d.pick(&ORDERS).as_bytes().to_vec();
        if d.one_in(2) {
            // Another number.
            let number = *d.pick(&["1e308", "-1e308", "0", "-1", "4294967296", "18446744073709551616", "1e-320", "7"]);
            let at = bytes.iter().rposition(u8::is_ascii_digit).unwrap_or(0);
            bytes.splice(at..=at.min(bytes.len() - 1), number.bytes());
        }
        if d.one_in(3) {
            d.mutate(&mut bytes);
        }
        bytes.push(b'\n');
        for line in lines(&mut rest, &bytes, 1 << 16).unwrap_or_default() {
            if let Ok(command) = serde_json::from_str::<Command>(&line) {
                taken += 1;
                let _ = world.command(command, case);
            }
        }
        if case % 64 == 0 {
            world.step(case);
            // Positions like 1e308 are accepted; they must not cause a panic.
            world = World::new(robot(), Some((0.5, 4.0)), None);
        }
        world.actions.clear();
    }
    assert!(taken > 0, "no line was an order");
}
