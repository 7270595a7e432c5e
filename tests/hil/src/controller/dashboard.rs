//! Commands of the dashboard server: one line in, one line out.

use super::robot::Robot;
use super::state::RuntimeState;
use crate::plant::Generation;
use crate::urscript::Popup;

/// First line of every connection.
pub(super) const GREETING: &str = "Connected: Universal Robots Dashboard Server";

/// An answer, and whether the connection is closed after it.
pub(super) struct Reply {
    /// One line without its newline.
    pub line: String,
    /// Close after sending.
    pub close: bool,
}

/// Executes one command. The answer is exactly one line for any input.
pub(super) fn answer(robot: &mut Robot, line: &str) -> Reply {
    let line = line.trim();
    let lower = line.to_ascii_lowercase();
    let close = matches!(lower.as_str(), "quit" | "shutdown");
    Reply { line: respond(robot, line, &lower).replace(['\n', '\r'], " "), close }
}

fn respond(robot: &mut Robot, line: &str, lower: &str) -> String {
    if let Some(argument) = argument(line, lower, "load") {
        return if robot.load_program(argument) {
            format!("Loading program: {argument}")
        } else {
            format!("File not found: {argument}")
        };
    }
    if let Some(text) = argument(line, lower, "popup") {
        robot.popup = Some(Popup {
            text: text.to_owned(),
            title: "Popup".to_owned(),
            warning: false,
            error: false,
            blocking: false,
        });
        return "showing popup".to_owned();
    }
    if argument(line, lower, "addtolog").is_some() {
        return "Added log message".to_owned();
    }
    if let Some(mode) = argument(line, lower, "set operational mode") {
        return format!("Setting operational mode: {}", mode.to_ascii_uppercase());
    }
    if argument(line, lower, "set user role").is_some() {
        return "Setting user role is not supported by this software".to_owned();
    }
    fixed(robot, line, lower)
}

/// Commands without an argument.
fn fixed(robot: &mut Robot, line: &str, lower: &str) -> String {
    let e_series = robot.setup.model.generation == Generation::ESeries;
    match lower {
        "polyscopeversion" => {
            let [major, minor, bugfix, build] = robot.setup.model.software();
            format!("URSoftware {major}.{minor}.{bugfix}.{build} (Jan 01 2022)")
        }
        "version" => {
            let [major, minor, bugfix, build] = robot.setup.model.software();
            format!("{major}.{minor}.{bugfix}.{build}")
        }
        "robotmode" => format!("Robotmode: {}", robot.mode.name()),
        "safetymode" => format!("Safetymode: {}", robot.safety.name()),
        "safetystatus" => format!("Safetystatus: {}", robot.safety.name()),
        "running" => format!("Program running: {}", robot.is_program_running()),
        "programstate" => {
            let name = robot.loaded_program().unwrap_or("<unnamed>");
            format!("{} {name}", robot.runtime.name())
        }
        "get loaded program" => match robot.loaded_program() {
            Some(name) => format!("Loaded program: /programs/{name}"),
            None => "No program loaded".to_owned(),
        },
        "isprogramsaved" => format!("true {}", robot.loaded_program().unwrap_or("<unnamed>")),
        "play" => outcome(robot.play(), "Starting program", line),
        "stop" => {
            robot.stop_program();
            "Stopped".to_owned()
        }
        "pause" => {
            let paused = robot.pause_program() || robot.runtime == RuntimeState::Paused;
            outcome(paused, "Pausing program", line)
        }
        "power on" => outcome(robot.power_on(), "Powering on", line),
        "power off" => {
            robot.power_off();
            "Powering off".to_owned()
        }
        "brake release" => outcome(robot.brake_release(), "Brake releasing", line),
        "unlock protective stop" => match robot.unlock() {
            Ok(()) => "Protective stop releasing".to_owned(),
            Err(reason) => reason.to_owned(),
        },
        "close safety popup" => "closing safety popup".to_owned(),
        "close popup" => {
            robot.popup = None;
            "closing popup".to_owned()
        }
        "restart safety" => {
            robot.restart_safety();
            "Restarting safety".to_owned()
        }
        "is in remote control" if e_series => robot.remote_control.to_string(),
        "get operational mode" if e_series => if robot.remote_control { "AUTOMATIC" } else { "NONE" }.to_owned(),
        "clear operational mode" if e_series => {
            "operational mode is no longer controlled by Dashboard Server".to_owned()
        }
        "get serial number" => robot.setup.serial.clone(),
        "get robot model" => robot.setup.model.dashboard_name.to_owned(),
        "quit" => "Disconnected".to_owned(),
        "shutdown" => {
            robot.power_off();
            "Shutting down".to_owned()
        }
        _ => format!("could not understand: '{}'", line.chars().take(200).collect::<String>()),
    }
}

