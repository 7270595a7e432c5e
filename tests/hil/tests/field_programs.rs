//! Programs in the form that PolyScope saves and that users upload: headers, several statements a line, strings,
//! structs, remote calls, interpreter mode, force mode, blends. The inputs in data/programs were written for this
//! project.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

use graspd_hil::controller::{Command, Hosted, MessageKind, Robot, RuntimeState, Setup, Upload};
use graspd_hil::mock_arm::MockArm;
use graspd_hil::plant::Model;
use graspd_hil::urscript::{Collector, Upload as Sent, accepted_without_effect, refused};
use serde_json::Value as Json;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpListener;
use std::time::{Duration, Instant};

fn arm() -> MockArm {
    let mut setup = Setup::new(Model::by_name("ur5e").unwrap());
    setup.start_joints = [0.3, -1.4, 1.5, -1.2, -1.4, 0.2];
    MockArm::new(setup, None)
}

/// Text messages and errors (`line N: ...`) since the last call.
fn log(a: &mut MockArm) -> Vec<String> {
    a.robot_mut()
        .outbox
        .drain()
        .filter_map(|m| match m.kind {
            MessageKind::Text(t) => Some(t),
            MessageKind::Runtime { line, text, .. } => Some(format!("line {line}: {text}")),
            _ => None,
        })
        .collect()
}

/// Runs a program to its end, at most `seconds`, and returns its messages.
fn run(text: &str, seconds: f64) -> Vec<String> {
    let mut a = arm();
    run_on(&mut a, text, seconds)
}

fn run_on(a: &mut MockArm, text: &str, seconds: f64) -> Vec<String> {
    a.step_until(0.02, |_| false);
    assert_eq!(a.upload(text), Upload::Main, "{:?}", log(a));
    assert!(a.step_until(seconds, |r| r.runtime == RuntimeState::Stopped), "still running: {:?}", log(a));
    log(a)
}

fn body(lines: &str, seconds: f64) -> Vec<String> {
    run(&format!("def t():\n{lines}\nend\n"), seconds)
}

#[test]
fn programs_saved_by_polyscope_run() {
    assert_eq!(run(include_str!("data/programs/polyscope_header.script"), 1.0), ["header done"]);
    assert_eq!(
        run(include_str!("data/programs/polyscope_5.script"), 30.0),
        ["first 0", "second 1", "steps counted True"]
    );
    assert_eq!(run(include_str!("data/programs/polyscope_3.script"), 30.0), ["moved 3"]);
}

/// The lines that urx sends, and the header of its gripper class.
#[test]
fn programs_of_urx_run() {
    let mut a = arm();
    assert_eq!(a.upload("digital_out[3]=True\n"), Upload::Main);
    a.step_until(0.1, |_| false);
    assert_eq!(a.robot().signals.digital_out, 8);
    assert_eq!(a.upload("speedl([0,0,0.05,0,0,0], a=0.5, t_min=0.3)\n"), Upload::Main);
    a.step_until(0.2, |_| false);
    assert!((a.robot().truth.target_tcp_speed[2] - 0.05).abs() < 1e-3);
    assert_eq!(a.upload("def myProg():\n\tfreedrive_mode()\n\tsleep(0.1)\nend\n"), Upload::Main);
    let out = run(
        "def myProg():\n\t# Pick-and-place header\n\tset_analog_inputrange(0,0)\n\tset_analog_outputdomain(0,0)\n\tset_tool_voltage(0)\n\
         \tset_runstate_outputs([])\n\tset_payload(0.85)\n\tsync()\n\ttextmsg(\"ready\")\nend\n",
        1.0,
    );
    assert_eq!(out, ["ready"]);
}

#[test]
fn several_statements_may_follow_on_one_line() {
    let out = run(include_str!("data/programs/two_statements_a_line.script"), 1.0);
    assert_eq!(out, ["y -0.2", "y 2"]);
    assert_eq!(body("if True: textmsg(1) textmsg(2) else: textmsg(3) end x = [1] textmsg(x)", 1.0), ["1", "2", "[1]"]);
    for bad in ["x = 1 2", "x = 1 )", "1 x = 2"] {
        assert!(matches!(arm().upload(&format!("def t():\n{bad}\nend\n")), Upload::Refused(_)), "{bad}");
    }
}

