//! The daemon's state as text, for the status verb and the log. It has a lock and is used by ordinary threads only.

use crate::arm::{MessageKind, RobotMessage, SAFETY_STOPPED_BITS, robot_mode_text, safety_bits_text};
use crate::log;
use crate::stop::LiveState;
use crossbeam::queue::ArrayQueue;
use graspd_rt::cycle::{CycleRecord, Grip, Transition, Why};
use graspd_rt::mode::{FaultCause, ModeName};
use graspd_rt::setpoint::SetPoint;
use graspd_shm::control::{Percentiles, TelemetrySample};
use serde_json::{Value, json};
use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard, PoisonError};

#[derive(Clone, Debug, Default)]
struct State {
    cause: String,
    link: String,
    /// How the last link was lost; kept because `link` changes to "connecting" immediately.
    last_loss: String,
    refused: Vec<String>,
    plan: String,
    refusal: String,
    lasting: Option<FaultCause>,
    sample: TelemetrySample,
    grip: Grip,
    /// Age of the newest usable image, ns; `u64::MAX` before the first, 0 before the first cycle.
    image_age_ns: u64,
    /// Robot mode and safety bits at the start of the last session, for the time without telemetry.
    controller: Option<(i32, u32)>,
    /// The last messages of the controller, the newest last.
    messages: VecDeque<String>,
    /// Why the controller stopped, by its own message; empty once it runs again.
    stop_cause: String,
    stop_kind: Option<MessageKind>,
    recovery: Recovery,
}

/// A recovery that an operator requested.
#[derive(Clone, Debug, Default)]
struct Recovery {
    /// Number of recoveries so far, so that a client can distinguish the new one from the last.
    number: u64,
    running: bool,
    steps: Vec<String>,
    error: Option<String>,
}

/// Number of controller messages that are kept.
const MAX_MESSAGES: usize = 8;
/// Number of recovery steps that are kept; a recovery has fewer.
const MAX_STEPS: usize = 32;

/// The daemon's state as text.
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

/// Text for robot mode and safety: from telemetry while a link is up, otherwise from the start of the last session.
fn controller_text(seen: Option<(i32, u32)>, t: &TelemetrySample) -> String {
    match if t.link == 2 && t.safety_bits != 0 { Some((t.robot_mode, t.safety_bits)) } else { seen } {
        Some((mode, safety)) => format!("{}, safety {}", robot_mode_text(mode), safety_bits_text(safety)),
        None => "unknown".to_owned(),
    }
}

/// A number for JSON, which has no NaN.
fn number(v: f64) -> Value {
    if v.is_finite() { json!(v) } else { Value::Null }
}

impl Report {
    fn lock(&self) -> MutexGuard<'_, State> {
        // The state consists of plain values and is valid after every statement: a panic elsewhere does not corrupt it.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Records a change of mode. The cause of a stop remains when the arm is at rest.
    pub fn transition(&self, event: &Transition, why: &str) {
        if !matches!(event.why, Why::AtRest) {
            why.clone_into(&mut self.lock().cause);
        }
    }

    /// Records a cycle.
    pub fn cycle(&self, record: &CycleRecord) {
        let mut s = self.lock();
        s.lasting = record.lasting;
        (s.grip, s.image_age_ns) = (record.grip, record.vision_age_ns);
    }

    /// The cause that prevents motion now, with its code; in a fault, the cause that would remain after a reset.
    pub fn lasting(&self) -> Option<String> {
        self.lock().lasting.map(|cause| format!("{}: {cause}", cause.code()))
    }

    /// Why images are refused (empty where they are not), and the age of the newest usable image, ms.
    pub fn images(&self) -> (String, Option<f64>) {
        let s = self.lock();
        let age = Some(s.image_age_ns).filter(|ns| *ns != u64::MAX && *ns != 0);
        (s.refusal.clone(), age.map(|ns| ns as f64 * 1e-6))
    }