fn outcome(done: bool, success: &str, command: &str) -> String {
    if done { success.to_owned() } else { format!("Failed to execute: {command}") }
}

/// The argument after `command` and a space, in the client's spelling.
fn argument<'a>(line: &'a str, lower: &str, command: &str) -> Option<&'a str> {
    let rest = lower.strip_prefix(command)?;
    (rest.is_empty() || rest.starts_with(' ')).then(|| line.get(command.len()..).unwrap_or("").trim())
}

#[cfg(test)]
mod tests {
    use super::super::robot::Setup;
    use super::super::state::{RobotMode, SafetyMode};
    use super::*;
    use crate::plant::Model;

    fn robot() -> Robot {
        Robot::new(Setup::new(Model::by_name("ur5e").unwrap()))
    }

    fn ask(robot: &mut Robot, line: &str) -> String {
        answer(robot, line).line
    }

    fn pass(robot: &mut Robot, seconds: f64) {
        for _ in 0..(seconds * 500.0) as usize {
            robot.step();
        }
    }

    #[test]
    fn the_recovery_chain_leads_from_a_protective_stop_to_running() {
        let mut r = robot();
        r.step();
        r.stop_protectively(1, 2);
        assert_eq!(ask(&mut r, "safetymode"), "Safetymode: PROTECTIVE_STOP");
        assert!(ask(&mut r, "unlock protective stop").starts_with("Cannot unlock"));
        pass(&mut r, 5.1);
        assert_eq!(ask(&mut r, "unlock protective stop"), "Protective stop releasing");
        assert_eq!(r.safety, SafetyMode::Normal);
    }

    #[test]
    fn an_emergency_stop_removes_power_and_must_be_released_before_power_on() {
        let mut r = robot();
        r.emergency_stop(false);
        pass(&mut r, 1.0);
        assert_eq!(r.mode, RobotMode::PowerOff);
        assert_eq!(ask(&mut r, "power on"), "Failed to execute: power on");
        r.clear_safety();
        assert_eq!(ask(&mut r, "power on"), "Powering on");
        pass(&mut r, 1.1);
        assert_eq!(ask(&mut r, "robotmode"), "Robotmode: IDLE");
        assert_eq!(ask(&mut r, "brake release"), "Brake releasing");
        pass(&mut r, 1.1);
        assert_eq!(ask(&mut r, "robotmode"), "Robotmode: RUNNING");
    }

    #[test]
    fn every_command_is_answered_by_one_line() {
        let mut r = robot();
        for line in
            ["", " ", "load", "load ../../etc/passwd", "loadx", "popup a\tb", "\u{0}", "é load", "play", "pause"]
        {
            let reply = ask(&mut r, line);
            assert!(!reply.is_empty() && !reply.contains('\n'), "{line}");
        }
        assert_eq!(ask(&mut r, "load ../../etc/passwd"), "File not found: ../../etc/passwd");
        assert_eq!(ask(&mut r, "PolyscopeVersion"), "URSoftware 5.11.0.108249 (Jan 01 2022)");
        assert!(ask(&mut r, "nonsense").starts_with("could not understand:"));
    }
}
