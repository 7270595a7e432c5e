//! The service thread (the process's main thread): verbs, signals, supervision. It asks the command thread and never commands.

use super::acquire::AcquireReport;
use super::report::Report;
use super::shared::Shared;
use crate::arm::{UrConfig, stop_script};
use crate::config::{Config, LinkKind};
use crate::links::ur_config;
use crate::log;
use crate::realtime::now_ns;
use crate::stop::By;
use graspd_calib::files::PlanFile;
use graspd_rt::cycle::{Request as CycleRequest, RequestKind};
use graspd_rt::mode::ModeName;
use graspd_rt::setpoint::SetPoint;
use graspd_shm::control::{Request, RequestServer, Verb};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Requests that start or allow motion are refused when older than this: a late message is not an operator's will any more.
const MAX_AGE_NS: u64 = 250_000_000;
/// How long ending the control script may take; the arm rests already.
const SCRIPT_END: Duration = Duration::from_millis(300);
/// How long the command thread may take to answer: many beats.
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
        let stale = now_ns().saturating_sub(request.stamp_ns) > MAX_AGE_NS;
        let result = match request.verb {
            Verb::Status => Ok(()),
            Verb::Stop => {
                self.shared.live.stop(By::Verb);
                Ok(())
            }
            Verb::Arm | Verb::Servo | Verb::Setpoint | Verb::Gripper if stale => {
                Err("the request is older than 250 ms and is not carried out; send it again".to_owned())
            }
            Verb::Arm => self.ask(id, RequestKind::Arm).map_err(|e| self.with_cause(e)),
            Verb::Servo => self.ask(id, RequestKind::Servo).map_err(|e| self.with_cause(e)),
            Verb::Reset => self.ask(id, RequestKind::Reset).map_err(|e| self.with_cause(e)),
            Verb::Setpoint => self.setpoint(&request.payload),
            Verb::Recover => self.recover(),
            Verb::Gripper => self.gripper(&request.payload, id),
        };
        if request.verb == Verb::Stop {
            self.wait_for_the_ramp();
        }
        let reason = result.as_ref().err().map(String::as_str);
        request
            .answer(result.is_ok(), &self.report.json(result.is_ok(), reason, &self.marks.text(), &self.shared.live));
    }

    /// A refusal, and what is wrong with the robot if anything is.
    fn with_cause(&self, refusal: String) -> String {
        match self.report.lasting() {
            Some(cause) => format!("{refusal} ({cause})"),
            None => refusal,
        }
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
            .push(CycleRequest { id, kind })
            .map_err(|_| "the command thread does not take requests".to_owned())?;
        let until = Instant::now() + ANSWER_WITHIN;
        while Instant::now() < until {
            if let Some(reply) = self.shared.replies.pop()
                && reply.id == id
            {
                return reply.result.map_err(|r| r.reason().to_owned());
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

    fn recover(&self) -> Result<(), String> {
        if matches!(self.shared.live.mode(), Some(ModeName::Servoing | ModeName::Converged | ModeName::Stopping)) {
            return Err("the arm is moving; stop first".to_owned());
        }
        self.recover.store(true, Ordering::Release);
        Ok(())
    }

    /// Serves until the end is asked for, or a thread broke. Then the arm is ramped down before this returns.
    pub fn serve(&self, server: &RequestServer) {
        let mut id = 1;
        let mut beats = (0, Instant::now());
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
            let now = self.shared.live.beats();
            if now != beats.0 {
                beats = (now, Instant::now());
            } else if beats.1.elapsed() > Duration::from_secs(2) {
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
        // From here on every beat asks for a stop, also where no signal has asked for the end.
        live.end.store(true, Ordering::Release);
        let (from, until) = (live.beats(), Instant::now() + ramp_limit(self.config));
        while Instant::now() < until && (live.moving() || live.beats() < from + 2) {
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

/// How long the arm may take to rest: twice the ramp from full speed within the configured limits.
pub fn ramp_limit(config: &Config) -> Duration {
    let l = &config.raw.limits;
    let ramp_s = l.joint_speed_rad_s / l.joint_accel_rad_s2 + l.joint_accel_rad_s2 / l.joint_jerk_rad_s3;
    Duration::from_secs_f64((2.0 * ramp_s).clamp(0.3, 5.0))
}
