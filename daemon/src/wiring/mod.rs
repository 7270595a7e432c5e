//! `graspd run`: from the configuration to running threads, and back to an exit code.

mod startup;
mod threads;

use crate::config::{Config, cycle_config, limit_failure};
use crate::exit::{Exit, Failure};
use crate::log;
use crate::realtime::{RealtimeReport, lock_memory};
use crate::stop::{LiveState, StopEndpoint, catch_signals};
use crate::threads::{AcquireReport, Report, Service, Shared};
use graspd_rt::cycle::CommandCycle;
use graspd_shm::control::RequestServer;
use graspd_shm::create_node;
use startup::{arm_kinematics, start_stop_thread};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;
use threads::Threads;

/// Runs the daemon until a signal ends it.
///
/// # Errors
/// A link that cannot be made at the start, a host that refuses real-time scheduling where it is required, or a bug of
/// graspd.
pub fn run(config: &Config, config_path: &Path) -> Result<Exit, Failure> {
    log::start().map_err(|e| Failure::link(format!("the log thread cannot be started ({e})")))?;
    let shared = Shared::default();
    catch_signals(&shared.live).map_err(|e| {
        Failure::link(format!(
            "signal handlers cannot be installed ({e}), and a signal would end the daemon without a stop"
        ))
    })?;
    // Before anything else: this refuses a second daemon in the cell before it connects to a robot.
    config.names.ensure_root(false).map_err(|e| Failure::link(e.to_string()))?;
    let mut endpoint = StopEndpoint::open(&config.names)?;
    start_stop_thread(config, &mut endpoint, &shared.live)?;
    let _close = CloseOnDrop(&shared.live);
    let node = create_node(&config.names, "graspd").map_err(|e| Failure::link(e.to_string()))?;
    let server = RequestServer::new(&node).map_err(|e| Failure::link(e.to_string()))?;
    let report = Report::default();
    let Some(dh) = arm_kinematics(config, &report, &server, &shared.live)? else { return Ok(Exit::Done) };

    let (marks, recover) = (AcquireReport::default(), AtomicBool::new(false));
    let mut host = RealtimeReport::default();
    lock_memory(&mut host);
    let parts = Threads {
        config,
        dh,
        node: &node,
        shared: &shared,
        report: &report,
        marks: &marks,
        recover: &recover,
        stop_paths: endpoint.paths(),
    };
    std::thread::scope(|scope| -> Result<Exit, Failure> {
        // Also after a panic: the scope waits for its threads, and they run until shutdown.
        let _shutdown = ShutdownOnDrop(&shared);
        let (host_sender, host_reports) = channel::<RealtimeReport>();
        let (cycle_sender, cycle_receiver) = channel::<CommandCycle>();
        parts.start(scope, host_sender, cycle_receiver).map_err(|e| {
            Failure::link(format!("a thread could not be started ({e}); raise the thread limit of the process"))
        })?;
        check_host(config, &report, &mut host, &host_reports)?;
        // The command thread waits for this: whether missed cycles are a fault depends on the host.
        let cycle = CommandCycle::new(cycle_config(config, dh, host.complete()))
            .map_err(|e| limit_failure(config_path, &config.limits, &e))?;
        let _ = cycle_sender.send(cycle);
        let ready = serde_json::json!({ "ready": true, "pid": std::process::id(), "cell": config.names.cell() });
        log::line(log::Stream::Out, ready.to_string());
        let service = Service { config, shared: &shared, report: &report, marks: &marks, recover: &recover };
        shared.guarded("service", || service.serve(&server));
        let result = exit_of(&shared);
        shared.live.finish(result.as_ref().map_or_else(|failure| failure.exit.code(), |exit| exit.code()));
        result
    })
}

/// Time for each real-time thread to report what the host refused.
const HOST_REPORT_TIMEOUT: Duration = Duration::from_secs(5);

/// Collects what the host refused to the two real-time threads, and refuses a host that the configuration does not
/// allow.
fn check_host(
    config: &Config,
    report: &Report,
    host: &mut RealtimeReport,
    reports: &Receiver<RealtimeReport>,
) -> Result<(), Failure> {
    for _ in 0..2 {
        if let Ok(thread) = reports.recv_timeout(HOST_REPORT_TIMEOUT) {
            host.refused.extend(thread.refused);
        }
    }
    report.host_refused(&host.refused);
    if config.threads.require_realtime && !host.complete() {
        return Err(Failure::link(format!(
            "loop.require_realtime is true and the host refused: {}",
            host.refused.join("; ")
        )));
    }
    Ok(())
}

/// The exit code after the service has ended.
fn exit_of(shared: &Shared) -> Result<Exit, Failure> {
    if shared.broken.load(Ordering::Acquire) {
        return Err(Failure::fault("a thread of the daemon failed; the arm was stopped; see the log lines above"));
    }
    // The damage is in the log already; it decides the exit code as well.
    shared.damage.get().map_or(Ok(Exit::Done), |reason| Err(Failure::link(reason.clone())))
}

/// Ends the threads when it is dropped.
struct ShutdownOnDrop<'a>(&'a Shared);

impl Drop for ShutdownOnDrop<'_> {
    fn drop(&mut self) {
        self.0.shutdown.store(true, Ordering::Release);
    }
}

/// Ends the stop thread when it is dropped, so that it does not outlast the daemon in a process that continues.
struct CloseOnDrop<'a>(&'a LiveState);

impl Drop for CloseOnDrop<'_> {
    fn drop(&mut self) {
        self.0.close();
    }
}
