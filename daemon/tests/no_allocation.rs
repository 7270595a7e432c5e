//! The whole daemon in this process, under an allocator that counts: from the first servoing cycle to the last, through every fault that
//! the outside can cause, the command thread and the vision thread neither take nor give back heap memory.
//!
//! The faults that only the inside can cause are driven, and counted in the same way, by `rt/tests/closed_loop`.
#![cfg(feature = "demo")]
#![allow(clippy::unwrap_used)] // a test: a failure is to be seen at once

mod cell;

use cell::{Process, World, ask};
use graspd::config::Config;
use graspd::realtime::now_ns;
use graspd_shm::control::{RequestClient, Verb};
use graspd_shm::create_node;
use serde_json::Value;
use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// Kinds of threads.
const UNKNOWN: u8 = 0;
const COMMAND: u8 = 1;
const VISION: u8 = 2;
const OTHER: u8 = 3;

static OPEN: AtomicBool = AtomicBool::new(false);
static COUNTS: [AtomicU64; 4] = [const { AtomicU64::new(0) }; 4];
/// The first allocation's place is worth more than a number.
static TOLD: AtomicBool = AtomicBool::new(false);

thread_local! {
    static KIND: Cell<u8> = const { Cell::new(UNKNOWN) };
}

/// Which thread this is, by the name that the operating system knows.
fn kind_of_thread() -> u8 {
    let mut name = [0u8; 16];
    // SAFETY: PR_GET_NAME writes at most 16 bytes, the length of the buffer, which lives through the call.
    unsafe { libc::prctl(libc::PR_GET_NAME, name.as_mut_ptr()) };
    match &name[..8] {
        b"command\0" => COMMAND,
        [b'v', b'i', b's', b'i', b'o', b'n', 0, _] => VISION,
        _ => OTHER,
    }
}

fn note() {
    if !OPEN.load(Ordering::Relaxed) {
        return;
    }
    let _ = KIND.try_with(|k| {
        if k.get() == UNKNOWN {
            k.set(kind_of_thread());
        }
        COUNTS[k.get() as usize].fetch_add(1, Ordering::Relaxed);
        if k.get() != OTHER && !TOLD.swap(true, Ordering::Relaxed) {
            let own = k.replace(OTHER);
            eprintln!("allocator used by thread kind {own}:\n{}", std::backtrace::Backtrace::force_capture());
            k.set(own);
        }
    });
}

struct Counting;

