//! `graspd-scene`: the simulated cameras as a program.

mod args;
mod control;
mod faults;
mod joints;
mod publish;

pub use args::Args;
pub use faults::Fault;

use crate::scenario::{Scenario, ScenarioError, WorldError};
use clap::Parser;
use control::Console;
use faults::Timed;
use graspd_rt::geom::View;
use graspd_shm::frame::TOPIC;
use graspd_shm::{Names, NamesError, ShmError, create_node};
use joints::{Arm, now_ns};
use publish::{Loop, Shared};
use serde_json::json;
use std::ffi::OsString;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// Why the scene did not start or had to stop.
#[derive(Debug, thiserror::Error)]
enum SceneError {
    #[error("no world: give --world DIR or --seed N")]
    NoWorld,
    #[error(transparent)]
    World(#[from] WorldError),
    #[error(transparent)]
    Draw(#[from] ScenarioError),
    #[error(transparent)]
    Names(#[from] NamesError),
    #[error(transparent)]
    Shm(#[from] ShmError),
    #[error("--rate {0}: expected 0.5 to 500 pairs per second")]
    Rate(f64),
    #[error("--joints: {0} rad is not a joint position")]
    Joint(f64),
    #[error("--fault {0}: {1}")]
    Fault(String, String),
    #[error("--images {0}: {1}")]
    GreyImage(PathBuf, String),
    #[error("--control-port {0}: {1}")]
    Port(u16, std::io::Error),
    #[error("cannot catch signals: {0}")]
    Signals(std::io::Error),
}

impl SceneError {
    /// Exit code, with the daemon's meaning: 2 usage, 3 input, 4 link.
    fn code(&self) -> i32 {
        match self {
            Self::NoWorld | Self::Rate(_) | Self::Joint(_) | Self::Fault(..) => 2,
            Self::Shm(_) | Self::Port(..) | Self::Signals(_) => 4,
            _ => 3,
        }
    }
}

/// Runs the program with these arguments (the first is its name) and returns its exit code.
pub fn main_with_args<I, T>(args: I) -> i32
where
    I: IntoIterator<Item = T>,
    T: Into<OsString> + Clone,
{
    let args = match Args::try_parse_from(args) {
        Ok(args) => args,
        Err(e) => {
            let _ = e.print();
            return e.exit_code();
        }
    };
    match run(&args) {
        Ok(()) => 0,
        Err(e) => {
            let _ = writeln!(std::io::stderr(), "graspd-scene: {e}");
            e.code()
        }
    }
}

fn run(args: &Args) -> Result<(), SceneError> {
    if !(0.5..=500.0).contains(&args.rate) {
        return Err(SceneError::Rate(args.rate));
    }
    // A camera keeps its rate on a loaded host.
    crate::host::prefer_this_process(crate::host::RENDERER_NICE);
    let scenario = match (&args.world, args.seed) {
        (Some(dir), _) => Scenario::load(dir)?,
        (None, Some(seed)) => Scenario::from_seed(seed, &args.options())?,
        (None, None) => return Err(SceneError::NoWorld),
    };
    if let Some(dir) = &args.make_world {
        return Ok(scenario.save(dir)?);
    }
    if let Some(dir) = &args.images {
        return images(&scenario, dir);
    }
    let mut q = scenario.start;
    for (q, v) in q.iter_mut().zip(args.joints.iter().flatten()) {
        if !(v.abs() < 100.0) {
            return Err(SceneError::Joint(*v));
        }
        *q = *v;
    }
    let shared = Arc::new(Shared::default());
    for text in &args.fault {
        let bad = |e: String| SceneError::Fault(text.clone(), e);
        let value = serde_json::from_str(text).map_err(|e| bad(e.to_string()))?;
        shared.add(Timed::parse(&value, now_ns()).map_err(bad)?);
    }
    let root = match &args.shm_root {
        // Relative to the working directory, like all paths on the command line.
        Some(root) => std::path::absolute(root).unwrap_or_else(|_| root.clone()),
        None => Names::default_root(),
    };
    let prefix = args.shm_prefix.clone().unwrap_or_else(Names::default_prefix);
    let names = Names::new(root, &prefix, &args.cell)?;
    let stop = stop_flag(args)?;
    let arm = Arm::fixed(q);
    let console = Console { shared: Arc::clone(&shared), arm: arm.clone(), stop: Arc::clone(&stop) };
    let port = match args.control_port {
        Some(p) => Some(console.listen_on_port(p).map_err(|e| SceneError::Port(p, e))?),
        None => None,
    };
    if let Some(address) = &args.rtde {
        arm.follow(address.clone(), Arc::clone(&stop));
    }
    let renderer = scenario.renderer();
    let node = create_node(&names, "graspd-scene")?;
    let seed = scenario.seed;
    let (width, height) = renderer.size();
    let tuning = (args.rate, args.latency_ms, args.close_output);
    let scene = Loop::new(scenario, renderer, arm, shared, &node, tuning)?;
    let stdin_ends = args.exit_with_stdin;
    let line = json!({
        "ready": true, "program": "graspd-scene", "service": names.service(TOPIC), "shm_root": names.root(),
        "shm_prefix": names.prefix(), "control_port": port, "width": width, "height": height, "rate_hz": args.rate, "seed": seed,
    });
    scene.run(&node, &stop, || {
        let mut out = std::io::stdout().lock();
        let _ = writeln!(out, "{line}").and_then(|()| out.flush());
        drop(out);
        console.listen_on_stdin(stdin_ends);
    })?;
    Ok(())
}

/// A flag that is set by SIGTERM, SIGINT, the end of the parent process or the time limit.
fn stop_flag(args: &Args) -> Result<Arc<AtomicBool>, SceneError> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGTERM, signal_hook::consts::SIGINT] {
        signal_hook::flag::register(signal, Arc::clone(&stop)).map_err(SceneError::Signals)?;
    }
    let parent = rustix::process::getppid();
    let deadline = args.max_seconds.map(|s| now_ns().saturating_add((s.clamp(0.0, 1e6) * 1e9) as u64));
    let watch_parent = !args.detach;
    let flag = Arc::clone(&stop);
    std::thread::spawn(move || {
        while !flag.load(Ordering::Relaxed) {
            let orphan = watch_parent && rustix::process::getppid() != parent;
            if orphan || deadline.is_some_and(|d| now_ns() > d) {
                flag.store(true, Ordering::Relaxed);
            }
            std::thread::sleep(Duration::from_millis(100));
        }
    });
    Ok(stop)
}

/// Writes the images of both cameras at the start.
fn images(scenario: &Scenario, dir: &Path) -> Result<(), SceneError> {
    let bad = |e: String| SceneError::GreyImage(dir.to_owned(), e);
    std::fs::create_dir_all(dir).map_err(|e| bad(e.to_string()))?;
    let mut renderer = scenario.renderer();
    let shot = scenario.snapshot(&scenario.start, 1);
    for (view, name) in [(View::Left, "left.png"), (View::Right, "right.png")] {
        renderer.image(view, &shot).save(dir.join(name)).map_err(|e| bad(e.to_string()))?;
    }
    Ok(())
}
