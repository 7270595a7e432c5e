//! The simulated cell: a world on disk and three processes.

use super::process::DemoProcess;
use crate::cli::DemoArgs;
use crate::exit::{Exit, Failure};
use graspd_hil::scenario::{Options, Scenario};
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Timeout of the start of a process: the scene renders its fixed layers first.
const START_TIMEOUT: Duration = Duration::from_secs(40);

/// A world and its processes. Dropping it ends them, the daemon first, so that it ramps the arm down.
#[derive(Debug)]
pub(super) struct Cell {
    /// `graspd run`.
    pub daemon: DemoProcess,
    /// `graspd-scene`.
    pub scene: DemoProcess,
    /// `graspd-mock-ur`.
    pub mock: DemoProcess,
    /// The daemon's configuration.
    pub config: PathBuf,
    /// The world's folder.
    pub world: PathBuf,
    /// The world as drawn.
    pub scenario: Scenario,
    /// Number of pairs that the scene had published at the last query, and its time.
    published: Option<(u64, Instant)>,
}

fn two(text: &str, key: &str) -> Result<[f64; 2], Failure> {
    let usage = || Failure {
        exit: Exit::Usage,
        message: format!("{key} {text}: give two numbers joined by a comma, like 0.5,0.1"),
    };
    let (a, b) = text.split_once(',').ok_or_else(usage)?;
    let number = |s: &str| s.trim().parse::<f64>().ok().filter(|v| v.is_finite()).ok_or_else(usage);
    Ok([number(a)?, number(b)?])
}

/// The errors that the world is drawn with.
pub(super) fn options(args: &DemoArgs) -> Result<Options, Failure> {
    let mut o = Options::default();
    if let Some(text) = &args.kinematics_error {
        [o.kinematics_error_mm, o.kinematics_error_deg] = two(text, "--kinematics-error")?;
    }
    if let Some(text) = &args.rig_error {
        let [percent, deg] = two(text, "--rig-error")?;
        o.focal_error = percent / 100.0;
        o.rotation_error_deg = deg;
    }
    Ok(o)
}

/// A loopback address on which the controller's ports are free. With one address for each demo no other demo uses its
/// ports, nor does an outgoing connection, as could happen with a port offset into the range of ephemeral ports.
fn free_address(seed: u64) -> Result<String, Failure> {
    let start = u64::from(std::process::id()).wrapping_mul(131).wrapping_add(seed.wrapping_mul(17));
    for k in 0..200_u64 {
        let n = (start + k * 7919) % (60 * 254 * 254);
        let address = format!("127.{}.{}.{}", 64 + n / (254 * 254), 1 + n / 254 % 254, 1 + n % 254);
        let free = [29_999_u16, 30_001, 30_002, 30_003, 30_004]
            .iter()
            .all(|port| TcpListener::bind((address.as_str(), *port)).is_ok());
        if free {
            return Ok(address);
        }
    }
    Err(Failure::link("no free ports 29999 to 30004 for the mock controller on any of 200 loopback addresses"))
}

impl Cell {
    /// Draws the world, starts mock controller, scene and daemon, and waits until each reports that it is ready.
    ///
    /// # Errors
    /// A world that cannot be drawn or written, or a process that does not start.
    pub(super) fn start(args: &DemoArgs, folder: &Path) -> Result<Self, Failure> {
        let world = folder.join("world");
        let scenario = Scenario::from_seed(args.seed, &options(args)?)
            .map_err(|e| Failure::input(format!("no world can be drawn from seed {}: {e}", args.seed)))?;
        scenario.save(&world).map_err(|e| Failure::input(e.to_string()))?;
        let address = free_address(args.seed)?;
        let cell = format!("demo-{}", std::process::id());
        let shm = folder.join("shm");
        let s = |p: &Path| p.display().to_string();
        let joints = scenario.start.map(|q| format!("{q:.9}")).join(",");
        let mock_args: Vec<String> = [
            "mock-ur",
            "--model",
            scenario.model.name(),
            "--bind",
            &address,
            &format!("--start-joints={joints}"),
            "--kinematics",
            &s(&world.join("true_arm.toml")),
            "--record",
            &s(&folder.join("wire.jsonl")),
            // The daemon's configured limits, with which the mock compares every set-point.
            "--limits",
            "0.5,4.0",
            "--exit-with-stdin",
        ]
        .map(str::to_owned)
        .to_vec();
        let mut mock = DemoProcess::start("mock-ur", &mock_args, folder)?;
        mock.json_line(START_TIMEOUT)?;
        let scene_args: Vec<String> = [
            "scene",
            "--world",
            &s(&world),
            "--rtde",
            &format!("{address}:30004"),
            "--rate",
            &args.frame_rate.to_string(),
            "--shm-root",
            &s(&shm),
            "--cell",
            &cell,
        ]
        .map(str::to_owned)
        .to_vec();
        let mut scene = DemoProcess::start("scene", &scene_args, folder)?;
        scene.json_line(START_TIMEOUT)?;
        let config = folder.join("graspd.toml");
        std::fs::write(&config, config_text(args, &cell, &address, scenario.model.name())).map_err(|e| {
            Failure::input(format!("{}: cannot be written ({e}); choose another folder with --out", config.display()))
        })?;
        let mut daemon = DemoProcess::start("graspd", &["run".to_owned(), "--config".to_owned(), s(&config)], folder)?;
        daemon.json_line(START_TIMEOUT)?;
        Ok(Self { daemon, scene, mock, config, world, scenario, published: None })
    }

    /// Pairs a second that the scene published since the last call; `None` in the first call, or when the scene does
    /// not answer.
    pub(super) fn pairs_per_second(&mut self) -> Option<f64> {
        let status = self.scene.ask(r#"{"ask":"status"}"#, Duration::from_secs(3)).ok()?;
        let now = (status.get("published")?.as_u64()?, Instant::now());
        let before = self.published.replace(now)?;
        let seconds = now.1.duration_since(before.1).as_secs_f64();
        (seconds > 0.0).then(|| now.0.saturating_sub(before.0) as f64 / seconds)
    }

    /// The name and exit status of a process that ended unexpectedly.
    pub(super) fn dead_process(&mut self) -> Option<String> {
        [("the daemon", &mut self.daemon), ("the scene", &mut self.scene), ("the mock controller", &mut self.mock)]
            .into_iter()
            .find_map(|(name, process)| process.ended().map(|status| format!("{name} ended ({status})")))
    }
}

fn config_text(args: &DemoArgs, cell: &str, address: &str, model: &str) -> String {
    format!(
        "# Written by graspd demo.\ncell = \"{cell}\"\n\n[files]\nrig = \"world/rig.toml\"\ngripper = \"world/gripper.toml\"\n\n\
         [shm]\nroot = \"shm\"\n\n[arm]\nlink = \"rtde\"\naddress = \"{address}\"\nmodel = \"{model}\"\n\
         kinematics = \"world/arm.toml\"\n\n# A simulated world shares its processors with the daemon.\n[loop]\nbest_effort = true\n\n\
         [vision]\nframe_rate_hz = {:?}\n\n[servo]\nviews = \"{}\"\n",
        args.frame_rate, args.views
    )
}