// SAFETY: every call goes to the system's allocator unchanged; `note` touches atomics and a const-initialised thread local, and its own
// allocations (once, for the backtrace) run with the thread marked so that they are not noted again.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        note();
        // SAFETY: as the caller promises.
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        note();
        // SAFETY: as the caller promises.
        unsafe { System.dealloc(at, layout) }
    }
    unsafe fn realloc(&self, at: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        note();
        // SAFETY: as the caller promises.
        unsafe { System.realloc(at, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Who is told of a fault.
enum Way {
    Mock(&'static str),
    Scene(&'static str),
}

/// An operator at the daemon's request service.
struct Operator {
    client: RequestClient,
}

impl Operator {
    fn ask(&self, verb: Verb, payload: &[u8]) -> Result<Value, String> {
        let answer =
            self.client.ask(verb, payload, now_ns(), Duration::from_secs(2)).map_err(|e| format!("{verb:?}: {e}"))?;
        let said: Value = serde_json::from_str(&answer.json).unwrap();
        if answer.accepted { Ok(said) } else { Err(format!("{verb:?}: {}", said["reason"])) }
    }

    fn insist(&self, verb: Verb, payload: &[u8]) {
        let until = Instant::now() + Duration::from_secs(30);
        loop {
            match self.ask(verb, payload) {
                Ok(_) => return,
                Err(e) => assert!(Instant::now() < until, "{e}"),
            }
            std::thread::sleep(Duration::from_millis(100));
        }
    }

    fn state(&self) -> (String, String) {
        let said = self.ask(Verb::Status, b"").unwrap_or(Value::Null);
        let text = |key: &str| said[key].as_str().unwrap_or("").to_owned();
        (text("state"), text("cause"))
    }

    fn until(&self, what: &str, patience: Duration, done: impl Fn(&str, &str) -> bool) -> Option<String> {
        let until = Instant::now() + patience;
        while Instant::now() < until {
            let (state, cause) = self.state();
            if done(&state, &cause) {
                return Some(cause);
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        println!("not {what}: {:?}", self.state());
        None
    }
}

/// Puts mock and scene back to health, the arm back to its start, and the daemon to tracking.
fn restore(operator: &Operator, world: &World, mock: &Process, scene: &Process) {
    ask(scene, r#"{"clear":true}"#);
    for line in [r#"{"cmd":"clear_faults"}"#, r#"{"cmd":"restore"}"#, r#"{"cmd":"speed_slider","fraction":1.0}"#] {
        let said = ask(mock, line);
        assert_eq!(said["ok"], true, "{line}: {said}");
    }
    ask(mock, &format!(r#"{{"cmd":"teleport","q":[{}]}}"#, world.joints));
    let mut recover = Instant::now() + Duration::from_secs(1);
    let until = Instant::now() + Duration::from_secs(40);
    loop {
        let (state, cause) = operator.state();
        match state.as_str() {
            "tracking" | "armed" => return,
            "fault" => drop(operator.ask(Verb::Reset, b"")),
            _ => {}
        }
        if Instant::now() > recover {
            let _ = operator.ask(Verb::Recover, b"");
            recover = Instant::now() + Duration::from_secs(5);
        }
        assert!(Instant::now() < until, "still {state}: {cause}");
        std::thread::sleep(Duration::from_millis(50));
    }
}

#[test]
fn neither_real_time_thread_touches_the_heap_while_servoing_or_stopping() {
    let world = World::new(12);
    let mock = world.mock();
    let scene = world.scene();
    let path = world.folder.join("graspd.toml");
    let config = Config::load(&path).unwrap();
    let names = config.names.clone();
    let daemon = std::thread::spawn(move || graspd::wiring::run(&config, &path).map(|_| ()).map_err(|f| f.message));
    let node = create_node(&names, "operator").unwrap();
    let operator = Operator { client: RequestClient::new(&node).unwrap() };
    let plan = std::fs::read(world.folder.join("plan.toml")).unwrap();
    operator.insist(Verb::Setpoint, &plan);

    // What the fault is, who makes it, and the reason that has to be named.
    let table: [(Way, &str); 22] = [
        (Way::Mock(r#"{"cmd":"protective_stop"}"#), "F-ARM-05"),
        (Way::Mock(r#"{"cmd":"emergency_stop"}"#), "F-ARM-06"),
        (Way::Mock(r#"{"cmd":"safeguard_stop"}"#), "F-ARM-07"),
        (Way::Mock(r#"{"cmd":"safety_failure","fault":true}"#), "F-ARM-08"),
        (Way::Mock(r#"{"cmd":"power_off"}"#), "F-ARM-"),
        (Way::Mock(r#"{"cmd":"stop_program"}"#), "F-ARM-10"),
        (Way::Mock(r#"{"cmd":"nan_position","joint":2}"#), "F-ARM-16"),
        (Way::Mock(r#"{"cmd":"stuck","joint":1}"#), "F-"),
        (Way::Mock(r#"{"cmd":"close","port":"rtde"}"#), "F-ARM-01"),
        (Way::Mock(r#"{"cmd":"reset","port":"rtde"}"#), "F-ARM-01"),
        (Way::Mock(r#"{"cmd":"blackhole","port":"rtde","seconds":1}"#), "F-ARM-02"),
        // Bytes that claim to be a long package: the link starves before the framing is known to be lost.
        (Way::Mock(r#"{"cmd":"garbage","port":"rtde","bytes":64}"#), "F-ARM-0"),
        (Way::Mock(r#"{"cmd":"clock_restart"}"#), "F-ARM-"),
        (Way::Mock(r#"{"cmd":"speed_slider","fraction":0.0}"#), "H-06"),
        (Way::Scene(r#"{"fault":"stop"}"#), "F-CAM-01"),
        (Way::Scene(r#"{"fault":"header","field":"stride","value":7}"#), "F-CAM-01"),
        (Way::Scene(r#"{"fault":"header","field":"calibration_id","value":7}"#), "another calibration"),
        (Way::Scene(r#"{"fault":"freeze"}"#), "F-"),
        (Way::Scene(r#"{"fault":"skew","ms":9}"#), "exposed too far apart"),
        (Way::Scene(r#"{"fault":"hide_gripper"}"#), "H-01"),
        (Way::Scene(r#"{"fault":"white_noise"}"#), "H-01"),
        (Way::Scene(r#"{"fault":"teleport","mm":60}"#), "-"),
    ];
    for (way, code) in &table {
        let mut seen = String::new();
        // A stalled host may put another fault before the one that was meant; then once more.
        for _ in 0..4 {
            // A fault of the robot's link hits the scene's own as well: its images then lag behind the encoders, which is a moved camera
            // as far as anybody can tell. An operator who knows better gives the set-point again.
            let until = Instant::now() + Duration::from_secs(30);
            while let Err(e) = operator.ask(Verb::Servo, b"") {
                assert!(Instant::now() < until, "{e}");
                if e.contains("camera was moved") {
                    let _ = operator.ask(Verb::Setpoint, &plan);
                }
                // A stalled host stops the arm by its own watchdog before anything was injected; that is put right like any other fault.
                restore(&operator, &world, &mock, &scene);
                let _ = operator.ask(Verb::Arm, b"");
                std::thread::sleep(Duration::from_millis(100));
            }
            OPEN.store(true, Ordering::SeqCst);
            if operator.until("moving", Duration::from_secs(5), |s, _| s == "servoing").is_some() {
                std::thread::sleep(Duration::from_millis(250));
            }
            let (line, to) = match way {
                Way::Mock(line) => (line, &mock),
                Way::Scene(line) => (line, &scene),
            };
            let said = ask(to, line);
            assert_eq!(said["ok"], true, "{line}: {said}");
            let stopped = |s: &str, c: &str| s == "fault" || (s == "armed" && c.starts_with("H-"));
            seen = operator.until("stopped", Duration::from_secs(6), stopped).unwrap_or_default();
            println!("{line}: {seen}");
            // Recovery, reset and the way back to tracking are counted as well: nothing of it is the real-time threads' own work.
            restore(&operator, &world, &mock, &scene);
            if seen.contains(code) {
                break;
            }
        }
        assert!(seen.contains(code), "expected {code}, found {seen:?}");
        let [_, command, vision, _] = counts();
        assert_eq!((command, vision), (0, 0), "after {code}: the heap was used on a real-time thread");
    }
    // The count can count: telemetry allocates by iceoryx2's own sending.
    let [_, command, vision, other] = counts();
    assert!(other > 1000, "{other}");

    // A camera process that dies and comes back is mapped by iceoryx2 on the vision thread, which must not reach the command thread.
    let mut scene = scene;
    if operator.state().0 != "armed" {
        operator.insist(Verb::Arm, b"");
    }
    operator.insist(Verb::Servo, b"");
    std::thread::sleep(Duration::from_millis(300));
    scene.kill();
    operator.until("stopped", Duration::from_secs(6), |s, _| s == "fault" || s == "armed").unwrap();
    let scene = world.scene();
    restore(&operator, &world, &mock, &scene);
    OPEN.store(false, Ordering::SeqCst);
    let [_, command_after, vision_after, _] = counts();
    assert_eq!(command_after, command, "another camera process reached the command thread's heap");
    println!(
        "heap calls: command {command_after}, vision {vision} (+{} by a new camera process), others {other}",
        vision_after - vision
    );

    rustix::process::kill_process(rustix::process::getpid(), rustix::process::Signal::TERM).unwrap();
    assert_eq!(daemon.join().unwrap(), Ok(()));
    drop((scene, mock));
    let _ = std::fs::remove_dir_all(&world.folder);
}

fn counts() -> [u64; 4] {
    std::array::from_fn(|i| COUNTS[i].load(Ordering::SeqCst))
}
