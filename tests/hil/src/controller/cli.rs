//! The command line of `graspd-mock-ur`.

use super::record::Recorder;
use super::robot::{Robot, Setup};
use super::server::{Server, now_ns};
use super::state::RobotMode;
use super::world::World;
use crate::numbers::numbers;
use crate::plant::{Kinematics, Model};
use clap::Parser;
use serde_json::json;
use std::ffi::OsString;
use std::io::{Read, Write};
use std::net::IpAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// A mock Universal Robots controller: dashboard 29999, primary 30001, secondary 30002, real-time 30003, RTDE 30004,
/// interpreter 30020.
///
/// It runs uploaded URScript, moves a simulated arm and checks every set-point. When it is ready it prints one line of
/// JSON.
#[derive(Parser, Debug, Clone)]
#[command(name = "graspd-mock-ur", version)]
pub struct Args {
    /// Arm model: ur3, ur5, ur10, ur3e, ur5e, ur10e, ur16e, ur20 or ur30
    #[arg(long, default_value = "ur5e")]
    pub model: String,
    /// Address to listen on; several mocks can keep the standard port numbers on 127.0.0.2, 127.0.0.3 ...
    #[arg(long, default_value = "127.0.0.1")]
    pub bind: IpAddr,
    /// Added to every port number
    #[arg(long, default_value_t = 0)]
    pub port_offset: u16,
    /// Write every input package and every control step to this file
    #[arg(long, value_name = "FILE")]
    pub record: Option<PathBuf>,
    /// Accept JSON commands (faults, state, summary) on this port; 0 picks a free port
    #[arg(long, value_name = "PORT")]
    pub control_port: Option<u16>,
    /// Initial joint positions, rad
    #[arg(long, value_parser = numbers::<6>, value_name = "Q1,..,Q6", allow_hyphen_values = true)]
    pub start_joints: Option<[f64; 6]>,
    /// Calibrated DH parameters of the unit: a TOML file with a table dh of a, d, alpha and theta
    #[arg(long, value_name = "FILE")]
    pub kinematics: Option<PathBuf>,
    /// Control rate; by default that of the model
    #[arg(long, value_name = "HZ")]
    pub rate: Option<f64>,
    /// Joint speed (rad/s) and acceleration (rad/s^2) that the client must not exceed
    #[arg(long, value_parser = numbers::<2>, value_name = "V,A")]
    pub limits: Option<[f64; 2]>,
    /// Start with the arm powered off
    #[arg(long)]
    pub powered_off: bool,
    /// Duration of powering on and of releasing the brakes, each
    #[arg(long, default_value_t = 1.0, value_name = "S")]
    pub power_time: f64,
    /// Controller time at the start
    #[arg(long, default_value_t = 60.0, value_name = "S")]
    pub clock: f64,
    /// Serial number
    #[arg(long, default_value = "20245500001")]
    pub serial: String,
    /// Directory in which `load NAME.urp` finds NAME.script
    #[arg(long, value_name = "DIR")]
    pub programs: Option<PathBuf>,
    /// Exit when standard input is closed, so that no mock outlives the test that started it
    #[arg(long)]
    pub exit_with_stdin: bool,
    /// Exit after this many seconds at the latest
    #[arg(long, value_name = "S")]
    pub max_seconds: Option<f64>,
}

