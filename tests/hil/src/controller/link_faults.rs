//! Faults of the network connection and of the RTDE server's answers.

use std::collections::HashSet;

/// Faults in the answers of the RTDE server.
#[derive(Clone, Debug, Default)]
pub struct RtdeFaults {
    /// Protocol version 2 is refused.
    pub refuse_v2: bool,
    /// Input names answered with `IN_USE`.
    pub in_use: HashSet<String>,
    /// Names answered with `NOT_FOUND`.
    pub not_found: HashSet<String>,
    /// Names answered with another type.
    pub wrong_type: HashSet<String>,
    /// Only one of this many output packages is sent; 0 and 1 send all.
    pub keep_one_of: u32,
}

impl RtdeFaults {
    /// The type answered for a field: its own, or another one while the fault is set.
    pub(super) fn type_name(&self, name: &str, right: &'static str) -> &'static str {
        match (self.wrong_type.contains(name), right) {
            (false, _) => right,
            (true, "DOUBLE") => "INT32",
            (true, _) => "DOUBLE",
        }
    }
}

/// Faults in the byte streams of one port.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct WireFaults {
    /// What the controller sends is lost until this time, ns.
    pub mute_until: u64,
    /// What clients send is lost until this time, ns.
    pub deaf_until: u64,
    /// What the controller sends is held back until this time and then sent in one burst, ns.
    pub hold_until: u64,
    /// Clients are not read until this time, so that their send buffers fill, ns.
    pub unread_until: u64,
    /// Delay of what the controller sends, ns.
    pub delay_ns: u64,
    /// Largest additional random delay, ns.
    pub jitter_ns: u64,
    /// Largest number of bytes per write; 0 for no limit.
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
