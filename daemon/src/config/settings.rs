//! From the file's text to values that are valid.

use super::cycle::{limit_settings, outputs_word};
use super::kinematics::load_kinematics;
use super::raw::RawConfig;
use crate::exit::Failure;
use graspd_calib::files::{ContentHash, GripperFile, RigFile};
use graspd_rt::arm::{Dh, Model};
use graspd_rt::cycle::same_words;
use graspd_rt::guard::{Limits, StopFigures};
use graspd_shm::Names;
use std::path::{Path, PathBuf};

/// Which arm.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LinkKind {
    /// A UR controller over RTDE.
    Rtde,
    /// The arm inside the daemon.
    Mock,
}

/// Where the arm's kinematics come from.
#[derive(Clone, Debug, PartialEq)]
pub enum Kinematics {
    /// The controller's own calibration, read from its primary interface.
    Controller,
    /// The model's published values.
    Nominal,
    /// A file, read and held against the model.
    File(PathBuf, Box<Dh>),
}

/// A configuration in which every value is in range and every named file was read.
#[derive(Clone, Debug)]
pub struct Config {
    /// The file's values; all numbers are checked.
    pub raw: RawConfig,
    /// Names of the shared-memory services.
    pub names: Names,
    /// The rig.
    pub rig: RigFile,
    /// The gripper.
    pub gripper: GripperFile,
    /// Which arm.
    pub link: LinkKind,
    /// Which model.
    pub model: Model,
    /// Where its kinematics come from.
    pub kinematics: Kinematics,
    /// How a stop from full speed goes.
    pub stop: StopFigures,
    /// Every file that was read, as it was read.
    pub files: Vec<ReadFile>,
}

/// A file that the configuration consists of, by its name and what it held.
#[derive(Clone, Debug, PartialEq)]
pub struct ReadFile {
    /// Its path.
    pub path: PathBuf,
    /// Hash of its bytes; `None` where they could not be read a second time.
    pub hash: Option<ContentHash>,
}

impl ReadFile {
    fn of(path: PathBuf) -> Self {
        let hash = std::fs::read(&path).ok().map(|bytes| ContentHash::of(&bytes));
        Self { path, hash }
    }

    /// Whether the file holds something else now.
    pub fn changed(&self) -> bool {
        Self::of(self.path.clone()).hash != self.hash
    }
}

/// Shared-memory names of a cell under a root folder, or under the user's own.
///
/// # Errors
/// A cell name or folder that cannot be used.
pub fn names(cell: &str, root: Option<&Path>) -> Result<Names, Failure> {
    match root {
        // Two programs started in different folders must mean the same place.
        Some(root) => match full_path(root) {
            Ok(root) => Names::new(root, &Names::default_prefix(), cell),
            Err(e) => return Err(Failure::input(format!("shared-memory root {}: {e}", root.display()))),
        },
        None => Names::default_for_user(cell),
    }
    .map_err(|e| Failure::input(e.to_string()))
}

/// The path from the root of the file system, without `..`. The last name is left as it is, be it a link or not yet
/// there: whoever opens it judges it.
fn full_path(path: &Path) -> std::io::Result<PathBuf> {
    let path = std::path::absolute(path)?;
    let Some(last) = path.file_name() else { return Ok(path) };
    let mut missing = vec![last.to_owned()];
    let mut there = path.parent();
    while let Some(folder) = there {
        if let Ok(real) = folder.canonicalize() {
            return Ok(missing.into_iter().rev().fold(real, |all, name| all.join(name)));
        }
        missing.push(folder.file_name().unwrap_or_default().to_owned());
        there = folder.parent();
    }
    Ok(path)
}

