//! The control script: rendering, upload, stop.

use std::io::{Read, Write};
use std::time::Duration;

use super::dashboard::Dashboard;
use super::ur_config::{ArmError, Port, UrConfig};

/// The script with its {{...}} placeholders; docs/RTDE-REGISTERS.md describes it.
const TEMPLATE: &str = include_str!("../../dist/graspd_control.script");

/// Maximum distance of a joint target from the joint in position mode, rad: the lag of `servoj` at full speed, with a
/// margin.
const MAX_POSITION_STEP_RAD: f64 = 0.25;

/// Time that a new script waits for the command thread, s.
const HANDSHAKE_S: f64 = 10.0;

/// Renders the control script. `step_s` is the controller's step: 0.002 s on e-Series, 0.008 s on CB3.
///
/// # Errors
/// A limit that is NaN, not positive or above its maximum: the script would use it unchecked.
pub fn render(config: &UrConfig, token: i32, step_s: f64) -> Result<String, ArmError> {
    let positive = |key, value: f64, max: f64| {
        if value > 0.0 && value <= max {
            Ok(value)
        } else {
            Err(ArmError::Setting { key, value, fix: "must be positive and within the arm's own limit" })
        }
    };
    for (limit, range) in config.speed_limits.iter().zip(config.model.joints()) {
        positive("speed limit", *limit, range.speed + 1e-9)?;
    }
    positive("acceleration", config.acceleration, 40.0)?;
    positive("stop acceleration", config.stop_acceleration, 40.0)?;
    positive("loop.rate_hz", config.cycle_hz, 1000.0)?;
    positive("arm.watchdog_ms", config.watchdog_ms, 1000.0)?;
    // The script's heartbeat timeout ends before the controller's watchdog, and not before two and a half cycles of a
    // slow loop.
    let patience_s = (0.8e-3 * config.watchdog_ms).max(2.5 / config.cycle_hz);
    let watchdog_s = (config.watchdog_ms * 1e-3).max(patience_s + 2.0 * step_s);
    let limits: Vec<String> = config.speed_limits.iter().map(|v| format!("{v:.6}")).collect();
    let filled = [
        ("{{TOKEN}}", token.to_string()),
        ("{{SPEED_LIMITS}}", format!("[{}]", limits.join(", "))),
        ("{{ACCELERATION_LIMIT}}", format!("{:.6}", config.acceleration)),
        ("{{STOP_ACCELERATION}}", format!("{:.6}", config.stop_acceleration)),
        ("{{POSITION_STEP}}", format!("{MAX_POSITION_STEP_RAD:.6}")),
        ("{{PATIENCE_STEPS}}", format!("{}", (patience_s / step_s).ceil() as u32)),
        ("{{HANDSHAKE_STEPS}}", format!("{}", (HANDSHAKE_S / step_s).ceil() as u32)),
        ("{{WATCHDOG_HZ}}", format!("{:.3}", 1.0 / watchdog_s)),
        ("{{LOOKAHEAD}}", "0.03".to_owned()),
        ("{{GAIN}}", "1000".to_owned()),
    ];
    Ok(filled.into_iter().fold(TEMPLATE.to_owned(), |text, (key, value)| text.replace(key, &value)))
}

/// Uploads the control script to the secondary interface. It replaces a running program and waits for the command
/// thread's handshake; the arm does not move.
///
/// # Errors
/// No connection, local control, or a setting that is out of range.
pub fn start_script(config: &UrConfig, token: i32, step_s: f64) -> Result<(), ArmError> {
    let text = render(config, token, step_s)?;
    // In local control an e-Series accepts the bytes and drops them. CB3 does not know the command; a controller
    // without a dashboard (PolyScope X) cannot be asked.
    if let Ok(mut dashboard) = Dashboard::open(config)
        && dashboard.ask("is in remote control").is_ok_and(|answer| answer.trim().eq_ignore_ascii_case("false"))
    {
        return Err(ArmError::LocalControl);
    }
    upload(config, &text)
}

/// Stops the running program by replacing it with one that only stops the joints.
///
/// # Errors
/// No connection.
pub fn stop_script(config: &UrConfig) -> Result<(), ArmError> {
    upload(config, &format!("def graspd_stop():\n  stopj({:.3})\nend\n", config.stop_acceleration))
}

/// Sends a script. The connection is read for up to 0.3 s before it is closed: closing with unread data in the receive
/// buffer resets it, and the reset can discard the script.
fn upload(config: &UrConfig, text: &str) -> Result<(), ArmError> {
    let fail = |source| ArmError::Io { service: Port::Secondary, source };
    let mut stream = config.open(Port::Secondary)?;
    stream.write_all(text.as_bytes()).map_err(fail)?;
    // The controller ignores a last line without a line end.
    stream.write_all(b"\n").map_err(fail)?;
    stream.shutdown(std::net::Shutdown::Write).map_err(fail)?;
    stream.set_read_timeout(Some(Duration::from_millis(100))).map_err(fail)?;
    let mut sink = [0u8; 4096];
    for _ in 0..3 {
        if !matches!(stream.read(&mut sink), Ok(n) if n > 0) {
            break;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use graspd_rt::arm::Model;

    #[test]
    fn every_placeholder_is_replaced() {
        let text = render(&UrConfig::new("localhost", Model::Ur5e), 77, 0.002).unwrap();
        assert!(!text.replace("The daemon fills in the {{...}}", "").contains("{{"), "{text}");
        assert!(text.contains("TOKEN = 77") && text.contains("PATIENCE_STEPS = 20"));
        assert!(text.contains("rtde_set_watchdog(\"input_int_register_25\", 20.000, \"stop\")"));
        assert!(text.is_ascii() && !text.contains('\t'));
    }

    #[test]
    fn a_slow_loop_gets_a_longer_heartbeat_timeout_and_a_later_watchdog() {
        let config = UrConfig { cycle_hz: 50.0, ..UrConfig::new("localhost", Model::Ur5) };
        let text = render(&config, 1, 0.008).unwrap();
        assert!(text.contains("PATIENCE_STEPS = 7"));
        assert!(text.contains("15.152"), "watchdog at the heartbeat timeout and two steps");
    }

    #[test]
    fn invalid_limits_are_refused() {
        for bad in [f64::NAN, 0.0, -1.0, f64::INFINITY, 4.0] {
            let mut config = UrConfig::new("localhost", Model::Ur5e);
            config.speed_limits[2] = bad;
            assert!(matches!(render(&config, 1, 0.002), Err(ArmError::Setting { .. })), "{bad}");
        }
    }
}
