//! What ordinary threads tell each other for the status verb and the log. Locks live here, never on a real-time thread.

use crate::arm::{Said, SaidKind, robot_mode, safety_words};
use crate::log;
use crate::stop::Live;
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
    /// How the last link ended: "connecting" follows at once.
    last_loss: String,
    refused: Vec<String>,
    plan: String,
    refusal: String,
    lasting: Option<FaultCause>,
    sample: TelemetrySample,
    grip: Grip,
    /// Age of the newest usable image, ns; `u64::MAX` before the first.
    image_age_ns: u64,
    /// Robot mode and safety bits when the link last looked, for the time without telemetry.
    controller: Option<(i32, u32)>,
    /// What the controller has said, the newest last.
    said: VecDeque<String>,
    /// Why it stopped, as it said itself; empty once it runs again.
    stop_cause: String,
    stop_kind: Option<SaidKind>,
    recovery: Recovery,
}

/// A walk out of a stop that an operator has asked for.
#[derive(Clone, Debug, Default)]
struct Recovery {
    /// Counts them, so that who asked can tell the new one from the last.
    number: u64,
    running: bool,
    steps: Vec<String>,
    error: Option<String>,
}

/// Messages of the controller that are kept.
const SAID: usize = 8;
/// Steps of a recovery that are kept: the chain has fewer.
const STEPS: usize = 32;

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

/// Bits of `safety_status_bits` under which the arm does not move.
const STOPPED: u32 = 0b111_1111_0100;

