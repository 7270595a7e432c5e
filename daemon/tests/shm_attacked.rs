//! Shared memory that is damaged while the daemon moves the arm, and attacks by another local user: the stop keeps
//! working.
//!
//! Each test runs in a mount namespace with its own `/dev/shm`, which it can fill and empty. That and the second
//! account need root; without root the tests print that they are skipped.
#![cfg(feature = "demo")]
#![allow(clippy::unwrap_used)] // a failure must panic

mod cell;
#[path = "cell/stops.rs"]
mod stops;
#[path = "cell/wire.rs"]
mod wire;

use cell::{Extra, Process, World, ask, summary};
use graspd::realtime::now_ns;
use graspd::stop::{StopAnswer, ask as request_stop};
use rustix::process::Signal;
use std::os::unix::fs::MetadataExt;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};
use stops::{Cell, by_socket, ended};
use wire::Entry;

/// User id of the attacker; no account has it.
const ATTACKER: u32 = 54_321;

/// Runs a test again in a separate mount namespace. True in the namespace; false outside, after the test has run.
fn in_own_namespace(test: &str) -> bool {
    if std::env::var_os("GRASPD_OWN_SHM").is_some() {
        return true;
    }
    if !rustix::process::geteuid().is_root() {
        println!("SKIPPED: {test} needs root for a separate /dev/shm and a second account; NOTHING WAS TESTED");
        return false;
    }
    let script = "mount -t tmpfs -o size=400m,mode=1777 tmpfs /dev/shm && exec \"$0\" --exact \"$1\" --nocapture";
    let me = std::env::current_exe().unwrap();
    let status = Command::new("unshare")
        .args(["-m", "sh", "-c", script])
        .arg(me)
        .arg(test)
        .env("GRASPD_OWN_SHM", "1")
        .status()
        .unwrap();
    assert!(status.success(), "{test} in its namespace: {status}");
    false
}

fn files(folder: &Path) -> Vec<PathBuf> {
    let mut all = Vec::new();
    for e in std::fs::read_dir(folder).into_iter().flatten().flatten() {
        if e.path().is_dir() {
            all.extend(files(&e.path()));
        } else {
            all.push(e.path());
        }
    }
    all
}

/// Segments and discovery files, not the stop socket and its lock.
fn middleware(root: &Path) -> Vec<PathBuf> {
    let mut all = files(Path::new("/dev/shm"));
    all.extend(files(root).into_iter().filter(|p| p.extension().is_none_or(|e| e != "stop" && e != "pid")));
    all
}

fn damage(kind: &str, root: &Path) {
    let all = middleware(root);
    assert!(all.len() > 15, "{all:?}");
    for path in all {
        let open = || std::fs::File::options().write(true).open(&path);
        let done = match kind {
            "deleted" => std::fs::remove_file(&path),
            "garbage" => open().and_then(|f| {
                let size = f.metadata()?.len().min(1 << 16);
                std::os::unix::fs::FileExt::write_all_at(&f, &vec![0xa5; size as usize], 0)
            }),
            _ => open().and_then(|f| f.set_len(0)),
        };
        if let Err(e) = done {
            println!("{kind} {}: {e}", path.display());
        }
    }
}

/// Target speed of the fastest joint at the end of the record, rad/s.
fn last_speed(entries: &[Entry]) -> f64 {
    let step = entries.iter().rev().find_map(|e| match e {
        Entry::Step { target, .. } => Some(*target),
        _ => None,
    });
    step.unwrap()
}

#[test]
fn damaged_shared_memory_stops_a_moving_arm() {
    if !in_own_namespace("damaged_shared_memory_stops_a_moving_arm") {
        return;
    }
    for kind in ["deleted", "garbage", "truncated"] {
        let mut cell = Cell::new(41);
        let names = cell.names();
        let mut daemon = cell.world.daemon();
        cell.drive(Duration::from_millis(500));
        let asked = now_ns();
        damage(kind, names.root());
        let answer = request_stop(&names);
        std::thread::sleep(Duration::from_millis(700));
        let mut entries = cell.wire.read();
        // A live daemon takes the stop immediately. If the kernel killed it for an access to missing memory (SIGBUS),
        // the control script stops the arm after its heartbeat timeout, and the daemon's last set-point was not a stop.
        let alive = matches!(answer, StopAnswer::Socket { taken: true, .. });
        if alive {
            stops::judge(&entries, asked).unwrap().check(&format!("shared memory {kind}, socket"));
        }
        let code = ended(&mut daemon, Duration::from_secs(10));
        entries.extend(cell.wire.read());
        println!("shared memory {kind}: {answer:?}, exit code {code:?}, arm at {:.5} rad/s", last_speed(&entries));
        assert!(last_speed(&entries) < 1e-3, "{kind}: still moving");
        match code {
            Some(4) => assert!(cell.world.log().contains("shared memory was damaged"), "{}", cell.world.log()),
            // Killed by a signal or by a panic in the middleware: without a message, but stopped.
            other => assert!(kind != "deleted" && other != Some(0), "{kind}: {other:?}\n{}", cell.world.log()),
        }
        // Without a daemon the command fails within bounded time.
        let started = Instant::now();
        assert!(!cell.world.verb(&["stop"]).0);
        assert!(started.elapsed() < Duration::from_secs(5), "{kind}: {:?}", started.elapsed());
        // A new daemon in the damaged folder works or ends with an error; it does not hang.
        let left = cell.world.path("graspd.toml");
        cell.scene = None;
        let mut again = Command::new(env!("CARGO_BIN_EXE_graspd"))
            .args(["run", "--config", &left])
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .map(|child| Process { child, ready: serde_json::Value::Null })
            .unwrap();
        std::thread::sleep(Duration::from_secs(2));
        if again.alive() {
            assert!(matches!(request_stop(&names), StopAnswer::Socket { .. }), "{kind}");
            again.signal(Signal::TERM);
        }
        ended(&mut again, Duration::from_secs(10));
        cell.check_limits();
        cell.clean();
        for path in files(Path::new("/dev/shm")) {
            let _ = std::fs::remove_file(path);
        }
    }
}

