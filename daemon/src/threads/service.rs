//! The service thread (the process's main thread): verbs, signals, supervision. It sends requests to the command thread
//! and never commands the arm.

use super::acquire::AcquireReport;
use super::advice::refusal_text;
use super::report::Report;
use super::shared::Shared;
use crate::arm::{UrConfig, stop_script};
use crate::config::{Config, LinkKind, ur_config};
use crate::log;
use crate::realtime::now_ns;
use crate::stop::StopSource;
use graspd_calib::files::PlanFile;
use graspd_rt::cycle::{CommandRequest, RequestKind};
use graspd_rt::mode::{ModeName, Reject};
use graspd_rt::setpoint::SetPoint;
use graspd_shm::control::{Request, RequestServer, Verb};
use serde_json::{Value, json};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Maximum age of a request that starts or allows motion, ns: an older one may no longer be what the operator wants.
const MAX_AGE_NS: u64 = 250_000_000;
/// Maximum lead of a request's stamp, ns. All processes share one monotonic clock: a later stamp was not taken from it,
/// and the request would never become too old.
const MAX_AHEAD_NS: u64 = 1_000_000;
/// Maximum image age that a refusal does not mention, ms.
const MAX_FRESH_IMAGE_MS: f64 = 100.0;
/// Timeout of ending the control script; the arm is at rest by then.
const SCRIPT_END_TIMEOUT: Duration = Duration::from_millis(300);
/// Timeout of an answer by the command thread: many cycles.
const ANSWER_TIMEOUT: Duration = Duration::from_millis(500);

/// What the service thread needs.
#[derive(Debug)]
pub struct Service<'a> {
    /// The configuration.
    pub config: &'a Config,
    /// Mailboxes and queues.
    pub shared: &'a Shared,
    /// State as text.
    pub report: &'a Report,
    /// Why the marks are not found.
    pub marks: &'a AcquireReport,
    /// Set to request a recovery from the link manager.
    pub recover: &'a AtomicBool,
}

