//! The configuration of the link to a UR controller.

use super::settings::Config;
use crate::arm::UrConfig;

/// The control script refuses joint speeds above the guard's limit times this: room for rounding on the wire.
const SPEED_MARGIN: f64 = 1.02;
/// Acceleration of `speedj`, rad/s²: high enough that it follows every set-point within one step. The guard limits the
/// acceleration.
const SPEEDJ_ACCELERATION: f64 = 40.0;
/// Minimum deceleration of the script's own stops, rad/s².
const MIN_STOP_ACCELERATION: f64 = 4.0;

/// How the UR controller of this configuration is reached and used.
pub fn ur_config(config: &Config) -> UrConfig {
    let arm = &config.arm;
    UrConfig {
        port_offset: arm.port_offset,
        cycle_hz: config.threads.rate_hz,
        motion: arm.motion,
        speed_limits: arm.model.joints().map(|r| (config.limits.velocity_rad_per_s * SPEED_MARGIN).min(r.speed)),
        acceleration: SPEEDJ_ACCELERATION,
        stop_acceleration: config.limits.acceleration_rad_per_s2.max(MIN_STOP_ACCELERATION),
        watchdog_ms: arm.watchdog_ms,
        ..UrConfig::new(arm.address.clone(), arm.model)
    }
}