#[test]
fn strings_structs_and_matrices_have_their_operators() {
    assert_eq!(run(include_str!("data/programs/string_plus.script"), 1.0), ["n = 3!"]);
    assert_eq!(run(include_str!("data/programs/struct.script"), 1.0), ["a 5"]);
    assert_eq!(run(include_str!("data/programs/inv.script"), 1.0), ["inv [[0.5, 0], [0, 0.25]]"]);
    let out = body(
        "s = struct(a=1, b=[1, 2], c=struct(d=p[1,2,3,0,0,0]))\ns.b[1] = 7\ns.c.d[2] = 4\ntextmsg(s)\ntextmsg(s.b[1] + s.a)\n\
         t = s\nt.a = 9\ntextmsg(s.a)\ntextmsg(size([[1, 2, 3], [4, 5, 6]]))\ntextmsg(inv(p[1,0,0,0,0,0]))",
        1.0,
    );
    assert_eq!(
        out,
        ["struct(a=1, b=[1, 7], c=struct(d=p[1, 2, 4, 0, 0, 0]))", "8", "1", "[2, 3]", "p[-1, 0, 0, 0, 0, 0]"]
    );
    let out = body(
        "l = [1, 2]\nl.append(3)\nl.insert(0, 9)\nl.extend([4])\nx = l.pop()\nl.remove(1)\ntextmsg(l, x)\ntextmsg(l.length())\n\
         textmsg(l.slice(1, 3))\ns = struct(m=[[1, 2], [3, 4]])\ns.m.swap_rows(0, 1)\ntextmsg(s.m.get_column(0))\ntextmsg(s.m.shape())",
        1.0,
    );
    assert_eq!(out, ["[9, 2, 3]4", "3", "[2, 3]", "[3, 1]", "[2, 2]"]);
    for (lines, part) in [
        ("l = [1]\nx = l.nothing()", "no method 'nothing'"),
        ("l = [1]\nl.remove(1)", "out of range"),
        ("s = \"a\" + 1", "to_str"),
        ("s = struct(a=1)\nx = s.b", "no member 'b'"),
        ("x = 1\ny = x.a", "has no elements"),
        ("x = inv([[1, 2], [2, 4]])", "singular"),
        ("x = inv([[1, 2, 3], [2, 4, 5]])", "square"),
    ] {
        let out = body(lines, 1.0);
        assert!(out[0].contains(part), "{lines}: {out:?}");
    }
}

#[test]
fn all_unknown_names_are_reported_at_upload_and_the_running_program_continues() {
    let mut a = arm();
    assert_eq!(a.upload("def first():\n while True:\n  sync()\n end\nend\n"), Upload::Main);
    a.step_until(0.1, |_| false);
    let text = "def second():\n movej([0,-1,1,0,0,0])\n no_such_thing(1)\n x = other_thing() + undefined\n if False:\n  no_such_thing(2)\n end\n optimovej([0,0,0,0,0,0])\nend\n";
    let Upload::Refused(reason) = a.upload(text) else { panic!("accepted") };
    for part in ["no_such_thing() (lines 3, 6)", "other_thing() (line 4)", "undefined (line 4)", "optimovej() (line 8)"]
    {
        assert!(reason.contains(part), "{part}: {reason}");
    }
    assert!(matches!(a.upload("def third(:\nend\n"), Upload::Refused(_)));
    a.step_until(0.1, |_| false);
    assert!(a.robot().is_program_running(), "the running program was ended by a refused upload");
    assert_eq!(log(&mut a).len(), 2, "one message for each refused upload");
}

