//! What happens before the threads start: the stop thread, and the arm's kinematics.

use crate::arm::{check_model, read_identity};
use crate::config::{Config, Kinematics, LinkKind, ur_config};
use crate::exit::{Exit, Failure};
use crate::realtime::{RealtimeReport, ThreadSettings, enter};
use crate::stop::{ForcedExit, LiveState, StopEndpoint, serve};
use crate::threads::{Report, ramp_limit};
use graspd_rt::arm::Dh;
use graspd_shm::control::{RequestServer, Verb};
use serde_json::Value;
use std::sync::Arc;
use std::time::Duration;

/// Time after the ramp of a stop until the process is ended by force, ns: for the end of the control script and for an
/// answer that is under way.
const MAX_SHUTDOWN_NS: u64 = 3_000_000_000;
/// Time after the regular end until the process is ended although threads are still running, ns: one may wait for a
/// controller.
const MAX_JOIN_NS: u64 = 1_000_000_000;

/// Starts the stop thread. It is not joined: it outlives all other threads, because it ends a process that hangs.
///
/// Its priority is just below the command thread's, so that it runs while images are tracked; it uses little processor
/// time.
pub(super) fn start_stop_thread(
    config: &Config,
    endpoint: &mut StopEndpoint,
    live: &Arc<LiveState>,
) -> Result<(), Failure> {
    let Some(listener) = endpoint.listener() else { return Ok(()) };
    let threads = &config.threads;
    let priority = threads.command.priority.saturating_sub(1).max(threads.vision.priority);
    let after_ns = ramp_limit(config).as_nanos() as u64 + MAX_SHUTDOWN_NS;
    let forced = ForcedExit { after_ns, finished_ns: MAX_JOIN_NS, code: Exit::Link.code() };
    let live = Arc::clone(live);
    std::thread::Builder::new()
        .name("stop".to_owned())
        .spawn(move || {
            // The host refuses this thread what it refuses the command thread, which reports it.
            enter("stop", &ThreadSettings { priority, core: None }, &mut RealtimeReport::default());
            serve(&listener, &live, forced);
        })
        .map(drop)
        .map_err(|e| {
            Failure::link(format!("the stop thread cannot be started ({e}); raise the thread limit of the process"))
        })
}

/// The arm's kinematics as configured. With "controller" this waits until the controller answers or the daemon has to
/// end (`None`): nothing may be commanded with another arm's kinematics.
pub(super) fn arm_kinematics(
    config: &Config,
    report: &Report,
    server: &RequestServer,
    live: &LiveState,
) -> Result<Option<Dh>, Failure> {
    match (&config.arm.kinematics, config.arm.link) {
        (Kinematics::File(_, dh), _) => return Ok(Some(**dh)),
        (Kinematics::Nominal, _) | (Kinematics::Controller, LinkKind::Mock) => {
            return Ok(Some(Dh::nominal(config.arm.model)));
        }
        (Kinematics::Controller, LinkKind::Rtde) => {}
    }
    loop {
        match read_identity(&ur_config(config)) {
            Ok(identity) => {
                check_model(&identity, config.arm.model).map_err(|e| Failure::input(e.to_string()))?;
                return Ok(Some(identity.dh));
            }
            Err(e) => report.link(&format!("waiting for the controller's kinematics: {e}")),
        }
        for _ in 0..20 {
            if live.ending() {
                return Ok(None);
            }
            answer_without_arm(report, server, live);
            std::thread::sleep(Duration::from_millis(50));
        }
    }
}

/// Answers requests before the threads run: status and stop are accepted, everything else is refused with the reason.
fn answer_without_arm(report: &Report, server: &RequestServer, live: &LiveState) {
    while let Ok(Some(request)) = server.next() {
        let accepted = matches!(request.verb, Verb::Status | Verb::Stop);
        let reason = (!accepted).then_some("the daemon waits for the controller and cannot do this yet");
        request.answer(accepted, &report.json(accepted, reason, "", live, Value::Null));
    }
}
