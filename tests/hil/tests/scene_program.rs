//! `graspd-scene` as a process: frames in shared memory, ground truth over a pipe, faults, end with its parent.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

use graspd_hil::scenario::{Options, Scenario};
use graspd_shm::frame::{FrameError, FramePolicy, FrameSubscriber, id_hash};
use graspd_shm::{Names, create_node};
use serde_json::Value;
use std::io::{BufRead, BufReader, Write};
use std::path::PathBuf;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::time::{Duration, Instant};

fn now_ns() -> u64 {
    let t = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    t.tv_sec as u64 * 1_000_000_000 + t.tv_nsec as u64
}

struct Scene {
    child: Child,
    stdin: ChildStdin,
    out: BufReader<ChildStdout>,
    names: Names,
    ready: Value,
    dir: PathBuf,
}

impl Scene {
    fn start(tag: &str, extra: &[&str]) -> Self {
        let tag = format!("gs{tag}{}", std::process::id());
        let dir = std::env::temp_dir().join(format!("graspd-{tag}"));
        let names = Names::new(dir.join("shm"), &format!("{tag}_"), "test").unwrap();
        let scenario = Scenario::from_seed(11, &Options::default()).unwrap();
        scenario.save(&dir.join("world")).unwrap();
        let mut child = Command::new(env!("CARGO_BIN_EXE_graspd-scene"))
            .arg("--world")
            .arg(dir.join("world"))
            .arg("--shm-root")
            .arg(names.root())
            .args(["--shm-prefix", names.prefix(), "--cell", "test", "--rate", "30", "--exit-with-stdin"])
            .args(["--max-seconds", "120"])
            .args(extra)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let stdin = child.stdin.take().unwrap();
        let mut out = BufReader::new(child.stdout.take().unwrap());
        let mut line = String::new();
        out.read_line(&mut line).unwrap();
        let ready: Value = serde_json::from_str(&line).unwrap();
        Self { child, stdin, out, names, ready, dir }
    }

    fn ask(&mut self, line: &str) -> Value {
        writeln!(self.stdin, "{line}").unwrap();
        let mut answer = String::new();
        self.out.read_line(&mut answer).unwrap();
        serde_json::from_str(&answer).unwrap()
    }

    /// Closes the pipe; the program must exit.
    fn end(mut self) {
        drop(self.stdin);
        let until = Instant::now() + Duration::from_secs(10);
        let status = loop {
            match self.child.try_wait().unwrap() {
                Some(s) => break Some(s),
                None if Instant::now() > until => break None,
                None => std::thread::sleep(Duration::from_millis(20)),
            }
        };
        let _ = self.child.kill();
        let _ = self.child.wait();
        let _ = std::fs::remove_dir_all(&self.dir);
        assert!(status.is_some_and(|s| s.success()), "{status:?}");
    }
}

