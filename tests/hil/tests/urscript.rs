//! Programs on a scripted host: language, threads, motion, limits.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

mod desk;

use desk::Desk;
use graspd_hil::urscript::{Machine, Motion, ProgramKind, StepOutcome, Value, WatchdogAction};
use proptest::prelude::*;

fn run(text: &str, steps: usize) -> (Desk, Machine, StepOutcome) {
    let mut desk = Desk { motion_steps: 3, ..Desk::default() };
    let (machine, outcome) = run_on(text, steps, &mut desk);
    (desk, machine, outcome)
}

fn run_on(text: &str, steps: usize, desk: &mut Desk) -> (Machine, StepOutcome) {
    let mut machine = Machine::load(text).expect("the script loads");
    let mut outcome = StepOutcome::Running;
    for _ in 0..steps {
        outcome = machine.step(desk);
    }
    (machine, outcome)
}

/// Runs bare statements that log by `textmsg` and returns the log.
fn log(body: &str) -> Vec<String> {
    let (desk, _, outcome) = run(&format!("def t():\n{body}\nend\n"), 1);
    assert_eq!(outcome, StepOutcome::Finished, "{body}");
    desk.log
}

fn failure(body: &str, steps: usize) -> (u32, String) {
    match run(&format!("def t():\n{body}\nend\n"), steps).2 {
        StepOutcome::Failed(e) => (e.line, e.message),
        other => panic!("{body}: {other:?}"),
    }
}

#[test]
fn expressions_keep_precedence_and_types() {
    for (expression, expected) in [
        ("1 + 2 * 3", "7"),
        ("(1 + 2) * 3", "9"),
        ("7 / 2", "3.5"),
        ("7 % 4", "3"),
        ("-2 - -3", "1"),
        ("2147483647 + 1", "-2147483648"),
        ("1 < 2 and not 2 < 1", "True"),
        ("True xor True", "False"),
        ("False and 1 / 0 == 1", "False"),
        ("1 == 1.0", "True"),
        ("\"a\" == 'a'", "True"),
        ("[1, 2, 3] + [1, 1, 1]", "[2, 3, 4]"),
        ("2 * [1, 2.5]", "[2, 5]"),
        ("[[1, 2], [3, 4]] * [1, 1]", "[3, 7]"),
        ("transpose([[1, 2], [3, 4]])", "[[1, 3], [2, 4]]"),
        ("p[1, 2, 3, 0, 0, 0][1]", "2"),
        ("get_jacobian()[2, 5]", "25"),
        ("0x10 + 1e1", "26"),
        ("norm([3, 4])", "5"),
        ("floor(-1.5)", "-2"),
        ("str_cat(\"n=\", 3)", "n=3"),
        ("to_num(\"2.5\") * 2", "5"),
        ("str_sub(\"gripper\", 2, 3)", "ipp"),
        ("str_find(\"gripper\", \"p\")", "3"),
        ("binary_list_to_integer([True, False, True])", "5"),
        ("pose_trans(p[1, 0, 0, 0, 0, d2r(90)], p[1, 0, 0, 0, 0, 0])", "p[1, 1, 0, 0, 0, 1.5708]"),
        ("norm(pose_sub(p[1, 2, 3, 0.1, 0.2, 0.3], p[1, 2, 3, 0.1, 0.2, 0.3]))", "0"),
        ("get_inverse_kin_has_solution(p[2, 0, 0, 0, 0, 0])", "False"),
        ("get_standard_digital_in(3)", "True"),
    ] {
        assert_eq!(log(&format!("textmsg({expression})")), [expected], "{expression}");
    }
}

#[test]
fn pose_functions_are_inverse_to_each_other() {
    let out = log("a = p[0.3, -0.2, 0.5, 0.4, -1.1, 0.7]\nb = p[-0.1, 0.6, 0.2, 1.9, 0.3, -0.4]\n\
        c = pose_trans(pose_inv(a), pose_trans(a, b))\ntextmsg(pose_dist(c, b) < 0.000000001)\n\
        d = pose_add(pose_sub(a, b), b)\ntextmsg(norm([d[3], d[4], d[5]] - [a[3], a[4], a[5]]) < 0.000000001)\n\
        e = interpolate_pose(a, b, 1)\ntextmsg(norm([e[3], e[4], e[5]] - [b[3], b[4], b[5]]) < 0.000000001)\n\
        r = rpy2rotvec(rotvec2rpy([0.4, -1.1, 0.7]))\ntextmsg(norm(r - [0.4, -1.1, 0.7]) < 0.000000001)");
    assert_eq!(out, ["True"; 4]);
}

