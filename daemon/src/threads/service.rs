//! The service thread (the process's main thread): verbs, signals, supervision. It asks the command thread and never commands.

use super::acquire::AcquireReport;
use super::advice;
use super::report::Report;
use super::shared::Shared;
use crate::arm::{UrConfig, stop_script};
use crate::config::{Config, LinkKind};
use crate::links::ur_config;
use crate::log;
use crate::realtime::now_ns;
use crate::stop::By;
use graspd_calib::files::PlanFile;
use graspd_rt::cycle::{CommandRequest, RequestKind};
use graspd_rt::mode::{ModeName, Reject};
use graspd_rt::setpoint::SetPoint;
use graspd_shm::control::{Request, RequestServer, Verb};
use serde_json::{Value, json};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Requests that start or allow motion are refused when older than this: a late message is not an operator's will any more.
const MAX_AGE_NS: u64 = 250_000_000;
/// One monotonic clock serves the whole host: a stamp later than this after now was not taken from it, and would never
/// grow old.
const MAX_AHEAD_NS: u64 = 1_000_000;
/// Images older than this are part of the answer to why the arm cannot be armed.
const OLD_IMAGE_MS: f64 = 100.0;
/// How long ending the control script may take; the arm rests already.
const SCRIPT_END: Duration = Duration::from_millis(300);
/// How long the command thread may take to answer: many cycles.
const ANSWER_WITHIN: Duration = Duration::from_millis(500);

/// What the service thread needs.
#[derive(Debug)]
pub struct Service<'a> {
    /// The configuration, with the path of its file.
    pub config: &'a Config,
    /// Its path, for the names in messages.
    pub config_path: &'a Path,
    /// Slots and queues.
    pub shared: &'a Shared,
    /// State in words.
    pub report: &'a Report,
    /// Why the marks are not found.
    pub marks: &'a AcquireReport,
    /// Asks the link manager to walk the controller out of a stop.
    pub recover: &'a AtomicBool,
}