/// What a user with an account on this machine can try.
const ATTEMPTS: &str = r#"
cd /; G=$1; R=$2; P=$3
for f in /dev/shm/*; do
  true > "$f"; echo garbage > "$f"; truncate -s 0 "$f"; dd if=/dev/urandom of="$f" bs=64 count=1 conv=notrunc; mv "$f" "$f.x"; rm -f "$f"
  cat "$f" > /dev/null && echo "READ $f"
done
ls -R "$R" && echo "LISTED $R"
for f in "$R/kill.stop" "$R/kill.pid" "$R/services" "$R/nodes"; do rm -rf "$f"; mv "$f" "$f.x"; echo x > "$f"; done
mv "$R" "$R.x"; rm -rf "$R"; ln -s /tmp "$R/nodes/x"
for s in USR1 TERM HUP INT STOP KILL; do kill -$s "$P" && echo "SIGNALLED $s"; done
for v in stop arm servo reset recover status; do "$G" $v --cell kill --shm-root "$R" --timeout 0.3 && echo "ANSWERED $v"; done
i=0; while [ $i -lt 300 ]; do echo x > "/dev/shm/graspd0_squat$i"; i=$((i+1)); done
echo DONE
"#;

#[test]
fn another_local_user_cannot_affect_the_daemon() {
    if !in_own_namespace("another_local_user_cannot_affect_the_daemon") {
        return;
    }
    let mut cell = Cell::new(42);
    let names = cell.names();
    let mut daemon = cell.world.daemon();
    for path in files(Path::new("/dev/shm")).iter().chain(&files(names.root())) {
        let mode = std::fs::metadata(path).unwrap().mode() & 0o777;
        assert_eq!(mode & 0o077 & !0o050, 0, "{} has mode {mode:o}", path.display());
        assert!(mode & 0o022 == 0, "{} has mode {mode:o}", path.display());
    }
    cell.drive(Duration::from_millis(300));
    let pid = daemon.child.id().to_string();
    let attack = |script: &str| {
        Command::new("sh")
            .args(["-c", script, "sh", env!("CARGO_BIN_EXE_graspd"), names.root().to_str().unwrap(), &pid])
            .uid(ATTACKER)
            .gid(ATTACKER)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap()
    };
    let out = attack(ATTEMPTS).wait_with_output().unwrap();
    let reached = String::from_utf8_lossy(&out.stdout);
    println!("output of the attack: {reached}");
    assert_eq!(reached.trim(), "DONE", "the attacker reached something");
    assert!(daemon.alive(), "the attacker killed the daemon:\n{}", cell.world.log());
    let cause = cell.world.log();
    assert!(!cause.contains("damaged"), "{cause}");
    // The attacker's programs on every processor, and shared memory filled while the arm moves: every stop is executed.
    let mut busy: Vec<_> = (0..4).map(|_| attack("while :; do :; done")).collect();
    let (mut stopped, mut tries) = (0, 0);
    while stopped < 2 {
        tries += 1;
        assert!(tries < 9, "no motion to stop in eight attempts\n{}", cell.world.log());
        cell.drive(Duration::from_millis(200));
        attack("dd if=/dev/zero of=/dev/shm/fill bs=1M").wait().unwrap();
        let free = Command::new("df").args(["--output=avail", "/dev/shm"]).output().unwrap();
        let free = String::from_utf8_lossy(&free.stdout).lines().last().and_then(|l| l.trim().parse::<u64>().ok());
        assert!(free.is_some_and(|kb| kb < 1024), "not full: {free:?} kB");
        let asked = now_ns();
        if stopped == 0 {
            by_socket(&names)
        } else {
            daemon.signal(Signal::USR1)
        }
        std::thread::sleep(Duration::from_millis(700));
        std::fs::remove_file("/dev/shm/fill").unwrap();
        match stops::judge(&cell.wire.read(), asked) {
            Ok(stop) => {
                stop.check(["attacker's load, full, socket", "attacker's load, full, SIGUSR1"][stopped]);
                stopped += 1;
            }
            Err(e) => {
                assert!(!e.starts_with(char::is_uppercase), "{e}");
                println!("skipped: {e}");
            }
        }
    }
    for b in &mut busy {
        b.kill().unwrap();
        b.wait().unwrap();
    }
    assert!(daemon.alive(), "{}", cell.world.log());
    daemon.signal(Signal::TERM);
    assert_eq!(ended(&mut daemon, Duration::from_secs(4)), Some(0));
    // A symbolic link in place of the daemon's folder is refused.
    std::fs::remove_dir_all(names.root()).unwrap();
    std::os::unix::fs::symlink("/tmp", names.root()).unwrap();
    let (accepted, _) = cell.world.verb(&["status"]);
    assert!(!accepted);
    let run = ["run", "--config", &cell.world.path("graspd.toml")];
    let out = Command::new(env!("CARGO_BIN_EXE_graspd")).args(run).output().unwrap();
    let out = String::from_utf8_lossy(&out.stderr);
    assert!(out.contains("symbolic link"), "{out}");
    std::fs::remove_file(names.root()).unwrap();
    cell.check_limits();
    cell.clean();
}
