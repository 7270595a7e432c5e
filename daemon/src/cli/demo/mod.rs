//! `graspd demo`: the complete chain against a simulated world, in separate processes.
//!
//! The demo does what an operator does: it takes the first images from shared memory, clicks where the world's script
//! has the object, runs `graspd plan`, sends the plan, arms, servoes and watches. The daemon gets no poses of the
//! world, and the final error is the ground truth of the scene.

mod cell;
mod process;
mod result;
mod trajectories;
mod watch;

use super::args::DemoArgs;
use crate::exit::{Exit, Failure};
use crate::realtime::now_ns;
use cell::Cell;
use graspd_shm::control::{RequestClient, TelemetrySample, Verb};
use graspd_shm::frame::{FramePolicy, FrameSubscriber};
use graspd_shm::{Names, ShmNode, create_node};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

/// Runs the demo.
///
/// # Errors
/// Usage, input, a process that does not start, a fault. A motion that does not converge is [`Exit::NotConverged`].
pub fn run(args: &DemoArgs) -> Result<Exit, Failure> {
    if !(args.timeout.is_finite() && args.timeout > 0.0) {
        return Err(Failure {
            exit: Exit::Usage,
            message: format!("--timeout {}: give a number of seconds", args.timeout),
        });
    }
    if !(10.0..=200.0).contains(&args.frame_rate) {
        return Err(Failure {
            exit: Exit::Usage,
            message: format!("--frame-rate {}: give 10 to 200 pairs a second", args.frame_rate),
        });
    }
    let shown = args.out.display();
    let wrong =
        |e: std::io::Error| Failure::input(format!("{shown}: cannot be used ({e}); choose another folder with --out"));
    std::fs::create_dir_all(&args.out).map_err(wrong)?;
    let folder = args.out.canonicalize().map_err(wrong)?;
    let console = Console::new(args);

    console.step("starting mock controller, scene and daemon");
    let mut cell = Cell::start(args, &folder)?;
    let config = crate::config::Config::load(&cell.config)?;
    let node = create_node(&config.names, "graspd-demo").map_err(|e| Failure::link(e.to_string()))?;
    let client = RequestClient::new(&node).map_err(|e| Failure::link(e.to_string()))?;

    console.step("taking the first images");
    first_images(&config, &config.names, &folder)?;
    console.step("off-line stage: from two clicks to a set-point");
    let plan = plan(args, &cell, &folder)?;
    console.plan(&plan);

    console.step("waiting for the marks and the robot");
    let tracking = |s: &TelemetrySample| s.state >= 1 && s.state != watch::FAULT;
    let ready = watch::until(&node, &mut cell, Duration::from_secs(20), |_| {}, tracking)?;
    if ready.seconds.is_none() {
        return Err(Failure::refused(format!("marks or robot did not become ready: {}", status(&client))));
    }
    let text = std::fs::read(folder.join("plan.toml")).map_err(wrong)?;
    ask(&client, Verb::Setpoint, &text)?;
    ask(&client, Verb::Arm, b"")?;
    ask(&client, Verb::Servo, b"")?;

    let _ = cell.pairs_per_second();
    console.step("on-line stage: servoing");
    let bar = console.bar();
    // After a hold the daemon is armed, and only an operator may continue.
    let held = |s: &TelemetrySample| s.state == watch::ARMED && s.cause_text().starts_with("H-");
    let over = |s: &TelemetrySample| s.state == watch::CONVERGED || s.state == watch::FAULT || held(s);
    let outcome =
        watch::until(&node, &mut cell, Duration::from_secs_f64(args.timeout), |s| console.progress(&bar, s), over)?;
    bar.finish_and_clear();
    let outcome = settle(&node, &mut cell, outcome)?;
    let result = result::collect(args, &mut cell, &outcome)?;
    // In every case the arm is stopped before the processes end.
    let _ = client.ask(Verb::Stop, b"", now_ns(), Duration::from_secs(2));
    let result = result::close(result, &mut cell);
    if !args.headless {
        trajectories::draw(&folder, &outcome.trajectories)?;
    }
    console.result(args, &result, &folder);
    if outcome.last.state == watch::FAULT {
        return Err(Failure::fault(outcome.last.cause_text().to_owned()));
    }
    Ok(if result.converged { Exit::Done } else { Exit::NotConverged })
}

/// Waits for half a second after convergence, so that the result is measured at rest.
fn settle(node: &ShmNode, cell: &mut Cell, mut outcome: watch::Outcome) -> Result<watch::Outcome, Failure> {
    if outcome.seconds.is_some() && outcome.last.state == watch::CONVERGED {
        let start = Instant::now();
        let held = watch::until(node, cell, Duration::from_millis(500), |_| {}, |s| s.state == watch::FAULT)?;
        debug_assert!(start.elapsed() < Duration::from_secs(5));
        if held.last.sequence > 0 {
            outcome.last = held.last;
        }
    }
    Ok(outcome)
}

fn ask(client: &RequestClient, verb: Verb, payload: &[u8]) -> Result<(), Failure> {
    // The daemon may become ready a little later: robot state and images have to be good for some time.
    let until = Instant::now() + Duration::from_secs(5);
    loop {
        let answer =
            client.ask(verb, payload, now_ns(), Duration::from_secs(2)).map_err(|e| Failure::link(e.to_string()))?;
        if answer.accepted {
            return Ok(());
        }
        if Instant::now() >= until {
            return Err(Failure::refused(format!("{verb:?} was refused: {}", answer.json)));
        }
        std::thread::sleep(Duration::from_millis(100));
    }
}

