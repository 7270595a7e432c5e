//! The link manager: makes the robot link on an ordinary thread, hands it to the command thread, and takes failed links
//! back. It never arms.

use crate::arm::{
    ArmError, ArmLink, MessageListener, MockLimits, MockLink, RecoverTimes, UrConfig, UrLink, backoff_delay,
    check_kinematics, check_model, read_identity, walk_out,
};
use crate::config::{Config, Kinematics, LinkKind, ur_config};
use crate::threads::{Report, Shared};
use std::cell::RefCell;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Timeouts and pauses of the link manager.
#[derive(Clone, Copy, Debug)]
pub struct LinkTimes {
    /// Timeout of connecting and of each answer.
    pub timeout: Duration,
    /// Pause before attempt n, counted from 0.
    pub backoff: fn(u32) -> Duration,
    /// Timeouts of a recovery.
    pub recover: RecoverTimes,
}

impl Default for LinkTimes {
    fn default() -> Self {
        Self { timeout: Duration::from_secs(5), backoff: backoff_delay, recover: RecoverTimes::default() }
    }
}

/// Makes links and takes failed ones back.
#[derive(Debug)]
pub struct LinkManager<'a> {
    config: &'a Config,
    shared: &'a Shared,
    report: &'a Report,
    recover: &'a AtomicBool,
    times: LinkTimes,
    /// Receives why the controller stopped; `None` for the arm inside the daemon.
    messages: RefCell<Option<MessageListener>>,
}

impl<'a> LinkManager<'a> {
    /// A manager that has not made a link yet.
    pub fn new(config: &'a Config, shared: &'a Shared, report: &'a Report, recover: &'a AtomicBool) -> Self {
        Self::with_times(config, shared, report, recover, LinkTimes::default())
    }

    /// The same with other timeouts.
    pub fn with_times(
        config: &'a Config,
        shared: &'a Shared,
        report: &'a Report,
        recover: &'a AtomicBool,
        times: LinkTimes,
    ) -> Self {
        let messages = (config.arm.link == LinkKind::Rtde).then(|| MessageListener::new(&ur_config(config)));
        Self { config, shared, report, recover, times, messages: RefCell::new(messages) }
    }

    fn ur_config(&self) -> UrConfig {
        UrConfig { timeout: self.times.timeout, ..ur_config(self.config) }
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
                    let delay = (self.times.backoff)(attempt);
                    attempt += 1;
                    self.report.link(&format!("down: {e}"));
                    self.pause(delay);
                }
            }
        }
    }

    fn make(&self) -> Result<Box<dyn ArmLink>, ArmError> {
        match self.config.arm.link {
            LinkKind::Mock => {
                let q = [0.0, -1.2, 1.4, -1.8, -1.57, 0.0];
                Ok(Box::new(MockLink::new(q, MockLimits::of(self.config.arm.model))))
            }
            LinkKind::Rtde => {
                self.report.link("connecting");
                let config = self.ur_config();
                // The arm may be another one in each session: it is identified before anything can move it.
                let identity = read_identity(&config)?;
                check_model(&identity, self.config.arm.model)?;
                if let Kinematics::File(_, dh) = &self.config.arm.kinematics {
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

    /// Waits until the command thread returns the failed link. Carries out requested recoveries meanwhile.
    fn watch(&self) {
        while !self.shared.ending() {
            if let Some(link) = self.shared.link_dead.take() {
                let s = link.stats();
                let why = link.fault().map_or_else(String::new, |f| format!(": {f}"));
                self.report.link(&format!(
                    "lost after {} states and {} commands ({} states missed){why}",
                    s.received, s.sent, s.missing
                ));
                return;
            }
            if self.recover.swap(false, Ordering::AcqRel) {
                self.recover_now();
                // The recovery has ended the session's script: a new session follows.
                self.shared.drop_link.store(true, Ordering::Release);
            }
            self.report_messages();
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    /// Reports the controller's new messages.
    fn report_messages(&self) {
        if let Some(listener) = self.messages.borrow_mut().as_mut() {
            for message in listener.poll() {
                self.report.controller_message(&message);
            }
        }
    }

    /// Brings the controller to a running arm. The next session uploads the script and starts idle.
    fn recover_now(&self) {
        if self.config.arm.link != LinkKind::Rtde {
            self.report.recovery_ended(Ok(()));
            return;
        }
        self.report.recovery_started();
        let result = walk_out(&self.ur_config(), self.times.recover, &mut |step| {
            self.report.recovery_step(&format!("{}: {}", step.command, step.answer));
            self.report_messages();
        });
        self.report.recovery_ended(result.map(drop).map_err(|e| e.to_string()));
    }

    /// Waits for `delay`, or until an operator has requested a recovery and it has ended.
    fn pause(&self, delay: Duration) {
        let until = Instant::now() + delay;
        while Instant::now() < until && !self.shared.ending() {
            if self.recover.swap(false, Ordering::AcqRel) {
                self.recover_now();
                return;
            }
            self.report_messages();
            std::thread::sleep(Duration::from_millis(10));
        }
    }
}
