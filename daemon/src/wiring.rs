//! From settings to threads: the one place where everything meets.

use crate::config::{Config, Kinematics, LinkKind, cycle_config};
use crate::exit::{Exit, Failure};
use crate::links::{LinkManager, ur_config};
use crate::log;
use crate::realtime::{RealtimeReport, ThreadSettings, enter, lock_memory};
use crate::stop::{Door, End, Live, catch_signals, serve};
use crate::threads::{
    AcquireReport, CommandWorker, Report, Service, Shared, VisionWorker, ramp_limit, run_acquire, run_damage,
    run_telemetry,
};
use graspd_rt::arm::Dh;
use graspd_rt::cycle::CommandCycle;
use graspd_shm::control::{RequestServer, Verb};
use graspd_shm::create_node;
use serde_json::Value;
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
    log::start().map_err(|e| Failure::link(format!("the log thread cannot be started ({e})")))?;
    let shared = Shared::default();
    catch_signals(&shared.live).map_err(|e| {
        Failure::link(format!("signals cannot be caught ({e}); the daemon would not stop the arm when it is ended"))
    })?;
    // First of all: this refuses a second daemon in the cell before anything talks to a robot.
    config.names.ensure_root(false).map_err(|e| Failure::link(e.to_string()))?;
    let mut door = Door::open(&config.names)?;
    start_stop_thread(config, &mut door, &shared.live)?;
    let _over = Over(&shared.live);
    let node = create_node(&config.names, "graspd").map_err(|e| Failure::link(e.to_string()))?;
    let server = RequestServer::new(&node).map_err(|e| Failure::link(e.to_string()))?;
    let report = Report::default();
    let dh = kinematics(config, &report, &server, &shared.live)?;
    let Some(dh) = dh else { return Ok(Exit::Done) };

    let marks = AcquireReport::default();
    let recover = AtomicBool::new(false);
    let mut host = RealtimeReport::default();
    lock_memory(&mut host);
    let (host_in, host_out) = channel::<RealtimeReport>();

    let door = &door;
    std::thread::scope(|scope| -> Result<Exit, Failure> {
        // However this scope is left, by a panic as well: its threads end, or it would wait for them for ever.
        let _end = EndOfThreads(&shared);
        let spawn = |name: &str| std::thread::Builder::new().name(name.to_owned());
        let vision_settings = thread_settings(config.raw.cycle.vision_priority, config.raw.cycle.vision_core);
        let command_settings = thread_settings(config.raw.cycle.command_priority, config.raw.cycle.command_core);
        let poll_ns = (config.raw.vision.poll_us * 1000.0) as u64;
        let spin_ns = (config.raw.cycle.spin_us * 1000.0) as u64;

        // The command thread waits for the host's verdict: with it the cycle knows whether missed cycles are a fault or the host.
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
                    if config.raw.cycle.clock == "robot" {
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
                            log::say(&e);
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
                            log::say(&e);
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
                            log::say(&e);
                        }
                    });
                })
            })
            .and_then(|_| {
                let manager = LinkManager::new(config, &shared, &report, &recover);
                spawn("link").spawn_scoped(scope, move || shared_ref.guarded("link", || manager.run()))
            })
            .and_then(|_| {
                let paths = door.paths();
                spawn("damage").spawn_scoped(scope, move || {
                    shared_ref.guarded("damage", || run_damage(node_ref, paths, shared_ref));
                })
            })
            .map(|_| ());
        if let Err(e) = started {
            return Err(Failure::link(format!(
                "a thread could not be started ({e}); raise the process's thread limit"
            )));
        }
        for _ in 0..2 {
            if let Ok(heard) = host_out.recv_timeout(Duration::from_secs(5)) {
                host.refused.extend(heard.refused);
            }
        }
        report.refused(&host.refused);
        if config.raw.cycle.require_realtime && !host.complete() {
            return Err(Failure::link(format!(
                "loop.require_realtime is true and the host refused: {}",
                host.refused.join("; ")
            )));
        }
        match CommandCycle::new(cycle_config(config, dh, host.complete())) {
            Ok(cycle) => drop(cycle_in.send(cycle)),
            Err(e) => {
                return Err(Failure::input(format!(
                    "{}: limits: {} = {} must lie between {} and {} for this arm",
                    config_path.display(),
                    e.key,
                    e.value,
                    e.lowest,
                    e.highest
                )));
            }
        }
        let ready = serde_json::json!({ "ready": true, "pid": std::process::id(), "cell": config.names.cell() });
        log::line(log::Stream::Out, ready.to_string());
        let service =
            Service { config, config_path, shared: &shared, report: &report, marks: &marks, recover: &recover };
        shared.guarded("service", || service.serve(&server));
        let verdict = verdict(&shared);
        shared.live.settle(verdict.as_ref().map_or_else(|failure| failure.exit.code(), |exit| exit.code()));
        verdict
    })
}