#[test]
fn a_call_after_the_program_is_refused_with_its_line_and_the_program_runs_to_its_end() {
    let mut a = arm();
    let sent = Collector::default().push(include_bytes!("data/programs/trailing_call.script")).unwrap();
    for upload in sent {
        let Sent::Program { text, first_line } = upload else { panic!("{upload:?}") };
        a.robot_mut().upload_at(&text, first_line);
    }
    a.step_until(2.0, |r| r.runtime == RuntimeState::Stopped);
    let out = log(&mut a);
    assert_eq!(out.len(), 3, "{out:?}");
    assert!(out[0].starts_with("line 6: unknown names: prog()"), "{out:?}");
    assert_eq!(out[1..], ["begins", "ends"]);
}

#[test]
fn the_target_waypoint_is_the_end_of_the_present_move() {
    let out = run(include_str!("data/programs/target_waypoint.script"), 1.0);
    assert!(out[0].starts_with("w p["), "{out:?}");
    let out = body(
        "thread ask():\n sleep(0.2)\n textmsg(point_dist(get_target_waypoint(), goal) < 0.0001)\n\
         textmsg(point_dist(get_target_tcp_pose(), goal) > 0.01)\nend\n\
         global goal = pose_add(get_actual_tcp_pose(), p[0,0,-0.1,0,0,0])\nrun ask()\nmovel(goal, a=0.5, v=0.1)",
        5.0,
    );
    assert_eq!(out, ["True", "True"]);
}

fn number(line: &str) -> f64 {
    line.rsplit(' ').next().unwrap().parse().unwrap()
}

#[test]
fn force_mode_moves_in_free_air_up_to_its_limit() {
    let dz = number(&run(include_str!("data/programs/force_mode.script"), 5.0)[0]);
    assert!((-0.1..-0.08).contains(&dz), "{dz} m in one second at 0.1 m/s");
    // The other axes do not move, and a smaller force gives a smaller speed.
    let out = body(
        "z = get_actual_tcp_pose()\nforce_mode(p[0,0,0,0,0,0], [1,0,0,0,0,0], [1,0,-50,0,0,0], 2, [0.1,0.1,0.1,0.3,0.3,0.3])\n\
         sleep(1.0)\nend_force_mode()\nsync()\nw = get_actual_tcp_pose()\ntextmsg(\"x \", w[0] - z[0])\ntextmsg(\"z \", norm(w[2] - z[2]))\n\
         sleep(0.5)\nv = get_actual_tcp_pose()\ntextmsg(\"after \", point_dist(v, w))",
        5.0,
    );
    let [x, z, after] = [0, 1, 2].map(|i| number(&out[i]));
    assert!((0.01..0.03).contains(&x) && z < 1e-3 && after < 2e-3, "{out:?}");
}

#[test]
fn force_mode_settles_at_the_commanded_force_on_a_plane() {
    let mut a = arm();
    a.step();
    let z = a.robot().truth.actual_tcp_pose[2];
    let plane = Command::ContactPlane { point: [0.0, 0.0, z - 0.03], normal: [0.0, 0.0, 1.0], stiffness: 2000.0 };
    a.command(plane).unwrap();
    let text = "def t():\n zero_ftsensor()\n force_mode(p[0,0,0,0,0,0], [0,0,1,0,0,0], [0,0,-20,0,0,0], 2, [0.1,0.1,0.05,0.3,0.3,0.3])\n \
                while True:\n  sync()\n end\nend\n";
    assert_eq!(a.upload(text), Upload::Main);
    let mut largest = 0.0f64;
    for _ in 0..2000 {
        a.step();
        largest = largest.max(a.robot().truth.tcp_force[2]);
    }
    let force = a.robot().truth.tcp_force[2];
    assert!((force - 20.0).abs() < 0.5, "{force} N");
    assert!(largest < 40.0, "{largest} N on impact");
    assert!(a.robot().at_rest(), "{:?}", a.robot().truth.actual_qd);
    // The end of the program ends force mode.
    a.command(Command::StopProgram).unwrap();
    a.command(Command::ExternalWrench { wrench: [30.0, 0.0, 0.0, 0.0, 0.0, 0.0] }).unwrap();
    a.step_until(0.5, |_| false);
    assert!(a.robot().at_rest());
}

