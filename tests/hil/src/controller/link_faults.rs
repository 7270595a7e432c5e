//! Faults of the wires, kept apart from those of the robot.

use std::collections::HashSet;

/// Answers of the RTDE server that differ on command (rows R09, R10, R11).
#[derive(Clone, Debug, Default)]
pub struct RtdeFaults {
    /// Protocol version 2 is refused.
    pub refuse_v2: bool,
    /// Inputs answered with `IN_USE`.
    pub in_use: HashSet<String>,
    /// Names answered with `NOT_FOUND`.
    pub not_found: HashSet<String>,
    /// Names answered with a type that is not theirs.
    pub wrong_type: HashSet<String>,
    /// Of every so many output packages only one is sent; 0 and 1 send all.
    pub keep_one_of: u32,
}

impl RtdeFaults {
    /// The word for a field's type, or a wrong one on command.
    pub(super) fn type_word(&self, name: &str, right: &'static str) -> &'static str {
        match (self.wrong_type.contains(name), right) {
            (false, _) => right,
            (true, "DOUBLE") => "INT32",
            (true, _) => "DOUBLE",
        }
    }
}

/// What happens to the bytes of one port (rows R02 to R08, R14).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct WireFaults {
    /// Nothing is sent to clients until this time, ns.
    pub mute_until: u64,
    /// Nothing from clients is heard until this time (it is lost), ns.
    pub deaf_until: u64,
    /// Everything to clients is kept back until this time and then sent at once, ns.
    pub hold_until: u64,
    /// Clients are not read until this time, so that their send buffers fill, ns.
    pub unread_until: u64,
    /// Delay of everything sent, ns.
    pub delay_ns: u64,
    /// Up to this much more delay, at random, ns.
    pub jitter_ns: u64,
    /// Sent in pieces of so many bytes; 0 sends whole.
    pub chunk: usize,
    /// New connections are refused.
    pub refuse: bool,
}

/// `seconds` (0 to 1e6) after `now_ns`.
pub(super) fn later(now_ns: u64, seconds: f64) -> u64 {
    now_ns.saturating_add((seconds.clamp(0.0, 1e6) * 1e9) as u64)
}

impl WireFaults {
    /// Loses what clients send (`upstream`) and what the controller sends (`downstream`) for `seconds`.
    pub(super) fn silence(&mut self, now_ns: u64, seconds: f64, upstream: bool, downstream: bool) {
        let until = later(now_ns, seconds);
        if upstream {
            self.deaf_until = until;
        }
        if downstream {
            self.mute_until = until;
        }
    }

    /// Delays what the controller sends; both times are limited to one minute.
    pub(super) fn delay(&mut self, ms: f64, jitter_ms: f64) {
        self.delay_ns = (ms.clamp(0.0, 60_000.0) * 1e6) as u64;
        self.jitter_ns = (jitter_ms.clamp(0.0, 60_000.0) * 1e6) as u64;
    }
}