/// Why the mock did not start.
#[derive(Debug, thiserror::Error)]
enum StartError {
    #[error(transparent)]
    Model(#[from] crate::plant::UnknownModel),
    #[error(transparent)]
    Kinematics(#[from] crate::plant::KinematicsFileError),
    #[error(transparent)]
    Listen(#[from] super::server::ListenError),
    #[error("--start-joints: {0} rad is outside the arm's joint range")]
    Joint(f64),
    #[error("--rate {0}: expected 50 to 1000 Hz")]
    Rate(f64),
    #[error("--limits {0},{1}: joint speed and acceleration must be above zero")]
    Limits(f64, f64),
    #[error("--record {0}: {1}")]
    Record(PathBuf, std::io::Error),
    #[error("cannot catch signals: {0}")]
    Signals(std::io::Error),
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
            // Help and version also arrive here; clap prints them to standard output.
            let _ = e.print();
            return e.exit_code();
        }
    };
    match run(&args) {
        Ok(()) => 0,
        Err(e) => {
            let _ = writeln!(std::io::stderr(), "graspd-mock-ur: {e}");
            2
        }
    }
}

fn setup(args: &Args) -> Result<Setup, StartError> {
    let model = Model::by_name(&args.model)?;
    let mut setup = Setup::new(model);
    if let Some(path) = &args.kinematics {
        setup.kinematics = Kinematics::from_file(path)?;
    }
    if let Some(q) = &args.start_joints {
        let limit = model.position_limit();
        if let Some((_, bad)) = q.iter().enumerate().find(|(i, v)| !v.is_finite() || v.abs() >= limit[*i]) {
            return Err(StartError::Joint(*bad));
        }
        setup.start_joints = *q;
    }
    if let Some(rate) = args.rate {
        if !(50.0..=1000.0).contains(&rate) {
            return Err(StartError::Rate(rate));
        }
        setup.rate_hz = rate;
    }
    if args.powered_off {
        setup.start_mode = RobotMode::PowerOff;
    }
    setup.power_time_s = args.power_time.clamp(0.0, 600.0);
    setup.start_clock_s = if args.clock.is_finite() { args.clock } else { 60.0 };
    setup.serial.clone_from(&args.serial);
    setup.programs.clone_from(&args.programs);
    Ok(setup)
}

fn run(args: &Args) -> Result<(), StartError> {
    let setup = setup(args)?;
    let limits = match args.limits {
        Some([v, a]) if v > 0.0 && a > 0.0 => Some((v, a)),
        Some([v, a]) => return Err(StartError::Limits(v, a)),
        None => None,
    };
    let recorder = match &args.record {
        Some(path) => Some(Recorder::create(path).map_err(|e| StartError::Record(path.clone(), e))?),
        None => None,
    };
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGTERM, signal_hook::consts::SIGINT] {
        signal_hook::flag::register(signal, Arc::clone(&stop)).map_err(StartError::Signals)?;
    }
    if args.exit_with_stdin {
        let stop = Arc::clone(&stop);
        std::thread::spawn(move || {
            let mut sink = [0; 256];
            while std::io::stdin().lock().read(&mut sink).is_ok_and(|n| n > 0) {}
            stop.store(true, Ordering::Relaxed);
        });
    }
    if let Some(seconds) = args.max_seconds {
        let stop = Arc::clone(&stop);
        std::thread::spawn(move || {
            std::thread::sleep(std::time::Duration::from_secs_f64(seconds.clamp(0.0, 1e6)));
            stop.store(true, Ordering::Relaxed);
        });
    }
    let world = World::new(Robot::new(setup), limits, recorder);
    let mut server = Server::bind(world, args.bind, args.port_offset, args.control_port)?;
    crate::host::prefer_this_thread(crate::host::CONTROLLER_FIFO, -15);
    announce(args, &server);
    server.run(&stop);
    conclude(server);
    Ok(())
}

/// Prints the ready line: everything that a test needs to connect.
fn announce(args: &Args, server: &Server) {
    let port = |n: u16| n.saturating_add(args.port_offset);
    let line = json!({
        "ready": true,
        "program": "graspd-mock-ur",
        "model": args.model,
        "address": args.bind,
        "dashboard": port(29999),
        "primary": port(30001),
        "secondary": port(30002),
        "realtime": port(30003),
        "rtde": port(30004),
        "interpreter": port(30020),
        "control": server.control_port(),
        "rate_hz": server.world.robot.setup.rate_hz,
        "pid": std::process::id(),
        "now_ns": now_ns(),
    });
    let mut out = std::io::stdout().lock();
    // Whoever started the mock may have closed its standard output.
    let _ = writeln!(out, "{line}").and_then(|()| out.flush());
}

/// Prints the summary line.
fn conclude(mut server: Server) {
    let summary = server.world.judge.summary();
    let recorder = server.world.recorder.take();
    let dropped = recorder.as_ref().map_or(0, |r| r.dropped);
    let written = recorder.map_or(Ok(()), Recorder::finish);
    let line = json!({
        "stopped": true,
        "summary": summary,
        "late_steps": server.late_steps,
        "record_blocks_dropped": dropped,
        "record_error": written.err().map(|e| e.to_string()),
    });
    let _ = writeln!(std::io::stdout().lock(), "{line}");
}
