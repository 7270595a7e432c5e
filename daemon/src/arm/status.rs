//! The controller's status numbers: what they mean, and which of them stop the arm.

/// Bits of `safety_status_bits` under which no program can run: protective, safeguard and emergency stops, violation,
/// fault.
pub const SAFETY_STOPPED_BITS: u32 = 0b111_1111_0100;

/// The text for a safety mode, as robot messages carry it.
pub fn safety_mode_text(mode: i32) -> &'static str {
    match mode {
        1 => "normal",
        2 => "reduced",
        3 => "protective stop",
        4 => "recovery mode: a joint is outside its limits",
        5 | 12 | 18 | 19 => "safeguard stop",
        6 | 15 | 20 => "emergency stop (system input)",
        7 => "emergency stop (button)",
        8 => "safety violation",
        9 => "fault of the safety system",
        10 => "validating joint identity",
        13 | 14 => "three-position enabling switch released",
        _ => "unknown safety mode",
    }
}

/// The text for `safety_status_bits`: the most severe bit that is set.
pub fn safety_bits_text(bits: u32) -> &'static str {
    let by_severity = [
        (9, "fault of the safety system"),
        (8, "safety violation"),
        (7, "emergency stop"),
        (6, "emergency stop (button)"),
        (5, "emergency stop (system input)"),
        (4, "safeguard stop"),
        (3, "recovery mode"),
        (2, "protective stop"),
        (10, "stopped for safety"),
        (1, "reduced"),
        (0, "normal"),
    ];
    by_severity.into_iter().find(|(bit, _)| bits >> bit & 1 == 1).map_or("unknown", |(_, text)| text)
}

/// The text for a robot mode.
pub fn robot_mode_text(mode: i32) -> &'static str {
    match mode {
        -1 => "no controller",
        0 => "disconnected",
        1 => "waits for the safety configuration to be confirmed",
        2 => "booting",
        3 => "power off",
        4 => "powering on",
        5 => "idle, brakes on",
        6 => "backdrive",
        graspd_rt::arm::ROBOT_MODE_RUNNING => "running",
        8 => "updating firmware",
        _ => "unknown",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_most_severe_safety_bit_is_named() {
        assert_eq!(safety_bits_text(0b1), "normal");
        assert_eq!(safety_bits_text(0b10), "reduced");
        assert_eq!(safety_bits_text(0b100), "protective stop");
        assert_eq!(safety_bits_text(1 << 10 | 1 << 7 | 1 << 6), "emergency stop");
        assert_eq!(safety_bits_text(0), "unknown");
    }

    #[test]
    fn normal_reduced_and_recovery_do_not_stop_the_arm_and_every_other_bit_does() {
        for bit in 0..=10 {
            assert_eq!(
                SAFETY_STOPPED_BITS >> bit & 1 == 1,
                ![0, 1, 3].contains(&bit),
                "{}",
                safety_bits_text(1 << bit)
            );
        }
    }
}
