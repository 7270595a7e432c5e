//! `graspd calibrate gripper` and `graspd calibrate record`.

use super::answer::finish;
use super::client_args::ClientArgs;
use crate::arm::read_identity;
use crate::config::ur_config;
use crate::config::{Config, Kinematics, LinkKind};
use crate::exit::{Exit, Failure};
use clap::Args;
use graspd_calib::calibrate::gripper::{Event, Recorder, Sample};
use graspd_calib::commands::calibrate::{GripperRequest, calibrate_gripper};
use graspd_calib::files::keep_apart;
use graspd_rt::arm::Dh;
use graspd_rt::geom::Pixel;
use graspd_shm::control::{TelemetrySample, TelemetrySubscriber};
use graspd_shm::create_node;
use serde_json::{Value, json};
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Poll period of the telemetry topic, which has 50 samples per second and buffers eight of them.
const POLL_PERIOD: Duration = Duration::from_millis(20);
/// Maximum time without a sample; after it the daemon is considered gone.
const MAX_SILENCE: Duration = Duration::from_secs(3);

/// `graspd calibrate gripper`.
#[derive(Debug, Args)]
pub struct CalibrateGripperArgs {
    /// Recording, written by `graspd calibrate record` or in the format of docs/CALIBRATION.md
    #[arg(long, value_name = "FILE.json")]
    pub data: PathBuf,
    /// Rig calibration that replaces the recording's own; its stated error is the prior
    #[arg(long, value_name = "rig.toml")]
    pub rig: Option<PathBuf>,
    /// Gripper file whose marks and mounting are replaced in --out [default: the one inside the recording]
    #[arg(long, value_name = "gripper.toml")]
    pub gripper: Option<PathBuf>,
    /// Required accuracy of the marks in the flange frame (one sigma), millimetres
    #[arg(long, value_name = "MM", default_value_t = 1.0)]
    pub tolerance_mm: f64,
    /// Output file of the calibrated gripper
    #[arg(long, value_name = "gripper.toml")]
    pub out: Option<PathBuf>,
    /// Output file of the refined rig, written if the images show an error of the rig
    #[arg(long, value_name = "rig.toml")]
    pub rig_out: Option<PathBuf>,
    /// Print one JSON object on the last line of standard output
    #[arg(long)]
    pub json: bool,
}

/// `graspd calibrate record`.
#[derive(Debug, Args)]
pub struct CalibrateRecordArgs {
    #[command(flatten)]
    #[allow(missing_docs)]
    pub client: ClientArgs,
    /// Output file of the recording; it is complete after every rest
    #[arg(long, value_name = "FILE.json")]
    pub out: PathBuf,
    /// Stop after this many rests
    #[arg(long, value_name = "N", default_value_t = 25)]
    pub rests: usize,
    /// Stop after this many seconds
    #[arg(long, value_name = "S", default_value_t = 3600.0)]
    pub seconds: f64,
    /// Accuracy of the mark positions in the gripper file (one sigma), millimetres [default: estimated]
    #[arg(long, value_name = "MM")]
    pub marks_mm: Option<f64>,
}

/// Runs `graspd calibrate gripper`.
pub(super) fn gripper(args: &CalibrateGripperArgs) -> Result<Exit, Failure> {
    let outputs = [("--out", args.out.as_deref()), ("--rig-out", args.rig_out.as_deref())];
    let inputs = [("--data", Some(args.data.as_path())), ("--rig", args.rig.as_deref())];
    keep_apart(&outputs, &inputs).map_err(|message| Failure { exit: Exit::Usage, message })?;
    let outcome = calibrate_gripper(&GripperRequest {
        data: args.data.clone(),
        rig: args.rig.clone(),
        gripper: args.gripper.clone(),
        tolerance_mm: args.tolerance_mm,
        out: args.out.clone(),
        rig_out: args.rig_out.clone(),
    });
    finish(args.json, outcome)
}

