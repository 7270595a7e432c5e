//! The documented layout, tested with a publisher in another language: `python/publish_stereo.py` in a virtual
//! environment.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

mod common;

use common::{Place, now_ns, until};
use graspd_shm::frame::*;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// Runs a command for at most `limit`; returns its standard error on failure.
fn run(mut c: Command, limit: Duration) -> Result<(), String> {
    let mut child = c.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().map_err(|e| e.to_string())?;
    let end = Instant::now() + limit;
    loop {
        match child.try_wait().map_err(|e| e.to_string())? {
            Some(s) if s.success() => return Ok(()),
            Some(s) => {
                let mut text = String::new();
                if let Some(mut e) = child.stderr.take() {
                    let _ = std::io::Read::read_to_string(&mut e, &mut text);
                }
                return Err(format!("{s}: {text}"));
            }
            None if Instant::now() > end => {
                let _ = child.kill();
                let _ = child.wait();
                return Err("took too long".into());
            }
            None => std::thread::sleep(Duration::from_millis(50)),
        }
    }
}

/// An interpreter with iceoryx2 0.10.0, kept in the target folder between runs.
fn python() -> Result<PathBuf, String> {
    let venv = Path::new(env!("CARGO_TARGET_TMPDIR")).join("iceoryx2-0.10.0-venv");
    let exe = venv.join("bin/python");
    let check = |exe: &Path| {
        let mut c = Command::new(exe);
        c.args(["-c", "import iceoryx2"]);
        run(c, Duration::from_secs(30))
    };
    if check(&exe).is_ok() {
        return Ok(exe);
    }
    let mut c = Command::new("python3");
    c.args(["-m", "venv", "--clear"]).arg(&venv);
    run(c, Duration::from_secs(60)).map_err(|e| format!("python3 -m venv: {e}"))?;
    let mut c = Command::new(&exe);
    c.args(["-m", "pip", "install", "--quiet", "--disable-pip-version-check", "iceoryx2==0.10.0"]);
    run(c, Duration::from_secs(120)).map_err(|e| format!("pip install iceoryx2==0.10.0: {e}"))?;
    check(&exe)?;
    Ok(exe)
}

#[test]
fn a_python_driver_feeds_the_subscriber() {
    let exe = match python() {
        Ok(p) => p,
        Err(e) if std::env::var_os("CI").is_none() => {
            eprintln!("SKIPPED: the Python publisher was NOT tested, no interpreter with iceoryx2 0.10.0: {e}");
            return;
        }
        Err(e) => panic!("in CI the Python publisher must be tested: {e}"),
    };
    let place = Place::new();
    let node = place.node("subscriber");
    let policy =
        FramePolicy { size: Some((320, 240)), cameras: [id_hash("cam-17"), id_hash("cam-18")], ..Default::default() };
    let mut s = FrameSubscriber::new(&node, policy).unwrap();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("python/publish_stereo.py");
    let mut child = Command::new(exe)
        .arg(script)
        .arg("--root")
        .arg(place.names.root())
        .args(["--prefix", place.names.prefix(), "--cell", "test", "--width", "320", "--height", "240"])
        .args(["--rate", "100", "--drop-every", "10", "--serial-left", "cam-17", "--serial-right", "cam-18"])
        .stdout(Stdio::null())
        .stderr(Stdio::inherit())
        .spawn()
        .unwrap();
    let mut good = 0;
    let mut gaps = 0;
    let done = until(Duration::from_secs(30), || {
        let got = s.newest(now_ns());
        gaps += got.skipped;
        if let Some(f) = got.frame {
            let k = f.sequence() % 8;
            for view in 0..2 {
                let p = f.mono8(view).unwrap();
                for (x, y) in [(0, 0), (319, 0), (0, 239), (319, 239), (100, 77)] {
                    assert_eq!(u64::from(p[y * 320 + x]), (x as u64 + y as u64 + 3 * k + 50 * view as u64) & 0xff);
                }
            }
            assert_ne!(f.sequence() % 10, 0, "a pair that the driver dropped");
            good += 1;
        }
        (good >= 60).then_some(())
    });
    let _ = child.kill();
    let _ = child.wait();
    assert!(done.is_some(), "only {good} frames; {:?}", s.stats());
    assert_eq!(s.stats().rejected_total(), 0, "{:?}", s.stats());
    assert!(gaps >= 5, "dropped pairs must be counted as gaps");
}
