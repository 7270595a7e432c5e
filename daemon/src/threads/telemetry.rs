//! The telemetry thread: reads the cycle records, keeps latency histograms, publishes 50 samples a second, logs changes
//! of mode. An ordinary thread, so that formatting, histograms and publishing do not delay the command cycle.

use super::cycle_report::CycleReport;
use super::frame_refusal::FrameRefusal;
use super::report::Report;
use super::sample::{fault_number, fill_cycle, fill_marks, view_number};
use super::shared::Shared;
use super::timing::Latency;
use crate::config::Config;
use crate::log;
use graspd_rt::cycle::{RequestKind, Transition, Why};
use graspd_rt::mode::{FaultCause, ModeName};
use graspd_rt::setpoint::SetPoint;
use graspd_shm::ShmNode;
use graspd_shm::control::{ControlError, TelemetryPublisher, TelemetrySample};
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

/// Time between two samples.
const PERIOD: Duration = Duration::from_millis(20);
/// A reason for refused images is current for this long after the last refusal.
const REFUSAL_LIFETIME: Duration = Duration::from_secs(1);

/// Why a mode changed, with the code of the cause where it has one.
fn why_text(why: &Why) -> String {
    match why {
        Why::Readiness => "readiness of marks and robot changed".into(),
        Why::Request(kind) => format!("requested: {kind:?}"),
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

impl Latencies {
    fn record(&mut self, cycle: &CycleReport) {
        self.wakeup.record(cycle.wakeup_ns);
        self.compute.record(cycle.compute_ns);
        if let Some(ns) = cycle.frame_to_command_ns {
            self.frame.record(ns);
        }
        if let Some(ns) = cycle.round_trip_ns {
            self.round_trip.record(ns);
        }
    }
}

/// The last refused image: how many were refused by then, why and when.
#[derive(Debug)]
struct LastRefusal {
    count: u64,
    reason: u32,
    at: Instant,
    /// Text of the reason; empty once it is no longer current.
    text: String,
}

impl LastRefusal {
    /// Logs a new reason once.
    fn update(&mut self, shared: &Shared, report: &Report) {
        let count = shared.counters.refused.load(Ordering::Relaxed);
        let reason = shared.counters.refusal.load(Ordering::Relaxed);
        if count != self.count {
            if reason != self.reason || self.text.is_empty() {
                self.text = FrameRefusal::text(reason);
                log::message(format_args!("images are refused: {}", self.text));
                report.refusal(&self.text);
            }
            (self.count, self.reason, self.at) = (count, reason, Instant::now());
        } else if self.at.elapsed() > REFUSAL_LIFETIME && !self.text.is_empty() {
            self.text.clear();
            report.refusal("");
        }
    }
}

struct Telemetry<'a> {
    shared: &'a Shared,
    report: &'a Report,
    sample: TelemetrySample,
    latencies: Latencies,
    refusal: LastRefusal,
    setpoint: Option<SetPoint>,
}

/// Runs until shutdown.
///
/// # Errors
/// When the telemetry topic cannot be opened.
pub fn run(config: &Config, node: &ShmNode, shared: &Shared, report: &Report) -> Result<(), ControlError> {
    let publisher = TelemetryPublisher::new(node)?;
    let mut telemetry = Telemetry {
        shared,
        report,
        sample: TelemetrySample {
            mark_count: config.gripper.gripper.marks.len() as u32,
            views: view_number(config.law.views),
            ..Default::default()
        },
        latencies: Latencies::default(),
        refusal: LastRefusal { count: 0, reason: 0, at: Instant::now(), text: String::new() },
        setpoint: None,
    };
    loop {
        let ending = shared.ending();
        telemetry.update();
        // A full subscriber list or a failed subscriber must not end the daemon; the next sample follows in 20 ms.
        let _ = publisher.publish(&telemetry.sample);
        if ending {
            return Ok(());
        }
        std::thread::sleep(PERIOD);
    }
}

impl Telemetry<'_> {
    /// Makes the next sample.
    fn update(&mut self) {
        self.refusal.update(self.shared, self.report);
        let mut last = None;
        while let Some(cycle) = self.shared.records.pop() {
            // The percentiles cover the current motion: they restart with each servo request.
            if cycle.event.is_some_and(|e| e.to == ModeName::Servoing && e.from == ModeName::Armed) {
                self.latencies = Latencies::default();
            }
            self.latencies.record(&cycle);
            if let Some(event) = &cycle.event {
                self.transition(event);
            }
            last = Some(cycle);
        }
        while let Some(next) = self.report.setpoint_for_telemetry() {
            self.setpoint = Some(next);
        }
        if let Some(vision) = self.shared.vision_seen.take() {
            fill_marks(&mut self.sample, &vision);
        }
        if let Some(cycle) = last {
            fill_cycle(&mut self.sample, &cycle, self.setpoint.as_ref());
            self.report.cycle(&cycle.record);
        }
        let (sample, counters) = (&mut self.sample, &self.shared.counters);
        sample.frames = counters.frames.load(Ordering::Relaxed);
        sample.frames_skipped = counters.skipped.load(Ordering::Relaxed);
        sample.frames_refused = counters.refused.load(Ordering::Relaxed);
        sample.wakeup_us = self.latencies.wakeup.percentiles();
        sample.compute_us = self.latencies.compute.percentiles();
        sample.frame_to_command_us = self.latencies.frame.percentiles();
        sample.round_trip_us = self.latencies.round_trip.percentiles();
        let lost = log::lost();
        sample.log_lost = u32::try_from(lost.dropped + lost.failed).unwrap_or(u32::MAX);
        sample.sequence += 1;
        self.report.sample(sample);
    }

    /// Logs a change of mode and puts its cause into the sample.
    fn transition(&mut self, event: &Transition) {
        let mut why = why_text(&event.why);
        if event.why == Why::Request(RequestKind::Stop) {
            why = format!("{why}, by {}", self.shared.live.stop_source());
        }
        if let (Why::Fault(FaultCause::FramesStale { .. }), false) = (event.why, self.refusal.text.is_empty()) {
            why = format!("{why}; images were refused: {}", self.refusal.text);
        }
        log::message(format_args!("{} -> {}: {why}", event.from.as_str(), event.to.as_str()));
        self.report.transition(event, &why);
        match event.why {
            Why::Fault(cause) => {
                self.sample.fault = fault_number(cause.code());
                self.sample.set_cause(&why);
            }
            Why::Hold(_) => self.sample.set_cause(&why),
            // At the end of a ramp the cause of the stop remains.
            Why::AtRest => {}
            _ if matches!(event.to, ModeName::Tracking | ModeName::Servoing | ModeName::Armed) => {
                self.sample.fault = 0;
                self.sample.set_cause("");
            }
            _ => {}
        }
    }
}
