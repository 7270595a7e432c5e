//! The daemon's telemetry: for the progress display, the result and the drawing of the image trajectories.

use super::cell::Cell;
use crate::exit::Failure;
use graspd_shm::ShmNode;
use graspd_shm::control::{TelemetrySample, TelemetrySubscriber};
use std::time::{Duration, Instant};

/// Names of the telemetry's state numbers.
pub(super) const STATES: [&str; 7] = ["idle", "tracking", "armed", "servoing", "converged", "stopping", "fault"];

/// State number of mode armed.
pub(super) const ARMED: u32 = 2;
/// State number of mode converged.
pub(super) const CONVERGED: u32 = 4;
/// State number of mode fault.
pub(super) const FAULT: u32 = 6;

/// Image trajectories of the marks in both views, with a sample every 20 ms.
#[derive(Clone, Debug, Default)]
pub(super) struct Trajectories {
    /// By view, mark and time, px; NaN where not seen.
    pub points: [Vec<Vec<[f32; 2]>>; 2],
    /// By view and mark, px: the position at the goal.
    pub goals: [Vec<[f32; 2]>; 2],
    /// Time since the start, s, and image error, px.
    pub errors: Vec<(f64, f64)>,
}

impl Trajectories {
    fn add(&mut self, sample: &TelemetrySample, seconds: f64) {
        let n = (sample.mark_count as usize).min(sample.marks[0].len());
        for view in 0..2 {
            self.points[view].resize(n, Vec::new());
            self.goals[view].resize(n, [f32::NAN; 2]);
            for i in 0..n {
                self.points[view][i].push(sample.marks[view][i]);
                if sample.goals[view][i][0].is_finite() {
                    self.goals[view][i] = sample.goals[view][i];
                }
            }
        }
        self.errors.push((seconds, sample.error_px));
    }
}

/// The result of [`until`].
#[derive(Clone, Debug)]
pub(super) struct Outcome {
    /// The last sample.
    pub last: TelemetrySample,
    /// Time until the condition was true, s; `None` after a timeout.
    pub seconds: Option<f64>,
    /// The trajectories of the marks.
    pub trajectories: Trajectories,
}

/// Reads telemetry until `done` is true for a sample, at most for `timeout`. `each` is called with every sample.
///
/// # Errors
/// A process that ended, or telemetry that fails.
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
    let mut received = false;
    while start.elapsed() < timeout {
        while let Some(sample) = subscriber.next().map_err(|e| Failure::link(e.to_string()))? {
            received = true;
            let seconds = start.elapsed().as_secs_f64();
            out.trajectories.add(&sample, seconds);
            out.last = sample;
            each(&sample);
            if done(&sample) {
                out.seconds = Some(seconds);
                return Ok(out);
            }
        }
        if let Some(process) = cell.dead_process() {
            return Err(Failure::link(format!("{process}; see its log in the demo's folder")));
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    if !received {
        return Err(Failure::link("the daemon publishes no telemetry"));
    }
    Ok(out)
}