/// How an ordered end is reported.
fn verdict(shared: &Shared) -> Result<Exit, Failure> {
    if shared.broken.load(Ordering::Acquire) {
        return Err(Failure::fault("a thread of the daemon ended by itself; the arm was stopped; see the lines above"));
    }
    // Said already; what remains is the exit code and the sentence at the end.
    shared.damage.get().map_or(Ok(Exit::Done), |reason| Err(Failure::link(reason.clone())))
}

/// Ends the threads when it is dropped.
struct EndOfThreads<'a>(&'a Shared);

impl Drop for EndOfThreads<'_> {
    fn drop(&mut self) {
        self.0.shutdown.store(true, Ordering::Release);
    }
}

/// Lets the stop thread go when the daemon is over: what runs on in this process is not its business.
struct Over<'a>(&'a Live);

impl Drop for Over<'_> {
    fn drop(&mut self) {
        self.0.close();
    }
}

/// Beyond the ramp: ending the script, and an answer that was being given.
const END_NS: u64 = 3_000_000_000;
/// For the threads when the arm rests: one that waits for a controller's answer is not waited for.
const SETTLED_NS: u64 = 1_000_000_000;

/// Starts the stop thread, which is not joined: it outlives everything else, because it is what ends a process that hangs.
/// Its priority lies just below the command thread's: it must run while images are tracked, and does next to nothing.
fn start_stop_thread(config: &Config, door: &mut Door, live: &Arc<Live>) -> Result<(), Failure> {
    let Some(listener) = door.listener() else { return Ok(()) };
    let priority = config.raw.cycle.command_priority.saturating_sub(1).max(config.raw.cycle.vision_priority);
    let after_ns = ramp_limit(config).as_nanos() as u64 + END_NS;
    let end = End { after_ns, settled_ns: SETTLED_NS, code: Exit::Link.code() };
    let live = Arc::clone(live);
    std::thread::Builder::new()
        .name("stop".to_owned())
        .spawn(move || {
            // What the host refuses here it refuses to the command thread as well, which reports it.
            enter("stop", &thread_settings(priority, None), &mut RealtimeReport::default());
            serve(&listener, &live, end);
        })
        .map(drop)
        .map_err(|e| {
            Failure::link(format!("the stop thread cannot be started ({e}); raise the process's thread limit"))
        })
}

fn thread_settings(priority: u8, core: Option<usize>) -> ThreadSettings {
    ThreadSettings { priority, core }
}

/// The arm's kinematics by the configuration. With "controller" this waits until the controller answers, or the daemon is ended
/// (`None`): nothing may be commanded with another arm's geometry.
fn kinematics(config: &Config, report: &Report, server: &RequestServer, live: &Live) -> Result<Option<Dh>, Failure> {
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
                if live.ending() {
                    return Ok(None);
                }
                // Nothing runs yet, but whoever asks is told why.
                while let Ok(Some(request)) = server.next() {
                    let accepted = matches!(request.verb, Verb::Status | Verb::Stop);
                    let reason = "the daemon waits for the controller and cannot do that yet";
                    request
                        .answer(accepted, &report.json(accepted, (!accepted).then_some(reason), "", live, Value::Null));
                }
                std::thread::sleep(Duration::from_millis(50));
            }
        },
    }
}
