//! From settings to threads: the one place where everything meets.

use crate::config::{Config, Kinematics, LinkKind, cycle_config};
use crate::exit::{Exit, Failure};
use crate::links::{LinkManager, ur_config};
use crate::realtime::{RealtimeReport, ThreadSettings, enter, lock_memory};
use crate::threads::{AcquireReport, CommandWorker, Report, Service, Shared, VisionWorker, run_acquire, run_telemetry};
use graspd_rt::arm::Dh;
use graspd_rt::cycle::CommandCycle;
use graspd_shm::control::{RequestServer, Verb};
use graspd_shm::create_node;
use serde_json::Value;
use signal_hook::consts::{SIGINT, SIGTERM};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::channel;
use std::time::Duration;

/// Runs the daemon until a signal ends it.
///
/// # Errors
/// A link that cannot be made at the start, a host that refuses real time where it is required, or a fault of our own.
pub fn run(config: &Config, config_path: &Path) -> Result<Exit, Failure> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [SIGTERM, SIGINT] {
        signal_hook::flag::register(signal, Arc::clone(&stop)).map_err(|e| {
            Failure::link(format!("signals cannot be caught ({e}); the daemon would not stop the arm when it is ended"))
        })?;
    }
    let node = create_node(&config.names, "graspd").map_err(|e| Failure::link(e.to_string()))?;
    // First of all: this refuses a second daemon in the cell before anything talks to a robot.
    let server = RequestServer::new(&node).map_err(|e| Failure::link(e.to_string()))?;
    let report = Report::default();
    let dh = kinematics(config, &report, &server, &stop)?;
    let Some(dh) = dh else { return Ok(Exit::Done) };

    let shared = Shared::default();
    let marks = AcquireReport::default();
    let recover = AtomicBool::new(false);
    let mut host = RealtimeReport::default();
    lock_memory(&mut host);
    let (host_in, host_out) = channel::<RealtimeReport>();

    std::thread::scope(|scope| -> Result<Exit, Failure> {
        let end = |failure: Failure| {
            shared.shutdown.store(true, Ordering::Release);
            Err(failure)
        };
        let spawn = |name: &str| std::thread::Builder::new().name(name.to_owned());
        let vision_settings = thread_settings(config.raw.beat.vision_priority, config.raw.beat.vision_core);
        let command_settings = thread_settings(config.raw.beat.command_priority, config.raw.beat.command_core);
        let poll_ns = (config.raw.vision.poll_us * 1000.0) as u64;
        let spin_ns = (config.raw.beat.spin_us * 1000.0) as u64;

        // The command thread waits for the host's verdict: with it the cycle knows whether missed beats are a fault or the host.
        let (cycle_in, cycle_out) = channel::<CommandCycle>();
        let said = host_in.clone();
        let (shared_ref, node_ref) = (&shared, &node);
        let started = spawn("command")
            .spawn_scoped(scope, move || {
                let mut heard = RealtimeReport::default();
                enter("command", &command_settings, &mut heard);
                let _ = said.send(heard);
                let Ok(cycle) = cycle_out.recv() else { return };
                shared_ref.guarded("command", || {
                    let mut worker = CommandWorker::new(cycle, shared_ref);
                    if config.raw.beat.beat == "robot" {
                        worker.run_with_robot(config.period_ns());
                    } else {
                        worker.run(config.period_ns(), spin_ns);
                    }
                });
            })
            .and_then(|_| {
                spawn("vision").spawn_scoped(scope, move || {
                    let mut heard = RealtimeReport::default();
                    let mut worker = match VisionWorker::new(config, dh, node_ref, shared_ref) {
                        Ok(worker) => worker,
                        Err(e) => {
                            eprintln!("graspd: {e}");
                            shared_ref.broken.store(true, Ordering::Release);
                            return;
                        }
                    };
                    enter("vision", &vision_settings, &mut heard);
                    let _ = host_in.send(heard);
                    shared_ref.guarded("vision", || worker.run(poll_ns));
                })
            })
            .and_then(|_| {
                let marks = &marks;
                spawn("acquire").spawn_scoped(scope, move || {
                    shared_ref.guarded("acquire", || {
                        if let Err(e) = run_acquire(config, node_ref, shared_ref, marks) {
                            eprintln!("graspd: {e}");
                            shared_ref.broken.store(true, Ordering::Release);
                        }
                    });
                })
            })
            .and_then(|_| {
                let report = &report;
                spawn("telemetry").spawn_scoped(scope, move || {
                    shared_ref.guarded("telemetry", || {
                        if let Err(e) = run_telemetry(config, node_ref, shared_ref, report) {
                            eprintln!("graspd: {e}");
                        }
                    });
                })
            })
            .and_then(|_| {
                let manager = LinkManager::new(config, &shared, &report, &recover);
                spawn("link").spawn_scoped(scope, move || shared_ref.guarded("link", || manager.run()))
            })
            .map(|_| ());
        if let Err(e) = started {
            return end(Failure::link(format!(
                "a thread could not be started ({e}); raise the process's thread limit"
            )));
        }
        for _ in 0..2 {
            if let Ok(heard) = host_out.recv_timeout(Duration::from_secs(5)) {
                host.refused.extend(heard.refused);
            }
        }
        report.refused(&host.refused);
        if config.raw.beat.require_realtime && !host.complete() {
            return end(Failure::link(format!(
                "loop.require_realtime is true and the host refused: {}",
                host.refused.join("; ")
            )));
        }
        match CommandCycle::new(cycle_config(config, dh, host.complete())) {
            Ok(cycle) => drop(cycle_in.send(cycle)),
            Err(e) => {
                return end(Failure::input(format!(
                    "{}: limits: {} = {} must lie between {} and {} for this arm",
                    config_path.display(),
                    e.key,
                    e.value,
                    e.lowest,
                    e.highest
                )));
            }
        }
        println!("{}", serde_json::json!({ "ready": true, "pid": std::process::id(), "cell": config.names.cell() }));
        let service =
            Service { config, config_path, shared: &shared, report: &report, marks: &marks, recover: &recover };
        service.serve(&server, &stop);
        shared.shutdown.store(true, Ordering::Release);
        if shared.broken.load(Ordering::Acquire) {
            return Err(Failure::fault(
                "a thread of the daemon ended by itself; the arm was stopped; see the lines above",
            ));
        }
        Ok(Exit::Done)
    })
}

