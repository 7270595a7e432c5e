//! Other people's clients against the mock controller: SDU's ur_rtde wheel as published, and a plain Python client.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

use graspd_hil::controller::{Command as Order, Hosted, Setup};
use graspd_hil::plant::Model;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

/// SDU's client, the version that the mock is held to.
const WHEEL: &str = "ur_rtde==1.6.5";

fn python_dir() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("python")
}

fn is_ci() -> bool {
    std::env::var("CI").is_ok_and(|v| v == "true" || v == "1")
}

/// Says at the top of its voice that a test was not run; in CI it fails instead.
fn skip(reason: &str) {
    assert!(!is_ci(), "{reason}: in CI this test must run");
    eprintln!("\n********************************************************************");
    eprintln!("*** SKIPPED, NOT PASSED: {reason}");
    eprintln!("********************************************************************\n");
}

/// Runs a command, at most so long; its output goes to this test's.
fn run(command: &mut Command, limit: Duration) -> Result<ExitStatus, String> {
    let mut child = command.stdin(Stdio::null()).spawn().map_err(|e| format!("{command:?}: {e}"))?;
    let begin = Instant::now();
    loop {
        match child.try_wait() {
            Ok(Some(status)) => return Ok(status),
            Ok(None) if begin.elapsed() < limit => std::thread::sleep(Duration::from_millis(50)),
            Ok(None) => {
                let _ = child.kill();
                let _ = child.wait();
                return Err(format!("{command:?} took more than {limit:?}"));
            }
            Err(e) => return Err(format!("{command:?}: {e}")),
        }
    }
}

/// A Python of its own with SDU's wheel, made once and kept in the target directory.
fn python_with_wheel() -> Result<PathBuf, String> {
    let home = Path::new(env!("CARGO_TARGET_TMPDIR")).join("ur-clients-venv");
    let python = home.join("bin/python");
    let has_wheel = |python: &Path| {
        let mut probe = Command::new(python);
        probe.args(["-c", "import rtde_control, rtde_receive, rtde_io"]).stderr(Stdio::null());
        run(&mut probe, Duration::from_secs(60)).is_ok_and(|s| s.success())
    };
    if has_wheel(&python) {
        return Ok(python);
    }
    let made = run(Command::new("python3").args(["-m", "venv"]).arg(&home), Duration::from_secs(180))?;
    if !made.success() {
        return Err("python3 -m venv failed".to_owned());
    }
    let mut pip = Command::new(&python);
    pip.args(["-m", "pip", "install", "--quiet", "--only-binary", ":all:", WHEEL]);
    run(&mut pip, Duration::from_secs(300))?;
    if has_wheel(&python) { Ok(python) } else { Err(format!("{WHEEL} could not be installed; is PyPI out of reach?")) }
}

fn mock() -> Hosted {
    let mut setup = Setup::new(Model::by_name("ur5e").unwrap());
    setup.start_joints = [0.3, -1.4, 1.5, -1.2, -1.4, 0.2];
    Hosted::start(setup, None, None).unwrap()
}

#[test]
fn sdus_receive_io_and_control_interfaces_drive_the_mock_unmodified() {
    let python = match python_with_wheel() {
        Ok(python) => python,
        Err(reason) => return skip(&reason),
    };
    let mut mock = mock();
    let script = python_dir().join("sdu_clients.py");
    let mut command = Command::new(python);
    command.arg(script).arg(mock.address.to_string());
    let status = run(&mut command, Duration::from_secs(120)).unwrap();
    let state = mock.ask(&Order::State).unwrap();
    assert!(status.success(), "{status}; the mock's state: {state}");
    // What its I/O interface wrote last is still there.
    assert_eq!(state["input_int"][19], 1234);
    assert_eq!(state["input_double"][19], -2.5);
    let seen = mock.ask(&Order::Summary).unwrap();
    assert_eq!(seen["limit_violations"], 0, "{seen}");
}

#[test]
fn a_plain_python_client_finds_everything_as_described() {
    if Command::new("python3").arg("--version").stdout(Stdio::null()).status().is_err() {
        return skip("there is no python3");
    }
    let mock = mock();
    let mut command = Command::new("python3");
    command.arg(python_dir().join("plain_client.py")).arg(mock.address.to_string());
    let status = run(&mut command, Duration::from_secs(60)).unwrap();
    assert!(status.success(), "{status}");
}
