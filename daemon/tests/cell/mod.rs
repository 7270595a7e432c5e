//! A simulated cell for tests: a world on disk, a plan for it, and mock controller, scene and daemon as processes.
#![allow(dead_code)] // no test uses all of it

use graspd_calib::commands::Class;
use graspd_calib::commands::plan::{PlanRequest, run};
use graspd_hil::scenario::{Options, Scenario};
use graspd_rt::geom::View;
use serde_json::Value;
use std::io::{BufRead, BufReader, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// A process of the cell; killed when dropped.
pub(crate) struct Process {
    pub(crate) child: Child,
    pub(crate) ready: Value,
}

impl Process {
    pub(crate) fn start(args: &[&str], log: &Path) -> Self {
        let log = std::fs::File::options().create(true).append(true).open(log).unwrap();
        let mut child = Command::new(env!("CARGO_BIN_EXE_graspd"))
            .args(args)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::from(log))
            .spawn()
            .unwrap();
        let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
        let ready = loop {
            let line = lines.next().expect("the process ended before it was ready").unwrap();
            if let Ok(v @ Value::Object(_)) = serde_json::from_str(&line) {
                break v;
            }
        };
        // The rest of the output is read, so that the process never blocks on a full pipe.
        std::thread::spawn(move || lines.for_each(drop));
        Self { child, ready }
    }

    pub(crate) fn alive(&mut self) -> bool {
        self.child.try_wait().unwrap().is_none()
    }

    /// SIGKILL.
    pub(crate) fn kill(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }

    /// SIGSTOP, SIGCONT.
    pub(crate) fn signal(&self, signal: rustix::process::Signal) {
        rustix::process::kill_process(rustix::process::Pid::from_child(&self.child), signal).unwrap();
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Deviations from the default cell.
#[derive(Clone, Debug)]
pub(crate) struct Extra {
    /// Stereo pairs a second.
    pub(crate) frame_rate: f64,
    /// Lines added to `[arm]`, with their ends.
    pub(crate) arm: String,
    /// Tables added to the configuration, with their ends.
    pub(crate) tables: String,
    /// Whether the mock writes its wire record to `wire`.
    pub(crate) record: bool,
}

impl Default for Extra {
    fn default() -> Self {
        Self { frame_rate: 60.0, arm: String::new(), tables: String::new(), record: false }
    }
}

/// A folder with a world, its plan and its daemon's configuration.
pub(crate) struct World {
    pub(crate) folder: PathBuf,
    pub(crate) address: String,
    pub(crate) joints: String,
    extra: Extra,
}

impl World {
    pub(crate) fn new(seed: u64) -> Self {
        Self::with(seed, Extra::default())
    }

    pub(crate) fn with(seed: u64, extra: Extra) -> Self {
        let folder = std::env::temp_dir().join(format!("graspd-kill-{}-{seed}", std::process::id()));
        let _ = std::fs::remove_dir_all(&folder);
        let scenario = Scenario::from_seed(seed, &Options::default()).unwrap();
        scenario.save(&folder.join("world")).unwrap();
        let mut renderer = scenario.renderer();
        let shot = scenario.snapshot(&scenario.start, 1);
        for (view, name) in [(View::Left, "left.png"), (View::Right, "right.png")] {
            renderer.image(view, &shot).save(folder.join(name)).unwrap();
        }
        let click = |view: usize| Some(format!("{:.1},{:.1}", scenario.clicks[view].x, scenario.clicks[view].y));
        let done = run(&PlanRequest {
            left: folder.join("left.png"),
            right: folder.join("right.png"),
            rig: folder.join("world/rig.toml"),
            gripper: folder.join("world/gripper.toml"),
            select_left: click(0),
            select_right: click(1),
            out: Some(folder.join("plan.toml")),
            ..PlanRequest::default()
        });
        assert_eq!(done.class, Class::Done, "{}", done.text);
        // A separate loopback address: its ports are not used by other tests or by outgoing connections.
        let id = std::process::id() + 131 * seed as u32;
        let address = format!("127.{}.{}.{}", 16 + id / (254 * 254) % 40, 1 + id / 254 % 254, 1 + id % 254);
        let joints = scenario.start.map(|q| format!("{q:.9}")).join(",");
        let config = format!(
            "cell = \"kill\"\n[files]\nrig = \"world/rig.toml\"\ngripper = \"world/gripper.toml\"\n[shm]\nroot = \"shm\"\n\
             [arm]\nmodel = \"ur5e\"\naddress = \"{address}\"\nkinematics = \"world/arm.toml\"\n{}[loop]\nbest_effort = true\n\
             [vision]\nframe_rate_hz = {:.1}\n{}",
            extra.arm, extra.frame_rate, extra.tables
        );
        std::fs::write(folder.join("graspd.toml"), config).unwrap();
        Self { folder, address, joints, extra }
    }

    pub(crate) fn path(&self, name: &str) -> String {
        self.folder.join(name).display().to_string()
    }

    pub(crate) fn mock(&self) -> Process {
        let (address, kinematics) = (&self.address, self.path("world/true_arm.toml"));
        let args = ["mock-ur", "--bind", address, "--start-joints", &self.joints, "--kinematics", &kinematics];
        let more = ["--control-port", "0", "--limits", "0.5,4.0", "--exit-with-stdin"];
        let wire = self.path("wire");
        let record: &[&str] = if self.extra.record { &["--record", &wire] } else { &[] };
        Process::start(&[&args[..], &more[..], record].concat(), &self.folder.join("mock.log"))
    }

    pub(crate) fn scene(&self) -> Process {
        let (world, rtde, root) = (self.path("world"), format!("{}:30004", self.address), self.path("shm"));
        let rate = format!("{:.1}", self.extra.frame_rate);
        let args = ["scene", "--world", &world, "--rtde", &rtde, "--shm-root", &root, "--cell", "kill"];
        let more = ["--control-port", "0", "--rate", &rate];
        Process::start(&[&args[..], &more[..]].concat(), &self.folder.join("scene.log"))
    }

    pub(crate) fn daemon(&self) -> Process {
        Process::start(&["run", "--config", &self.path("graspd.toml")], &self.folder.join("graspd.log"))
    }

    /// Runs a verb on the command line; returns whether it was accepted, and the answer.
    pub(crate) fn verb(&self, verb: &[&str]) -> (bool, Value) {
        let config = self.path("graspd.toml");
        let out = Command::new(env!("CARGO_BIN_EXE_graspd"))
            .args(verb)
            .args(["--config", &config, "--json", "--timeout", "2"])
            .output()
            .unwrap();
        (out.status.success(), serde_json::from_slice(&out.stdout).unwrap_or(Value::Null))
    }

    pub(crate) fn insist(&self, verb: &[&str]) {
        let until = Instant::now() + Duration::from_secs(40);
        loop {
            let (accepted, answer) = self.verb(verb);
            if accepted {
                return;
            }
            let log = std::fs::read_to_string(self.folder.join("graspd.log")).unwrap_or_default();
            assert!(Instant::now() < until, "{verb:?} is refused: {answer}\n{log}");
            std::thread::sleep(Duration::from_millis(100));
        }
    }

    /// Clears a fault. If a stall of the host has ended the control script, the robot is recovered first.
    pub(crate) fn clear(&self) {
        let until = Instant::now() + Duration::from_secs(60);
        while !self.verb(&["reset"]).0 {
            assert!(Instant::now() < until, "the fault stays: {:?}", self.state());
            self.verb(&["recover"]);
        }
    }

    pub(crate) fn state(&self) -> (String, String) {
        let (_, status) = self.verb(&["status"]);
        let text = |key: &str| status.get(key).and_then(Value::as_str).unwrap_or("").to_owned();
        (text("state"), text("cause"))
    }

    /// Sends the plan, arms, servoes and returns after `after`. If a stall of the host ends the control script before
    /// the arm has moved, the robot is recovered, the fault is reset, and the sequence is repeated.
    pub(crate) fn servo(&self, after: Duration) {
        let plan = self.path("plan.toml");
        let until = Instant::now() + Duration::from_secs(120);
        'again: loop {
            let started = Instant::now();
            for verb in [&["setpoint", &plan][..], &["arm"], &["servo"]] {
                loop {
                    let (accepted, answer) = self.verb(verb);
                    if accepted {
                        break;
                    }
                    let log = || std::fs::read_to_string(self.folder.join("graspd.log")).unwrap_or_default();
                    assert!(Instant::now() < until, "{verb:?} is refused: {answer}\n{}", log());
                    std::thread::sleep(Duration::from_millis(100));
                    let fault = answer.get("state").and_then(Value::as_str) == Some("fault");
                    if fault || started.elapsed() > Duration::from_secs(15) {
                        self.verb(&["recover"]);
                        self.verb(&["reset"]);
                        continue 'again;
                    }
                }
            }
            break;
        }
        std::thread::sleep(after);
    }

    /// The daemon's log.
    pub(crate) fn log(&self) -> String {
        std::fs::read_to_string(self.folder.join("graspd.log")).unwrap_or_default()
    }

    /// Waits for a fault or a hold and returns the log.
    pub(crate) fn stopped(&self) -> String {
        let until = Instant::now() + Duration::from_secs(10);
        loop {
            let (state, cause) = self.state();
            if state == "fault" || (state == "armed" && cause.starts_with("H-")) {
                // A separate thread writes the log, a little later than the state changes.
                let log = std::fs::read_to_string(self.folder.join("graspd.log")).unwrap();
                let last = log.lines().rfind(|l| l.contains(" -> ")).unwrap_or_default();
                if last.contains(&format!(" -> {state}")) {
                    return log;
                }
            }
            assert!(Instant::now() < until, "still {state}: {cause}");
            std::thread::sleep(Duration::from_millis(50));
        }
    }
}

/// Sends a line to the control port of mock or scene and returns the answer.
pub(crate) fn ask(process: &Process, line: &str) -> Value {
    let port = ["control", "control_port"].iter().find_map(|k| process.ready[*k].as_u64()).unwrap() as u16;
    let host = process.ready["address"].as_str().unwrap_or("127.0.0.1");
    let mut stream = TcpStream::connect((host, port)).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(5))).unwrap();
    writeln!(stream, "{line}").unwrap();
    let mut answer = String::new();
    BufReader::new(stream).read_line(&mut answer).unwrap();
    serde_json::from_str(&answer).unwrap()
}

/// The mock's summary of the wire, from wherever the answer has it.
pub(crate) fn summary(mock: &Process) -> Value {
    let v = ask(mock, r#"{"cmd":"summary"}"#);
    ["/summary", "/answer", "/result", ""]
        .iter()
        .find_map(|p| v.pointer(p).filter(|s| s.get("limit_violations").is_some()).cloned())
        .unwrap_or_else(|| panic!("no summary in {v}"))
}
