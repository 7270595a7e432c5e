//! What ordinary threads tell each other for the status verb and the log. Locks live here, never on a real-time thread.

use crossbeam::queue::ArrayQueue;
use graspd_rt::cycle::{CycleRecord, Transition, Why};
use graspd_rt::mode::ModeName;
use graspd_rt::setpoint::SetPoint;
use graspd_shm::control::{Percentiles, TelemetrySample};
use serde_json::{Value, json};
use std::sync::{Mutex, MutexGuard, PoisonError};

#[derive(Debug, Default)]
struct State {
    mode: Option<ModeName>,
    cause: String,
    link: String,
    refused: Vec<String>,
    plan: String,
    refusal: String,
    sample: TelemetrySample,
    rest: bool,
}

/// The daemon's state in words.
#[derive(Debug)]
pub struct Report {
    state: Mutex<State>,
    setpoints: ArrayQueue<SetPoint>,
}

impl Default for Report {
    fn default() -> Self {
        Self { state: Mutex::default(), setpoints: ArrayQueue::new(4) }
    }
}

fn percentiles(p: &Percentiles) -> Value {
    json!({ "p50": p.p50, "p99": p.p99, "p999": p.p999, "max": p.max })
}

/// JSON has no NaN.
fn number(v: f64) -> Value {
    if v.is_finite() { json!(v) } else { Value::Null }
}

impl Report {
    fn lock(&self) -> MutexGuard<'_, State> {
        // The state is plain values, whole after every statement: a panic elsewhere does not spoil it.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Notes a change of mode. What began a stop stays its reason when the arm has come to rest.
    pub fn transition(&self, event: &Transition, why: &str) {
        let mut s = self.lock();
        s.mode = Some(event.to);
        if !matches!(event.why, Why::AtRest) {
            why.clone_into(&mut s.cause);
        }
    }

    /// Notes a beat.
    pub fn beat(&self, record: &CycleRecord) {
        let mut s = self.lock();
        s.mode = Some(record.mode);
        s.rest = record.command.rates.iter().all(|r| *r == 0.0);
    }

    /// Notes the newest telemetry.
    pub fn sample(&self, sample: &TelemetrySample, _settled: bool) {
        self.lock().sample = *sample;
    }

    /// Notes how the robot link is, in words.
    pub fn link(&self, words: &str) {
        let mut s = self.lock();
        if s.link != words {
            eprintln!("graspd: robot link: {words}");
            words.clone_into(&mut s.link);
        }
    }

    /// Notes why pictures are being refused; empty when they are not.
    pub fn refusal(&self, words: &str) {
        words.clone_into(&mut self.lock().refusal);
    }

    /// Notes what the host refused.
    pub fn refused(&self, what: &[String]) {
        for line in what {
            eprintln!("graspd: not real-time: {line}");
        }
        self.lock().refused.extend_from_slice(what);
    }

    /// Notes an accepted set-point.
    pub fn setpoint(&self, setpoint: &SetPoint, name: String) {
        self.lock().plan = name;
        let _ = self.setpoints.force_push(*setpoint);
    }

    /// The next accepted set-point, for the telemetry thread.
    pub fn setpoint_for_telemetry(&self) -> Option<SetPoint> {
        self.setpoints.pop()
    }

    /// The mode, once the first beat has run.
    pub fn mode(&self) -> Option<ModeName> {
        self.lock().mode
    }

    /// Whether the last command was to rest.
    pub fn at_rest(&self) -> bool {
        self.lock().rest
    }

    /// The whole state as one JSON object.
    pub fn json(&self, accepted: bool, reason: Option<&str>, marks: &str) -> String {
        let s = self.lock();
        let t = &s.sample;
        let mut v = json!({
            "accepted": accepted,
            "state": s.mode.map_or("starting", ModeName::as_str),
            "cause": s.cause,
            "robot": s.link,
            "marks": if marks.is_empty() { format!("{} left, {} right of {}", t.marks_seen[0], t.marks_seen[1], t.mark_count) } else { marks.to_owned() },
            "setpoint": if t.setpoint == 0 { String::from("none") } else { format!("{:016x}", t.setpoint) },
            "plan": s.plan,
            "robot_mode": t.robot_mode,
            "ticks": t.ticks,
            "overruns": t.overruns,
            "frames": t.frames,
            "frames_skipped": t.frames_skipped,
            "frames_refused": t.frames_refused,
            "frames_refused_because": s.refusal,
            "error_px": number(t.error_px),
            "residual_px": number(t.residual_px),
            "distance_m": number(t.distance_m),
            "angle_rad": number(t.angle_rad),
            "wakeup_us": percentiles(&t.wakeup_us),
            "compute_us": percentiles(&t.compute_us),
            "frame_to_command_us": percentiles(&t.frame_to_command_us),
            "round_trip_us": percentiles(&t.round_trip_us),
            "not_realtime": s.refused,
        });
        if let (Some(reason), Some(map)) = (reason, v.as_object_mut()) {
            map.insert("reason".into(), json!(reason));
        }
        v.to_string()
    }
}
