//! The telemetry thread: drains what the loop noted, keeps latency histograms, publishes 50 samples a second, logs changes of mode.
//! An ordinary thread: formatting, histograms and iceoryx2's send stay off the loop.

use super::refusal::Refusal;
use super::report::Report;
use super::shared::Shared;
use super::timing::Latency;
use crate::config::Config;
use crate::log;
use graspd_rt::cycle::{CycleRecord, RequestKind, Stage, Transition, Why};
use graspd_rt::gripper::MAX_MARKS;
use graspd_rt::mode::{FaultCause, ModeName};
use graspd_rt::online::Vision;
use graspd_rt::setpoint::{Goal, SetPoint};
use graspd_shm::ShmNode;
use graspd_shm::control::{ControlError, TelemetryPublisher, TelemetrySample};
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

/// What the command thread notes about one cycle.
#[derive(Clone, Copy, Debug)]
pub struct CycleReport {
    /// What the cycle knew and did.
    pub record: CycleRecord,
    /// A change of mode.
    pub event: Option<Transition>,
    /// How late the thread woke, ns.
    pub wakeup_ns: u64,
    /// From waking to the command sent, ns.
    pub compute_ns: u64,
    /// Whole periods missed before this cycle.
    pub skipped: u64,
    /// From the exposure of a pair to this command, in the first cycle that used the pair.
    pub frame_to_command_ns: Option<u64>,
    /// From a command to its echo, when a new echo came.
    pub round_trip_ns: Option<u64>,
    /// 0 down, 1 connecting, 2 up.
    pub link: u32,
    /// The controller's robot mode and safety bits.
    pub robot: (i32, u32),
}

/// A stable number for a stable code like "F-ARM-05": its group times a hundred and its own number.
pub fn fault_number(code: &str) -> u32 {
    let mut parts = code.split('-').skip(1);
    let group = match parts.next() {
        Some("CAM") => 1,
        Some("MRK") => 2,
        Some("LAW") => 3,
        Some("ARM") => 4,
        Some("TIM") => 5,
        _ => 9,
    };
    group * 100 + parts.next().and_then(|n| n.parse().ok()).unwrap_or(0)
}

/// Why a mode changed, in words with its code where it has one.
pub fn why_words(why: &Why) -> String {
    match why {
        Why::Readiness => "readiness of marks and robot changed".into(),
        Why::Request(kind) => format!("asked for: {kind:?}"),
        Why::Progress => "progress of the motion".into(),
        Why::AtRest => "at rest".into(),
        Why::Hold(cause) => format!("{}: {cause}", cause.code()),
        Why::Fault(cause) => format!("{}: {cause}", cause.code()),
    }
}

#[derive(Debug, Default)]
struct Latencies {
    wakeup: Latency,
    compute: Latency,
    frame: Latency,
    round_trip: Latency,
}

