//! `graspd recover`: from a protective stop, or from power off, back to an idle arm under our script.

use std::time::{Duration, Instant};

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

/// How long the chain waits for what takes its time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RecoverTimes {
    /// Powering on, and releasing the brakes.
    pub power_up: Duration,
    /// Unlocking: refused for five seconds after the stop.
    pub unlock: Duration,
}

impl Default for RecoverTimes {
    fn default() -> Self {
        RecoverTimes { power_up: Duration::from_secs(30), unlock: Duration::from_secs(8) }
    }
}

/// Walks the dashboard and uploads the control script with `token`: [`walk_out`], then [`start_script`] at the controller's own
/// step. The arm ends idle: the script waits for the handshake, and nothing is armed.
///
/// # Errors
/// The first step that the controller refuses, with what to do about it.
pub fn recover(config: &UrConfig, token: i32, mut tell: impl FnMut(&RecoverStep)) -> Result<(), ArmError> {
    let step_s = walk_out(config, RecoverTimes::default(), &mut tell)?;
    start_script(config, token, step_s)?;
    tell(&RecoverStep { command: "upload", answer: "control script uploaded".to_owned() });
    Ok(())
}

/// Walks the dashboard from wherever the robot stands to running: close popups, unlock a protective stop, power on, release the
/// brakes, stop a program that still runs. Returns the controller's step, s.
///
/// Called only when an operator asks for it. It never touches an emergency stop, a safeguard or a safety fault: those are ended at
/// the robot, and are reported.
///
/// # Errors
/// The first step that the controller refuses, with what to do about it.
pub fn walk_out(config: &UrConfig, times: RecoverTimes, tell: &mut impl FnMut(&RecoverStep)) -> Result<f64, ArmError> {
    let mut dashboard = Dashboard::open(config)?;
    let mut done = |command, answer| tell(&RecoverStep { command, answer });
    let step_s = controller_step(config, &mut dashboard)?;
    // In local control an e-Series answers questions and refuses the rest. CB3 does not know the question.
    if dashboard.ask("is in remote control")?.trim().eq_ignore_ascii_case("false") {
        return Err(ArmError::LocalControl);
    }
    for command in ["close safety popup", "close popup"] {
        // Nothing to close is no failure.
        let answer = dashboard.ask(command)?;
        done(command, answer);
    }
    let safety = dashboard.ask("safetymode")?;
    done("safetymode", safety.clone());
    match safety_of(&safety) {
        Safety::Good => {}
        Safety::ProtectiveStop => unlock(&mut dashboard, times.unlock, &mut done)?,
        Safety::AtTheRobot(fix) => {
            return Err(ArmError::Dashboard { command: "safetymode".to_owned(), answer: safety, fix });
        }
    }
    power_up(&mut dashboard, times.power_up, &mut done)?;
    // Whatever still runs (a script of a session that died, somebody's program) stands in our script's way; a stop is what was asked for.
    if dashboard.ask("running")?.to_ascii_lowercase().contains("true") {
        done("stop", dashboard.demand("stop", &["Stopped"], "stop the program on the pendant")?);
    }
    Ok(step_s)
}

/// The controller's step by its software: PolyScope 3 is CB3, 125 Hz; everything later 500 Hz. Where it does not say, by the
/// configured model.
fn controller_step(config: &UrConfig, dashboard: &mut Dashboard) -> Result<f64, ArmError> {
    let answer = dashboard.ask("PolyscopeVersion")?;
    let major = answer.split(|c: char| !c.is_ascii_digit()).find_map(|n| n.parse::<u32>().ok());
    let fast = major.map_or(config.model.is_e_series(), |m| m > 3);
    Ok(if fast { 0.002 } else { 0.008 })
}