#[test]
fn a_blend_radius_rounds_the_corner_without_a_stop() {
    let path = |r: f64| {
        format!(
            "def t():\n a = get_actual_tcp_pose()\n movel(pose_add(a, p[0,0,-0.1,0,0,0]), a=1, v=0.1, r={r})\n \
             movel(pose_add(a, p[0,0.1,-0.1,0,0,0]), a=1, v=0.1)\nend\n"
        )
    };
    let drive = |r: f64| {
        let mut a = arm();
        a.step();
        let start = a.robot().truth.target_tcp_pose;
        let corner = [start[0], start[1], start[2] - 0.1];
        assert_eq!(a.upload(&path(r)), Upload::Main);
        let (mut nearest, mut slowest, mut steps) = (f64::INFINITY, f64::INFINITY, 0);
        while a.robot().runtime != RuntimeState::Stopped && steps < 3000 {
            a.step();
            steps += 1;
            let t = &a.robot().truth;
            let [p, v] = [&t.target_tcp_pose, &t.target_tcp_speed].map(|v| [v[0], v[1], v[2]]);
            let d = (0..3).map(|i| (p[i] - corner[i]).powi(2)).sum::<f64>().sqrt();
            nearest = nearest.min(d);
            if d < 0.02 {
                slowest = slowest.min(v.iter().map(|x| x * x).sum::<f64>().sqrt());
            }
        }
        let end = a.robot().truth.target_tcp_pose;
        assert!((end[1] - start[1] - 0.1).abs() < 1e-4 && (end[2] - corner[2]).abs() < 1e-4, "{end:?}");
        (nearest, slowest, steps)
    };
    let (sharp, stopped, long) = drive(0.0);
    let (round, moving, short) = drive(0.02);
    assert!(sharp < 1e-3 && stopped < 1e-3, "{sharp} {stopped}");
    assert!((1e-4..0.02).contains(&round) && moving > 0.04 && short < long, "{round} m, {moving} m/s, {short} {long}");
}

/// An XML-RPC server that answers `set_title` with true, `get_width` with twice its argument, and everything else with
/// a fault.
fn rpc_server() -> u16 {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    std::thread::spawn(move || {
        for stream in listener.incoming().take(4) {
            let mut stream = stream.unwrap();
            let mut input = BufReader::new(stream.try_clone().unwrap());
            let (mut length, mut line) = (0, String::new());
            while input.read_line(&mut line).unwrap() > 2 {
                if let Some(n) = line.to_ascii_lowercase().strip_prefix("content-length:") {
                    length = n.trim().parse().unwrap();
                }
                line.clear();
            }
            let mut request = vec![0; length];
            input.read_exact(&mut request).unwrap();
            let request = String::from_utf8(request).unwrap();
            let value = if request.contains("<methodName>set_title</methodName>") {
                assert!(request.contains("<string>hello</string>"), "{request}");
                "<params><param><value><boolean>1</boolean></value></param></params>"
            } else if request.contains("<methodName>get_width</methodName>") && request.contains("<int>2</int>") {
                "<params><param><value><int>4</int></value></param></params>"
            } else {
                "<fault><value><string>unknown method</string></value></fault>"
            };
            let body = format!("<?xml version=\"1.0\"?>\n<methodResponse>{value}</methodResponse>");
            let head = format!("HTTP/1.1 200 OK\r\nContent-Type: text/xml\r\nContent-Length: {}\r\n\r\n", body.len());
            stream.write_all(format!("{head}{body}").as_bytes()).unwrap();
        }
    });
    port
}

/// Runs a program that waits for real connections.
fn run_in_real_time(text: &str) -> Vec<String> {
    let mut a = arm();
    assert_eq!(a.upload(text), Upload::Main, "{:?}", log(&mut a));
    let begin = Instant::now();
    while a.robot().runtime != RuntimeState::Stopped {
        assert!(begin.elapsed() < Duration::from_secs(20), "{:?}", log(&mut a));
        a.step();
        std::thread::sleep(Duration::from_millis(1));
    }
    log(&mut a)
}

