//! The command line of `graspd-scene`.

use crate::numbers::numbers;
use crate::scenario::Options;
use clap::Parser;
use std::path::PathBuf;

/// Two simulated cameras: renders valve, gripper and marks for the arm's true joints and publishes stereo pairs like a camera driver.
///
/// The arm's joints come from a UR controller (or the mock) as a second, read-only RTDE client. When images flow it prints one
/// line of JSON. It takes lines of JSON on standard input (and on --control-port): {"ask":"truth"}, {"ask":"status"},
/// {"fault":"freeze"}, {"ask":"faults"}, {"clear":true}, {"quit":true}.
#[derive(Parser, Debug, Clone)]
#[command(name = "graspd-scene", version)]
pub struct Args {
    /// Folder of the world to show
    #[arg(long, value_name = "DIR", conflicts_with = "seed")]
    pub world: Option<PathBuf>,
    /// Draw a world instead of reading one
    #[arg(long, value_name = "N")]
    pub seed: Option<u64>,
    /// Write the drawn world into this folder and end
    #[arg(long, value_name = "DIR", requires = "seed")]
    pub make_world: Option<PathBuf>,
    /// Write left.png and right.png of the start into this folder and end
    #[arg(long, alias = "pictures", value_name = "DIR")]
    pub images: Option<PathBuf>,
    /// RTDE port of the controller whose arm is shown
    #[arg(long, value_name = "HOST:PORT", conflicts_with = "joints")]
    pub rtde: Option<String>,
    /// Show the arm at these joints (rad) instead; without this and --rtde, at the world's start
    #[arg(long, value_parser = numbers::<6>, value_name = "Q1,..,Q6", allow_hyphen_values = true)]
    pub joints: Option<[f64; 6]>,
    /// Stereo pairs a second
    #[arg(long, default_value_t = 60.0, value_name = "HZ")]
    pub rate: f64,
    /// Time from mid-exposure to the start of rendering, ms: what exposure and read-out take
    #[arg(long, default_value_t = 3.0, value_name = "MS")]
    pub latency_ms: f64,
    /// Root folder of the shared memory; as in graspd.toml
    #[arg(long, value_name = "DIR")]
    pub shm_root: Option<PathBuf>,
    /// Prefix of the shared memory; as in graspd.toml
    #[arg(long, value_name = "NAME")]
    pub shm_prefix: Option<String>,
    /// Cell whose topic is published
    #[arg(long, default_value = "default")]
    pub cell: String,
    /// Digital output that closes the gripper
    #[arg(long, default_value_t = 0, value_name = "BIT")]
    pub close_output: u32,
    /// A fault from the start on, as JSON; may be given several times
    #[arg(long, value_name = "JSON")]
    pub fault: Vec<String>,
    /// Take the same JSON lines on this TCP port of 127.0.0.1; 0 picks a free one
    #[arg(long, value_name = "PORT")]
    pub control_port: Option<u16>,
    /// End when standard input ends
    #[arg(long)]
    pub exit_with_stdin: bool,
    /// Live on when the process that started this one ends
    #[arg(long)]
    pub detach: bool,
    /// End after so many seconds at the latest
    #[arg(long, value_name = "S")]
    pub max_seconds: Option<f64>,
    /// With --seed: error of each DH length and angle that graspd is told, mm and degrees
    #[arg(long, value_parser = numbers::<2>, value_name = "MM,DEG", allow_hyphen_values = true)]
    pub kinematics_error: Option<[f64; 2]>,
    /// With --seed: error of focal length and relative rotation of the rig that graspd is told, per cent and degrees
    #[arg(long, value_parser = numbers::<2>, value_name = "PERCENT,DEG", allow_hyphen_values = true)]
    pub rig_error: Option<[f64; 2]>,
    /// With --seed: hidden part of the rim, per cent
    #[arg(long, default_value_t = 0.0, value_name = "PERCENT")]
    pub rim_occlusion: f64,
    /// With --seed: factor on the sensor's noise
    #[arg(long, default_value_t = 1.0)]
    pub noise: f64,
    /// With --seed: a bare wheel without the painted circle
    #[arg(long)]
    pub bare_wheel: bool,
}

impl Args {
    /// What a world is drawn with.
    pub(super) fn options(&self) -> Options {
        let mut o = Options { noise: self.noise, rim_occlusion: self.rim_occlusion / 100.0, ..Default::default() };
        if let Some([mm, deg]) = self.kinematics_error {
            (o.kinematics_error_mm, o.kinematics_error_deg) = (mm, deg);
        }
        if let Some([percent, deg]) = self.rig_error {
            (o.focal_error, o.rotation_error_deg) = (percent / 100.0, deg);
        }
        if self.bare_wheel {
            o.paint_width_m = 0.0;
        }
        o
    }
}
