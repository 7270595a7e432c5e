//! The link manager: makes the robot link on an ordinary thread, hands it to the command thread, takes dead ones back. It never arms.

use crate::arm::{
    ArmError, ArmLink, MockArm, MockLimits, Motion, UrConfig, UrLink, backoff_delay, fresh_token, recover,
};
use crate::config::{Config, LinkKind};
use crate::threads::{Report, Shared};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// How a UR controller of this configuration is talked to.
pub fn ur_config(config: &Config) -> UrConfig {
    let raw = &config.raw;
    let ranges = config.model.joints();
    UrConfig {
        port_offset: raw.arm.port_offset,
        beat_hz: raw.beat.rate_hz,
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

/// Makes links and takes them back.
#[derive(Debug)]
pub struct LinkManager<'a> {
    config: &'a Config,
    shared: &'a Shared,
    report: &'a Report,
    recover: &'a AtomicBool,
}

impl<'a> LinkManager<'a> {
    /// A manager that has made nothing yet.
    pub fn new(config: &'a Config, shared: &'a Shared, report: &'a Report, recover: &'a AtomicBool) -> Self {
        Self { config, shared, report, recover }
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
                    let delay = backoff_delay(attempt);
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
                let config = ur_config(self.config);
                let mut link = UrLink::connect(&config)?;
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
                self.report.link(&format!(
                    "lost after {} states and {} commands ({} states missed)",
                    s.received, s.sent, s.missing
                ));
                return;
            }
            if self.recover.swap(false, Ordering::AcqRel) {
                self.recover_now();
                // A new session follows in any case: the old one's script is gone.
                self.shared.drop_link.store(true, Ordering::Release);
            }
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    fn recover_now(&self) {
        if self.config.link != LinkKind::Rtde {
            return;
        }
        let config = ur_config(self.config);
        self.report.link("recovering");
        let result = recover(&config, fresh_token(), 1.0 / 500.0, |step| {
            eprintln!("graspd: recover: {} -> {}", step.command, step.answer);
        });
        match result {
            Ok(()) => self.report.link("recovered; connecting"),
            Err(e) => self.report.link(&format!("not recovered: {e}")),
        }
    }

    /// Waits, but not longer than it takes for an operator to ask for a recovery.
    fn pause(&self, delay: Duration) {
        let until = Instant::now() + delay;
        while Instant::now() < until && !self.shared.ending() {
            if self.recover.swap(false, Ordering::AcqRel) {
                self.recover_now();
                return;
            }
            std::thread::sleep(Duration::from_millis(10));
        }
    }
}