    /// Records the newest telemetry.
    pub fn sample(&self, sample: &TelemetrySample) {
        self.lock().sample = *sample;
    }

    /// Records and logs the state of the robot link.
    pub fn link(&self, text: &str) {
        let mut s = self.lock();
        if s.link != text {
            log::message(format_args!("robot link: {text}"));
            if text.starts_with("lost") {
                text.clone_into(&mut s.last_loss);
            }
            text.clone_into(&mut s.link);
        }
    }

    /// Records why images are refused; empty when they are not.
    pub fn refusal(&self, text: &str) {
        text.clone_into(&mut self.lock().refusal);
    }

    /// Records robot mode and safety bits at the start of a session.
    pub fn controller(&self, mode: i32, safety: u32) {
        let mut s = self.lock();
        s.controller = Some((mode, safety));
        if safety & SAFETY_STOPPED_BITS == 0 {
            s.stop_cause.clear();
            s.stop_kind = None;
        }
    }

    /// Records and logs a message of the controller.
    pub fn controller_message(&self, message: &RobotMessage) {
        let mut s = self.lock();
        // An error is more specific than the change of safety mode that follows it, and both are more specific than the
        // end of the program.
        let normal = ["normal", "reduced"].iter().any(|mode| message.text.starts_with(mode));
        let stops = match (message.kind, s.stop_kind) {
            (MessageKind::Error, _) => true,
            (MessageKind::Safety, kind) => !normal && kind != Some(MessageKind::Error),
            (MessageKind::Program, kind) => kind.is_none_or(|k| k == MessageKind::Program),
            (MessageKind::Popup, _) => false,
        };
        if stops {
            s.stop_cause.clone_from(&message.text);
            s.stop_kind = Some(message.kind);
        }
        if s.messages.back() != Some(&message.text) {
            log::message(format_args!("controller message: {}", message.text));
            if s.messages.len() == MAX_MESSAGES {
                s.messages.pop_front();
            }
            s.messages.push_back(message.text.clone());
        }
    }

    /// Records the start of a recovery.
    pub fn recovery_started(&self) {
        {
            let r = &mut self.lock().recovery;
            *r = Recovery { number: r.number + 1, running: true, ..Recovery::default() };
        }
        self.link("recovering");
    }

    /// Records and logs a completed step of it.
    pub fn recovery_step(&self, text: &str) {
        log::message(format_args!("recover: {text}"));
        let steps = &mut self.lock().recovery.steps;
        if steps.len() < MAX_STEPS {
            steps.push(text.to_owned());
        }
    }

    /// Records its end.
    pub fn recovery_ended(&self, result: Result<(), String>) {
        match &result {
            Ok(()) => self.link("recovered; connecting"),
            Err(e) => self.link(&format!("not recovered: {e}")),
        }
        let r = &mut self.lock().recovery;
        (r.running, r.error) = (false, result.err());
    }

    /// Records and logs what the host refused.
    pub fn host_refused(&self, refused: &[String]) {
        for line in refused {
            log::message(format_args!("not real-time: {line}"));
        }
        self.lock().refused.extend_from_slice(refused);
    }

    /// Records an accepted set-point.
    pub fn setpoint(&self, setpoint: &SetPoint, name: String) {
        let mut s = self.lock();
        s.plan = name;
        // Telemetry follows a moment later; the answer to the client already needs the id.
        s.sample.setpoint = setpoint.id;
        drop(s);
        let _ = self.setpoints.force_push(*setpoint);
    }

    /// The next accepted set-point, for the telemetry thread.
    pub fn setpoint_for_telemetry(&self) -> Option<SetPoint> {
        self.setpoints.pop()
    }

