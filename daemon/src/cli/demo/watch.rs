//! What the demo sees of the daemon: telemetry, for progress, for the table and for the image of the marks' ways.

use super::cell::Cell;
use crate::exit::Failure;
use graspd_shm::ShmNode;
use graspd_shm::control::{TelemetrySample, TelemetrySubscriber};
use std::time::{Duration, Instant};

/// Words of the telemetry's state number.
pub(super) const STATES: [&str; 7] = ["idle", "tracking", "armed", "servoing", "converged", "stopping", "fault"];

/// State number of an armed daemon.
pub(super) const ARMED: u32 = 2;
/// State number of a converged daemon.
pub(super) const CONVERGED: u32 = 4;
/// State number of a fault.
pub(super) const FAULT: u32 = 6;

/// The ways of the marks in both images, a sample every 20 ms.
#[derive(Clone, Debug, Default)]
pub(super) struct Trajectories {
    /// By view, mark and time, px; NaN where not seen.
    pub points: [Vec<Vec<[f32; 2]>>; 2],
    /// By view and mark, px: where they had to go.
    pub goals: [Vec<[f32; 2]>; 2],
    /// Image error by time: seconds since the start, px.
    pub errors: Vec<(f64, f64)>,
}

impl Trajectories {
    fn add(&mut self, sample: &TelemetrySample, seconds: f64) {
        let n = (sample.mark_count as usize).min(sample.marks[0].len());
        for eye in 0..2 {
            self.points[eye].resize(n, Vec::new());
            self.goals[eye].resize(n, [f32::NAN; 2]);
            for i in 0..n {
                self.points[eye][i].push(sample.marks[eye][i]);
                if sample.goals[eye][i][0].is_finite() {
                    self.goals[eye][i] = sample.goals[eye][i];
                }
            }
        }
        self.errors.push((seconds, sample.error_px));
    }
}

/// The end of a watch.
#[derive(Clone, Debug)]
pub(super) struct Outcome {
    /// The last sample.
    pub last: TelemetrySample,
    /// Seconds from the start of servoing to convergence at the last goal.
    pub seconds: Option<f64>,
    /// The marks' ways.
    pub trajectories: Trajectories,
}

/// Reads telemetry until `done` says so of a sample, at most `timeout`. `each` sees every sample.
///
/// # Errors
/// A part that ended, telemetry that fails.
pub(super) fn until(
    node: &ShmNode,
    cell: &mut Cell,
    timeout: Duration,
    mut each: impl FnMut(&TelemetrySample),
    done: impl Fn(&TelemetrySample) -> bool,
) -> Result<Outcome, Failure> {
    let subscriber = TelemetrySubscriber::new(node).map_err(|e| Failure::link(e.to_string()))?;
    let start = Instant::now();
    let mut out = Outcome { last: TelemetrySample::default(), seconds: None, trajectories: Trajectories::default() };
    let mut heard = false;
    while start.elapsed() < timeout {
        while let Some(sample) = subscriber.next().map_err(|e| Failure::link(e.to_string()))? {
            heard = true;
            let seconds = start.elapsed().as_secs_f64();
            out.trajectories.add(&sample, seconds);
            out.last = sample;
            each(&sample);
            if done(&sample) {
                out.seconds = Some(seconds);
                return Ok(out);
            }
        }
        if let Some(who) = cell.dead_part() {
            return Err(Failure::link(format!("{who}; its log stands in the demo's folder")));
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    if !heard {
        return Err(Failure::link("the daemon publishes no telemetry"));
    }
    Ok(out)
}