/// Runs `graspd calibrate record`.
pub(super) fn record(args: &CalibrateRecordArgs) -> Result<Exit, Failure> {
    let usage = |message: &str| Failure { exit: Exit::Usage, message: message.to_owned() };
    let path = args
        .client
        .config
        .as_deref()
        .ok_or_else(|| usage("--config is required: it names the cell, the arm, the rig and the gripper"))?;
    if !(args.seconds > 0.0 && args.seconds <= 86_400.0) || args.rests == 0 || args.rests > 2000 {
        return Err(usage("give --seconds above 0 and up to 86400, and --rests from 1 to 2000"));
    }
    if args.marks_mm.is_some_and(|v| !(0.0..=100.0).contains(&v)) {
        return Err(usage("give --marks-mm as a standard deviation from 0 to 100 millimetres"));
    }
    let config = Config::load(path)?;
    let (dh, source) = kinematics(&config)?;
    let node = create_node(&config.names, "graspd-calibrate-record").map_err(|e| Failure::link(e.to_string()))?;
    let topic = TelemetrySubscriber::new(&node).map_err(|e| Failure::link(e.to_string()))?;
    let ended = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
        signal_hook::flag::register(signal, Arc::clone(&ended)).map_err(|e| Failure::fault(e.to_string()))?;
    }
    print_line(
        args,
        &format!(
            "recording; kinematics: {source}. Move the arm by hand or pendant, and let it rest 1.5 s at each pose."
        ),
    );
    let mut recorder = Recorder::new(dh);
    let (start, mut heard) = (Instant::now(), Instant::now());
    while recorder.rests() < args.rests
        && start.elapsed().as_secs_f64() < args.seconds
        && !ended.load(Ordering::Relaxed)
    {
        while let Some(sample) = topic.next().map_err(|e| Failure::link(e.to_string()))? {
            heard = Instant::now();
            match recorder.offer(sample_of(&sample)) {
                Event::None => {}
                Event::Skipped(why) => print_line(args, &why),
                Event::Stored(n, [left, right]) => {
                    write(args, &config, &recorder)?;
                    print_line(args, &format!("rest {n} of {}: {left} marks left, {right} marks right", args.rests));
                }
            }
        }
        if heard.elapsed() > MAX_SILENCE {
            return Err(Failure::link(format!(
                "no telemetry for {} s; check that `graspd run` is running with this configuration; {} rests are in {}",
                MAX_SILENCE.as_secs(),
                recorder.rests(),
                args.out.display()
            )));
        }
        std::thread::sleep(POLL_PERIOD);
    }
    if args.client.json {
        let done = json!({ "rests": recorder.rests(), "out": args.out.display().to_string(), "kinematics": source });
        let _ = writeln!(std::io::stdout(), "{done}");
    }
    if recorder.rests() == 0 {
        return Err(Failure::refused("no rest was recorded with three marks in both images"));
    }
    print_line(
        args,
        &format!("{} rests; next: graspd calibrate gripper --data {}", recorder.rests(), args.out.display()),
    );
    Ok(Exit::Done)
}

fn print_line(args: &CalibrateRecordArgs, text: &str) {
    if !args.client.json {
        let _ = writeln!(std::io::stdout(), "{text}");
    }
}

/// The kinematics that the daemon uses, and their source.
fn kinematics(config: &Config) -> Result<(Dh, String), Failure> {
    match &config.arm.kinematics {
        Kinematics::File(path, dh) => Ok((**dh, path.display().to_string())),
        Kinematics::Controller if config.arm.link == LinkKind::Rtde => {
            let identity = read_identity(&ur_config(config)).map_err(|e| Failure::link(e.to_string()))?;
            Ok((identity.dh, "the controller's own calibration".to_owned()))
        }
        _ => Ok((
            config.arm.model.dh(),
            format!("published values of the {}, accurate to a few millimetres", config.arm.model.name()),
        )),
    }
}

fn sample_of(t: &TelemetrySample) -> Sample {
    let count = t.marks[0].len().min(t.mark_count as usize);
    let seen =
        |p: &[f32; 2]| (p[0].is_finite() && p[1].is_finite()).then(|| Pixel::new(f64::from(p[0]), f64::from(p[1])));
    let view = |v: usize| t.marks[v][..count].iter().map(seen).collect();
    Sample { time_s: t.stamp_ns as f64 * 1e-9, q: t.q, qd: t.qd, marks: [view(0), view(1)] }
}

/// Writes the recording so far to a temporary file and renames it.
fn write(args: &CalibrateRecordArgs, config: &Config, recorder: &Recorder) -> Result<(), Failure> {
    let stated: Value = args.marks_mm.map_or_else(|| json!({}), |mm| json!({ "mark_model_mm": mm }));
    let g = &config.gripper;
    let marks: Vec<_> = g.gripper.marks.iter().map(|m| m.position).collect();
    let assumed = Some(&g.gripper.flange_from_gripper);
    let text = recorder.to_json(&config.rig.rig, &marks, &g.to_toml(), assumed, stated).to_string();
    let mut part = args.out.as_os_str().to_owned();
    part.push(".part");
    let part = Path::new(&part);
    let done = std::fs::write(part, text).and_then(|()| std::fs::rename(part, &args.out));
    done.map_err(|e| Failure::input(format!("{}: cannot be written ({e}); choose another path", args.out.display())))
}
