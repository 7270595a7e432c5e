//! The command line of `graspd-scene`.

use crate::numbers::numbers;
use crate::scenario::Options;
use clap::Parser;
use std::path::PathBuf;

/// Two simulated cameras: renders valve, gripper and marks for the arm's joints and publishes stereo pairs as a camera
/// driver does.
///
/// It reads the joints from a UR controller (or the mock) as a second, read-only RTDE client. It prints one line of
/// JSON once images are published. It accepts lines of JSON on standard input (and on --control-port): {"ask":"truth"},
/// {"ask":"status"}, {"fault":"freeze"}, {"ask":"faults"}, {"clear":true}, {"quit":true}.
#[derive(Parser, Debug, Clone)]
#[command(name = "graspd-scene", version)]
pub struct Args {
    /// Folder of the world to render
    #[arg(long, value_name = "DIR", conflicts_with = "seed")]
    pub world: Option<PathBuf>,
    /// Draw a random world instead of reading one
    #[arg(long, value_name = "N")]
    pub seed: Option<u64>,
    /// Write the drawn world into this folder and exit
    #[arg(long, value_name = "DIR", requires = "seed")]
    pub make_world: Option<PathBuf>,
    /// Write left.png and right.png of the start pose into this folder and exit
    #[arg(long, alias = "pictures", value_name = "DIR")]
    pub images: Option<PathBuf>,
    /// RTDE port of the controller whose arm is rendered
    #[arg(long, value_name = "HOST:PORT", conflicts_with = "joints")]
    pub rtde: Option<String>,
    /// Render the arm at these joints (rad); without this option and --rtde at the world's start joints
    #[arg(long, value_parser = numbers::<6>, value_name = "Q1,..,Q6", allow_hyphen_values = true)]
    pub joints: Option<[f64; 6]>,
    /// Stereo pairs per second
    #[arg(long, default_value_t = 60.0, value_name = "HZ")]
    pub rate: f64,
    /// Time from mid-exposure to the start of rendering, ms: exposure and read-out
    #[arg(long, default_value_t = 3.0, value_name = "MS")]
    pub latency_ms: f64,
    /// Root folder of the shared memory, as in graspd.toml
    #[arg(long, value_name = "DIR")]
    pub shm_root: Option<PathBuf>,
    /// Prefix of the shared memory, as in graspd.toml
    #[arg(long, value_name = "NAME")]
    pub shm_prefix: Option<String>,
    /// Cell name, part of the topic
    #[arg(long, default_value = "default")]
    pub cell: String,
    /// Digital output that closes the gripper
    #[arg(long, default_value_t = 0, value_name = "BIT")]
    pub close_output: u32,
    /// A fault that is active from the start, as JSON; may be repeated
    #[arg(long, value_name = "JSON")]
    pub fault: Vec<String>,
    /// Accept the same JSON lines on this TCP port of 127.0.0.1; 0 picks a free port
    #[arg(long, value_name = "PORT")]
    pub control_port: Option<u16>,
    /// Exit when standard input is closed
    #[arg(long)]
    pub exit_with_stdin: bool,
    /// Keep running when the parent process ends
    #[arg(long)]
    pub detach: bool,
    /// Exit after this many seconds at the latest
    #[arg(long, value_name = "S")]
    pub max_seconds: Option<f64>,
    /// With --seed: error of each DH length and angle that graspd is given, mm and degrees
    #[arg(long, value_parser = numbers::<2>, value_name = "MM,DEG", allow_hyphen_values = true)]
    pub kinematics_error: Option<[f64; 2]>,
    /// With --seed: error of focal length and relative rotation of the rig that graspd is given, percent and degrees
    #[arg(long, value_parser = numbers::<2>, value_name = "PERCENT,DEG", allow_hyphen_values = true)]
    pub rig_error: Option<[f64; 2]>,
    /// With --seed: occluded part of the rim, percent
    #[arg(long, default_value_t = 0.0, value_name = "PERCENT")]
    pub rim_occlusion: f64,
    /// With --seed: factor of the sensor noise
    #[arg(long, default_value_t = 1.0)]
    pub noise: f64,
    /// With --seed: a bare wheel without painted circle
    #[arg(long)]
    pub bare_wheel: bool,
}

impl Args {
    /// Options for drawing a world.
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