/// Runs until shutdown.
///
/// # Errors
/// When the telemetry topic cannot be opened.
pub fn run(config: &Config, node: &ShmNode, shared: &Shared, report: &Report) -> Result<(), ControlError> {
    let publisher = TelemetryPublisher::new(node)?;
    let mut latencies = Latencies::default();
    let mut sample = TelemetrySample { mark_count: config.gripper.gripper.marks.len() as u32, ..Default::default() };
    sample.views = match config.raw.servo.views.as_str() {
        "left" => 1,
        "right" => 2,
        "best" => 3,
        _ => 0,
    };
    let mut setpoint: Option<SetPoint> = None;
    let mut settled = false;
    let mut refusal = (0, 0, Instant::now());
    let mut refused = String::new();
    loop {
        let ending = shared.ending();
        refusals(shared, report, &mut refusal, &mut refused);
        let mut last = None;
        while let Some(cycle) = shared.records.pop() {
            // Percentiles are of the loop in service: from the first arming on, and afresh with each.
            if cycle.event.is_some_and(|e| e.to == ModeName::Servoing && e.from == ModeName::Armed) {
                latencies = Latencies::default();
                settled = true;
            }
            note(&mut latencies, &cycle);
            if let Some(event) = cycle.event {
                let mut why = why_words(&event.why);
                if event.why == Why::Request(RequestKind::Stop) {
                    why = format!("{why}, by {}", shared.live.who());
                }
                if let (Why::Fault(FaultCause::FramesStale { .. }), false) = (event.why, refused.is_empty()) {
                    why = format!("{why}; images were refused: {refused}");
                }
                log::say(format_args!("{} -> {}: {why}", event.from.as_str(), event.to.as_str()));
                report.transition(&event, &why);
                match event.why {
                    Why::Fault(cause) => {
                        sample.fault = fault_number(cause.code());
                        sample.set_cause(&why);
                    }
                    Why::Hold(_) => sample.set_cause(&why),
                    // The end of a ramp says nothing new: what began it stays the reason.
                    Why::AtRest => {}
                    _ if matches!(event.to, ModeName::Tracking | ModeName::Servoing | ModeName::Armed) => {
                        sample.fault = 0;
                        sample.set_cause("");
                    }
                    _ => {}
                }
            }
            last = Some(cycle);
        }
        while let Some(next) = report.setpoint_for_telemetry() {
            setpoint = Some(next);
        }
        if let Some(vision) = shared.vision_seen.take() {
            marks(&mut sample, &vision);
        }
        if let Some(cycle) = last {
            fill(&mut sample, &cycle, setpoint.as_ref());
            report.cycle(&cycle.record);
        }
        sample.frames = shared.counters.frames.load(Ordering::Relaxed);
        sample.frames_skipped = shared.counters.skipped.load(Ordering::Relaxed);
        sample.frames_refused = shared.counters.refused.load(Ordering::Relaxed);
        sample.wakeup_us = latencies.wakeup.percentiles();
        sample.compute_us = latencies.compute.percentiles();
        sample.frame_to_command_us = latencies.frame.percentiles();
        sample.round_trip_us = latencies.round_trip.percentiles();
        let lost = log::lost();
        sample.log_lost = u32::try_from(lost.dropped + lost.failed).unwrap_or(u32::MAX);
        sample.sequence += 1;
        report.sample(&sample, settled);
        // A full subscriber list or a dying reader must not end the daemon; the next sample follows in 20 ms.
        let _ = publisher.publish(&sample);
        if ending {
            return Ok(());
        }
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// Says once why images are refused. `seen` is the count, the reason and the time of the last refusal; `words` are those of the last
/// second, for the fault that may follow.
fn refusals(shared: &Shared, report: &Report, seen: &mut (u64, u32, Instant), words: &mut String) {
    let count = shared.counters.refused.load(Ordering::Relaxed);
    let why = shared.counters.refusal.load(Ordering::Relaxed);
    if count != seen.0 {
        if why != seen.1 || words.is_empty() {
            *words = Refusal::words(why);
            log::say(format_args!("images are refused: {words}"));
            report.refusal(words);
        }
        *seen = (count, why, Instant::now());
    } else if seen.2.elapsed() > Duration::from_secs(1) && !words.is_empty() {
        words.clear();
        report.refusal("");
    }
}

fn note(l: &mut Latencies, cycle: &CycleReport) {
    l.wakeup.note(cycle.wakeup_ns);
    l.compute.note(cycle.compute_ns);
    if let Some(ns) = cycle.frame_to_command_ns {
        l.frame.note(ns);
    }
    if let Some(ns) = cycle.round_trip_ns {
        l.round_trip.note(ns);
    }
}

fn fill(sample: &mut TelemetrySample, cycle: &CycleReport, setpoint: Option<&SetPoint>) {
    let r = &cycle.record;
    sample.stamp_ns = r.now_ns;
    sample.state = r.mode as u32;
    sample.phase = match (r.mode, r.stage) {
        (ModeName::Converged, _) => 3,
        (ModeName::Servoing, Stage::Pregrasp) => 1,
        (ModeName::Servoing, Stage::Grasp) => 2,
        (ModeName::Servoing, Stage::Turn) => 5,
        (ModeName::Servoing, Stage::Retreat) => 6,
        _ => 0,
    };
    sample.ticks = r.counters.cycles;
    sample.overruns = r.counters.overruns;
    sample.setpoint = r.setpoint_id;
    sample.link = cycle.link;
    (sample.robot_mode, sample.safety_bits) = cycle.robot;
    sample.limits_active = u32::from(r.held.0);
    sample.q = r.q;
    sample.qd = r.qd;
    sample.command = r.command.rates;
    sample.screw = r.screw.into();
    sample.left_from_gripper = r.left_from_gripper.map_or([f64::NAN; 7], |p| {
        let (t, q) = (p.translation.vector, p.rotation.quaternion());
        [t.x, t.y, t.z, q.w, q.i, q.j, q.k]
    });
    sample.error_px = r.error_px;
    sample.residual_px = r.residual_px;
    sample.condition = r.mark_condition;
    sample.gain = r.scale;
    let goal = setpoint.filter(|s| s.id == r.setpoint_id).map(|s| match r.stage {
        Stage::Pregrasp | Stage::Retreat => &s.pregrasp,
        Stage::Grasp | Stage::Turn => &s.grasp,
    });
    (sample.distance_m, sample.angle_rad) = match (goal, r.left_from_gripper) {
        (Some(g), Some(p)) => {
            let d = p.inverse() * g.left_from_gripper;
            (d.translation.vector.norm(), d.rotation.angle())
        }
        _ => (f64::NAN, f64::NAN),
    };
    goals(sample, goal);
}

fn marks(sample: &mut TelemetrySample, vision: &Vision) {
    sample.marks_seen = vision.seen.map(u32::from);
    for (eye, seen) in vision.marks.iter().enumerate() {
        for (i, mark) in seen.iter().enumerate().take(MAX_MARKS) {
            sample.marks[eye][i] = mark.map_or([f32::NAN; 2], |m| [m.pixel.x as f32, m.pixel.y as f32]);
        }
    }
}

fn goals(sample: &mut TelemetrySample, goal: Option<&Goal>) {
    for eye in 0..2 {
        for i in 0..MAX_MARKS {
            let pixel = goal.and_then(|g| g.marks[eye][i]);
            sample.goals[eye][i] = pixel.map_or([f32::NAN; 2], |p| [p.x as f32, p.y as f32]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::fault_number;

    #[test]
    fn codes_have_stable_numbers() {
        assert_eq!(fault_number("F-ARM-05"), 405);
        assert_eq!(fault_number("F-CAM-01"), 101);
        assert_eq!(fault_number("F-INT-01"), 901);
    }
}