fn thread_settings(priority: u8, core: Option<usize>) -> ThreadSettings {
    ThreadSettings { priority, core }
}

/// The arm's kinematics by the configuration. With "controller" this waits until the controller answers, or the daemon is ended
/// (`None`): nothing may be commanded with another arm's geometry.
fn kinematics(
    config: &Config,
    report: &Report,
    server: &RequestServer,
    stop: &AtomicBool,
) -> Result<Option<Dh>, Failure> {
    match (&config.kinematics, config.link) {
        (Kinematics::File(_, dh), _) => Ok(Some(**dh)),
        (Kinematics::Nominal, _) | (Kinematics::Controller, LinkKind::Mock) => Ok(Some(Dh::nominal(config.model))),
        (Kinematics::Controller, LinkKind::Rtde) => loop {
            match crate::arm::read_identity(&ur_config(config)) {
                Ok(identity) => {
                    crate::arm::check_model(&identity, config.model).map_err(|e| Failure::input(e.to_string()))?;
                    return Ok(Some(identity.dh));
                }
                Err(e) => report.link(&format!("waiting for the controller's kinematics: {e}")),
            }
            for _ in 0..20 {
                if stop.load(Ordering::Acquire) {
                    return Ok(None);
                }
                // Nothing runs yet, but whoever asks is told why.
                while let Ok(Some(request)) = server.next() {
                    let accepted = matches!(request.verb, Verb::Status | Verb::Stop);
                    let reason = "the daemon waits for the controller and cannot do that yet";
                    request.answer(accepted, &report.json(accepted, (!accepted).then_some(reason), "", Value::Null));
                }
                std::thread::sleep(Duration::from_millis(50));
            }
        },
    }
}
