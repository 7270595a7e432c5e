//! The result of the demo: the error by the scene's ground truth, limit violations by the mock controller, timing by
//! the daemon.

use super::cell::Cell;
use super::watch::{CONVERGED, Outcome};
use crate::cli::DemoArgs;
use crate::exit::Failure;
use graspd_shm::control::Percentiles;
use serde_json::{Value, json};
use std::time::Duration;

/// The result, as printed.
#[derive(Clone, Debug)]
pub(super) struct DemoResult {
    /// Seed of the world.
    pub seed: u64,
    /// Whether the daemon reported convergence.
    pub converged: bool,
    /// True distance of the gripper from the planned pose, by the scene.
    pub position_error_mm: f64,
    /// True angle between the gripper's approach and the valve's axis, by the scene.
    pub orientation_error_deg: f64,
    /// Time from the start of servoing to convergence.
    pub convergence_s: Option<f64>,
    /// Cycles of the command thread, and those that were a whole period late.
    pub cycles: (u64, u64),
    /// Pairs tracked.
    pub frames: u64,
    /// Pairs a second that the scene published during servoing.
    pub pairs_per_s: Option<f64>,
    /// Set-points on the wire that exceeded a limit, by the mock controller; `None` when it gave no summary.
    pub limit_violations: Option<u64>,
    /// Wake-up, computation, frame to command, round trip.
    pub timing: [Percentiles; 4],
    /// Residual of the marks at rest, which shows errors of the calibration.
    pub residual_px: f64,
    /// Final state and its cause.
    pub state: String,
}

/// Takes the error from the scene and the other values from the daemon's telemetry.
///
/// # Errors
/// When the scene does not answer.
pub(super) fn collect(args: &DemoArgs, cell: &mut Cell, outcome: &Outcome) -> Result<DemoResult, Failure> {
    let s = &outcome.last;
    let truth = cell.scene.ask(r#"{"ask":"truth"}"#, Duration::from_secs(3))?;
    let number = |key: &str| truth.pointer(key).and_then(Value::as_f64);
    let (position, orientation) = (number("/grasp/position_error_mm"), number("/grasp/orientation_error_deg"));
    let (Some(position_error_mm), Some(orientation_error_deg)) = (position, orientation) else {
        return Err(Failure::link(format!("the scene's answer has no grasp error: {truth}")));
    };
    Ok(DemoResult {
        seed: args.seed,
        converged: s.state == CONVERGED && outcome.seconds.is_some(),
        position_error_mm,
        orientation_error_deg,
        convergence_s: outcome.seconds.filter(|_| s.state == CONVERGED),
        cycles: (s.ticks, s.overruns),
        frames: s.frames,
        pairs_per_s: cell.pairs_per_second(),
        limit_violations: None,
        timing: [s.wakeup_us, s.compute_us, s.frame_to_command_us, s.round_trip_us],
        residual_px: s.residual_px,
        state: format!(
            "{}{}",
            super::watch::STATES.get(s.state as usize).unwrap_or(&"?"),
            match s.cause_text() {
                "" => String::new(),
                cause => format!(" ({cause})"),
            }
        ),
    })
}

/// Ends the processes in order and takes the mock controller's summary of the wire.
pub(super) fn close(mut result: DemoResult, cell: &mut Cell) -> DemoResult {
    let timeout = Duration::from_secs(3);
    cell.daemon.end(timeout);
    cell.scene.end(timeout);
    // Its last line is the summary of everything on the wire.
    cell.mock.end(timeout);
    while let Ok(line) = cell.mock.json_line(Duration::from_millis(200)) {
        if let Some(n) = line.pointer("/summary/limit_violations") {
            result.limit_violations = n.as_u64();
        }
    }
    result
}

fn percentiles(p: &Percentiles) -> Value {
    json!({ "p50": p.p50, "p99": p.p99, "p999": p.p999, "max": p.max })
}

impl DemoResult {
    /// One JSON object.
    pub(super) fn json(&self) -> String {
        json!({
            "seed": self.seed,
            "converged": self.converged,
            "position_error_mm": self.position_error_mm,
            "orientation_error_deg": self.orientation_error_deg,
            "convergence_s": self.convergence_s,
            "ticks": self.cycles.0,
            "overruns": self.cycles.1,
            "frames": self.frames,
            "pairs_per_s": self.pairs_per_s,
            "limit_violations": self.limit_violations,
            "residual_px": if self.residual_px.is_finite() { Some(self.residual_px) } else { None },
            "state": self.state,
            "wakeup_us": percentiles(&self.timing[0]),
            "compute_us": percentiles(&self.timing[1]),
            "frame_to_command_us": percentiles(&self.timing[2]),
            "round_trip_us": percentiles(&self.timing[3]),
        })
        .to_string()
    }

    /// A table for people.
    pub(super) fn table(&self) -> String {
        use std::fmt::Write;
        let mut out = String::new();
        let verdict = if self.converged { "converged" } else { "NOT converged" };
        let seconds = self.convergence_s.map_or_else(|| "-".into(), |s| format!("{s:.1} s"));
        let violations = self.limit_violations.map_or_else(|| "unknown".into(), |n| n.to_string());
        // Writing to a String cannot fail.
        let _ = writeln!(out, "\n{verdict} in {seconds}; {}", self.state);
        let _ = writeln!(
            out,
            "true error   {:8.3} mm   {:8.3} degrees   (ground truth from the scene)",
            self.position_error_mm, self.orientation_error_deg
        );
        let _ = writeln!(
            out,
            "at rest      {:8.3} px   residual of the marks (error of the calibration)",
            self.residual_px
        );
        let _ = writeln!(
            out,
            "on the wire  {violations} limit violations; {} cycles, {} overruns, {} stereo pairs ({:.1} a second)",
            self.cycles.0,
            self.cycles.1,
            self.frames,
            self.pairs_per_s.unwrap_or(f64::NAN)
        );
        let _ = writeln!(out, "\nus                    p50       p99     p99.9       max");
        for (name, p) in ["wake-up", "compute", "frame to command", "round trip"].iter().zip(&self.timing) {
            let _ = writeln!(out, "{name:16} {:8.0}  {:8.0}  {:8.0}  {:8.0}", p.p50, p.p99, p.p999, p.max);
        }
        out
    }
}
