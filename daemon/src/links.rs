//! The link manager: makes the robot link on an ordinary thread, hands it to the command thread, takes dead ones back. It never arms.

use crate::arm::{
    ArmError, ArmLink, Ear, MockArm, MockLimits, Motion, RecoverTimes, UrConfig, UrLink, backoff_delay,
    check_kinematics, check_model, read_identity, walk_out,
};
use crate::config::{Config, Kinematics, LinkKind};
use crate::threads::{Report, Shared};
use std::cell::RefCell;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// How a UR controller of this configuration is talked to.
pub fn ur_config(config: &Config) -> UrConfig {
    let raw = &config.raw;
    let ranges = config.model.joints();
    UrConfig {
        port_offset: raw.arm.port_offset,
        cycle_hz: raw.cycle.rate_hz,
        motion: if raw.arm.motion == "position" { Motion::Position } else { Motion::Velocity },
        // The script refuses what exceeds these, so they carry the guard's own limits with room for rounding, never above the arm's.
        speed_limits: ranges.map(|r| (raw.limits.joint_speed_rad_s * 1.02).min(r.speed)),
        // speedj must be able to follow every set-point within a step; the acceleration limit itself is the guard's.
        acceleration: 40.0,
        stop_acceleration: raw.limits.joint_accel_rad_s2.max(4.0),
        watchdog_ms: raw.arm.watchdog_ms,
        ..UrConfig::new(raw.arm.address.clone(), config.model)
    }
}

/// How long things may take.
#[derive(Clone, Copy, Debug)]
pub struct Pace {
    /// Connecting, and each answer.
    pub timeout: Duration,
    /// Pause before attempt n, from 0.
    pub backoff: fn(u32) -> Duration,
    /// Powering up and unlocking.
    pub recover: RecoverTimes,
}

impl Default for Pace {
    fn default() -> Self {
        Self { timeout: Duration::from_secs(5), backoff: backoff_delay, recover: RecoverTimes::default() }
    }
}

/// Makes links and takes them back.
#[derive(Debug)]
pub struct LinkManager<'a> {
    config: &'a Config,
    shared: &'a Shared,
    report: &'a Report,
    recover: &'a AtomicBool,
    pace: Pace,
    /// Hears why the controller stopped; `None` for the arm inside the daemon.
    ear: RefCell<Option<Ear>>,
}

impl<'a> LinkManager<'a> {
    /// A manager that has made nothing yet.
    pub fn new(config: &'a Config, shared: &'a Shared, report: &'a Report, recover: &'a AtomicBool) -> Self {
        Self::with_pace(config, shared, report, recover, Pace::default())
    }

    /// The same at another pace.
    pub fn with_pace(
        config: &'a Config,
        shared: &'a Shared,
        report: &'a Report,
        recover: &'a AtomicBool,
        pace: Pace,
    ) -> Self {
        let ear = (config.link == LinkKind::Rtde).then(|| Ear::new(&ur_config(config)));
        Self { config, shared, report, recover, pace, ear: RefCell::new(ear) }
    }

    fn ur_config(&self) -> UrConfig {
        UrConfig { timeout: self.pace.timeout, ..ur_config(self.config) }
    }

    /// Runs until shutdown.
    pub fn run(&self) {
        let mut attempt = 0;
        while !self.shared.ending() {
            match self.make() {
                Ok(link) => {
                    attempt = 0;
                    self.report.link("up");
                    self.shared.link_ready.put(link);
                    self.watch();
                }
                Err(e) => {
                    let delay = (self.pace.backoff)(attempt);
                    attempt += 1;
                    self.report.link(&format!("down: {e}"));
                    self.pause(delay);
                }
            }
        }
    }

    fn make(&self) -> Result<Box<dyn ArmLink>, ArmError> {
        match self.config.link {
            LinkKind::Mock => {
                let q = [0.0, -1.2, 1.4, -1.8, -1.57, 0.0];
                Ok(Box::new(MockArm::new(q, MockLimits::of(self.config.model))))
            }
            LinkKind::Rtde => {
                self.report.link("connecting");
                let config = self.ur_config();
                // Every session may be with another arm: who it is comes before anything that could move it.
                let identity = read_identity(&config)?;
                check_model(&identity, self.config.model)?;
                if let Kinematics::File(_, dh) = &self.config.kinematics {
                    check_kinematics(&identity, dh)?;
                }
                let mut link = UrLink::connect(&config)?;
                if let Some(state) = link.state() {
                    self.report.controller(state.robot_mode, state.safety_status_bits);
                }
                link.bring_up(&config)?;
                Ok(Box::new(link))
            }
        }
    }

    /// Returns when the link came back dead, or an operator asked for a recovery and it is done.
    fn watch(&self) {
        while !self.shared.ending() {
            if let Some(dead) = self.shared.link_dead.take() {
                let s = dead.stats();
                let why = dead.fault().map_or_else(String::new, |f| format!(": {f}"));
                self.report.link(&format!(
                    "lost after {} states and {} commands ({} states missed){why}",
                    s.received, s.sent, s.missing
                ));
                return;
            }
            if self.recover.swap(false, Ordering::AcqRel) {
                self.recover_now();
                // A new session follows in any case: the old one's script is gone.
                self.shared.drop_link.store(true, Ordering::Release);
            }
            self.listen();
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    /// Takes what the controller has said.
    fn listen(&self) {
        if let Some(ear) = self.ear.borrow_mut().as_mut() {
            for said in ear.listen() {
                self.report.said(&said);
            }
        }
    }

    /// Walks the controller to a running arm. The script comes with the next session, which begins idle.
    fn recover_now(&self) {
        if self.config.link != LinkKind::Rtde {
            self.report.recovered(Ok(()));
            return;
        }
        self.report.recovering();
        let result = walk_out(&self.ur_config(), self.pace.recover, &mut |step| {
            self.report.recover_step(&format!("{}: {}", step.command, step.answer));
            self.listen();
        });
        self.report.recovered(result.map(drop).map_err(|e| e.to_string()));
    }

    /// Waits, but not longer than it takes for an operator to ask for a recovery.
    fn pause(&self, delay: Duration) {
        let until = Instant::now() + delay;
        while Instant::now() < until && !self.shared.ending() {
            if self.recover.swap(false, Ordering::AcqRel) {
                self.recover_now();
                return;
            }
            self.listen();
            std::thread::sleep(Duration::from_millis(10));
        }
    }
}
