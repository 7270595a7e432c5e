//! Latency percentiles, computed outside the command cycle from its records.

use graspd_shm::control::Percentiles;
use hdrhistogram::Histogram;

/// One latency: a histogram from 1 ns to 10 s with three significant digits.
#[derive(Debug)]
pub struct Latency {
    histogram: Histogram<u64>,
}

impl Default for Latency {
    fn default() -> Self {
        // These bounds are always valid; the fallback is the library's auto-resizing histogram.
        let histogram = Histogram::new_with_bounds(1, 10_000_000_000, 3)
            .or_else(|_| Histogram::new(3))
            .unwrap_or_else(|_| unreachable!("three significant digits are always valid"));
        Self { histogram }
    }
}

impl Latency {
    /// Records one value, ns.
    pub fn record(&mut self, ns: u64) {
        self.histogram.saturating_record(ns.max(1));
    }

    /// Removes all values.
    pub fn clear(&mut self) {
        self.histogram.reset();
    }

    /// Percentiles, µs; zero before the first value.
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
