//! From configuration to the settings of the command cycle.

use super::settings::Config;
use crate::exit::Failure;
use graspd_rt::arm::{Dh, Model};
use graspd_rt::cycle::{ConvergeSettings, CycleConfig, CycleSettings, TaskSettings, WatchSettings};
use graspd_rt::guard::LimitSettings;
use graspd_rt::online::path::PathSettings;
use graspd_rt::online::screw::{JacobianAt, LawSettings, ViewMode};
use std::path::Path;

/// The command cycle's configuration, for an arm with these kinematics on a host that is real-time or not.
pub fn cycle_config(c: &Config, dh: Dh, realtime: bool) -> CycleConfig {
    let raw = &c.raw;
    let law = LawSettings {
        views: match raw.servo.views.as_str() {
            "left" => ViewMode::Left,
            "right" => ViewMode::Right,
            "best" => ViewMode::Best,
            _ => ViewMode::Stereo,
        },
        jacobian: match raw.servo.jacobian.as_str() {
            "current" => JacobianAt::Current,
            "desired" => JacobianAt::SetPoint,
            _ => JacobianAt::Mean,
        },
        gain_far_per_s: raw.servo.gain,
        gain_near_per_s: raw.servo.gain_near,
        min_points: min_points(raw.vision.min_observations, &raw.servo.views),
        ..LawSettings::default()
    };
    let limits = LimitSettings {
        velocity_rad_per_s: raw.limits.joint_speed_rad_s,
        acceleration_rad_per_s2: raw.limits.joint_accel_rad_s2,
        jerk_rad_per_s3: raw.limits.joint_jerk_rad_s3,
        tcp_speed_m_per_s: raw.limits.tcp_speed_m_s,
        position_margin_rad: raw.limits.joint_margin_rad,
        ..LimitSettings::default()
    };
    let frame_period_ns = (1e9 / raw.vision.frame_rate_hz) as u64;
    // A host without real-time scheduling misses beats as a matter of course: they are counted and said, and only a stall stops
    // the arm (the robot's own watchdog stands behind that).
    let strict = realtime && !raw.beat.best_effort;
    let mut watch = if strict { WatchSettings::default() } else { WatchSettings::best_effort() };
    // One package that a slow controller leaves out must not be a stale state.
    if !c.model.is_e_series() {
        watch.state_age_ns = watch.state_age_ns.max(28_000_000);
    }
    watch.skew_ns = (raw.vision.max_skew_ms * 1e6) as u64;
    CycleConfig {
        model: c.model,
        dh,
        rig: c.rig.rig,
        gripper: c.gripper.gripper.clone(),
        settings: CycleSettings {
            period_ns: c.period_ns(),
            frame_period_ns,
            law,
            path: PathSettings {
                speed_m_per_s: raw.servo.path_speed_m_s,
                turn_rad_per_s: raw.servo.path_speed_rad_s,
                ..PathSettings::default()
            },
            limits,
            converge: ConvergeSettings {
                position_m: raw.converged.distance_m,
                angle_rad: raw.converged.angle_rad,
                error_px: raw.converged.error_px,
                frames: raw.converged.frames,
                ..ConvergeSettings::default()
            },
            watch,
            task: TaskSettings {
                close_outputs: outputs_word(&raw.gripper.close_set, &raw.gripper.close_clear),
                open_outputs: outputs_word(&raw.gripper.open_set, &raw.gripper.open_clear),
                grip_ns: (raw.gripper.time_ms * 1e6) as u64,
                close_on_arrival: raw.gripper.close_on_arrival,
                ..TaskSettings::default()
            },
            ..CycleSettings::default()
        },
    }
}

/// The outputs word of the control script: mask in the upper 16 bits, values in the lower.
fn outputs_word(set: &[u8], clear: &[u8]) -> u32 {
    let bits = |list: &[u8]| list.iter().fold(0u32, |word, o| word | 1 << (o & 15));
    (bits(set) | bits(clear)) << 16 | bits(set)
}

#[derive(serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct KinematicsFile {
    /// The model that the table belongs to; compared with the configuration's where it is given.
    model: Option<String>,
    dh: DhTable,
}

#[derive(serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct DhTable {
    a: [f64; 6],
    d: [f64; 6],
    alpha: [f64; 6],
    theta: [f64; 6],
}

/// Reads an arm's Denavit-Hartenberg table: `[dh]` with `a`, `d` (m), `alpha`, `theta` (rad), six numbers each, and optionally the
/// `model` that it belongs to.
///
/// # Errors
/// Names the file, the key and the fix; another model's table is refused.
pub fn load_kinematics(path: &Path, model: Model) -> Result<Dh, Failure> {
    let shown = path.display();
    let text = std::fs::read_to_string(path).map_err(|e| {
        Failure::input(format!(
            "{shown}: cannot be read ({e}); arm.kinematics must be \"controller\", \"nominal\" or a file"
        ))
    })?;
    let file: KinematicsFile = toml::from_str(&text).map_err(|e| {
        Failure::input(format!("{shown}: {e}\nExpected a table [dh] with a, d, alpha, theta of six numbers each."))
    })?;
    if let Some(other) = file.model.filter(|m| m != model.name()) {
        return Err(Failure::input(format!(
            "{shown}: model = \"{other}\", but arm.model is \"{}\": give the kinematics of this arm",
            model.name()
        )));
    }
    let t = file.dh;
    for (name, values, limit) in [("a", t.a, 3.0), ("d", t.d, 3.0), ("alpha", t.alpha, 7.0), ("theta", t.theta, 7.0)] {
        for (i, v) in values.iter().enumerate() {
            if !(v.is_finite() && v.abs() <= limit) {
                return Err(Failure::input(format!(
                    "{shown}: dh.{name}[{i}] = {v} is no arm's; it must lie within {limit} of zero"
                )));
            }
        }
    }
    Ok(Dh { a: t.a, d: t.d, alpha: t.alpha, theta: t.theta })
}

/// One picture shows half of what two do.
fn min_points(both_views: usize, views: &str) -> u8 {
    let needed = if views == "stereo" { both_views } else { both_views.div_ceil(2) };
    u8::try_from(needed).unwrap_or(u8::MAX)
}
