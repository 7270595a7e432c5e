//! The machine: threads of a program taking turns within one control step.

use super::arithmetic::{binary, bounded, element, set_element, unary};
use super::ast::{FunctionKind, Scope};
use super::builtins::{Flow, Wait, begin, resume};
use super::compile::{NameId, Op, Program, compile};
use super::error::{RuntimeError, ScriptError};
use super::host::{Host, StepOutcome};
use super::lexer::lex;
use super::parser::parse;
use super::sockets::SocketBuffers;
use super::value::Value;

/// Instructions of one thread within one control step; beyond them it is taken to compute for ever.
pub const MAX_INSTRUCTIONS: u32 = 50_000;
/// Threads of a program, the main one included.
pub const MAX_THREADS: usize = 64;
/// Calls within calls.
pub const MAX_CALL_DEPTH: usize = 128;
/// Values waiting on a thread's stack.
const MAX_STACK: usize = 20_000;

/// How an upload is meant to run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ProgramKind {
    /// `def`: replaces the running program.
    Main,
    /// `sec`: runs beside it and must take no controller time.
    Secondary,
    /// Bare statements: a program of their own, replaces the running one.
    Bare,
}

struct Frame {
    routine: usize,
    at: usize,
    locals: Vec<(NameId, Value)>,
}

struct Fibre {
    id: u32,
    frames: Vec<Frame>,
    stack: Vec<Value>,
    wait: Option<Wait>,
    critical: u32,
    dead: bool,
}

/// A loaded program and all its threads.
pub struct Machine {
    program: Program,
    fibres: Vec<Fibre>,
    globals: Vec<Option<Value>>,
    next_id: u32,
    /// Thread that waits for its motion.
    mover: Option<u32>,
    sockets: SocketBuffers,
    ended: Option<StepOutcome>,
}

/// Why a thread's turn is over.
enum Turn {
    /// Waits for the next step, or is done.
    Over,
    /// The whole program is done.
    Halt,
}

impl Machine {
    /// Reads a program as a controller does at upload. Nothing runs yet.
    ///
    /// # Errors
    /// The first thing that is not URScript, with its line.
    pub fn load(text: &str) -> Result<Self, ScriptError> {
        let program = compile(&parse(&lex(text)?)?)?;
        let globals = vec![None; program.names.len()];
        let main = Fibre::new(1, program.entry);
        Ok(Self {
            program,
            fibres: vec![main],
            globals,
            next_id: 2,
            mover: None,
            sockets: SocketBuffers::default(),
            ended: None,
        })
    }

    /// How this upload is meant to run.
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

    /// Threads that are alive, the main one included.
    #[must_use]
    pub fn threads(&self) -> usize {
        self.fibres.len()
    }

    /// Line at which the main thread stands.
    #[must_use]
    pub fn line(&self) -> u32 {
        self.fibres.first().map_or(0, |f| self.line_of(f))
    }

    /// Runs one control step. After `Finished` or `Failed` further calls only repeat the outcome.
    pub fn step(&mut self, host: &mut dyn Host) -> StepOutcome {
        if let Some(ended) = &self.ended {
            return ended.clone();
        }
        let mut i = 0;
        // Threads started in this step are appended and run in it; a cap on threads alive and dead bounds the loop.
        while i < self.fibres.len() {
            // A thread goes on until it waits, so nobody interrupts a critical section; while its thread waits inside it, the others
            // run: UR's own driver script reads its socket inside one while its servo thread moves the arm.
            if self.fibres[i].dead {
                i += 1;
                continue;
            }
            match self.turn(i, host) {
                Ok(Turn::Over) => {}
                Ok(Turn::Halt) => return self.end(StepOutcome::Finished, host),
                Err(message) => {
                    let line = self.fibres.get(i).map_or(0, |f| self.line_of(f));
                    return self.end(StepOutcome::Failed(RuntimeError { line, message }), host);
                }
            }
            i += 1;
        }
        if self.fibres.first().is_none_or(|main| main.dead) {
            return self.end(StepOutcome::Finished, host);
        }
        if self.kind() == ProgramKind::Secondary {
            let message = "a secondary program must not take controller time".to_owned();
            return self.end(StepOutcome::Failed(RuntimeError { line: self.line(), message }), host);
        }
        self.fibres.retain(|f| !f.dead);
        StepOutcome::Running
    }

