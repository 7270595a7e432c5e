//! The virtual machine: runs the threads of a program one after the other within a control step.

use super::ast::FunctionKind;
use super::builtins::resume;
use super::compile::{Op, Program, compile};
use super::error::{RuntimeError, ScriptError};
use super::host::{Host, StepOutcome};
use super::lexer::lex;
use super::parser::parse;
use super::queue::StatementQueue;
use super::sockets::SocketBuffers;
use super::thread::{Frame, Thread};
use super::value::Value;
use super::wait::{Flow, Wait};

/// Instructions of one thread within one control step; a thread that exceeds them counts as an infinite loop.
pub const MAX_INSTRUCTIONS: u32 = 50_000;
/// Threads of a program, including the main one.
pub const MAX_THREADS: usize = 64;
/// Depth of nested calls.
pub const MAX_CALL_DEPTH: usize = 128;
/// Values on a thread's stack.
const MAX_STACK: usize = 20_000;

/// How an upload is run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ProgramKind {
    /// `def`: replaces the running program.
    Main,
    /// `sec`: runs in parallel and must take no controller time.
    Secondary,
    /// Bare statements: a program that replaces the running one.
    Bare,
}

/// A compiled program and its threads.
pub struct Machine {
    pub(super) program: Program,
    pub(super) threads: Vec<Thread>,
    pub(super) globals: Vec<Option<Value>>,
    pub(super) next_id: u32,
    /// Thread that waits for its motion.
    pub(super) mover: Option<u32>,
    pub(super) sockets: SocketBuffers,
    pub(super) interpreter: StatementQueue,
    ended: Option<StepOutcome>,
}

/// Why a thread's turn has ended.
enum Turn {
    /// It waits for the next step, or has ended.
    Over,
    /// It executed `halt`, which ends the program.
    Halt,
}

impl Machine {
    /// Compiles a program. Nothing runs yet.
    ///
    /// # Errors
    /// The first error with its line; unknown names are reported together.
    pub fn load(text: &str) -> Result<Self, ScriptError> {
        Self::load_at(text, 1)
    }

    /// Like [`Machine::load`] for a text whose first line has number `first_line` in the upload.
    ///
    /// # Errors
    /// As [`Machine::load`].
    pub fn load_at(text: &str, first_line: u32) -> Result<Self, ScriptError> {
        let program = compile(&parse(&lex(text, first_line)?)?)?;
        let globals = vec![None; program.names.len()];
        let main = Thread::new(1, program.entry);
        Ok(Self {
            program,
            threads: vec![main],
            globals,
            next_id: 2,
            mover: None,
            sockets: SocketBuffers::default(),
            interpreter: StatementQueue::default(),
            ended: None,
        })
    }

    /// How this upload is run.
    #[must_use]
    pub fn kind(&self) -> ProgramKind {
        match self.program.kind {
            Some(FunctionKind::Sec) => ProgramKind::Secondary,
            Some(_) => ProgramKind::Main,
            None => ProgramKind::Bare,
        }
    }

    /// Name of the program's `def` or `sec`.
    #[must_use]
    pub fn name(&self) -> &str {
        self.program.routines.get(self.program.entry).map_or("", |r| r.name.as_str())
    }

    /// Value of a global variable.
    #[must_use]
    pub fn global(&self, name: &str) -> Option<&Value> {
        let id = self.program.names.iter().position(|n| n == name)?;
        self.globals.get(id)?.as_ref()
    }

    /// Number of running threads, including the main one.
    #[must_use]
    pub fn threads(&self) -> usize {
        self.threads.len()
    }

    /// Present line of the main thread.
    #[must_use]
    pub fn line(&self) -> u32 {
        self.threads.first().map_or(0, |f| self.line_of(f))
    }

