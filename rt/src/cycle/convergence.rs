//! Convergence and progress of one leg, judged from the correction that each image asks for.

use super::settings::ConvergeSettings;
use crate::geom::Twist;
use crate::online::screw::{LawSettings, Screw};

/// Weight of the newest correction in the low pass; it leaves sqrt(0.3 / 1.7) = 0.42 of the noise's standard deviation.
const NEWEST: f64 = 0.3;
/// Standard deviations of the unfiltered noise to which the tolerance opens: 3.6 of the filtered noise, which therefore
/// almost never exceeds it.
const NOISE_SIGMAS: f64 = 1.5;
/// Decrease of the remaining distance that counts as progress, metres (unit-scaled): above the noise of the filtered
/// correction.
const MIN_PROGRESS_M: f64 = 2e-4;

/// Filtered correction of the current leg, and how it has developed.
#[derive(Clone, Copy, Debug)]
pub(super) struct Convergence {
    settings: ConvergeSettings,
    /// Low-passed correction `[v; ω]` (m, rad), gripper frame; `None` before the leg's first image.
    filtered: Option<Twist>,
    /// Consecutive images within the tolerance.
    steady: u32,
    /// Smallest remaining distance of the leg, metres (unit-scaled), and when it was reached.
    best_left_m: f64,
    progress_ns: u64,
}

impl Convergence {
    pub(super) fn new(settings: ConvergeSettings) -> Self {
        Self { settings, filtered: None, steady: 0, best_left_m: f64::INFINITY, progress_ns: 0 }
    }

    /// Starts a new leg.
    pub(super) fn restart(&mut self, now_ns: u64) {
        *self = Self { progress_ns: now_ns, ..Self::new(self.settings) };
    }

    /// Takes the correction of a new image. It counts as steady when the reference has `ended` and the filtered
    /// correction is within `factor` times the tolerance.
    pub(super) fn observe(&mut self, screw: &Screw, ended: bool, factor: f64) {
        let filtered = match self.filtered {
            None => screw.correction,
            Some(f) => f * (1.0 - NEWEST) + screw.correction * NEWEST,
        };
        self.filtered = Some(filtered);
        self.steady = if ended && self.within(screw, factor) { self.steady + 1 } else { 0 };
    }

    /// Consecutive images that were steady.
    pub(super) fn steady(&self) -> u32 {
        self.steady
    }

    /// Whether the filtered correction is within `factor` times the tolerance; false before the first image.
    ///
    /// The tolerance opens to what the marks' noise allows (one view resolves depth ten times worse than two), at most
    /// [`ConvergeSettings::noise_factor`] times. With noisier marks the loop never converges.
    pub(super) fn within(&self, screw: &Screw, factor: f64) -> bool {
        let Some(filtered) = &self.filtered else { return false };
        let c = &self.settings;
        let open =
            |tolerance: f64, sigma: f64| (NOISE_SIGMAS * sigma).clamp(tolerance, tolerance * c.noise_factor) * factor;
        filtered.fixed_rows::<3>(0).norm() <= open(c.position_m, screw.sigma_m)
            && filtered.fixed_rows::<3>(3).norm() <= open(c.angle_rad, screw.sigma_rad)
            && screw.error_px <= c.error_px * factor.max(1.0)
    }

    /// Notes the distance to the end of the leg (m, unit-scaled) and returns the smaller of it and the distance that
    /// the correction and the reference still have to go. The reference's own motion counts as progress, and so does a
    /// probe.
    pub(super) fn note_distance(&mut self, law: &LawSettings, left_m: f64, ended: bool, now_ns: u64) -> f64 {
        let correction_m = self.filtered.map_or(f64::INFINITY, |f| law.size(&f));
        let left_m = left_m.min(correction_m + if ended { 0.0 } else { left_m });
        if left_m < self.best_left_m - MIN_PROGRESS_M {
            self.best_left_m = left_m;
            self.progress_ns = now_ns;
        }
        left_m
    }

    /// Time since the last progress, ns.
    pub(super) fn stalled_ns(&self, now_ns: u64) -> u64 {
        now_ns.saturating_sub(self.progress_ns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SETTINGS: ConvergeSettings = ConvergeSettings {
        position_m: 0.0003,
        angle_rad: 0.002,
        noise_factor: 5.0,
        error_px: 12.0,
        frames: 12,
        pregrasp_factor: 4.0,
        pregrasp_frames: 3,
        leave_factor: 6.0,
    };

    fn screw(x_m: f64, sigma_m: f64) -> Screw {
        Screw {
            correction: Twist::new(x_m, 0.0, 0.0, 0.0, 0.0, 0.0),
            points: 8,
            error_px: 0.1,
            residual_px: 0.1,
            sigma_min: 100.0,
            condition: 10.0,
            sigma_m,
            sigma_rad: 0.0,
        }
    }

    #[test]
    fn steady_images_are_consecutive_and_need_an_ended_reference() {
        let mut c = Convergence::new(SETTINGS);
        c.restart(0);
        for k in 1..=3 {
            c.observe(&screw(0.0001, 0.0), true, 1.0);
            assert_eq!(c.steady(), k);
        }
        c.observe(&screw(0.0001, 0.0), false, 1.0);
        assert_eq!(c.steady(), 0, "the reference still moves");
        c.observe(&screw(0.0001, 0.0), true, 1.0);
        c.observe(&screw(0.1, 0.0), true, 1.0);
        assert_eq!(c.steady(), 0, "the correction grew");
    }

    #[test]
    fn the_tolerance_opens_with_the_noise_up_to_its_factor() {
        let within = |x_m: f64, sigma_m: f64| {
            let mut c = Convergence::new(SETTINGS);
            c.observe(&screw(x_m, sigma_m), true, 1.0);
            c.within(&screw(x_m, sigma_m), 1.0)
        };
        assert!(within(0.000_299, 0.0) && !within(0.000_301, 0.0));
        assert!(within(0.000_599, 0.0004) && !within(0.000_601, 0.0004), "1.5 times the noise");
        assert!(within(0.001_499, 1.0) && !within(0.001_501, 1.0), "five times the tolerance at most");
    }

    #[test]
    fn a_new_leg_forgets_the_last_one() {
        let mut c = Convergence::new(SETTINGS);
        c.observe(&screw(0.5, 0.0), true, 1.0);
        c.restart(7);
        assert!(!c.within(&screw(0.0, 0.0), 1.0), "no image yet");
        c.observe(&screw(0.0001, 0.0), true, 1.0);
        assert_eq!((c.steady(), c.stalled_ns(10)), (1, 3));
    }

    #[test]
    fn only_a_clear_decrease_is_progress() {
        let law = LawSettings::default();
        let mut c = Convergence::new(SETTINGS);
        c.restart(0);
        c.observe(&screw(0.0, 0.0), false, 1.0);
        c.note_distance(&law, 0.1, false, 10);
        assert_eq!(c.stalled_ns(10), 0);
        c.note_distance(&law, 0.1 - 0.000_19, false, 20);
        assert_eq!(c.stalled_ns(20), 10, "within the noise");
        c.note_distance(&law, 0.1 - 0.000_21, false, 30);
        assert_eq!(c.stalled_ns(30), 0);
        // Once the reference has ended, the correction alone counts.
        assert_eq!(c.note_distance(&law, 0.05, true, 40), 0.0);
    }
}
