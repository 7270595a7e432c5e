//! `graspd recover`: from a protective stop or power off back to an idle arm under the control script.

use std::time::{Duration, Instant};

use super::dashboard::Dashboard;
use super::script::start_script;
use super::ur_config::{ArmError, UrConfig};

/// One completed step of a recovery.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RecoverStep {
    /// The command sent to the controller.
    pub command: &'static str,
    /// Its answer.
    pub answer: String,
}

/// Timeouts of the slow steps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RecoverTimes {
    /// Powering on and releasing the brakes, each.
    pub power_up: Duration,
    /// Unlocking: the controller refuses it for five seconds after the stop.
    pub unlock: Duration,
}

impl Default for RecoverTimes {
    fn default() -> Self {
        RecoverTimes { power_up: Duration::from_secs(30), unlock: Duration::from_secs(8) }
    }
}

/// Recovers the controller and uploads the control script with `token`: [`walk_out`], then [`start_script`] for the
/// controller's step. The arm ends idle: the script waits for the handshake, and nothing is armed.
///
/// # Errors
/// The first step that the controller refuses, with what to do.
pub fn recover(config: &UrConfig, token: i32, mut report: impl FnMut(&RecoverStep)) -> Result<(), ArmError> {
    let step_s = walk_out(config, RecoverTimes::default(), &mut report)?;
    start_script(config, token, step_s)?;
    report(&RecoverStep { command: "upload", answer: "control script uploaded".to_owned() });
    Ok(())
}

/// Brings the robot to mode running through the dashboard: close popups, unlock a protective stop, power on, release
/// the brakes, stop a program that still runs. Returns the controller's step, s.
///
/// Called only on an operator's request. Emergency stops, safeguards and safety faults are reported, never cleared:
/// they have to be cleared at the robot.
///
/// # Errors
/// The first step that the controller refuses, with what to do.
pub fn walk_out(
    config: &UrConfig,
    times: RecoverTimes,
    report: &mut impl FnMut(&RecoverStep),
) -> Result<f64, ArmError> {
    let mut dashboard = Dashboard::open(config)?;
    let mut done = |command, answer| report(&RecoverStep { command, answer });
    let step_s = controller_step(config, &mut dashboard)?;
    // In local control an e-Series answers queries and refuses commands. CB3 does not know this query.
    if dashboard.ask("is in remote control")?.trim().eq_ignore_ascii_case("false") {
        return Err(ArmError::LocalControl);
    }
    for command in ["close safety popup", "close popup"] {
        // The answer does not matter: there may be no popup.
        let answer = dashboard.ask(command)?;
        done(command, answer);
    }
    let safety = dashboard.ask("safetymode")?;
    done("safetymode", safety.clone());
    match safety_of(&safety) {
        Safety::Good => {}
        Safety::ProtectiveStop => unlock(&mut dashboard, times.unlock, &mut done)?,
        Safety::ClearAtRobot(fix) => {
            return Err(ArmError::Dashboard { command: "safetymode".to_owned(), answer: safety, fix });
        }
    }
    power_up(&mut dashboard, times.power_up, &mut done)?;
    // A running program (the script of a lost session, or another one) blocks the control script; the operator asked
    // for a recovery.
    if dashboard.ask("running")?.to_ascii_lowercase().contains("true") {
        done("stop", dashboard.demand("stop", &["Stopped"], "stop the program on the pendant")?);
    }
    Ok(step_s)
}

/// The controller's step, s, from its software version: 125 Hz with PolyScope 3 (CB3), 500 Hz with later versions.
/// Without a version in the answer, from the configured model.
fn controller_step(config: &UrConfig, dashboard: &mut Dashboard) -> Result<f64, ArmError> {
    let answer = dashboard.ask("PolyscopeVersion")?;
    let major = answer.split(|c: char| !c.is_ascii_digit()).find_map(|n| n.parse::<u32>().ok());
    let fast = major.map_or(config.model.is_e_series(), |m| m > 3);
    Ok(if fast { 0.002 } else { 0.008 })
}

enum Safety {
    Good,
    ProtectiveStop,
    /// A person has to clear this at the robot.
    ClearAtRobot(&'static str),
}

fn safety_of(answer: &str) -> Safety {
    let upper = answer.to_ascii_uppercase();
    let has = |text: &str| upper.contains(text);
    if has("PROTECTIVE_STOP") {
        Safety::ProtectiveStop
    } else if has("EMERGENCY") {
        Safety::ClearAtRobot("release the emergency stop at the robot, then run `graspd recover` again")
    } else if has("SAFEGUARD") {
        Safety::ClearAtRobot("close the safeguard and confirm it at the robot, then run `graspd recover` again")
    } else if has("VIOLATION") || has("FAULT") {
        Safety::ClearAtRobot("find the cause in the pendant's log, then restart the safety system there")
    } else if has("RECOVERY") {
        Safety::ClearAtRobot("a joint is outside its limits; move the arm back by hand on the pendant")
    } else if has("NORMAL") || has("REDUCED") {
        Safety::Good
    } else {
        Safety::ClearAtRobot("graspd does not know this safety mode; clear it on the pendant")
    }
}

/// Brings the robot to RUNNING from any mode that allows it.
fn power_up(
    dashboard: &mut Dashboard,
    limit: Duration,
    done: &mut impl FnMut(&'static str, String),
) -> Result<(), ArmError> {
    let mode = dashboard.ask("robotmode")?;
    let has = |text: &str| mode.to_ascii_uppercase().contains(text);
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
                dashboard.demand("power on", &["Powering on"], "the pendant shows why the power stays off")?,
            );
        }
        // The arm stays in IDLE until its brakes are released.
        dashboard.wait_for("robotmode", "IDLE", limit, "the arm has no power after the timeout; see the pendant")?;
    }
    let answer =
        dashboard.demand("brake release", &["Brake releasing"], "the pendant shows why the brakes stay closed")?;
    done("brake release", answer);
    let fix = "the brakes did not open within the timeout; see the pendant";
    let answer = dashboard.wait_for("robotmode", "RUNNING", limit, fix)?;
    done("robotmode", answer);
    Ok(())
}

/// Repeats the unlock until the controller's waiting time has passed, then waits for the safety mode to become normal.
fn unlock(
    dashboard: &mut Dashboard,
    limit: Duration,
    done: &mut impl FnMut(&'static str, String),
) -> Result<(), ArmError> {
    const COMMAND: &str = "unlock protective stop";
    const FIX: &str = "the cause of the stop may still be present: see `graspd status` and the pendant";
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
            Safety::ClearAtRobot(fix) => {
                return Err(ArmError::Dashboard { command: "safetymode".to_owned(), answer, fix });
            }
        }
    }
}
