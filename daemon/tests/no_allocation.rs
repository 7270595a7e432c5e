//! The daemon in this process, under a counting allocator: from the first servoing cycle to the last, through every
//! external fault, the command thread and the vision thread neither allocate nor free heap memory.
//!
//! `rt/tests/closed_loop` does the same for internal faults.
#![cfg(feature = "demo")]
#![allow(clippy::unwrap_used)] // a failure must panic

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
/// Whether the backtrace of the first allocation was printed.
static PRINTED: AtomicBool = AtomicBool::new(false);

thread_local! {
    static KIND: Cell<u8> = const { Cell::new(UNKNOWN) };
}

/// The kind of the calling thread, by its name in the operating system.
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

fn count() {
    if !OPEN.load(Ordering::Relaxed) {
        return;
    }
    let _ = KIND.try_with(|k| {
        if k.get() == UNKNOWN {
            k.set(kind_of_thread());
        }
        COUNTS[k.get() as usize].fetch_add(1, Ordering::Relaxed);
        if k.get() != OTHER && !PRINTED.swap(true, Ordering::Relaxed) {
            let own = k.replace(OTHER);
            eprintln!("allocator used by thread kind {own}:\n{}", std::backtrace::Backtrace::force_capture());
            k.set(own);
        }
    });
}

struct Counting;