impl Service<'_> {
    /// Answers one request.
    pub fn answer(&self, request: &Request, id: u64) {
        let result = match (request.verb, out_of_time(request.stamp_ns, now_ns())) {
            (Verb::Status, _) => Ok(()),
            (Verb::Stop, _) => {
                self.shared.live.stop(By::Verb);
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
        let more = self.configured();
        let json = self.report.json(result.is_ok(), reason, &self.marks.text(), &self.shared.live, more);
        request.answer(result.is_ok(), &json);
    }

    /// What the configuration promises, and whether its files still say so.
    fn configured(&self) -> Value {
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

    /// A refusal in words; where the robot or the images are what is missing, with all that the status knows of them.
    fn refused(&self, kind: RequestKind, reject: Reject) -> String {
        let words = advice::refusal(kind, self.shared.live.mode().unwrap_or(ModeName::Idle), reject);
        let mut causes: Vec<String> = self.report.lasting().into_iter().collect();
        if matches!(reject, Reject::NoMarks | Reject::Settling | Reject::WrongMode) {
            let (refusal, age_ms) = self.report.images();
            if !refusal.is_empty() {
                causes.push(format!("images are refused: {refusal}"));
            }
            match age_ms {
                None => causes.push("no usable image has come yet".to_owned()),
                Some(ms) if ms > OLD_IMAGE_MS => causes.push(format!("the newest usable image is {ms:.0} ms old")),
                Some(_) => {}
            }
            causes.extend(Some(self.marks.text()).filter(|t| !t.is_empty()));
        }
        if causes.is_empty() { words } else { format!("{words} ({})", causes.join("; ")) }
    }

    /// A stop is answered when its ramp has begun.
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
            .map_err(|_| "the command thread does not take requests".to_owned())?;
        let until = Instant::now() + ANSWER_WITHIN;
        while Instant::now() < until {
            if let Some(reply) = self.shared.replies.pop()
                && reply.id == id
            {
                return reply.result.map_err(|r| self.refused(kind, r));
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        Err("the command thread does not answer".to_owned())
    }

    fn setpoint(&self, payload: &[u8]) -> Result<(), String> {
        let text = std::str::from_utf8(payload).map_err(|e| format!("the plan is not UTF-8 text ({e})"))?;
        let (name, setpoint) = self.read_plan(text)?;
        while self.shared.setpoint_reply.take().is_some() {}
        self.shared.setpoint.put(setpoint);
        let until = Instant::now() + ANSWER_WITHIN;
        while Instant::now() < until {
            if let Some(reply) = self.shared.setpoint_reply.take() {
                reply.map_err(|r| r.reason().to_owned())?;
                self.report.setpoint(&setpoint, name);
                return Ok(());
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        Err("the command thread does not answer".to_owned())
    }

    fn read_plan(&self, text: &str) -> Result<(String, SetPoint), String> {
        let folder = self.config_path.parent().unwrap_or(Path::new("."));
        let shown = |p: &Path| folder.join(p).display().to_string();
        let plan = PlanFile::parse(text, "the plan").map_err(|e| e.to_string())?;
        let (rig, gripper) = (shown(&self.config.raw.files.rig), shown(&self.config.raw.files.gripper));
        let setpoint = plan
            .set_point(text, "the plan", (&rig, &self.config.rig), (&gripper, &self.config.gripper))
            .map_err(|e| e.to_string())?;
        Ok((format!("{} at {:.3} m", plan.object.model, setpoint.object_centre.norm()), setpoint))
    }

    fn gripper(&self, payload: &[u8], id: u64) -> Result<(), String> {
        let g = &self.config.raw.gripper;
        let (close, outputs) = match payload {
            b"close" => (true, [&g.close_set, &g.close_clear]),
            b"open" => (false, [&g.open_set, &g.open_clear]),
            _ => return Err("ask the gripper to `close` or to `open`".to_owned()),
        };
        if outputs.iter().all(|list| list.is_empty()) {
            return Err("no outputs move the gripper that way: name them in [gripper] of the configuration".to_owned());
        }
        self.ask(id, RequestKind::Gripper { close })
    }

    fn recover(&self, id: u64) -> Result<(), String> {
        match self.shared.live.mode() {
            Some(ModeName::Servoing | ModeName::Converged | ModeName::Stopping) => {
                return Err("the arm is moving; stop first".to_owned());
            }
            // A recovery ends the session, which is a fault to whoever is armed; what is asked for is an idle arm.
            Some(ModeName::Armed) => self.ask(id, RequestKind::Disarm)?,
            _ => {}
        }
        self.recover.store(true, Ordering::Release);
        Ok(())
    }

    /// Serves until the end is asked for, or a thread broke. Then the arm is ramped down before this returns.
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
                        log::say(&e);
                    }
                    std::thread::sleep(Duration::from_millis(200));
                }
            }
            let now = self.shared.live.cycles();
            if now != cycles.0 {
                cycles = (now, Instant::now());
            } else if cycles.1.elapsed() > Duration::from_secs(2) {
                log::say(
                    "the command thread has stood still for 2 s; ending, so that the robot's own watchdog holds it stopped",
                );
                self.shared.broken.store(true, Ordering::Release);
            }
        }
        self.ramp_down();
    }

    /// Stops the arm, waits until it rests, and ends the control script: the arm is then left to no watchdog.
    fn ramp_down(&self) {
        let live = &self.shared.live;
        live.stop(By::Ending);
        // From here on every cycle asks for a stop, also where no signal has asked for the end.
        live.end.store(true, Ordering::Release);
        let (from, until) = (live.cycles(), Instant::now() + ramp_limit(self.config));
        while Instant::now() < until && (live.moving() || live.cycles() < from + 2) {
            std::thread::sleep(Duration::from_millis(2));
        }
        if self.config.link == LinkKind::Rtde && live.linked() && !live.moving() {
            let config = UrConfig { timeout: SCRIPT_END, ..ur_config(self.config) };
            if let Err(e) = stop_script(&config) {
                log::say(format_args!("the control script is left to the controller's watchdog: {e}"));
            }
        }
    }
}

/// How long the arm may take to rest: twice the stop from full speed within the configured limits.
pub fn ramp_limit(config: &Config) -> Duration {
    Duration::from_secs_f64((2.0 * config.stop.time_s).clamp(0.3, 5.0))
}

/// Why a request's stamp does not allow it to be carried out; `None` where it does.
fn out_of_time(stamp_ns: u64, now_ns: u64) -> Option<String> {
    if now_ns.saturating_sub(stamp_ns) > MAX_AGE_NS {
        return Some("the request is older than 250 ms and is not carried out; send it again".to_owned());
    }
    let ahead = stamp_ns.saturating_sub(now_ns);
    (ahead > MAX_AHEAD_NS).then(|| {
        format!(
            "the request is stamped {:.1} ms in the future and is not carried out; stamp it by CLOCK_MONOTONIC of this host",
            ahead as f64 * 1e-6
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stamps_are_believed_within_their_bounds_only() {
        let now = 10_000_000_000;
        for (stamp, fine) in [
            (now, true),
            (now - MAX_AGE_NS, true),
            (now - MAX_AGE_NS - 1, false),
            (now + MAX_AHEAD_NS, true),
            (now + MAX_AHEAD_NS + 1, false),
            (u64::MAX, false),
            (0, false),
        ] {
            assert_eq!(out_of_time(stamp, now).is_none(), fine, "{stamp}");
        }
    }
}