impl Config {
    /// Reads and checks a configuration and every file it names.
    ///
    /// # Errors
    /// Names the file, the key, the value and the fix.
    pub fn load(path: &Path) -> Result<Self, Failure> {
        let shown = path.display();
        super::check_trust(path)?;
        let text = std::fs::read_to_string(path).map_err(|e| {
            Failure::input(format!("{shown}: cannot be read ({e}); docs/CONFIG.md has an example to start from"))
        })?;
        let mut raw: RawConfig = toml::from_str(&text)
            .map_err(|e| Failure::input(format!("{shown}: {e}\nSee docs/CONFIG.md for every key.")))?;
        let model = Model::from_name(&raw.arm.model).ok_or_else(|| {
            bad(path, "arm.model", &raw.arm.model, "use ur3, ur5, ur10, ur3e, ur5e, ur10e, ur16e, ur20 or ur30")
        })?;
        if raw.cycle.rate_hz == 0.0 {
            raw.cycle.rate_hz = controller_hz(model);
        }
        check_numbers(path, &raw)?;
        check_outputs(path, &raw)?;
        one_of(path, "loop.clock", &raw.cycle.clock, &["timer", "robot"])?;
        if raw.cycle.clock == "robot" && raw.cycle.rate_hz != controller_hz(model) {
            return Err(bad(
                path,
                "loop.rate_hz",
                &raw.cycle.rate_hz.to_string(),
                &format!(
                    "loop.clock = \"robot\" cycles as the controller does: leave loop.rate_hz out, or set {}",
                    controller_hz(model)
                ),
            ));
        }
        let folder = path.parent().unwrap_or(Path::new("."));
        let names = names(&raw.cell, raw.shm.root.as_deref().map(|r| folder.join(r)).as_deref())
            .map_err(|e| Failure::input(format!("{shown}: {e}")))?;
        for file in [&raw.files.rig, &raw.files.gripper] {
            super::check_trust(&folder.join(file))?;
        }
        let rig = RigFile::load(&folder.join(&raw.files.rig)).map_err(|e| Failure::input(e.to_string()))?;
        let gripper = GripperFile::load(&folder.join(&raw.files.gripper)).map_err(|e| Failure::input(e.to_string()))?;
        let link = match raw.arm.link.as_str() {
            "rtde" => LinkKind::Rtde,
            "mock" => LinkKind::Mock,
            other => return Err(bad(path, "arm.link", other, "use \"rtde\" or \"mock\"")),
        };
        let kinematics = match raw.arm.kinematics.as_str() {
            "controller" => Kinematics::Controller,
            "nominal" => Kinematics::Nominal,
            file => {
                let file = folder.join(file);
                super::check_trust(&file)?;
                let dh = Box::new(load_kinematics(&file, model)?);
                Kinematics::File(file, dh)
            }
        };
        one_of(path, "arm.motion", &raw.arm.motion, &["velocity", "position"])?;
        one_of(path, "servo.views", &raw.servo.views, &["stereo", "left", "right", "best"])?;
        one_of(path, "servo.jacobian", &raw.servo.jacobian, &["current", "desired", "mean"])?;
        let stop = check_limits(path, &raw, model)?;
        let mut files = vec![path.to_owned(), folder.join(&raw.files.rig), folder.join(&raw.files.gripper)];
        if let Kinematics::File(file, _) = &kinematics {
            files.push(file.clone());
        }
        let files = files.into_iter().map(ReadFile::of).collect();
        Ok(Self { raw, names, rig, gripper, link, model, kinematics, stop, files })
    }

    /// Period of the command thread's cycle, nanoseconds.
    pub fn period_ns(&self) -> u64 {
        period_ns(&self.raw)
    }
}

/// Steps a second of the controller that an arm of this model comes with.
fn controller_hz(model: Model) -> f64 {
    if model.is_e_series() { 500.0 } else { 125.0 }
}

fn period_ns(raw: &RawConfig) -> u64 {
    // check_numbers keeps the rate in 50..=1000 Hz.
    (1e9 / raw.cycle.rate_hz).round() as u64
}

/// The limits as the loop will build them: what it would refuse is refused here, by the keys of the file.
fn check_limits(path: &Path, raw: &RawConfig, model: Model) -> Result<StopFigures, Failure> {
    let e = match Limits::new(&limit_settings(raw), model, period_ns(raw)) {
        Ok(limits) => return Ok(limits.stop_figures()),
        Err(e) => e,
    };
    let key = match e.key {
        "velocity_rad_per_s" => "limits.joint_speed_rad_s",
        "acceleration_rad_per_s2" => "limits.joint_accel_rad_s2",
        "jerk_rad_per_s3" => "limits.joint_jerk_rad_s3",
        "tcp_speed_m_per_s" => "limits.tcp_speed_m_s",
        "position_margin_rad" | "position_min_rad" | "position_max_rad" => "limits.joint_margin_rad",
        "stop.time_s" | "stop.joint_rad" | "stop.tcp_m" => {
            let (what, unit, scale) = match e.key {
                "stop.time_s" => ("takes", "ms", 1e3),
                "stop.joint_rad" => ("turns a joint by", "degrees", 180.0 / std::f64::consts::PI),
                _ => ("moves the gripper by", "mm", 1e3),
            };
            let l = &raw.limits;
            return Err(Failure::input(format!(
                "{}: [limits]: a stop from full speed {what} {:.1} {unit}, at most {:.1} {unit} are allowed: raise joint_accel_rad_s2 \
                 ({}) or joint_jerk_rad_s3 ({}), or lower joint_speed_rad_s ({}) or tcp_speed_m_s ({})",
                path.display(),
                e.value * scale,
                e.highest * scale,
                l.joint_accel_rad_s2,
                l.joint_jerk_rad_s3,
                l.joint_speed_rad_s,
                l.tcp_speed_m_s
            )));
        }
        other => other,
    };
    let fix = format!("must lie between {} and {} for this arm", e.lowest, e.highest);
    Err(bad(path, key, &e.value.to_string(), &fix))
}

