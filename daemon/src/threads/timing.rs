//! Latency percentiles, recorded outside the loop from what the loop noted.

use graspd_shm::control::Percentiles;
use hdrhistogram::Histogram;

/// One latency: a histogram of nanoseconds up to ten seconds, three digits.
#[derive(Debug)]
pub struct Latency {
    histogram: Histogram<u64>,
}

impl Default for Latency {
    fn default() -> Self {
        // 1 ns .. 10 s at three digits is always a valid pair of bounds; the fallback is the library's own auto-resizing one.
        let histogram = Histogram::new_with_bounds(1, 10_000_000_000, 3)
            .or_else(|_| Histogram::new(3))
            .unwrap_or_else(|_| unreachable!("three significant digits are always valid"));
        Self { histogram }
    }
}

impl Latency {
    /// Notes one value.
    pub fn note(&mut self, ns: u64) {
        self.histogram.saturating_record(ns.max(1));
    }

    /// Forgets everything.
    pub fn clear(&mut self) {
        self.histogram.reset();
    }

    /// Percentiles in microseconds; zeroes before the first value.
    pub fn percentiles(&self) -> Percentiles {
        let us = |ns: u64| ns as f32 / 1000.0;
        if self.histogram.is_empty() {
            return Percentiles::default();
        }
        Percentiles {
            p50: us(self.histogram.value_at_quantile(0.5)),
            p99: us(self.histogram.value_at_quantile(0.99)),
            p999: us(self.histogram.value_at_quantile(0.999)),
            max: us(self.histogram.max()),
        }
    }
}