#[test]
fn scopes_follow_the_manual() {
    let out = log("a = 0\nglobal g = 0\ndef f():\n a = 1\n local g = 9\n own = 5\n return own\nend\n\
        def h(x, y=[1, 2], z=3):\n return x + y[1] + z\nend\n\
        r = f()\ntextmsg(a)\ntextmsg(g)\ntextmsg(r)\ntextmsg(h(1))\ntextmsg(h(1, z=10))\ntextmsg(h(1, [0, 0], 0))");
    assert_eq!(out, ["1", "0", "5", "6", "13", "1"]);
    assert!(failure("def f():\n own = 5\nend\nf()\ntextmsg(own)", 1).1.contains("'own' has no value"));
}

#[test]
fn loops_branches_and_element_assignment() {
    let out = log(
        "i = 0\nsum = 0\nwhile True:\n i = i + 1\n if i == 3:\n continue\n elif i > 6:\n break\n else:\n sum = sum + i\n end\nend\n\
        textmsg(sum)\nq = [[1, 2], [3, 4]]\nq[1, 0] = 7\nq[0][1] = 8\ntextmsg(q)\np = p[0,0,0,0,0,0]\np[2] = p[2] + 0.5\ntextmsg(p) # done",
    );
    assert_eq!(out, ["18", "[[1, 8], [7, 4]]", "p[0, 0, 0.5, 0, 0, 0]"]);
}

#[test]
fn a_value_on_the_next_line_followed_by_a_keyword_is_accepted() {
    // SDU's client library uploads this, and controllers run it.
    let out = log("global a = # comment\n0    global b = 2\nif a == 0: textmsg(b) end\ntextmsg(a)");
    assert_eq!(out, ["2", "0"]);
}

#[test]
fn syntax_errors_carry_the_line_and_nothing_runs() {
    for (text, line, part) in [
        ("def t():\n x = = 1\nend\n", 2, "expected a value"),
        ("def t():\n if True\n end\nend\n", 2, "':'"),
        ("def t():\n x = 1\n", 1, "no 'end'"),
        ("def t():\n s = \"open\nend\n", 2, "no closing quote"),
        ("def t():\n x = p[1, 2, 3]\nend\n", 2, "six"),
        ("def t():\n break\nend\n", 2, "outside a loop"),
        ("def t():\n for i in x:\n end\nend\n", 2, "syntax"),
        ("def t():\n x = run nothing()\nend\n", 2, "no thread"),
        ("def t():\n movej(a=1, [0,0,0,0,0,0])\nend\n", 2, "named argument"),
        ("def t():\n x = 1 & 2\nend\n", 2, "unexpected character"),
        ("def t(a):\nend\n", 1, "parameters"),
    ] {
        let error = Machine::load(text).err().unwrap_or_else(|| panic!("{text} loads"));
        assert_eq!(error.line, line, "{text}: {error}");
        assert!(error.message.contains(part), "{text}: {error}");
    }
}

#[test]
fn unknown_names_are_refused_at_load_with_all_their_lines() {
    let error = Machine::load("def t():\n if False:\n  no_such_thing(1)\n end\n x = y\nend\n").err().unwrap();
    assert_eq!(error.line, 3);
    assert!(error.message.contains("no_such_thing() (line 3)") && error.message.contains("y (line 5)"), "{error}");
}

#[test]
fn runtime_errors_name_their_line() {
    for (body, line, part) in [
        ("x = 1 / 0", 2, "division by zero"),
        ("q = [1, 2]\nx = q[2]", 3, "out of range"),
        ("if \"a\":\nend", 2, "boolean"),
        ("if 1 and True:\nend", 2, "boolean"),
        ("write_output_integer_register(48, 1)", 2, "0 to 47"),
        ("set_payload(-1)", 2, "negative payload"),
        ("q = get_inverse_kin(p[3,0,0,0,0,0])", 2, "out of reach"),
        ("speedj([0,0,0,0,0,sqrt(2)*1e308*10], 1)", 2, "finite"),
        ("movej([0,0,0], a=1)", 2, "six"),
        ("movej([0,0,0,0,0,0], speed=1)", 2, "'speed'"),
        ("exit_critical", 2, "enter_critical"),
        ("def f():\n f()\nend\nf()", 3, "deep"),
        ("s = \"ab\"\nwhile True:\n s = str_cat(s, s)\nend", 4, "bytes"),
        ("l = [1, 2]\nwhile True:\n l = [l, l]\nend", 4, "nested"),
        ("while True:\nend", 2, "infinite loop"),
    ] {
        let (at, message) = failure(body, 1);
        assert_eq!(at, line, "{body}: {message}");
        assert!(message.contains(part), "{body}: {message}");
    }
}

