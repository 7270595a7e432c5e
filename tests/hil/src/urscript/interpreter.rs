//! Interpreter mode: statements that arrive on port 30020 while `interpreter_mode()` waits.

use super::compile::extend;
use super::error::ScriptError;
use super::host::Host;
use super::lexer::lex;
use super::machine::Machine;
use super::parser::parse;
use super::queue::MAX_STATEMENTS;

impl Machine {
    /// Answers one line of the interpreter port: `ack: <id>: <statement>`, `discard: <reason>: <statement>` or
    /// `state: <number>: <command>`.
    pub fn interpret(&mut self, line: &str, host: &mut dyn Host) -> String {
        let line = line.trim();
        let queue = &mut self.interpreter;
        let state = match line {
            "skipbuffer" => queue.skip(),
            "abort" => {
                host.motion_abandon();
                queue.last_executed()
            }
            "statelastexecuted" => queue.last_executed(),
            "statelastinterpreted" => queue.last_interpreted(),
            "statelastcleared" => queue.last_cleared(),
            "stateunexecuted" => queue.unexecuted(),
            _ if !queue.is_active() => return discard("interpreter mode is not active", line),
            _ if queue.is_full() => {
                return discard(&format!("more than {MAX_STATEMENTS} statements, call clear_interpreter()"), line);
            }
            _ => return self.accept(line),
        };
        format!("state: {state}: {line}")
    }

    fn accept(&mut self, line: &str) -> String {
        match self.compile_statement(line) {
            Ok(routine) => {
                self.globals.resize(self.program.names.len(), None);
                format!("ack: {}: {line}", self.interpreter.push(routine))
            }
            Err(e) => discard(&e.message, line),
        }
    }

    fn compile_statement(&mut self, line: &str) -> Result<usize, ScriptError> {
        extend(&mut self.program, &parse(&lex(line, 1)?)?)
    }
}

fn discard(reason: &str, line: &str) -> String {
    format!("discard: {reason}: {line}")
}

/// Answer when no program runs.
pub fn no_program(line: &str) -> String {
    discard("no program is running", line.trim())
}
