//! Missed cycles of the command thread, counted over a sliding window.

const SECOND_NS: u64 = 1_000_000_000;

/// Cycles missed in the current and in the previous second.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct MissedCycles {
    second: u64,
    current: u32,
    previous: u32,
}

impl MissedCycles {
    /// Adds `n` missed cycles and returns the total of the current and the previous second: a window of 1 s to 2 s.
    pub(super) fn add(&mut self, now_ns: u64, n: u32) -> u32 {
        let second = now_ns / SECOND_NS;
        if second != self.second {
            self.previous = if second == self.second + 1 { self.current } else { 0 };
            self.current = 0;
            self.second = second;
        }
        self.current = self.current.saturating_add(n);
        self.current.saturating_add(self.previous)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn missed_cycles_count_for_one_to_two_seconds() {
        let mut m = MissedCycles::default();
        assert_eq!(m.add(10 * SECOND_NS, 3), 3);
        assert_eq!(m.add(10 * SECOND_NS + 999_999_999, 2), 5);
        assert_eq!(m.add(11 * SECOND_NS, 0), 5, "the previous second still counts");
        assert_eq!(m.add(11 * SECOND_NS + 5, 1), 6);
        assert_eq!(m.add(12 * SECOND_NS, 0), 1, "the second before the previous one does not");
        assert_eq!(m.add(14 * SECOND_NS, 0), 0, "a gap of a whole second clears both");
    }

    #[test]
    fn counts_saturate() {
        let mut m = MissedCycles::default();
        m.add(SECOND_NS, u32::MAX);
        assert_eq!(m.add(SECOND_NS, 7), u32::MAX);
        assert_eq!(m.add(2 * SECOND_NS, 7), u32::MAX);
    }

    #[test]
    fn a_clock_that_goes_back_clears_both() {
        let mut m = MissedCycles::default();
        m.add(9 * SECOND_NS, 4);
        assert_eq!(m.add(3 * SECOND_NS, 1), 1);
    }
}
