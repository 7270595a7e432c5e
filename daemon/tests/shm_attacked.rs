//! The shared memory taken away under a moving daemon, and another local user who does whatever he can: the stop stays.
//!
//! Each test runs in a mount namespace with a `/dev/shm` of its own, so that it can fill and empty it; that and the
//! second account need root. Where the tests do not run as root they say so and look at nothing.
#![cfg(feature = "demo")]
#![allow(clippy::unwrap_used)] // a test: a failure is to be seen at once

mod cell;
#[path = "cell/stops.rs"]
mod stops;
#[path = "cell/wire.rs"]
mod wire;

use cell::{Extra, Process, World, ask, summary};
use graspd::realtime::now_ns;
use graspd::stop::{Heard, ask as ask_to_stop};
use rustix::process::Signal;
use std::os::unix::fs::MetadataExt;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};
use stops::{Cell, by_socket, ended};
use wire::Entry;

/// An account that nobody has.
const STRANGER: u32 = 54_321;

/// Runs a test again by this binary, in a mount namespace of its own. `true` in there; `false` outside, where all is
/// done.
fn in_a_namespace_of_its_own(test: &str) -> bool {
    if std::env::var_os("GRASPD_OWN_SHM").is_some() {
        return true;
    }
    if !rustix::process::geteuid().is_root() {
        println!("SKIPPED: {test} needs root for a /dev/shm of its own and a second account; NOTHING WAS TESTED");
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

fn harm(kind: &str, root: &Path) {
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

/// The speed that the arm's targets have at the end of what was recorded.
fn last_speed(entries: &[Entry]) -> f64 {
    let step = entries.iter().rev().find_map(|e| match e {
        Entry::Step { target, .. } => Some(*target),
        _ => None,
    });
    step.unwrap()
}

#[test]
fn shared_memory_deleted_overwritten_or_cut_under_a_moving_arm() {
    if !in_a_namespace_of_its_own("shared_memory_deleted_overwritten_or_cut_under_a_moving_arm") {
        return;
    }
    for kind in ["deleted", "garbage", "cut to nothing"] {
        let mut cell = Cell::new(41);
        let names = cell.names();
        let mut daemon = cell.world.daemon();
        cell.drive(Duration::from_millis(500));
        let asked = now_ns();
        harm(kind, names.root());
        let heard = ask_to_stop(&names);
        std::thread::sleep(Duration::from_millis(700));
        let mut entries = cell.wire.read();
        // A daemon that lives takes the stop at once. One that the kernel killed for touching what is gone (SIGBUS) is
        // stopped by the control script's patience: the daemon's last set-point then was no stop.
        let alive = matches!(heard, Heard::Socket { taken: true, .. });
        if alive {
            stops::judge(&entries, asked).unwrap().check(&format!("shared memory {kind}, socket"));
        }
        let code = ended(&mut daemon, Duration::from_secs(10));
        entries.extend(cell.wire.read());
        println!("shared memory {kind}: {heard:?}, exit code {code:?}, arm at {:.5} rad/s", last_speed(&entries));
        assert!(last_speed(&entries) < 1e-3, "{kind}: still moving");
        match code {
            Some(4) => assert!(cell.world.log().contains("shared memory was damaged"), "{}", cell.world.log()),
            // By a signal or a panic in the middleware: not in words, but stopped.
            other => assert!(kind != "deleted" && other != Some(0), "{kind}: {other:?}\n{}", cell.world.log()),
        }
        // Nobody is there any more, and that is said in bounded time.
        let begun = Instant::now();
        assert!(!cell.world.verb(&["stop"]).0);
        assert!(begun.elapsed() < Duration::from_secs(5), "{kind}: {:?}", begun.elapsed());
        // A new daemon in what is left: it works, or says what is in its way; it does not hang.
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
            assert!(matches!(ask_to_stop(&names), Heard::Socket { .. }), "{kind}");
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

/// What somebody with an account on this machine can try.
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
fn another_local_user_can_take_nothing_away() {
    if !in_a_namespace_of_its_own("another_local_user_can_take_nothing_away") {
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
            .uid(STRANGER)
            .gid(STRANGER)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap()
    };
    let out = attack(ATTEMPTS).wait_with_output().unwrap();
    let said = String::from_utf8_lossy(&out.stdout);
    println!("the stranger got: {said}");
    assert_eq!(said.trim(), "DONE", "a stranger reached something");
    assert!(daemon.alive(), "the stranger killed the daemon:\n{}", cell.world.log());
    let cause = cell.world.log();
    assert!(!cause.contains("damaged"), "{cause}");
    // His programs on every processor, and shared memory filled by him while the arm moves: every stop is obeyed.
    let mut busy: Vec<_> = (0..4).map(|_| attack("while :; do :; done")).collect();
    let (mut obeyed, mut tries) = (0, 0);
    while obeyed < 2 {
        tries += 1;
        assert!(tries < 9, "eight times no motion to stop\n{}", cell.world.log());
        cell.drive(Duration::from_millis(200));
        attack("dd if=/dev/zero of=/dev/shm/fill bs=1M").wait().unwrap();
        let free = Command::new("df").args(["--output=avail", "/dev/shm"]).output().unwrap();
        let free = String::from_utf8_lossy(&free.stdout).lines().last().and_then(|l| l.trim().parse::<u64>().ok());
        assert!(free.is_some_and(|kb| kb < 1024), "not full: {free:?} kB");
        let asked = now_ns();
        if obeyed == 0 {
            by_socket(&names)
        } else {
            daemon.signal(Signal::USR1)
        }
        std::thread::sleep(Duration::from_millis(700));
        std::fs::remove_file("/dev/shm/fill").unwrap();
        match stops::judge(&cell.wire.read(), asked) {
            Ok(stop) => {
                stop.check(["a stranger's load, full, socket", "a stranger's load, full, SIGUSR1"][obeyed]);
                obeyed += 1;
            }
            Err(e) => {
                assert!(!e.starts_with(char::is_uppercase), "{e}");
                println!("passed over: {e}");
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
    // Names that he took before us, and a link where our folder is looked for, are refused by name.
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