#[test]
fn remote_procedure_calls_are_made() {
    let at = |text: &str| text.replace("40999", &rpc_server().to_string());
    assert_eq!(run_in_real_time(&at(include_str!("data/programs/rpc.script"))), ["v 4"]);
    let out = run_in_real_time(&at(
        "def t():\n c = rpc_factory(\"xmlrpc\", \"http://127.0.0.1:40999/RPC2\")\n x = c.nothing()\nend\n",
    ));
    assert!(out[0].starts_with("line 3: remote call failed") || out[0].contains("unknown method"), "{out:?}");
    let out = run_in_real_time("def t():\n c = rpc_factory(\"xmlrpc\", \"http://127.0.0.1:1/\")\n c.f()\nend\n");
    assert!(out[0].starts_with("line 3: remote call failed: http://127.0.0.1:1/"), "{out:?}");
    assert!(body("c = rpc_factory(\"soap\", \"http://127.0.0.1/\")", 1.0)[0].contains("only 'xmlrpc'"));
    assert!(body("c = 5\nc.f()", 1.0)[0].contains("no method 'f'"));
}

fn interpret(r: &mut Robot, line: &str) -> String {
    r.interpret(line)
}

#[test]
fn interpreter_mode_executes_statements_in_their_order() {
    let mut a = arm();
    assert_eq!(interpret(a.robot_mut(), "x = 1"), "discard: no program is running: x = 1");
    assert_eq!(a.upload(include_str!("data/programs/interpreter_mode.script")), Upload::Main);
    assert!(interpret(a.robot_mut(), "x = 1").starts_with("discard: interpreter mode is not active"));
    a.step_until(0.05, |_| false);
    for (line, answer) in [
        ("def twice(v): return 2 * v end", "ack: 1: def twice(v): return 2 * v end"),
        ("x = twice(4)", "ack: 2: x = twice(4)"),
        (
            "movej([0.4, -1.3, 1.4, -1.2, -1.4, 0.2], a=1, v=0.2)",
            "ack: 3: movej([0.4, -1.3, 1.4, -1.2, -1.4, 0.2], a=1, v=0.2)",
        ),
        ("textmsg(\"x \", x)", "ack: 4: textmsg(\"x \", x)"),
        ("statelastinterpreted", "state: 4: statelastinterpreted"),
        ("stateunexecuted", "state: 4: stateunexecuted"),
        ("statelastexecuted", "state: 0: statelastexecuted"),
    ] {
        assert_eq!(interpret(a.robot_mut(), line), answer);
    }
    for (bad, part) in
        [("no_such_thing()", "no_such_thing()"), ("y = = 2", "expected a value"), ("z = w", "w (line 1)")]
    {
        let answer = interpret(a.robot_mut(), bad);
        assert!(answer.starts_with("discard: ") && answer.contains(part) && answer.ends_with(bad), "{answer}");
    }
    a.step_until(0.1, |_| false);
    assert_eq!(interpret(a.robot_mut(), "statelastexecuted"), "state: 3: statelastexecuted");
    assert_eq!(log(&mut a), [""; 0], "a move delays the next statement");
    assert_eq!(interpret(a.robot_mut(), "abort"), "state: 3: abort");
    a.step_until(0.5, |_| false);
    assert_eq!(log(&mut a), ["x 8"]);
    assert!(a.robot().at_rest() && (a.robot().truth.actual_q[0] - 0.4).abs() > 0.01, "the move was not aborted");
    assert!(interpret(a.robot_mut(), "sleep(5)").starts_with("ack: 5"));
    assert!(interpret(a.robot_mut(), "textmsg(1)").starts_with("ack: 6"));
    a.step_until(0.1, |_| false);
    assert_eq!(interpret(a.robot_mut(), "skipbuffer"), "state: 1: skipbuffer");
    assert!(interpret(a.robot_mut(), "clear_interpreter()").starts_with("ack: 7"));
    assert!(interpret(a.robot_mut(), "end_interpreter()").starts_with("ack: 8"));
    assert!(a.step_until(7.0, |r| r.runtime == RuntimeState::Stopped), "end_interpreter ends interpreter_mode");
    assert_eq!(log(&mut a), [""; 0]);
}

