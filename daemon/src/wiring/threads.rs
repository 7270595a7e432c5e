//! The daemon's scoped threads, one function each.

use crate::config::{Clock, Config};
use crate::links::LinkManager;
use crate::log;
use crate::realtime::{RealtimeReport, enter};
use crate::threads::{
    AcquireReport, CommandWorker, Report, Shared, VisionWorker, run_acquire, run_damage, run_telemetry,
};
use graspd_rt::arm::Dh;
use graspd_rt::cycle::CommandCycle;
use graspd_shm::ShmNode;
use std::io;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender};
use std::thread::{Builder, Scope};

/// What the threads need.
#[derive(Clone, Copy)]
pub(super) struct Threads<'a> {
    pub config: &'a Config,
    pub dh: Dh,
    pub node: &'a ShmNode,
    pub shared: &'a Shared,
    pub report: &'a Report,
    pub marks: &'a AcquireReport,
    pub recover: &'a AtomicBool,
    /// Files of the stop path, which the damage thread watches.
    pub stop_paths: &'a [PathBuf],
}

impl<'a> Threads<'a> {
    /// Starts all threads. The two real-time threads report to `host` what the host refused; the command thread then
    /// waits for its cycle.
    ///
    /// # Errors
    /// When a thread cannot be started.
    pub(super) fn start<'s>(
        self,
        scope: &'s Scope<'s, 'a>,
        host: Sender<RealtimeReport>,
        cycle: Receiver<CommandCycle>,
    ) -> io::Result<()> {
        let command_host = host.clone();
        spawn(scope, "command", move || self.command(&command_host, &cycle))?;
        spawn(scope, "vision", move || self.vision(&host))?;
        spawn(scope, "acquire", move || self.shared.guarded("acquire", || self.acquire()))?;
        spawn(scope, "telemetry", move || self.shared.guarded("telemetry", || self.telemetry()))?;
        spawn(scope, "link", move || self.shared.guarded("link", || self.link()))?;
        spawn(scope, "damage", move || {
            self.shared.guarded("damage", || run_damage(self.node, self.stop_paths, self.shared));
        })
    }

    fn command(&self, host: &Sender<RealtimeReport>, cycle: &Receiver<CommandCycle>) {
        let threads = &self.config.threads;
        let mut refused = RealtimeReport::default();
        enter("command", &threads.command, &mut refused);
        let _ = host.send(refused);
        let Ok(cycle) = cycle.recv() else { return };
        self.shared.guarded("command", || {
            let mut worker = CommandWorker::new(cycle, self.shared);
            match threads.clock {
                Clock::Robot => worker.run_with_robot(threads.period_ns()),
                Clock::Timer => worker.run(threads.period_ns(), threads.spin_ns),
            }
        });
    }

    fn vision(&self, host: &Sender<RealtimeReport>) {
        let mut worker = match VisionWorker::new(self.config, self.dh, self.node, self.shared) {
            Ok(worker) => worker,
            Err(e) => return self.fail(&e),
        };
        let mut refused = RealtimeReport::default();
        enter("vision", &self.config.threads.vision, &mut refused);
        let _ = host.send(refused);
        self.shared.guarded("vision", || worker.run(self.config.frames.poll_ns));
    }

    fn acquire(&self) {
        if let Err(e) = run_acquire(self.config, self.node, self.shared, self.marks) {
            self.fail(&e);
        }
    }

    fn telemetry(&self) {
        if let Err(e) = run_telemetry(self.config, self.node, self.shared, self.report) {
            log::message(&e);
        }
    }

    fn link(&self) {
        LinkManager::new(self.config, self.shared, self.report, self.recover).run();
    }

    /// Logs why a thread cannot run, and stops the daemon.
    fn fail(&self, error: &dyn std::fmt::Display) {
        log::message(error);
        self.shared.broken.store(true, Ordering::Release);
    }
}

fn spawn<'s>(scope: &'s Scope<'s, '_>, name: &str, work: impl FnOnce() + Send + 's) -> io::Result<()> {
    Builder::new().name(name.to_owned()).spawn_scoped(scope, work).map(drop)
}
