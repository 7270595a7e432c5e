//! From configuration to the settings of the command cycle.

use super::raw::RawConfig;
use super::settings::Config;
use graspd_rt::arm::Dh;
use graspd_rt::cycle::{ConvergeSettings, CycleConfig, CycleSettings, TaskSettings, WatchSettings};
use graspd_rt::guard::LimitSettings;
use graspd_rt::online::path::PathSettings;
use graspd_rt::online::screw::{JacobianAt, LawSettings, ViewMode};

/// The limits as the file gives them.
pub(super) fn limit_settings(raw: &RawConfig) -> LimitSettings {
    LimitSettings {
        velocity_rad_per_s: raw.limits.joint_speed_rad_s,
        acceleration_rad_per_s2: raw.limits.joint_accel_rad_s2,
        jerk_rad_per_s3: raw.limits.joint_jerk_rad_s3,
        tcp_speed_m_per_s: raw.limits.tcp_speed_m_s,
        position_margin_rad: raw.limits.joint_margin_rad,
        ..LimitSettings::default()
    }
}

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
    let frame_period_ns = (1e9 / raw.vision.frame_rate_hz) as u64;
    // A host without real-time scheduling misses cycles as a matter of course: they are counted and said, and only a stall stops
    // the arm (the robot's own watchdog stands behind that).
    let strict = realtime && !raw.cycle.best_effort;
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
            limits: limit_settings(raw),
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
pub(super) fn outputs_word(set: &[u8], clear: &[u8]) -> u32 {
    let bits = |list: &[u8]| list.iter().fold(0u32, |word, o| word | 1 << (o & 15));
    (bits(set) | bits(clear)) << 16 | bits(set)
}

/// One image shows half of what two do.
fn min_points(both_views: usize, views: &str) -> u8 {
    let needed = if views == "stereo" { both_views } else { both_views.div_ceil(2) };
    u8::try_from(needed).unwrap_or(u8::MAX)
}