/// Polls until the condition holds, at most ten seconds.
fn until(mut f: impl FnMut() -> bool) -> bool {
    let end = Instant::now() + Duration::from_secs(10);
    while Instant::now() < end {
        if f() {
            return true;
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    false
}

#[test]
fn frames_truth_and_faults() {
    let mut scene = Scene::start("a", &[]);
    assert_eq!(scene.ready["ready"], true);
    assert_eq!(scene.ready["service"], "test/frames/stereo");
    let node = create_node(&scene.names, "test").unwrap();
    let policy = FramePolicy {
        size: Some((1280, 1024)),
        cameras: [id_hash("sim-left"), id_hash("sim-right")],
        ..Default::default()
    };
    let mut frames = FrameSubscriber::new(&node, policy).unwrap();
    let mut seen = 0;
    let mut stamps = Vec::new();
    assert!(until(|| {
        if let Some(f) = frames.newest(now_ns()).frame {
            seen += 1;
            stamps.push(f.capture_ns()[0]);
            let (l, r) = (f.mono8(0).unwrap(), f.mono8(1).unwrap());
            assert_ne!(l, r);
            let mean = l.iter().map(|p| f64::from(*p)).sum::<f64>() / l.len() as f64;
            assert!((30.0..200.0).contains(&mean), "{mean}");
        }
        seen >= 10
    }));
    // Time stamps are on the camera's time grid.
    let period = 1_000_000_000 / 30;
    assert!(stamps.windows(2).all(|w| (w[1] - w[0]).is_multiple_of(period)), "{stamps:?}");
    assert_eq!(frames.stats().rejected_total(), 0, "{:?}", frames.stats());

    // Ground truth of an arm at rest at its start is that of the scenario.
    let scenario = Scenario::load(&scene.dir.join("world")).unwrap();
    let want = scenario.truth(&scenario.start, 0.0);
    let truth = scene.ask(r#"{"ask":"truth"}"#);
    assert!((truth["grasp"]["position_error_mm"].as_f64().unwrap() - want.position_error_mm).abs() < 1e-6, "{truth}");
    let standoff = truth["pregrasp"]["standoff_m"].as_f64().unwrap();
    assert!((standoff - graspd_hil::scenario::STANDOFF_M).abs() < 1e-12);

    // Faults cause the intended frame error and end when cleared.
    for (fault, reject) in [
        (r#"{"fault":"skew","ms":8}"#, FrameError::Skew),
        (r#"{"fault":"swap","ids":true}"#, FrameError::Cameras),
        (r#"{"fault":"incomplete","eye":1}"#, FrameError::Incomplete),
        (r#"{"fault":"stamp","ms":50}"#, FrameError::Future),
        (r#"{"fault":"header","field":"width","value":4294967295}"#, FrameError::Size),
        (r#"{"fault":"header","field":"offset","value":18446744073709551610}"#, FrameError::Bounds),
        (r#"{"fault":"repeat_sequence"}"#, FrameError::Sequence),
        (r#"{"fault":"second_publisher"}"#, FrameError::Foreign),
    ] {
        assert_eq!(scene.ask(fault)["ok"], true, "{fault}");
        assert!(until(|| frames.newest(now_ns()).last_error == Some(reject)), "{fault}: {:?}", frames.stats());
        assert_eq!(scene.ask(r#"{"clear":true}"#)["ok"], true);
        assert!(until(|| frames.newest(now_ns()).frame.is_some()), "{fault}: no recovery");
    }
    // A frozen camera repeats its pixels, another one does not.
    assert_eq!(scene.ask(r#"{"fault":"freeze","eye":1}"#)["ok"], true);
    let mut prints: Vec<[u64; 2]> = Vec::new();
    assert!(until(|| {
        prints.extend(frames.newest(now_ns()).frame.map(|f| f.fingerprint()));
        prints.windows(2).any(|w| w[0][1] == w[1][1] && w[0][0] != w[1][0])
    }));
    assert_eq!(scene.ask(r#"{"fault":"freez"}"#)["ok"], false);
    assert_eq!(scene.ask("nonsense")["ok"], false);
    scene.end();
}

#[test]
fn bad_input_ends_with_the_documented_code_and_a_reason() {
    for (args, code, part) in [
        (vec!["--rate", "0"], 2, "--rate"),
        (vec![], 2, "--world"),
        (vec!["--world", "/nonexistent/world"], 3, "truth.toml"),
        (vec!["--seed", "1", "--fault", "{\"fault\":\"nothing\"}"], 2, "nothing"),
        (vec!["--seed", "1", "--cell", "Bad Cell"], 3, "cell"),
        (vec!["--unknown"], 2, "--unknown"),
    ] {
        let o = Command::new(env!("CARGO_BIN_EXE_graspd-scene")).args(&args).stdin(Stdio::null()).output().unwrap();
        let said = String::from_utf8_lossy(&o.stderr);
        assert_eq!(o.status.code(), Some(code), "{args:?}: {said}");
        assert!(said.contains(part), "{args:?}: {said}");
    }
}

/// The options accept numbers in the form shown by the help.
#[test]
fn lists_of_numbers_are_accepted_in_the_form_of_the_help() {
    let dir = std::env::temp_dir().join(format!("graspd-scene-args-{}", std::process::id()));
    let _ = std::fs::remove_dir_all(&dir);
    let make = |to: &str, extra: &[&str]| {
        let mut c = Command::new(env!("CARGO_BIN_EXE_graspd-scene"));
        c.args(["--seed", "5"]).args(extra).arg("--make-world").arg(dir.join(to)).output().unwrap()
    };
    assert!(make("plain", &[]).status.success());
    let out = make("wrong", &["--rig-error", "0.5,0.1", "--kinematics-error", "0.5,0.1"]);
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    let read = |to: &str, file: &str| std::fs::read_to_string(dir.join(to).join(file)).unwrap();
    for file in ["rig.toml", "true_arm.toml"] {
        assert_ne!(read("plain", file), read("wrong", file), "{file}");
    }
    assert_eq!(read("plain", "true_rig.toml"), read("wrong", "true_rig.toml"));
    for (option, bad) in
        [("--rig-error", "0.5"), ("--kinematics-error", "1,2,3"), ("--rig-error", "a,b"), ("--rig-error", "nan,0")]
    {
        let out = make("bad", &[option, bad]);
        assert_eq!(out.status.code(), Some(2), "{option} {bad}");
        assert!(String::from_utf8_lossy(&out.stderr).contains("2 numbers"), "{option} {bad}");
    }
    let images = |joints: &str| {
        let mut c = Command::new(env!("CARGO_BIN_EXE_graspd-scene"));
        c.arg("--world").arg(dir.join("plain")).args(["--joints", joints, "--images"]).arg(dir.join("images"));
        c.output().unwrap()
    };
    assert!(images("-0.1,-1.6,1.9,-1.87,-1.57,0").status.success());
    assert_eq!(images("1,2,3").status.code(), Some(2));
    std::fs::remove_dir_all(&dir).unwrap();
}

/// docs/SCENE.md lists every fault in a form that the program accepts.
#[test]
fn the_document_names_every_fault() {
    let text = include_str!("../../../docs/SCENE.md");
    let lines: Vec<&str> = text.split('`').filter(|part| part.starts_with("{\"fault\":")).collect();
    let mut scene = Scene::start("doc", &[]);
    let unknown = scene.ask(r#"{"fault":"nothing_of_the_kind"}"#);
    let known: Vec<String> =
        unknown["error"].as_str().unwrap().split('`').skip(3).step_by(2).map(str::to_owned).collect();
    assert!(known.len() > 20, "{unknown}");
    for name in &known {
        let named = lines.iter().any(|l| l.starts_with(&format!("{{\"fault\":\"{name}\"")));
        assert!(named, "docs/SCENE.md does not name {name}");
    }
    for line in lines {
        assert_eq!(scene.ask(line)["ok"], true, "{line}");
    }
    assert_eq!(scene.ask(r#"{"clear":true}"#)["ok"], true);
}