enum Safety {
    Good,
    ProtectiveStop,
    /// Only a person at the robot may end this.
    AtTheRobot(&'static str),
}

fn safety_of(answer: &str) -> Safety {
    let word = answer.to_ascii_uppercase();
    let has = |w: &str| word.contains(w);
    if has("PROTECTIVE_STOP") {
        Safety::ProtectiveStop
    } else if has("EMERGENCY") {
        Safety::AtTheRobot("release the emergency stop at the robot, then run `graspd recover` again")
    } else if has("SAFEGUARD") {
        Safety::AtTheRobot("close the safeguard and confirm it at the robot, then run `graspd recover` again")
    } else if has("VIOLATION") || has("FAULT") {
        Safety::AtTheRobot("restart the safety system on the pendant after looking for the cause in its log")
    } else if has("RECOVERY") {
        Safety::AtTheRobot("a joint stands outside its limits; move the arm back by hand on the pendant")
    } else if has("NORMAL") || has("REDUCED") {
        Safety::Good
    } else {
        Safety::AtTheRobot("graspd does not know this safety mode; end it on the pendant")
    }
}

/// From any robot mode that leads there to RUNNING.
fn power_up(
    dashboard: &mut Dashboard,
    limit: Duration,
    done: &mut impl FnMut(&'static str, String),
) -> Result<(), ArmError> {
    let mode = dashboard.ask("robotmode")?;
    let has = |w: &str| mode.to_ascii_uppercase().contains(w);
    if has("RUNNING") {
        return Ok(());
    }
    let refuse = |fix| Err(ArmError::Dashboard { command: "robotmode".to_owned(), answer: mode.clone(), fix });
    if has("CONFIRM_SAFETY") {
        return refuse("confirm the safety configuration on the pendant");
    }
    if has("BACKDRIVE") {
        return refuse("end backdrive on the pendant");
    }
    if has("UPDATING") || has("NO_CONTROLLER") || has("DISCONNECTED") {
        return refuse("wait until the controller has started, or restart it");
    }
    if !has("IDLE") {
        if !has("POWER_ON") && !has("BOOTING") {
            done(
                "power on",
                dashboard.demand("power on", &["Powering on"], "look at the pendant for what holds the power back")?,
            );
        }
        // A short model's arm passes IDLE and waits there for its brakes.
        dashboard.wait_for("robotmode", "IDLE", limit, "the arm did not get power in time; look at the pendant")?;
    }
    let answer =
        dashboard.demand("brake release", &["Brake releasing"], "look at the pendant for what holds the brakes")?;
    done("brake release", answer);
    let fix = "the brakes did not open in time; look at the pendant";
    let answer = dashboard.wait_for("robotmode", "RUNNING", limit, fix)?;
    done("robotmode", answer);
    Ok(())
}

/// Asks for the unlock until the controller's waiting time has passed.
fn unlock(
    dashboard: &mut Dashboard,
    limit: Duration,
    done: &mut impl FnMut(&'static str, String),
) -> Result<(), ArmError> {
    const COMMAND: &str = "unlock protective stop";
    const FIX: &str = "the stop's cause may still be there: look at `graspd status` and at the pendant";
    let start = Instant::now();
    loop {
        match dashboard.demand(COMMAND, &["Protective stop releasing"], FIX) {
            Ok(answer) => {
                done(COMMAND, answer);
                break;
            }
            Err(ArmError::Dashboard { .. }) if start.elapsed() < limit => {
                std::thread::sleep(Duration::from_millis(500));
            }
            Err(e) => return Err(e),
        }
    }
    let start = Instant::now();
    loop {
        let answer = dashboard.ask("safetymode")?;
        match safety_of(&answer) {
            Safety::Good => {
                done("safetymode", answer);
                return Ok(());
            }
            Safety::ProtectiveStop if start.elapsed() < limit => std::thread::sleep(Duration::from_millis(100)),
            Safety::ProtectiveStop => {
                return Err(ArmError::Dashboard { command: COMMAND.to_owned(), answer, fix: FIX });
            }
            Safety::AtTheRobot(fix) => {
                return Err(ArmError::Dashboard { command: "safetymode".to_owned(), answer, fix });
            }
        }
    }
}
