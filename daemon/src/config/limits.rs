//! The motion limits of graspd.toml, built as the command cycle builds them, so that `graspd check` refuses what
//! `graspd run` would.

use super::ranges::bad;
use super::raw::RawLimits;
use crate::exit::Failure;
use graspd_rt::arm::Model;
use graspd_rt::guard::{LimitError, LimitSettings, Limits, StopFigures};
use std::path::Path;

/// The limits as the file gives them.
fn limit_settings(l: &RawLimits) -> LimitSettings {
    LimitSettings {
        velocity_rad_per_s: l.joint_speed_rad_s,
        acceleration_rad_per_s2: l.joint_accel_rad_s2,
        jerk_rad_per_s3: l.joint_jerk_rad_s3,
        tcp_speed_m_per_s: l.tcp_speed_m_s,
        position_margin_rad: l.joint_margin_rad,
        ..LimitSettings::default()
    }
}

/// Builds the limits; gives their settings and the stop from full speed that they allow.
///
/// # Errors
/// See [`limit_failure`].
pub(super) fn load_limits(
    path: &Path,
    limits: &RawLimits,
    model: Model,
    period_ns: u64,
) -> Result<(LimitSettings, StopFigures), Failure> {
    let settings = limit_settings(limits);
    match Limits::new(&settings, model, period_ns) {
        Ok(limits) => Ok((settings, limits.stop_figures())),
        Err(e) => Err(limit_failure(path, &settings, &e)),
    }
}

/// A limit that the command cycle refuses, under the key that the file has for it.
pub fn limit_failure(path: &Path, settings: &LimitSettings, e: &LimitError) -> Failure {
    let (what, unit, scale) = match e.key {
        "stop.time_s" => ("takes", "ms", 1e3),
        "stop.joint_rad" => ("turns a joint by", "degrees", 180.0 / std::f64::consts::PI),
        "stop.tcp_m" => ("moves the gripper by", "mm", 1e3),
        _ => {
            let fix = format!("must lie between {} and {} for this arm", e.lowest, e.highest);
            return bad(path, file_key(e.key), &e.value.to_string(), &fix);
        }
    };
    Failure::input(format!(
        "{}: [limits]: a stop from full speed {what} {:.1} {unit}, the maximum is {:.1} {unit}: raise joint_accel_rad_s2 ({}) or \
         joint_jerk_rad_s3 ({}), or lower joint_speed_rad_s ({}) or tcp_speed_m_s ({})",
        path.display(),
        e.value * scale,
        e.highest * scale,
        settings.acceleration_rad_per_s2,
        settings.jerk_rad_per_s3,
        settings.velocity_rad_per_s,
        settings.tcp_speed_m_per_s
    ))
}

/// The key of graspd.toml from which a setting of the limits comes.
fn file_key(setting: &'static str) -> &'static str {
    match setting {
        "period_s" => "loop.rate_hz",
        "velocity_rad_per_s" => "limits.joint_speed_rad_s",
        "acceleration_rad_per_s2" => "limits.joint_accel_rad_s2",
        "jerk_rad_per_s3" => "limits.joint_jerk_rad_s3",
        "tcp_speed_m_per_s" => "limits.tcp_speed_m_s",
        "position_margin_rad" | "position_min_rad" | "position_max_rad" => "limits.joint_margin_rad",
        other => other,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refused(change: impl FnOnce(&mut RawLimits)) -> String {
        let mut limits = RawLimits::default();
        change(&mut limits);
        load_limits(Path::new("graspd.toml"), &limits, Model::Ur5e, 2_000_000).unwrap_err().message
    }

    #[test]
    fn the_defaults_are_valid_for_every_model() {
        for model in Model::ALL {
            load_limits(Path::new("graspd.toml"), &RawLimits::default(), model, 2_000_000).unwrap();
        }
    }

    #[test]
    fn every_refused_limit_is_named_by_its_key_in_the_file() {
        let message = refused(|l| l.joint_speed_rad_s = 3.0);
        assert!(
            message.contains("graspd.toml: limits.joint_speed_rad_s = \"3\"") && message.contains("1.6"),
            "{message}"
        );
        assert!(refused(|l| l.joint_accel_rad_s2 = f64::NAN).contains("limits.joint_accel_rad_s2"));
        assert!(refused(|l| l.joint_jerk_rad_s3 = 0.1).contains("limits.joint_jerk_rad_s3"));
        assert!(refused(|l| l.tcp_speed_m_s = 0.6).contains("limits.tcp_speed_m_s"));
        assert!(refused(|l| l.joint_margin_rad = -0.1).contains("limits.joint_margin_rad"));
        assert!(refused(|l| l.joint_margin_rad = 1e9).contains("limits.joint_margin_rad"));
        assert!(refused(|l| l.joint_accel_rad_s2 = 0.1).contains("joint_accel_rad_s2 (0.1)"));
    }
}