/// Robot mode and safety in words: by telemetry while a link is up, otherwise as the last session found them.
fn controller_words(seen: Option<(i32, u32)>, t: &TelemetrySample) -> String {
    match if t.link == 2 && t.safety_bits != 0 { Some((t.robot_mode, t.safety_bits)) } else { seen } {
        Some((mode, safety)) => format!("{}, safety {}", robot_mode(mode), safety_words(safety)),
        None => "unknown".to_owned(),
    }
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
        if !matches!(event.why, Why::AtRest) {
            why.clone_into(&mut self.lock().cause);
        }
    }

    /// Notes a cycle.
    pub fn cycle(&self, record: &CycleRecord) {
        let mut s = self.lock();
        s.lasting = record.lasting;
        (s.grip, s.image_age_ns) = (record.grip, record.vision_age_ns);
    }

    /// What is wrong with the robot now (in a fault: what still would be after a reset), in words with its code.
    pub fn lasting(&self) -> Option<String> {
        self.lock().lasting.map(|cause| format!("{}: {cause}", cause.code()))
    }

    /// Why images are refused (empty where they are not), and the age of the newest usable one, ms.
    pub fn images(&self) -> (String, Option<f64>) {
        let s = self.lock();
        // 0 is what nobody has noted yet.
        let age = Some(s.image_age_ns).filter(|ns| *ns != u64::MAX && *ns != 0);
        (s.refusal.clone(), age.map(|ns| ns as f64 * 1e-6))
    }

    /// Notes the newest telemetry.
    pub fn sample(&self, sample: &TelemetrySample, _settled: bool) {
        self.lock().sample = *sample;
    }

    /// Notes how the robot link is, in words.
    pub fn link(&self, words: &str) {
        let mut s = self.lock();
        if s.link != words {
            log::say(format_args!("robot link: {words}"));
            if words.starts_with("lost") {
                words.clone_into(&mut s.last_loss);
            }
            words.clone_into(&mut s.link);
        }
    }

    /// Notes why images are being refused; empty when they are not.
    pub fn refusal(&self, words: &str) {
        words.clone_into(&mut self.lock().refusal);
    }

    /// Notes robot mode and safety bits as a new session found them.
    pub fn controller(&self, mode: i32, safety: u32) {
        let mut s = self.lock();
        s.controller = Some((mode, safety));
        if safety & STOPPED == 0 {
            s.stop_cause.clear();
            s.stop_kind = None;
        }
    }

    /// Notes a message of the controller.
    pub fn said(&self, said: &Said) {
        let mut s = self.lock();
        // An error says more than the change of safety mode that follows it, and both more than the program that ended by it.
        let normal = ["normal", "reduced"].iter().any(|w| said.text.starts_with(w));
        let stops = match (said.kind, s.stop_kind) {
            (SaidKind::Error, _) => true,
            (SaidKind::Safety, kind) => !normal && kind != Some(SaidKind::Error),
            (SaidKind::Program, kind) => kind.is_none_or(|k| k == SaidKind::Program),
            (SaidKind::Popup, _) => false,
        };
        if stops {
            s.stop_cause.clone_from(&said.text);
            s.stop_kind = Some(said.kind);
        }
        if s.said.back() != Some(&said.text) {
            log::say(format_args!("controller says: {}", said.text));
            if s.said.len() == SAID {
                s.said.pop_front();
            }
            s.said.push_back(said.text.clone());
        }
    }

    /// A recovery begins.
    pub fn recovering(&self) {
        {
            let r = &mut self.lock().recovery;
            *r = Recovery { number: r.number + 1, running: true, ..Recovery::default() };
        }
        self.link("recovering");
    }

    /// A step of it is done.
    pub fn recover_step(&self, words: &str) {
        log::say(format_args!("recover: {words}"));
        let steps = &mut self.lock().recovery.steps;
        if steps.len() < STEPS {
            steps.push(words.to_owned());
        }
    }

    /// It has ended.
    pub fn recovered(&self, result: Result<(), String>) {
        match &result {
            Ok(()) => self.link("recovered; connecting"),
            Err(e) => self.link(&format!("not recovered: {e}")),
        }
        let r = &mut self.lock().recovery;
        (r.running, r.error) = (false, result.err());
    }

    /// Notes what the host refused.
    pub fn refused(&self, what: &[String]) {
        for line in what {
            log::say(format_args!("not real-time: {line}"));
        }
        self.lock().refused.extend_from_slice(what);
    }

    /// Notes an accepted set-point.
    pub fn setpoint(&self, setpoint: &SetPoint, name: String) {
        let mut s = self.lock();
        s.plan = name;
        // Telemetry says the same a moment later; the answer to whoever sent it must not say "none" until then.
        s.sample.setpoint = setpoint.id;
        drop(s);
        let _ = self.setpoints.force_push(*setpoint);
    }

    /// The next accepted set-point, for the telemetry thread.
    pub fn setpoint_for_telemetry(&self) -> Option<SetPoint> {
        self.setpoints.pop()
    }

    /// The whole state as one JSON object, with what else the caller knows. Mode and motion are the last cycle's own; nothing is formatted under
    /// the lock.
    pub fn json(&self, accepted: bool, reason: Option<&str>, marks: &str, live: &Live, more: Value) -> String {
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
            "robot_state": controller_words(s.controller, t),
            "stop_cause": s.stop_cause,
            "controller_says": s.said,
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

    fn status(report: &Report) -> Value {
        serde_json::from_str(&report.json(true, None, "", &Live::default(), Value::Null)).unwrap()
    }

    #[test]
    fn the_cause_of_a_stop_outlives_what_follows_it_and_ends_with_the_stop() {
        let report = Report::default();
        let say = |kind, text: &str| report.said(&Said { kind, text: text.to_owned() });
        say(SaidKind::Program, "RTDE watchdog");
        assert_eq!(status(&report)["stop_cause"], "RTDE watchdog");
        say(SaidKind::Safety, "protective stop (C153A2)");
        assert_eq!(status(&report)["stop_cause"], "protective stop (C153A2)");
        say(SaidKind::Error, "C153A2 joint 2 left its path");
        for (kind, text) in
            [(SaidKind::Safety, "protective stop (C153A2)"), (SaidKind::Popup, "x: y"), (SaidKind::Safety, "normal")]
        {
            say(kind, text);
            assert_eq!(status(&report)["stop_cause"], "C153A2 joint 2 left its path");
        }
        report.controller(7, 0b100);
        assert_eq!(status(&report)["stop_cause"], "C153A2 joint 2 left its path");
        assert_eq!(status(&report)["robot_state"], "running, safety protective stop");
        report.controller(7, 1);
        assert_eq!(status(&report)["stop_cause"], "");
        assert_eq!(status(&report)["controller_says"].as_array().map(Vec::len), Some(6));
    }

    #[test]
    fn a_recovery_is_numbered_told_and_ended() {
        let report = Report::default();
        report.recovering();
        report.recover_step("power on: Powering on");
        assert_eq!(status(&report)["recovery"]["running"], true);
        report.recovered(Err("brakes".to_owned()));
        let s = status(&report);
        assert_eq!((&s["recovery"]["number"], &s["recovery"]["error"]), (&json!(1), &json!("brakes")));
        assert_eq!(
            (&s["recovery"]["steps"][0], &s["robot"]),
            (&json!("power on: Powering on"), &json!("not recovered: brakes"))
        );
        report.recovering();
        assert_eq!(status(&report)["recovery"]["steps"], json!([]));
    }
}
