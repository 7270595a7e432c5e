//! Programs on the controller: upload, play, pause, stop, watchdogs, and their execution in each control step.

use super::message::MessageKind;
use super::programs::{MAX_SECONDARY, Upload};
use super::robot::{PROGRAM_STOP_DECEL, Robot};
use super::state::{RobotMode, RuntimeState};
use crate::plant::Motion;
use crate::urscript::{Machine, ProgramKind, StepOutcome, WatchdogAction, no_program};

impl Robot {
    /// Whether the main program is running: bit 1 of `robot_status_bits`.
    pub fn is_program_running(&self) -> bool {
        matches!(self.runtime, RuntimeState::Playing | RuntimeState::Resuming)
    }

    /// Takes a script as ports 30001 to 30003 do: `def` replaces the main program, `sec` runs as a secondary program, a
    /// bare line is a program of one line.
    pub fn upload(&mut self, text: &str) -> Upload {
        self.upload_at(text, 1)
    }

    /// Like [`Robot::upload`] for a text that begins at line `first_line` of what the client sent.
    pub fn upload_at(&mut self, text: &str, first_line: u32) -> Upload {
        let machine = match Machine::load_at(text, first_line) {
            Ok(machine) => machine,
            Err(e) => {
                self.say(MessageKind::Runtime { line: e.line as i32, column: 1, text: e.message.clone() });
                return Upload::Refused(e.to_string());
            }
        };
        if machine.kind() == ProgramKind::Secondary {
            if self.programs.secondary.len() >= MAX_SECONDARY {
                return Upload::Refused("too many secondary programs".to_owned());
            }
            self.programs.secondary.push(machine);
            return Upload::Secondary;
        }
        if !self.remote_control {
            return Upload::Refused("the robot is in local control".to_owned());
        }
        if self.mode != RobotMode::Running || !self.safety.allows_motion() {
            let text = format!("program refused: {} and {}", self.mode.name(), self.safety.name());
            self.say(MessageKind::Error { code: 0, argument: 0, level: 2, text: text.clone() });
            return Upload::Refused(text);
        }
        self.end_program();
        (self.programs.main, self.programs.active) = (Some(machine), true);
        self.runtime = RuntimeState::Playing;
        Upload::Main
    }

    /// Answers one line of the interpreter port.
    pub fn interpret(&mut self, line: &str) -> String {
        let Some(mut main) = self.programs.main.take() else { return no_program(line) };
        let answer = main.interpret(line, self);
        self.programs.main = Some(main);
        answer
    }

    /// Loads `NAME.urp`, i.e. `NAME.script` of the program directory; false if there is none.
    pub fn load_program(&mut self, name: &str) -> bool {
        let stem = name.trim().trim_end_matches(".urp");
        if stem.is_empty() || stem.contains(['/', '\\']) || stem.starts_with('.') {
            return false;
        }
        let Some(directory) = &self.setup.programs else { return false };
        match std::fs::read_to_string(directory.join(format!("{stem}.script"))) {
            Ok(text) => {
                self.programs.loaded = Some((format!("{stem}.urp"), text));
                true
            }
            Err(_) => false,
        }
    }

    /// Name of the loaded program.
    pub fn loaded_program(&self) -> Option<&str> {
        self.programs.loaded.as_ref().map(|(name, _)| name.as_str())
    }

    /// Starts the loaded program or resumes a paused one; false if neither is possible.
    pub fn play(&mut self) -> bool {
        if self.mode != RobotMode::Running || !self.safety.allows_motion() {
            return false;
        }
        if matches!(self.runtime, RuntimeState::Paused | RuntimeState::Pausing) && self.programs.active {
            self.runtime = RuntimeState::Playing;
            self.watchdogs.feed_all(self.clock_s);
            return true;
        }
        let Some((_, text)) = self.programs.loaded.clone() else { return false };
        self.upload(&text) == Upload::Main
    }

    /// Pauses the program; the arm comes to rest on its path. False if no program is running.
    pub fn pause_program(&mut self) -> bool {
        let playing = self.is_program_running();
        if playing {
            self.runtime = RuntimeState::Pausing;
        }
        playing
    }

    /// Stops the program and brings the arm to rest.
    pub fn stop_program(&mut self) {
        if self.programs.active {
            self.end_program();
        }
    }

    /// Ends the main program, its motion, its watchdogs and its sockets.
    pub(super) fn end_program(&mut self) {
        self.watchdogs.clear();
        self.sockets.close_all();
        self.remote_calls.clear();
        self.generator.set_force_control(None);
        (self.motion_left_s, self.motion_failure) = (None, None);
        self.programs.main = None;
        if std::mem::take(&mut self.programs.active) {
            self.generator.start(Motion::StopJ { decel: PROGRAM_STOP_DECEL });
            self.runtime = RuntimeState::Stopping;
        }
    }

    /// Runs one control step of every program.
    pub(super) fn run_programs(&mut self) {
        if self.is_program_running()
            && let Some(mut main) = self.programs.main.take()
        {
            let outcome = main.step(self);
            // The step itself may have ended the program, for example by a protective stop.
            if self.programs.active {
                self.programs.main = Some(main);
                self.conclude(outcome);
            }
        }
        let mut secondary = std::mem::take(&mut self.programs.secondary);
        secondary.retain_mut(|machine| match machine.step(self) {
            StepOutcome::Running => true,
            StepOutcome::Finished => false,
            StepOutcome::Failed(e) => {
                self.say(MessageKind::Runtime { line: e.line as i32, column: 1, text: e.message });
                false
            }
        });
        self.programs.secondary = secondary;
    }

    fn conclude(&mut self, outcome: StepOutcome) {
        match outcome {
            StepOutcome::Running => {}
            StepOutcome::Finished => self.end_program(),
            StepOutcome::Failed(e) => {
                self.say(MessageKind::Runtime { line: e.line as i32, column: 1, text: e.message });
                self.end_program();
            }
        }
    }

    /// Ends `Stopping` and `Pausing` once the arm is at rest.
    pub(super) fn settle_runtime(&mut self) {
        let rest = self.generator.at_rest();
        match self.runtime {
            RuntimeState::Stopping if rest => self.runtime = RuntimeState::Stopped,
            RuntimeState::Pausing if rest => self.runtime = RuntimeState::Paused,
            _ => {}
        }
    }

    /// Pauses or stops the program if a watched input was not written in time.
    pub(super) fn check_watchdogs(&mut self) {
        if self.deaf_watchdog || !self.is_program_running() {
            return;
        }
        let Some((input, action)) = self.watchdogs.expired(self.clock_s) else { return };
        let text = format!("RTDE watchdog: input '{input}' was not written in time");
        self.say(MessageKind::Runtime { line: 0, column: 0, text });
        match action {
            WatchdogAction::Stop => self.stop_program(),
            WatchdogAction::Pause => {
                self.pause_program();
            }
            WatchdogAction::Ignore => {}
        }
    }
}