impl Service<'_> {
    /// Answers one request.
    pub fn answer(&self, request: &Request, id: u64) {
        let result = match (request.verb, stamp_error(request.stamp_ns, now_ns())) {
            (Verb::Status, _) => Ok(()),
            (Verb::Stop, _) => {
                self.shared.live.stop(StopSource::Verb);
                Ok(())
            }
            (Verb::Reset, _) => self.ask(id, RequestKind::Reset),
            (_, Some(why)) => Err(why),
            (Verb::Arm, _) => self.ask(id, RequestKind::Arm),
            (Verb::Servo, _) => self.ask(id, RequestKind::Servo),
            (Verb::Setpoint, _) => self.setpoint(&request.payload),
            (Verb::Recover, _) => self.recover(id),
            (Verb::Gripper, _) => self.gripper(&request.payload, id),
        };
        if request.verb == Verb::Stop {
            self.wait_for_the_ramp();
        }
        let reason = result.as_ref().err().map(String::as_str);
        let more = self.configuration_status();
        let json = self.report.json(result.is_ok(), reason, &self.marks.text(), &self.shared.live, more);
        request.answer(result.is_ok(), &json);
    }

    /// The stop from full speed by the configuration, and its files that have changed since.
    fn configuration_status(&self) -> Value {
        let s = self.config.stop;
        let changed: Vec<String> =
            self.config.files.iter().filter(|f| f.changed()).map(|f| f.path.display().to_string()).collect();
        json!({
            "stop_from_full_speed": {
                "time_ms": s.time_s * 1e3, "joint_deg": s.joint_rad.to_degrees(), "tcp_mm": s.tcp_m * 1e3,
            },
            "configuration_changed": changed,
        })
    }

    /// The text of a refusal, with the state of the robot and the images where they are the reason.
    fn refused(&self, kind: RequestKind, reject: Reject) -> String {
        let text = refusal_text(kind, self.shared.live.mode().unwrap_or(ModeName::Idle), reject);
        let mut causes: Vec<String> = self.report.lasting().into_iter().collect();
        if matches!(reject, Reject::NoMarks | Reject::Settling | Reject::WrongMode) {
            let (refusal, age_ms) = self.report.images();
            if !refusal.is_empty() {
                causes.push(format!("images are refused: {refusal}"));
            }
            match age_ms {
                None => causes.push("no usable image has arrived yet".to_owned()),
                Some(ms) if ms > MAX_FRESH_IMAGE_MS => {
                    causes.push(format!("the newest usable image is {ms:.0} ms old"))
                }
                Some(_) => {}
            }
            causes.extend(Some(self.marks.text()).filter(|t| !t.is_empty()));
        }
        if causes.is_empty() { text } else { format!("{text} ({})", causes.join("; ")) }
    }

    /// Waits until the ramp of a stop has begun.
    fn wait_for_the_ramp(&self) {
        let until = Instant::now() + Duration::from_millis(100);
        while Instant::now() < until
            && matches!(self.shared.live.mode(), Some(ModeName::Servoing | ModeName::Converged))
        {
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    fn ask(&self, id: u64, kind: RequestKind) -> Result<(), String> {
        while self.shared.replies.pop().is_some() {}
        self.shared
            .requests
            .push(CommandRequest { id, kind })
            .map_err(|_| "the command thread does not accept requests: its queue is full".to_owned())?;
        let until = Instant::now() + ANSWER_TIMEOUT;
        while Instant::now() < until {
            if let Some(reply) = self.shared.replies.pop()
                && reply.id == id
            {
                return reply.result.map_err(|r| self.refused(kind, r));
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        Err("the command thread does not answer; run `graspd status`".to_owned())
    }

    fn setpoint(&self, payload: &[u8]) -> Result<(), String> {
        let text = std::str::from_utf8(payload).map_err(|e| format!("the plan is not UTF-8 text ({e})"))?;
        let (name, setpoint) = self.read_plan(text)?;
        while self.shared.setpoint_reply.take().is_some() {}
        self.shared.setpoint.put(setpoint);
        let until = Instant::now() + ANSWER_TIMEOUT;
        while Instant::now() < until {
            if let Some(reply) = self.shared.setpoint_reply.take() {
                reply.map_err(|r| r.reason().to_owned())?;
                self.report.setpoint(&setpoint, name);
                return Ok(());
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        Err("the command thread does not answer; run `graspd status`".to_owned())
    }

    fn read_plan(&self, text: &str) -> Result<(String, SetPoint), String> {
        let plan = PlanFile::parse(text, "the plan").map_err(|e| e.to_string())?;
        let c = self.config;
        let (rig, gripper) = (c.rig_path.display().to_string(), c.gripper_path.display().to_string());
        let setpoint =
            plan.set_point(text, "the plan", (&rig, &c.rig), (&gripper, &c.gripper)).map_err(|e| e.to_string())?;
        Ok((format!("{} at {:.3} m", plan.object.model, setpoint.object_centre.norm()), setpoint))
    }

    fn gripper(&self, payload: &[u8], id: u64) -> Result<(), String> {
        let task = &self.config.task;
        let (close, outputs) = match payload {
            b"close" => (true, task.close_outputs),
            b"open" => (false, task.open_outputs),
            _ => return Err("the gripper can `close` or `open`".to_owned()),
        };
        if outputs == 0 {
            return Err("no outputs are configured for this: list them in [gripper] of the configuration".to_owned());
        }
        self.ask(id, RequestKind::Gripper { close })
    }

    fn recover(&self, id: u64) -> Result<(), String> {
        match self.shared.live.mode() {
            Some(ModeName::Servoing | ModeName::Converged | ModeName::Stopping) => {
                return Err("the arm is moving; stop first".to_owned());
            }
            // A recovery ends the session, which would be a fault while armed.
            Some(ModeName::Armed) => self.ask(id, RequestKind::Disarm)?,
            _ => {}
        }
        self.recover.store(true, Ordering::Release);
        Ok(())
    }

    /// Serves until the end is requested or a thread has failed, then ramps the arm down.
    pub fn serve(&self, server: &RequestServer) {
        let mut id = 1;
        let mut cycles = (0, Instant::now());
        let mut failing = false;
        while !self.shared.live.ending() && !self.shared.broken.load(Ordering::Acquire) {
            match server.next() {
                Ok(Some(request)) => {
                    id += 1;
                    self.answer(&request, id);
                }
                Ok(None) => std::thread::sleep(Duration::from_millis(2)),
                Err(e) => {
                    if !std::mem::replace(&mut failing, true) {
                        log::message(&e);
                    }
                    std::thread::sleep(Duration::from_millis(200));
                }
            }
            let now = self.shared.live.cycles();
            if now != cycles.0 {
                cycles = (now, Instant::now());
            } else if cycles.1.elapsed() > Duration::from_secs(2) {
                log::message(
                    "the command thread has not run for 2 s; the process ends, and the robot's own watchdog stops the arm",
                );
                self.shared.broken.store(true, Ordering::Release);
            }
        }
        self.ramp_down();
    }

    /// Stops the arm, waits until it is at rest, and ends the control script, so that the robot's watchdog need not end
    /// it.
    fn ramp_down(&self) {
        let live = &self.shared.live;
        live.stop(StopSource::Ending);
        // From here on every cycle requests a stop, also when no signal requested the end.
        live.end.store(true, Ordering::Release);
        let (from, until) = (live.cycles(), Instant::now() + ramp_limit(self.config));
        while Instant::now() < until && (live.moving() || live.cycles() < from + 2) {
            std::thread::sleep(Duration::from_millis(2));
        }
        if self.config.arm.link == LinkKind::Rtde && live.linked() && !live.moving() {
            let config = UrConfig { timeout: SCRIPT_END_TIMEOUT, ..ur_config(self.config) };
            if let Err(e) = stop_script(&config) {
                log::message(format_args!(
                    "the control script could not be ended and stops by the controller's watchdog: {e}"
                ));
            }
        }
    }
}

/// Maximum time until the arm is at rest: twice the stop from full speed within the configured limits.
pub fn ramp_limit(config: &Config) -> Duration {
    Duration::from_secs_f64((2.0 * config.stop.time_s).clamp(0.3, 5.0))
}

/// Why the stamp of a request is invalid; `None` where it is valid.
fn stamp_error(stamp_ns: u64, now_ns: u64) -> Option<String> {
    if now_ns.saturating_sub(stamp_ns) > MAX_AGE_NS {
        return Some("the request is older than 250 ms and was not executed; send it again".to_owned());
    }
    let ahead = stamp_ns.saturating_sub(now_ns);
    (ahead > MAX_AHEAD_NS).then(|| {
        format!(
            "the request is stamped {:.1} ms in the future and was not executed; stamp it with CLOCK_MONOTONIC of this host",
            ahead as f64 * 1e-6
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stamps_are_accepted_within_their_bounds_only() {
        let now = 10_000_000_000;
        for (stamp, valid) in [
            (now, true),
            (now - MAX_AGE_NS, true),
            (now - MAX_AGE_NS - 1, false),
            (now + MAX_AHEAD_NS, true),
            (now + MAX_AHEAD_NS + 1, false),
            (u64::MAX, false),
            (0, false),
        ] {
            assert_eq!(stamp_error(stamp, now).is_none(), valid, "{stamp}");
        }
    }
}