#[test]
fn motion_and_sleep_take_the_expected_steps() {
    let mut desk = Desk { motion_steps: 4, ..Desk::default() };
    let mut m = Machine::load("def t():\n movej([0,0,0,0,0,1], a=0.5, v=0.25)\n write_output_integer_register(0, 1)\n sleep(0.01)\n write_output_integer_register(0, 2)\n sync()\n write_output_integer_register(0, 3)\nend\n").unwrap();
    let trace: Vec<i32> = (0..11)
        .map(|_| {
            m.step(&mut desk);
            desk.out_ints[0]
        })
        .collect();
    assert_eq!(trace, [0, 0, 0, 0, 1, 1, 1, 1, 1, 2, 3]);
    assert!(matches!(desk.motions[..], [Motion::MoveJ { a: 0.5, v: 0.25, t: 0.0, .. }]), "{:?}", desk.motions);
}

#[test]
fn threads_share_a_step_and_globals() {
    let text = "def t():\n global n = 0\n thread worker():\n  while n < 3:\n   n = n + 1\n   sync()\n  end\n  return False\n end\n\
        h = run worker()\n join h\n write_output_integer_register(1, n)\n kill h\n kill 0\nend\n";
    let (desk, _, outcome) = run(text, 6);
    assert_eq!(desk.out_ints[1], 3);
    assert_eq!(outcome, StepOutcome::Finished);
}

#[test]
fn a_killed_thread_abandons_its_motion_and_the_main_thread_may_move() {
    let text = "def t():\n thread mover():\n  while True:\n   speedj([1,0,0,0,0,0], a=2)\n  end\n end\n h = run mover()\n sync()\n kill h\n stopj(3)\nend\n";
    let (desk, _, outcome) = run(text, 8);
    assert_eq!(outcome, StepOutcome::Finished);
    assert_eq!(desk.abandoned, 1);
    assert!(matches!(desk.motions.last(), Some(Motion::StopJ { a: 3.0 })));
    let both = "def t():\n thread mover():\n  movej([1,0,0,0,0,0])\n end\n run mover()\n sync()\n stopj(3)\nend\n";
    let (_, _, outcome) = run(both, 4);
    assert!(matches!(outcome, StepOutcome::Failed(e) if e.line == 7 && e.message.contains("another thread")));
}

#[test]
fn a_critical_section_is_not_interrupted_but_others_run_while_its_thread_waits() {
    let text = "def t():\n global seen = 0\n thread other():\n  while True:\n   seen = seen + 1\n   sync()\n  end\n end\n run other()\n\
        enter_critical\n enter_critical\n before = seen\n i = 0\n while i < 1000:\n i = i + 1\n end\n after = seen\n sync()\n sync()\n exit_critical\n\
        exit_critical\n write_output_integer_register(0, after - before)\n write_output_integer_register(1, seen)\n halt\nend\n";
    let (desk, _, outcome) = run(text, 6);
    assert_eq!(outcome, StepOutcome::Finished);
    assert_eq!(desk.out_ints[0], 0);
    assert!(desk.out_ints[1] > 0);
}

#[test]
fn threads_end_with_the_main_program() {
    let (desk, m, outcome) = run(
        "def t():\n thread w():\n  while True:\n   speedj([0,0,0,0,0,1], 1)\n  end\n end\n run w()\n sync()\nend\n",
        4,
    );
    assert_eq!(outcome, StepOutcome::Finished);
    assert_eq!(m.threads(), 0);
    assert_eq!(desk.abandoned, 1);
}