    /// Runs one control step. After `Finished` or `Failed` further calls repeat the outcome.
    pub fn step(&mut self, host: &mut dyn Host) -> StepOutcome {
        if let Some(ended) = &self.ended {
            return ended.clone();
        }
        let mut i = 0;
        // Threads started in this step are appended and run in it. The number of threads, including ended ones, is
        // bounded.
        while i < self.threads.len() {
            // A thread runs until it waits, so a critical section is not interrupted between two waits. While its
            // thread waits inside the section the other threads run: UR's own driver script reads its socket inside a
            // critical section while its servo thread moves the arm.
            if self.threads[i].dead {
                i += 1;
                continue;
            }
            match self.turn(i, host) {
                Ok(Turn::Over) => {}
                Ok(Turn::Halt) => return self.end(StepOutcome::Finished, host),
                Err(message) => {
                    let line = self.threads.get(i).map_or(0, |f| self.line_of(f));
                    return self.end(StepOutcome::Failed(RuntimeError { line, message }), host);
                }
            }
            i += 1;
        }
        if self.threads.first().is_none_or(|main| main.dead) {
            return self.end(StepOutcome::Finished, host);
        }
        if self.kind() == ProgramKind::Secondary {
            let message = "a secondary program must not take controller time".to_owned();
            return self.end(StepOutcome::Failed(RuntimeError { line: self.line(), message }), host);
        }
        self.threads.retain(|f| !f.dead);
        StepOutcome::Running
    }

    /// Stops the program (stop button, watchdog, another upload): abandons its motion and closes its sockets.
    pub fn stop(&mut self, host: &mut dyn Host) {
        if self.ended.is_none() {
            self.end(StepOutcome::Finished, host);
        }
    }

    fn end(&mut self, outcome: StepOutcome, host: &mut dyn Host) -> StepOutcome {
        if self.mover.take().is_some() {
            host.motion_abandon();
        }
        self.sockets.close_all(host);
        self.threads.clear();
        self.ended = Some(outcome.clone());
        outcome
    }

    fn line_of(&self, thread: &Thread) -> u32 {
        thread
            .frames
            .last()
            .and_then(|f| {
                let lines = &self.program.routines.get(f.routine)?.lines;
                lines.get(f.at.saturating_sub(1)).or(lines.first()).copied()
            })
            .unwrap_or(0)
    }

    /// Runs one thread until it has used its controller time.
    fn turn(&mut self, i: usize, host: &mut dyn Host) -> Result<Turn, String> {
        if let Some(wait) = self.threads[i].wait.take() {
            let value = match wait {
                Wait::Interpreter => {
                    let Some(routine) = self.interpreter.next() else {
                        self.threads[i].wait = Some(Wait::Interpreter);
                        return Ok(Turn::Over);
                    };
                    self.threads[i].frames.push(Frame { routine, at: 0, locals: Vec::new(), statement: true });
                    return self.instructions(i, host);
                }
                Wait::Thread(t) => {
                    let alive = self.threads.iter().any(|f| f.id == t && !f.dead);
                    if alive { Flow::Wait(Wait::Thread(t)) } else { Flow::Value(Value::None) }
                }
                other => resume(other, host, &mut self.sockets)?,
            };
            match value {
                Flow::Wait(again) => {
                    self.threads[i].wait = Some(again);
                    return Ok(Turn::Over);
                }
                Flow::Value(v) => {
                    if self.mover == Some(self.threads[i].id) {
                        self.mover = None;
                    }
                    self.threads[i].stack.push(v);
                }
            }
        }
        self.instructions(i, host)
    }

    /// Executes the instructions of one thread until it waits or ends.
    fn instructions(&mut self, i: usize, host: &mut dyn Host) -> Result<Turn, String> {
        for _ in 0..MAX_INSTRUCTIONS {
            let Some(frame) = self.threads[i].frames.last_mut() else {
                self.threads[i].dead = true;
                return Ok(Turn::Over);
            };
            // Every routine ends with `Return`, so the address is valid.
            let op = self.program.routines[frame.routine].code[frame.at].clone();
            frame.at += 1;
            match op {
                Op::Halt => return Ok(Turn::Halt),
                op => {
                    if let Some(wait) = self.execute(i, op, host)? {
                        let id = self.threads[i].id;
                        if matches!(wait, Wait::Motion) {
                            self.mover = Some(id);
                        }
                        self.threads[i].wait = Some(wait);
                        return Ok(Turn::Over);
                    }
                }
            }
            if self.threads[i].dead {
                return Ok(Turn::Over);
            }
            if self.threads[i].stack.len() > MAX_STACK {
                return Err("expression too large for the controller".to_owned());
            }
        }
        Err(format!(
            "infinite loop: {MAX_INSTRUCTIONS} instructions without using controller time (no sync, sleep or motion)"
        ))
    }
}