    /// Ends the program from outside (stop button, watchdog, replaced by another): its motion is abandoned, its sockets closed.
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
        self.fibres.clear();
        self.ended = Some(outcome.clone());
        outcome
    }

    fn line_of(&self, fibre: &Fibre) -> u32 {
        fibre
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
        if let Some(wait) = self.fibres[i].wait.take() {
            let value = match wait {
                Wait::Thread(t) => {
                    let alive = self.fibres.iter().any(|f| f.id == t && !f.dead);
                    if alive { Flow::Wait(Wait::Thread(t)) } else { Flow::Value(Value::None) }
                }
                other => resume(other, host, &mut self.sockets)?,
            };
            match value {
                Flow::Wait(again) => {
                    self.fibres[i].wait = Some(again);
                    return Ok(Turn::Over);
                }
                Flow::Value(v) => {
                    if self.mover == Some(self.fibres[i].id) {
                        self.mover = None;
                    }
                    self.fibres[i].stack.push(v);
                }
            }
        }
        for _ in 0..MAX_INSTRUCTIONS {
            let Some(frame) = self.fibres[i].frames.last_mut() else {
                self.fibres[i].dead = true;
                return Ok(Turn::Over);
            };
            // Every routine ends in `Return`, so the address is always inside the code.
            let op = self.program.routines[frame.routine].code[frame.at].clone();
            frame.at += 1;
            match op {
                Op::Halt => return Ok(Turn::Halt),
                op => {
                    if let Some(wait) = self.execute(i, op, host)? {
                        let id = self.fibres[i].id;
                        if matches!(wait, Wait::Motion) {
                            self.mover = Some(id);
                        }
                        self.fibres[i].wait = Some(wait);
                        return Ok(Turn::Over);
                    }
                }
            }
            if self.fibres[i].dead {
                return Ok(Turn::Over);
            }
            if self.fibres[i].stack.len() > MAX_STACK {
                return Err("expression too large for the controller".to_owned());
            }
        }
        Err(format!(
            "infinite loop: {MAX_INSTRUCTIONS} instructions without using controller time (no sync, sleep or motion)"
        ))
    }

    fn pop(&mut self, i: usize) -> Value {
        self.fibres[i].stack.pop().unwrap_or(Value::None)
    }

    fn pop_many(&mut self, i: usize, n: usize) -> Vec<Value> {
        let stack = &mut self.fibres[i].stack;
        stack.split_off(stack.len().saturating_sub(n))
    }

    fn pop_bool(&mut self, i: usize) -> Result<bool, String> {
        match self.pop(i) {
            Value::Bool(b) => Ok(b),
            other => Err(format!("a condition must be a boolean, this is {}", other.type_name())),
        }
    }

    /// What `if` and `while` look at: UR's own driver script writes `if has_qnear:` with a number, so a number that is not zero
    /// holds. `and`, `or` and `not` take booleans only.
    fn pop_condition(&mut self, i: usize) -> Result<bool, String> {
        match self.pop(i) {
            Value::Int(n) => Ok(n != 0),
            Value::Float(x) => Ok(x != 0.0),
            Value::Bool(b) => Ok(b),
            other => Err(format!("a condition must be a boolean, this is {}", other.type_name())),
        }
    }

    fn jump(&mut self, i: usize, target: usize) {
        if let Some(frame) = self.fibres[i].frames.last_mut() {
            frame.at = target;
        }
    }

    fn variable(&self, i: usize, name: NameId) -> Option<&Value> {
        let frame = self.fibres[i].frames.last()?;
        frame.locals.iter().find(|(n, _)| *n == name).map(|(_, v)| v).or_else(|| self.globals.get(name)?.as_ref())
    }

    /// Where an assignment goes: a local of that name, else a global, else a new local; the program's first level is global.
    fn assign(&mut self, i: usize, scope: Scope, name: NameId, value: Value) {
        let entry = self.program.entry;
        let global_exists = self.globals.get(name).is_some_and(Option::is_some);
        let Some(frame) = self.fibres[i].frames.last_mut() else { return };
        let local = frame.locals.iter_mut().find(|(n, _)| *n == name);
        match (scope, local) {
            (Scope::Local | Scope::Free, Some((_, slot))) => *slot = value,
            (Scope::Local, None) if frame.routine != entry => frame.locals.push((name, value)),
            (Scope::Free, None) if frame.routine != entry && !global_exists => frame.locals.push((name, value)),
            _ => {
                if let Some(slot) = self.globals.get_mut(name) {
                    *slot = Some(value);
                }
            }
        }
    }

    fn undefined(&self, name: NameId) -> String {
        format!("variable '{}' has no value", self.program.names.get(name).map_or("?", String::as_str))
    }

    fn execute(&mut self, i: usize, op: Op, host: &mut dyn Host) -> Result<Option<Wait>, String> {
        match op {
            Op::Push(v) => self.fibres[i].stack.push(v),
            Op::Load(name) => {
                let value = self.variable(i, name).cloned().ok_or_else(|| self.undefined(name))?;
                self.fibres[i].stack.push(value);
            }
            Op::Store(scope, name) => {
                let value = self.pop(i);
                if value == Value::None {
                    return Err("the function assigned here returns no value".to_owned());
                }
                self.assign(i, scope, name, bounded(value)?);
            }
            Op::StoreIndex(name, n) => {
                let value = self.pop(i);
                let path = self.pop_many(i, n);
                let mut base = self.variable(i, name).cloned().ok_or_else(|| self.undefined(name))?;
                set_element(&mut base, &path, value)?;
                self.assign(i, Scope::Free, name, bounded(base)?);
            }
            Op::MakeList(n) => {
                let items = self.pop_many(i, n);
                self.fibres[i].stack.push(bounded(Value::List(items))?);
            }
            Op::MakePose => {
                let items = Value::List(self.pop_many(i, 6));
                let six = items.as_six().ok_or("a pose holds six numbers")?;
                self.fibres[i].stack.push(Value::Pose(six));
            }
            Op::Index(n) => {
                let path = self.pop_many(i, n);
                let base = self.pop(i);
                self.fibres[i].stack.push(element(&base, &path)?);
            }
            Op::Unary(op) => {
                let v = self.pop(i);
                self.fibres[i].stack.push(unary(op, &v)?);
            }
            Op::Binary(op) => {
                let b = self.pop(i);
                let a = self.pop(i);
                self.fibres[i].stack.push(bounded(binary(op, &a, &b)?)?);
            }
            Op::Jump(target) => self.jump(i, target),
            Op::JumpIfFalse(target) => {
                if !self.pop_condition(i)? {
                    self.jump(i, target);
                }
            }
            Op::ShortCircuit(flag, target) => {
                let value = self.pop_bool(i)?;
                if value == flag {
                    self.fibres[i].stack.push(Value::Bool(value));
                    self.jump(i, target);
                }
            }
            Op::CheckBool => {
                let value = self.pop_bool(i)?;
                self.fibres[i].stack.push(Value::Bool(value));
            }
            Op::JumpIfSet(name, target) => {
                let set = self.fibres[i].frames.last().is_some_and(|f| f.locals.iter().any(|(n, _)| *n == name));
                if set {
                    self.jump(i, target);
                }
            }
            Op::CallUser(callee, names) => self.call(i, callee, &names)?,
            Op::CallBuiltin(name, names) => {
                let arguments = self.pop_many(i, names.len());
                let free = self.mover.is_none();
                match begin(&name, arguments, &names, free, host, &mut self.sockets)? {
                    Flow::Value(v) => self.fibres[i].stack.push(bounded(v)?),
                    Flow::Wait(wait) => return Ok(Some(wait)),
                }
            }
            Op::Run(routine) => {
                if self.fibres.len() >= MAX_THREADS {
                    return Err(format!("more than {MAX_THREADS} threads in one control step"));
                }
                let id = self.next_id;
                self.next_id = self.next_id.wrapping_add(1).max(2);
                self.fibres.push(Fibre::new(id, routine));
                self.fibres[i].stack.push(Value::Thread(id));
            }
            Op::Kill => {
                let target = self.pop(i);
                self.kill(&target, host)?;
            }
            Op::Join => match self.pop(i) {
                Value::Thread(t) if t == self.fibres[i].id => return Err("a thread cannot join itself".to_owned()),
                Value::Thread(t) if self.fibres.iter().any(|f| f.id == t && !f.dead) => {
                    return Ok(Some(Wait::Thread(t)));
                }
                Value::Thread(_) | Value::Int(0) => self.fibres[i].stack.push(Value::None),
                other => return Err(format!("join needs a thread, this is {}", other.type_name())),
            },
            Op::EnterCritical => self.fibres[i].critical = self.fibres[i].critical.saturating_add(1),
            Op::ExitCritical => {
                let depth = self.fibres[i].critical;
                self.fibres[i].critical =
                    depth.checked_sub(1).ok_or_else(|| "exit_critical without enter_critical".to_owned())?;
            }
            Op::Pop => {
                self.pop(i);
            }
            Op::Return => {
                self.fibres[i].frames.pop();
                if self.fibres[i].frames.is_empty() {
                    self.fibres[i].dead = true;
                    self.fibres[i].critical = 0;
                }
            }
            Op::Halt => {}
        }
        Ok(None)
    }

    fn kill(&mut self, target: &Value, host: &mut dyn Host) -> Result<(), String> {
        match target {
            Value::Thread(t) => {
                if let Some(f) = self.fibres.iter_mut().find(|f| f.id == *t) {
                    f.dead = true;
                    f.critical = 0;
                    if self.mover == Some(*t) {
                        self.mover = None;
                        host.motion_abandon();
                    }
                }
                Ok(())
            }
            // Scripts keep 0 for "no thread" and kill it without asking.
            Value::Int(0) => Ok(()),
            other => Err(format!("kill needs a thread, this is {}", other.type_name())),
        }
    }

    fn call(&mut self, i: usize, callee: usize, names: &[Option<NameId>]) -> Result<(), String> {
        if self.fibres[i].frames.len() >= MAX_CALL_DEPTH {
            return Err(format!("calls nested more than {MAX_CALL_DEPTH} deep"));
        }
        let arguments = self.pop_many(i, names.len());
        let routine = &self.program.routines[callee];
        let mut locals: Vec<(NameId, Value)> = Vec::with_capacity(arguments.len());
        for (position, (value, name)) in arguments.into_iter().zip(names).enumerate() {
            let slot = match name {
                Some(n) => routine.parameters.iter().find(|p| *p == n),
                None => routine.parameters.get(position),
            };
            let Some(slot) = slot.filter(|s| !locals.iter().any(|(n, _)| n == *s)) else {
                return Err(format!(
                    "'{}' does not take argument {}, or it is given twice",
                    routine.name,
                    position + 1
                ));
            };
            if value == Value::None {
                return Err("the function used as an argument returns no value".to_owned());
            }
            locals.push((*slot, bounded(value)?));
        }
        for (p, optional) in routine.parameters.iter().zip(&routine.optional) {
            if !optional && !locals.iter().any(|(n, _)| n == p) {
                let name = self.program.names.get(*p).map_or("?", String::as_str);
                return Err(format!("'{}' needs argument '{name}'", routine.name));
            }
        }
        self.fibres[i].frames.push(Frame { routine: callee, at: 0, locals });
        Ok(())
    }
}

impl Fibre {
    fn new(id: u32, routine: usize) -> Self {
        let frames = vec![Frame { routine, at: 0, locals: Vec::new() }];
        Self { id, frames, stack: Vec::new(), wait: None, critical: 0, dead: false }
    }
}