#[test]
fn secondary_programs_must_not_wait() {
    let (desk, m, outcome) = run("sec io():\n set_standard_digital_out(2, True)\nend\n", 1);
    assert_eq!((m.kind(), m.name()), (ProgramKind::Secondary, "io"));
    assert_eq!((outcome, &desk.out_bits[..]), (StepOutcome::Finished, &[(1002, true)][..]));
    assert!(matches!(run("sec io():\n sync()\nend\n", 1).2, StepOutcome::Failed(_)));
}

#[test]
fn bare_lines_are_programs() {
    let (desk, m, outcome) = run("set_digital_out(1, True)\n", 1);
    assert_eq!((m.kind(), outcome), (ProgramKind::Bare, StepOutcome::Finished));
    assert_eq!(desk.out_bits, [(1001, true)]);
}

#[test]
fn watchdog_defaults_to_pause() {
    let (desk, ..) = run("def t():\n rtde_set_watchdog(\"input_int_register_24\", 10.0)\nend\n", 1);
    assert_eq!(desk.watchdog, Some(("input_int_register_24".into(), 10.0, WatchdogAction::Pause)));
    let (desk, ..) = run("def t():\n rtde_set_watchdog(\"input_int_register_24\", 20, \"STOP\")\nend\n", 1);
    assert_eq!(desk.watchdog, Some(("input_int_register_24".into(), 20.0, WatchdogAction::Stop)));
}

#[test]
fn sockets_read_numbers_lines_and_time_out() {
    let text = "def t():\n ok = socket_open(\"127.0.0.1\", 50001, \"rev\")\n bad = socket_open(\"127.0.0.1\", 1, \"no\")\n\
        m = socket_read_binary_integer(2, \"rev\", 0.01)\n late = socket_read_binary_integer(1, \"rev\", 0.01)\n\
        socket_send_int(-2, \"rev\")\n textmsg(ok)\n textmsg(bad)\n textmsg(m)\n textmsg(late)\n socket_close(\"rev\")\nend\n";
    let mut desk = Desk { inbox: vec![0, 0, 0, 5, 0xff, 0xff, 0xff, 0xfe], ..Desk::default() };
    let (_, outcome) = run_on(text, 8, &mut desk);
    assert_eq!(outcome, StepOutcome::Finished);
    assert_eq!(desk.log, ["True", "False", "[2, 5, -2]", "[0, -1]"]);
    assert_eq!(desk.sent, [0xff, 0xff, 0xff, 0xfe]);
}

#[test]
fn deep_nesting_is_refused() {
    for text in [
        format!("x = {}1{}\n", "(".repeat(100_000), ")".repeat(100_000)),
        format!("x = {}1\n", "-".repeat(100_000)),
        format!("x = {}True\n", "not ".repeat(100_000)),
        format!("x = 1{}\n", "+1".repeat(100_000)),
        format!("{}{}", "if True:\n".repeat(50_000), "end\n".repeat(50_000)),
        format!("{}{}", "def f():\n".repeat(50_000), "end\n".repeat(50_000)),
        format!("x = {}\n", "[".repeat(100_000)),
    ] {
        assert!(Machine::load(&text).is_err());
    }
}

#[test]
fn a_program_keeps_its_value_between_steps() {
    let (_, m, outcome) = run("def t():\n global n = 0\n while True:\n  n = n + 1\n  sync()\n end\nend\n", 500);
    assert_eq!(outcome, StepOutcome::Running);
    assert_eq!(m.global("n"), Some(&Value::Int(500)));
}

proptest! {
    #[test]
    fn arbitrary_text_never_panics(text in "\\PC*") {
        let _ = Machine::load(&text);
    }

    #[test]
    fn arbitrary_words_never_panic(words in prop::collection::vec(prop::sample::select(vec![
        "def", "thread", "sec", "f", "(", ")", ":", "\n", "end", "if", "elif", "else", "while", "True", "x", "=", "1", "2.5",
        "p[", "[", "]", ",", "run", "kill", "join", "sync()", "return", "break", "and", "not", "+", "-", "*", "/", "global",
        "\"s\"", "enter_critical", "exit_critical", "speedj(x, 1)", "textmsg(x)", "x[0]", "halt", "sleep(0.1)", "str_cat(x, x)",
    ]), 0..80)) {
        if let Ok(mut m) = Machine::load(&words.join(" ")) {
            let mut desk = Desk { motion_steps: 2, ..Desk::default() };
            for _ in 0..20 {
                m.step(&mut desk);
            }
        }
    }
}