#[test]
fn a_runtime_error_in_interpreter_mode_ends_the_program() {
    let mut a = arm();
    a.upload("interpreter_mode()\n");
    a.step_until(0.05, |_| false);
    assert!(interpret(a.robot_mut(), "x = 1 / 0").starts_with("ack: 1"));
    assert!(a.step_until(1.0, |r| r.runtime == RuntimeState::Stopped));
    assert!(log(&mut a)[0].contains("division by zero"));
}

#[test]
fn the_interpreter_port_answers_line_by_line() {
    let mut mock = Hosted::start(Setup::new(Model::by_name("ur5e").unwrap()), None, None).unwrap();
    let mut upload = mock.connect(30002).unwrap();
    upload.write_all(b"interpreter_mode(clearQueueOnEnter=True, clearOnEnd=True)\n").unwrap();
    let mut port = mock.connect(30020).unwrap();
    let mut lines = BufReader::new(port.try_clone().unwrap());
    let mut ask = |line: &str| {
        port.write_all(format!("{line}\n").as_bytes()).unwrap();
        let mut answer = String::new();
        lines.read_line(&mut answer).unwrap();
        answer
    };
    let begin = Instant::now();
    while !ask("write_output_integer_register(7, 12)").starts_with("ack: 1: ") {
        assert!(begin.elapsed() < Duration::from_secs(10), "interpreter mode did not begin");
    }
    assert!(ask("end_interpreter()").starts_with("ack: 2: "));
    let done = |state: &Json| state["output_int"][7] == 12 && state["program_running"] == false;
    while !done(&mock.ask(&Command::State).unwrap()) {
        assert!(begin.elapsed() < Duration::from_secs(10), "{}", mock.ask(&Command::State).unwrap());
    }
}

#[test]
fn modbus_signals_and_encoders_are_values_that_a_test_sets() {
    let mut a = arm();
    let text = "def t():\n modbus_add_signal(\"127.0.0.1\", 255, 16, 2, \"weight\")\n encoder_set_tick_count(0, 17)\n sleep(0.1)\n \
                textmsg(modbus_get_signal_status(\"weight\", False))\n textmsg(encoder_get_tick_count(0))\n textmsg(read_port_register(128))\nend\n";
    assert_eq!(a.upload(text), Upload::Main);
    a.step_until(0.05, |_| false);
    a.command(Command::ModbusSignal { name: "weight".into(), value: 42 }).unwrap();
    a.command(Command::PortRegister { address: 128, value: 9 }).unwrap();
    assert!(a.command(Command::ModbusSignal { name: "nothing".into(), value: 1 }).is_err());
    a.step_until(1.0, |r| r.runtime == RuntimeState::Stopped);
    assert_eq!(log(&mut a), ["42", "17", "9"]);
}

/// docs/MOCK-UR.md lists the functions that are accepted without effect and those that are refused.
#[test]
fn the_document_lists_the_functions_without_effect_and_the_refused_ones() {
    let text = include_str!("../../../docs/MOCK-UR.md");
    let section = |title: &str| -> Vec<&str> {
        let begin = text.find(title).unwrap_or_else(|| panic!("docs/MOCK-UR.md has no section {title}"));
        let rest = &text[begin + title.len()..];
        let end = rest.find("\n#").unwrap_or(rest.len());
        rest[..end].split('`').skip(1).step_by(2).collect()
    };
    assert_eq!(section("### Accepted without effect"), accepted_without_effect().collect::<Vec<_>>());
    assert_eq!(section("### Refused at upload"), refused().collect::<Vec<_>>());
}