fn bad(path: &Path, key: &str, value: &str, fix: &str) -> Failure {
    Failure::input(format!("{}: {key} = \"{value}\": {fix}", path.display()))
}

fn one_of(path: &Path, key: &str, value: &str, allowed: &[&str]) -> Result<(), Failure> {
    if allowed.contains(&value) {
        return Ok(());
    }
    Err(bad(path, key, value, &format!("use one of: {}", allowed.join(", "))))
}

/// Outputs that exist, each once.
fn check_outputs(path: &Path, c: &RawConfig) -> Result<(), Failure> {
    let g = &c.gripper;
    let lists = [
        ("gripper.close_set", &g.close_set, &g.close_clear),
        ("gripper.close_clear", &g.close_clear, &g.close_set),
        ("gripper.open_set", &g.open_set, &g.open_clear),
        ("gripper.open_clear", &g.open_clear, &g.open_set),
    ];
    for (key, outputs, others) in lists {
        if let Some(wrong) = outputs.iter().find(|o| **o > 9 || others.contains(o)) {
            let fix = "use each output once: 0 to 7 are the controller's digital outputs, 8 and 9 the tool's";
            return Err(bad(path, key, &wrong.to_string(), fix));
        }
    }
    if same_words(outputs_word(&g.close_set, &g.close_clear), outputs_word(&g.open_set, &g.open_clear)) {
        let fix = "opening must take back an output that closing sets, or set one that it clears: otherwise nothing opens the \
                   fingers, and nobody can read back what they hold";
        return Err(bad(path, "gripper.open_set", &format!("{:?}", g.open_set), fix));
    }
    if g.close_on_arrival && g.close_set.is_empty() && g.close_clear.is_empty() {
        let fix = "name the outputs that close the fingers in gripper.close_set or gripper.close_clear";
        return Err(bad(path, "gripper.close_on_arrival", "true", fix));
    }
    Ok(())
}

/// Every number with its range: finite, and inside what the arm, the host or the law can do.
fn check_numbers(path: &Path, c: &RawConfig) -> Result<(), Failure> {
    let ranges: &[(&str, f64, f64, f64)] = &[
        ("arm.watchdog_ms", c.arm.watchdog_ms, 20.0, 200.0),
        ("loop.rate_hz", c.cycle.rate_hz, 50.0, 1000.0),
        ("loop.command_priority", f64::from(c.cycle.command_priority), 0.0, 98.0),
        ("loop.vision_priority", f64::from(c.cycle.vision_priority), 0.0, 97.0),
        ("loop.spin_us", c.cycle.spin_us, 0.0, 4000.0),
        ("vision.poll_us", c.vision.poll_us, 100.0, 20_000.0),
        ("vision.frame_rate_hz", c.vision.frame_rate_hz, 1.0, 1000.0),
        ("vision.max_skew_ms", c.vision.max_skew_ms, 0.0, 100.0),
        ("vision.min_observations", c.vision.min_observations as f64, 3.0, 64.0),
        ("servo.gain", c.servo.gain, 0.05, 20.0),
        ("servo.gain_near", c.servo.gain_near, 0.05, 20.0),
        ("servo.path_speed_m_s", c.servo.path_speed_m_s, 0.001, 1.0),
        ("servo.path_speed_rad_s", c.servo.path_speed_rad_s, 0.001, 3.0),
        ("converged.error_px", c.converged.error_px, 0.1, 50.0),
        ("converged.distance_m", c.converged.distance_m, 1e-5, 0.1),
        ("converged.angle_rad", c.converged.angle_rad, 1e-4, 0.5),
        ("converged.frames", f64::from(c.converged.frames), 1.0, 10_000.0),
        ("gripper.time_ms", c.gripper.time_ms, 0.0, 60_000.0),
    ];
    for (key, value, low, high) in ranges {
        if !(value.is_finite() && value >= low && value <= high) {
            return Err(bad(path, key, &value.to_string(), &format!("must lie between {low} and {high}")));
        }
    }
    if c.cycle.vision_priority >= c.cycle.command_priority && c.cycle.vision_priority > 0 {
        return Err(bad(
            path,
            "loop.vision_priority",
            &c.cycle.vision_priority.to_string(),
            "must lie below loop.command_priority, so that tracking never delays the arm's cycle",
        ));
    }
    Ok(())
}