fn status(client: &RequestClient) -> String {
    client.ask(Verb::Status, b"", now_ns(), Duration::from_secs(1)).map_or_else(|e| e.to_string(), |a| a.json)
}

/// Saves one stereo pair as `left.png` and `right.png`.
fn first_images(config: &crate::config::Config, names: &Names, folder: &Path) -> Result<(), Failure> {
    let node = create_node(names, "graspd-demo-images").map_err(|e| Failure::link(e.to_string()))?;
    let mut frames = FrameSubscriber::new(&node, FramePolicy::default()).map_err(|e| Failure::link(e.to_string()))?;
    let until = Instant::now() + Duration::from_secs(10);
    while Instant::now() < until {
        if let Some(frame) = frames.newest(now_ns()).frame {
            let (w, h) = (frame.width(), frame.height());
            for (view, name) in ["left.png", "right.png"].iter().enumerate() {
                let mut grey = vec![0; w * h];
                if !frame.write_mono8(view, &mut grey) {
                    return Err(Failure::link("the scene's frames cannot be converted to grey"));
                }
                let path = folder.join(name);
                image::save_buffer(&path, &grey, w as u32, h as u32, image::ExtendedColorType::L8)
                    .map_err(|e| Failure::input(format!("{}: cannot be written ({e})", path.display())))?;
            }
            let (rw, rh) = (config.rig.rig.left.width as usize, config.rig.rig.left.height as usize);
            debug_assert_eq!((w, h), (rw, rh));
            return Ok(());
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    Err(Failure::link("the scene published no stereo pair within 10 s"))
}

/// Runs `graspd plan` on the saved pair, as a process, with the clicks of the world's script.
fn plan(args: &DemoArgs, cell: &Cell, folder: &Path) -> Result<serde_json::Value, Failure> {
    let program =
        std::env::current_exe().map_err(|e| Failure::link(format!("this program's own path is unknown ({e})")))?;
    let click = |view: usize| format!("{:.1},{:.1}", cell.scenario.clicks[view].x, cell.scenario.clicks[view].y);
    let mut command = Command::new(program);
    command.arg("plan").arg("--json").args(["--select-left", &click(0), "--select-right", &click(1)]);
    for (key, file) in [
        ("--left", folder.join("left.png")),
        ("--right", folder.join("right.png")),
        ("--rig", cell.world.join("rig.toml")),
        ("--gripper", cell.world.join("gripper.toml")),
        ("--out", folder.join("plan.toml")),
    ] {
        command.arg(key).arg(file);
    }
    command.args(["--pregrasp", &format!("{}", graspd_hil::scenario::STANDOFF_M)]);
    if !args.headless {
        command.arg("--overlay").arg(folder.join("plan.png"));
        command.arg("--report").arg(folder.join("plan.html"));
    }
    let output = command.output().map_err(|e| Failure::link(format!("graspd plan could not be started ({e})")))?;
    if !output.status.success() {
        let message = String::from_utf8_lossy(&output.stderr);
        return Err(Failure::refused(format!("no plan: {}", message.trim())));
    }
    serde_json::from_slice(&output.stdout)
        .map_err(|e| Failure::link(format!("graspd plan --json printed no JSON ({e})")))
}

/// Progress and result on the terminal; disabled with --headless or --json.
#[derive(Debug)]
struct Console {
    enabled: bool,
    start: Instant,
}

impl Console {
    fn new(args: &DemoArgs) -> Self {
        Self { enabled: !args.headless && !args.json, start: Instant::now() }
    }

    fn step(&self, what: &str) {
        if self.enabled {
            println!("{:6.1} s  {what}", self.start.elapsed().as_secs_f64());
        }
    }

    fn plan(&self, plan: &serde_json::Value) {
        if !self.enabled {
            return;
        }
        let get = |key: &str| plan.pointer(key).and_then(serde_json::Value::as_f64);
        if let (Some(a), Some(c), Some(n)) = (
            get("/plan/object/semi_axes_m/0"),
            get("/plan/object/sigma_centre_mm"),
            get("/plan/object/sigma_normal_deg"),
        ) {
            println!(
                "          rim of radius {:.1} mm; standard deviation of the centre {c:.2} mm, of the axis {n:.2} degrees",
                a * 1e3
            );
        }
    }

    fn bar(&self) -> ProgressBar {
        if !self.enabled {
            return ProgressBar::hidden();
        }
        let bar = ProgressBar::with_draw_target(Some(1000), ProgressDrawTarget::stderr());
        if let Ok(style) = ProgressStyle::with_template("          [{bar:40}] {msg}") {
            bar.set_style(style);
        }
        bar
    }

    fn progress(&self, bar: &ProgressBar, s: &TelemetrySample) {
        let phase = match s.phase {
            1 => "to pre-grasp",
            2 => "to grasp",
            _ => watch::STATES.get(s.state as usize).copied().unwrap_or(""),
        };
        let left = if s.distance_m.is_finite() { s.distance_m } else { 0.5 };
        let full_m = 0.5_f64;
        bar.set_position((1000.0 * (1.0 - (left / full_m).clamp(0.0, 1.0))) as u64);
        bar.set_message(format!(
            "{phase}: {:.1} mm and {:.2} deg left, {:.2} px",
            s.distance_m * 1e3,
            s.angle_rad.to_degrees(),
            s.error_px
        ));
    }

    fn result(&self, args: &DemoArgs, r: &result::DemoResult, folder: &Path) {
        if args.json {
            println!("{}", r.json());
            return;
        }
        print!("{}", r.table());
        if !args.headless {
            println!("images: {0}/plan.png, {0}/trajectories.png; report: {0}/plan.html", folder.display());
        }
    }
}