// SAFETY: every call goes to the system's allocator unchanged; `count` touches atomics and a const-initialised thread
// local, and its own allocations (once, for the backtrace) run with the thread marked so that they are not counted.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: as the caller promises.
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        count();
        // SAFETY: as the caller promises.
        unsafe { System.dealloc(at, layout) }
    }
    unsafe fn realloc(&self, at: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count();
        // SAFETY: as the caller promises.
        unsafe { System.realloc(at, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// The process that a fault is injected into.
enum Fault {
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
        let json: Value = serde_json::from_str(&answer.json).unwrap();
        if answer.accepted { Ok(json) } else { Err(format!("{verb:?}: {}", json["reason"])) }
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
        let status = self.ask(Verb::Status, b"").unwrap_or(Value::Null);
        let text = |key: &str| status[key].as_str().unwrap_or("").to_owned();
        (text("state"), text("cause"))
    }

    fn until(&self, what: &str, timeout: Duration, done: impl Fn(&str, &str) -> bool) -> Option<String> {
        let until = Instant::now() + timeout;
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

/// Clears all faults of mock and scene, moves the arm to its start, and brings the daemon to tracking.
fn restore(operator: &Operator, world: &World, mock: &Process, scene: &Process) {
    ask(scene, r#"{"clear":true}"#);
    for line in [r#"{"cmd":"clear_faults"}"#, r#"{"cmd":"restore"}"#, r#"{"cmd":"speed_slider","fraction":1.0}"#] {
        let answer = ask(mock, line);
        assert_eq!(answer["ok"], true, "{line}: {answer}");
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
fn the_real_time_threads_do_not_use_the_heap_while_servoing_or_stopping() {
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

    // The fault, and the cause that has to be reported.
    let table: [(Fault, &str); 22] = [
        (Fault::Mock(r#"{"cmd":"protective_stop"}"#), "F-ARM-05"),
        (Fault::Mock(r#"{"cmd":"emergency_stop"}"#), "F-ARM-06"),
        (Fault::Mock(r#"{"cmd":"safeguard_stop"}"#), "F-ARM-07"),
        (Fault::Mock(r#"{"cmd":"safety_failure","fault":true}"#), "F-ARM-08"),
        (Fault::Mock(r#"{"cmd":"power_off"}"#), "F-ARM-"),
        (Fault::Mock(r#"{"cmd":"stop_program"}"#), "F-ARM-10"),
        (Fault::Mock(r#"{"cmd":"nan_position","joint":2}"#), "F-ARM-16"),
        (Fault::Mock(r#"{"cmd":"stuck","joint":1}"#), "F-"),
        (Fault::Mock(r#"{"cmd":"close","port":"rtde"}"#), "F-ARM-01"),
        (Fault::Mock(r#"{"cmd":"reset","port":"rtde"}"#), "F-ARM-01"),
        (Fault::Mock(r#"{"cmd":"blackhole","port":"rtde","seconds":1}"#), "F-ARM-02"),
        // The bytes look like a long package: the state becomes stale before the framing error is detected.
        (Fault::Mock(r#"{"cmd":"garbage","port":"rtde","bytes":64}"#), "F-ARM-0"),
        (Fault::Mock(r#"{"cmd":"clock_restart"}"#), "F-ARM-"),
        (Fault::Mock(r#"{"cmd":"speed_slider","fraction":0.0}"#), "H-06"),
        (Fault::Scene(r#"{"fault":"stop"}"#), "F-CAM-01"),
        (Fault::Scene(r#"{"fault":"header","field":"stride","value":7}"#), "F-CAM-01"),
        (Fault::Scene(r#"{"fault":"header","field":"calibration_id","value":7}"#), "another calibration"),
        (Fault::Scene(r#"{"fault":"freeze"}"#), "F-"),
        (Fault::Scene(r#"{"fault":"skew","ms":9}"#), "exposed too far apart"),
        (Fault::Scene(r#"{"fault":"hide_gripper"}"#), "H-01"),
        (Fault::Scene(r#"{"fault":"white_noise"}"#), "H-01"),
        (Fault::Scene(r#"{"fault":"teleport","mm":60}"#), "-"),
    ];
    for (fault, code) in &table {
        let mut seen = String::new();
        // A stalled host may cause another fault before the injected one; then the row is repeated.
        for _ in 0..4 {
            // A fault of the robot's link affects the scene's link as well: its images then lag behind the encoders,
            // which looks like a moved camera. An operator who knows the reason sends the set-point again.
            let until = Instant::now() + Duration::from_secs(30);
            while let Err(e) = operator.ask(Verb::Servo, b"") {
                assert!(Instant::now() < until, "{e}");
                if e.contains("camera was moved") {
                    let _ = operator.ask(Verb::Setpoint, &plan);
                }
                // A stalled host may stop the arm by its watchdog before the fault is injected; that is cleared like
                // any other fault.
                restore(&operator, &world, &mock, &scene);
                let _ = operator.ask(Verb::Arm, b"");
                std::thread::sleep(Duration::from_millis(100));
            }
            OPEN.store(true, Ordering::SeqCst);
            if operator.until("moving", Duration::from_secs(5), |s, _| s == "servoing").is_some() {
                std::thread::sleep(Duration::from_millis(250));
            }
            let (line, to) = match fault {
                Fault::Mock(line) => (line, &mock),
                Fault::Scene(line) => (line, &scene),
            };
            let answer = ask(to, line);
            assert_eq!(answer["ok"], true, "{line}: {answer}");
            let stopped = |s: &str, c: &str| s == "fault" || (s == "armed" && c.starts_with("H-"));
            seen = operator.until("stopped", Duration::from_secs(6), stopped).unwrap_or_default();
            println!("{line}: {seen}");
            // Recovery, reset and the return to tracking are counted as well: none of it is work of the real-time
            // threads.
            restore(&operator, &world, &mock, &scene);
            if seen.contains(code) {
                break;
            }
        }
        assert!(seen.contains(code), "expected {code}, found {seen:?}");
        let [_, command, vision, _] = counts();
        assert_eq!((command, vision), (0, 0), "after {code}: the heap was used on a real-time thread");
    }
    // The counter works: the telemetry thread allocates when iceoryx2 sends.
    let [_, command, vision, other] = counts();
    assert!(other > 1000, "{other}");

    // iceoryx2 maps a restarted camera process on the vision thread; the command thread must not be affected.
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
    assert_eq!(command_after, command, "the command thread used the heap because of a new camera process");
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
