//! `graspd recover`: from a protective stop, or from power off, back to an idle arm under our script.

use std::time::Duration;

use super::dashboard::Dashboard;
use super::script::start_script;
use super::ur_config::{ArmError, UrConfig};

/// One step of the chain, told as it is done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RecoverStep {
    /// What was asked of the controller.
    pub command: &'static str,
    /// What it answered.
    pub answer: String,
}

/// How long power and brakes may take.
const POWER_UP: Duration = Duration::from_secs(30);

/// An unlock is refused for five seconds after the stop.
const UNLOCK: Duration = Duration::from_secs(8);

/// Walks the dashboard: close popups, unlock a protective stop, power on, release the brakes, upload the script with `token`.
///
/// Called only when an operator asks for it. It never touches an emergency stop or a safety fault: those are ended at the robot,
/// and are reported. The arm ends idle: the script waits for the handshake, and nothing is armed.
///
/// # Errors
/// The first step that the controller refuses.
pub fn recover(config: &UrConfig, token: i32, step_s: f64, mut tell: impl FnMut(&RecoverStep)) -> Result<(), ArmError> {
    let mut dashboard = Dashboard::open(config)?;
    let mut done = |command, answer| tell(&RecoverStep { command, answer });
    for command in ["close safety popup", "close popup"] {
        // Nothing to close is no failure.
        let answer = dashboard.ask(command)?;
        done(command, answer);
    }
    let safety = dashboard.ask("safetymode")?;
    let word = safety.to_ascii_uppercase();
    done("safetymode", safety.clone());
    if word.contains("PROTECTIVE_STOP") {
        unlock(&mut dashboard, &mut done)?;
    } else if !(word.contains("NORMAL") || word.contains("REDUCED")) {
        return Err(ArmError::Dashboard { command: "safetymode".to_owned(), answer: safety });
    }
    let mode = dashboard.ask("robotmode")?.to_ascii_uppercase();
    if !mode.contains("RUNNING") {
        if !mode.contains("IDLE") {
            done("power on", dashboard.demand("power on", &["Powering on"])?);
            // A short model's arm passes IDLE and waits there for its brakes.
            dashboard.wait_for("robotmode", "IDLE", POWER_UP)?;
        }
        done("brake release", dashboard.demand("brake release", &["Brake releasing"])?);
        let answer = dashboard.wait_for("robotmode", "RUNNING", POWER_UP)?;
        done("robotmode", answer);
    }
    start_script(config, token, step_s)?;
    done("upload", "control script uploaded".to_owned());
    Ok(())
}

/// Asks for the unlock until the controller's waiting time has passed.
fn unlock(dashboard: &mut Dashboard, done: &mut impl FnMut(&'static str, String)) -> Result<(), ArmError> {
    const COMMAND: &str = "unlock protective stop";
    let start = std::time::Instant::now();
    loop {
        match dashboard.demand(COMMAND, &["Protective stop releasing"]) {
            Ok(answer) => {
                done(COMMAND, answer);
                break;
            }
            Err(ArmError::Dashboard { .. }) if start.elapsed() < UNLOCK => {
                std::thread::sleep(Duration::from_millis(500));
            }
            Err(e) => return Err(e),
        }
    }
    // REDUCED also means that the stop is over, but a controller says NORMAL first or stays in reduced mode.
    let released = |answer: &str| !answer.to_ascii_uppercase().contains("PROTECTIVE_STOP");
    let start = std::time::Instant::now();
    loop {
        let answer = dashboard.ask("safetymode")?;
        if released(&answer) {
            done("safetymode", answer);
            return Ok(());
        }
        if start.elapsed() > UNLOCK {
            return Err(ArmError::Dashboard { command: COMMAND.to_owned(), answer });
        }
        std::thread::sleep(Duration::from_millis(100));
    }
}
