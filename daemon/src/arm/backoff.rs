//! Pauses between attempts to connect.

use std::time::Duration;

/// Pause before attempt `n` (from 0): 0.5 s, doubling up to 5 s. A new link always starts unarmed.
pub fn backoff_delay(n: u32) -> Duration {
    Duration::from_millis(500 * (1u64 << n.min(4))).min(Duration::from_secs(5))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pauses_double_up_to_five_seconds() {
        let all: Vec<_> = (0..6).map(|n| backoff_delay(n).as_millis()).collect();
        assert_eq!(all, [500, 1000, 2000, 4000, 5000, 5000]);
        assert_eq!(backoff_delay(u32::MAX).as_millis(), 5000);
    }
}
