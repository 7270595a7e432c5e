//! The range of every number in graspd.toml, and the outputs of the gripper.

use super::raw::RawConfig;
use crate::exit::Failure;
use graspd_rt::cycle::same_words;
use std::path::Path;

/// The error for a value: file, key, value, and what to write instead.
pub(super) fn bad(path: &Path, key: &str, value: &str, fix: &str) -> Failure {
    Failure::input(format!("{}: {key} = \"{value}\": {fix}", path.display()))
}

/// Checks every number: finite, and within what the arm, the host or the control law can do. The motion limits have a
/// check of their own.
pub(super) fn check_numbers(path: &Path, c: &RawConfig) -> Result<(), Failure> {
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
            "must be lower than loop.command_priority, so that tracking never delays the command cycle",
        ));
    }
    Ok(())
}

/// Output word of the control script: mask in the upper 16 bits, values in the lower 16.
pub(super) fn outputs_word(set: &[u8], clear: &[u8]) -> u32 {
    let bits = |list: &[u8]| list.iter().fold(0u32, |word, o| word | 1 << (o & 15));
    (bits(set) | bits(clear)) << 16 | bits(set)
}

/// Checks the outputs of the gripper: each exists and is listed once, and opening reverses closing.
pub(super) fn check_outputs(path: &Path, c: &RawConfig) -> Result<(), Failure> {
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
        let fix = "opening must clear an output that closing sets, or set one that it clears: otherwise nothing opens the \
                   fingers, and the outputs do not show whether they are closed";
        return Err(bad(path, "gripper.open_set", &format!("{:?}", g.open_set), fix));
    }
    if g.close_on_arrival && g.close_set.is_empty() && g.close_clear.is_empty() {
        let fix = "list the outputs that close the fingers in gripper.close_set or gripper.close_clear";
        return Err(bad(path, "gripper.close_on_arrival", "true", fix));
    }
    Ok(())
}