    /// The state as one JSON object, with the keys of `more` added. Mode and motion are those of the last cycle.
    /// Nothing is formatted under the lock.
    pub fn json(&self, accepted: bool, reason: Option<&str>, marks: &str, live: &LiveState, more: Value) -> String {
        let (_, image_age_ms) = self.images();
        let s = self.lock().clone();
        let t = &s.sample;
        let lost = log::lost();
        let mut v = json!({
            "accepted": accepted,
            "state": live.mode().map_or("starting", ModeName::as_str),
            "moving": live.moving(),
            "cause": s.cause,
            "robot": s.link,
            "robot_last_loss": s.last_loss,
            "robot_state": controller_text(s.controller, t),
            "stop_cause": s.stop_cause,
            "controller_says": s.messages,
            "recovery": json!({ "number": s.recovery.number, "running": s.recovery.running, "steps": s.recovery.steps, "error": s.recovery.error }),
            "marks": if marks.is_empty() { format!("{} left, {} right of {}", t.marks_seen[0], t.marks_seen[1], t.mark_count) } else { marks.to_owned() },
            "setpoint": if t.setpoint == 0 { String::from("none") } else { format!("{:016x}", t.setpoint) },
            "plan": s.plan,
            "gripper": s.grip.as_str(),
            "image_age_ms": image_age_ms,
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
            "log_lines_lost": lost.dropped + lost.failed,
            "log_blocked": lost.blocked,
        });
        if let (Some(reason), Some(map)) = (reason, v.as_object_mut()) {
            map.insert("reason".into(), json!(reason));
        }
        if let (Value::Object(more), Some(map)) = (more, v.as_object_mut()) {
            map.extend(more);
        }
        v.to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use graspd_rt::arm::ROBOT_MODE_RUNNING;

    fn status(report: &Report) -> Value {
        serde_json::from_str(&report.json(true, None, "", &LiveState::default(), Value::Null)).unwrap()
    }

    #[test]
    fn the_cause_of_a_stop_is_kept_until_the_stop_ends() {
        let report = Report::default();
        let receive = |kind, text: &str| report.controller_message(&RobotMessage { kind, text: text.to_owned() });
        receive(MessageKind::Program, "RTDE watchdog");
        assert_eq!(status(&report)["stop_cause"], "RTDE watchdog");
        receive(MessageKind::Safety, "protective stop (C153A2)");
        assert_eq!(status(&report)["stop_cause"], "protective stop (C153A2)");
        receive(MessageKind::Error, "C153A2 joint 2 left its path");
        for (kind, text) in [
            (MessageKind::Safety, "protective stop (C153A2)"),
            (MessageKind::Popup, "x: y"),
            (MessageKind::Safety, "normal"),
        ] {
            receive(kind, text);
            assert_eq!(status(&report)["stop_cause"], "C153A2 joint 2 left its path");
        }
        report.controller(ROBOT_MODE_RUNNING, 0b100);
        assert_eq!(status(&report)["stop_cause"], "C153A2 joint 2 left its path");
        assert_eq!(status(&report)["robot_state"], "running, safety protective stop");
        report.controller(ROBOT_MODE_RUNNING, 1);
        assert_eq!(status(&report)["stop_cause"], "");
        assert_eq!(status(&report)["controller_says"].as_array().map(Vec::len), Some(6));
    }

    #[test]
    fn a_recovery_has_a_number_steps_and_an_end() {
        let report = Report::default();
        report.recovery_started();
        report.recovery_step("power on: Powering on");
        assert_eq!(status(&report)["recovery"]["running"], true);
        report.recovery_ended(Err("brakes".to_owned()));
        let s = status(&report);
        assert_eq!((&s["recovery"]["number"], &s["recovery"]["error"]), (&json!(1), &json!("brakes")));
        assert_eq!(
            (&s["recovery"]["steps"][0], &s["robot"]),
            (&json!("power on: Powering on"), &json!("not recovered: brakes"))
        );
        report.recovery_started();
        assert_eq!(status(&report)["recovery"]["steps"], json!([]));
    }
}
