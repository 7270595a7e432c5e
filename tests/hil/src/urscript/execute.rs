//! Execution of single operations: values, variables, jumps, calls and thread control.

use super::arithmetic::{binary, bounded, element, set_element, unary};
use super::ast::Scope;
use super::builtins::begin;
use super::compile::{NameId, Op};
use super::functions::bind;
use super::host::Host;
use super::machine::{MAX_CALL_DEPTH, MAX_THREADS, Machine};
use super::queue::StatementQueue;
use super::thread::{Frame, Thread};
use super::value::Value;
use super::wait::{Flow, Wait};
use super::{methods, rpc};

impl Machine {
    /// Executes one operation of thread `i`; returns what the thread now waits for.
    pub(super) fn execute(&mut self, i: usize, op: Op, host: &mut dyn Host) -> Result<Option<Wait>, String> {
        match op {
            Op::Load(_) | Op::Store(..) | Op::StoreIndex(..) => self.access_variable(i, op)?,
            Op::Push(_)
            | Op::MakeList(_)
            | Op::MakePose
            | Op::MakeStruct(_)
            | Op::Index(_)
            | Op::Unary(_)
            | Op::Binary(_)
            | Op::Pop => {
                self.evaluate(i, op)?;
            }
            Op::Jump(_) | Op::JumpIfFalse(_) | Op::ShortCircuit(..) | Op::CheckBool | Op::JumpIfSet(..) => {
                self.branch(i, &op)?;
            }
            Op::CallUser(callee, names) => self.call(i, callee, &names)?,
            Op::CallBuiltin(name, names) => {
                let arguments = self.pop_many(i, names.len());
                if StatementQueue::has_function(&name) {
                    return self.control_interpreter(i, &name, arguments, &names);
                }
                let free = self.mover.is_none();
                match begin(&name, arguments, &names, free, host, &mut self.sockets)? {
                    Flow::Value(v) => self.threads[i].stack.push(bounded(v)?),
                    Flow::Wait(wait) => return Ok(Some(wait)),
                }
            }
            Op::CallMethod(method, arguments) => {
                let arguments = self.pop_many(i, arguments);
                let base = self.pop(i);
                if let Value::Rpc(_) = base {
                    return rpc::begin(&base, &method, &arguments, host).map(Some);
                }
                let (value, _) = methods::call(&base, &method, &arguments)?;
                self.threads[i].stack.push(value);
            }
            Op::CallVariableMethod(name, path, method, arguments) => {
                let arguments = self.pop_many(i, arguments);
                let path = self.pop_many(i, path);
                return self.call_method(i, name, &path, &method, &arguments, host);
            }
            Op::Return => {
                let frame = self.threads[i].frames.pop();
                if frame.is_some_and(|f| f.statement) {
                    self.pop(i);
                    if self.interpreter.is_active() {
                        return Ok(Some(Wait::Interpreter));
                    }
                    // The call of interpreter_mode returns.
                    self.threads[i].stack.push(Value::None);
                } else if self.threads[i].frames.is_empty() {
                    self.threads[i].end();
                }
            }
            Op::Run(_) | Op::Kill | Op::Join | Op::EnterCritical | Op::ExitCritical => {
                return self.control_thread(i, &op, host);
            }
            // The caller ends the program before it executes this.
            Op::Halt => {}
        }
        Ok(None)
    }

    /// `interpreter_mode`, `end_interpreter` and `clear_interpreter`.
    fn control_interpreter(
        &mut self,
        i: usize,
        name: &str,
        arguments: Vec<Value>,
        names: &[Option<String>],
    ) -> Result<Option<Wait>, String> {
        let bound = bind(name, arguments, names).ok_or_else(|| format!("'{name}' has no parameters"))??;
        match (name, bound.as_slice()) {
            ("interpreter_mode", [Value::Bool(clear_on_enter), Value::Bool(clear_on_end)]) => {
                self.interpreter.enter(*clear_on_enter, *clear_on_end)?;
                return Ok(Some(Wait::Interpreter));
            }
            ("interpreter_mode", _) => return Err("interpreter_mode needs two booleans".to_owned()),
            ("end_interpreter", _) => self.interpreter.end(),
            _ => self.interpreter.clear(),
        }
        self.threads[i].stack.push(Value::None);
        Ok(None)
    }

    /// Calls a method of a variable or of one of its elements, and stores the changed list.
    fn call_method(
        &mut self,
        i: usize,
        name: NameId,
        path: &[Value],
        method: &str,
        arguments: &[Value],
        host: &mut dyn Host,
    ) -> Result<Option<Wait>, String> {
        let mut variable = self.variable(i, name).cloned().ok_or_else(|| self.undefined(name))?;
        let base = element(&variable, path)?;
        if let Value::Rpc(_) = base {
            return rpc::begin(&base, method, arguments, host).map(Some);
        }
        let (value, changed) = methods::call(&base, method, arguments)?;
        if let Some(changed) = changed {
            set_element(&mut variable, path, changed)?;
            self.assign(i, Scope::Free, name, bounded(variable)?);
        }
        self.threads[i].stack.push(value);
        Ok(None)
    }

    /// Loads and stores.
    fn access_variable(&mut self, i: usize, op: Op) -> Result<(), String> {
        match op {
            Op::Load(name) => {
                let value = self.variable(i, name).cloned().ok_or_else(|| self.undefined(name))?;
                self.threads[i].stack.push(value);
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
            _ => {}
        }
        Ok(())
    }

    /// Operations on the value stack.
    fn evaluate(&mut self, i: usize, op: Op) -> Result<(), String> {
        let value = match op {
            Op::Push(v) => v,
            Op::MakeList(n) => bounded(Value::List(self.pop_many(i, n)))?,
            Op::MakePose => {
                let items = Value::List(self.pop_many(i, 6));
                Value::Pose(items.as_six().ok_or("a pose needs six numbers")?)
            }
            Op::MakeStruct(names) => {
                let values = self.pop_many(i, names.len());
                bounded(Value::Struct(names.into_iter().zip(values).collect()))?
            }
            Op::Index(n) => {
                let path = self.pop_many(i, n);
                let base = self.pop(i);
                element(&base, &path)?
            }
            Op::Unary(op) => {
                let v = self.pop(i);
                unary(op, &v)?
            }
            Op::Binary(op) => {
                let b = self.pop(i);
                let a = self.pop(i);
                bounded(binary(op, &a, &b)?)?
            }
            _ => {
                self.pop(i);
                return Ok(());
            }
        };
        self.threads[i].stack.push(value);
        Ok(())
    }

    /// Jumps and their conditions.
    fn branch(&mut self, i: usize, op: &Op) -> Result<(), String> {
        match *op {
            Op::Jump(target) => self.jump(i, target),
            Op::JumpIfFalse(target) => {
                let holds = self.pop_condition(i)?;
                if !holds {
                    self.jump(i, target);
                }
            }
            Op::ShortCircuit(flag, target) => {
                let value = self.pop_bool(i)?;
                if value == flag {
                    self.threads[i].stack.push(Value::Bool(value));
                    self.jump(i, target);
                }
            }
            Op::CheckBool => {
                let value = self.pop_bool(i)?;
                self.threads[i].stack.push(Value::Bool(value));
            }
            Op::JumpIfSet(name, target) => {
                let set = self.threads[i].frames.last().is_some_and(|f| f.locals.iter().any(|(n, _)| *n == name));
                if set {
                    self.jump(i, target);
                }
            }
            _ => {}
        }
        Ok(())
    }

    /// Starts, ends and awaits threads; enters and leaves critical sections.
    fn control_thread(&mut self, i: usize, op: &Op, host: &mut dyn Host) -> Result<Option<Wait>, String> {
        match op {
            Op::Run(routine) => {
                if self.threads.len() >= MAX_THREADS {
                    return Err(format!("more than {MAX_THREADS} threads in one control step"));
                }
                let id = self.next_id;
                self.next_id = self.next_id.wrapping_add(1).max(2);
                self.threads.push(Thread::new(id, *routine));
                self.threads[i].stack.push(Value::Thread(id));
            }
            Op::Kill => {
                let target = self.pop(i);
                self.kill(&target, host)?;
            }
            Op::Join => match self.pop(i) {
                Value::Thread(t) if t == self.threads[i].id => return Err("a thread cannot join itself".to_owned()),
                Value::Thread(t) if self.threads.iter().any(|f| f.id == t && !f.dead) => {
                    return Ok(Some(Wait::Thread(t)));
                }
                Value::Thread(_) | Value::Int(0) => self.threads[i].stack.push(Value::None),
                other => return Err(format!("join needs a thread, got {}", other.type_name())),
            },
            Op::EnterCritical => self.threads[i].critical = self.threads[i].critical.saturating_add(1),
            _ => {
                let depth = self.threads[i].critical;
                self.threads[i].critical =
                    depth.checked_sub(1).ok_or_else(|| "exit_critical without enter_critical".to_owned())?;
            }
        }
        Ok(None)
    }

    fn pop(&mut self, i: usize) -> Value {
        self.threads[i].stack.pop().unwrap_or(Value::None)
    }

    fn pop_many(&mut self, i: usize, n: usize) -> Vec<Value> {
        let stack = &mut self.threads[i].stack;
        stack.split_off(stack.len().saturating_sub(n))
    }

    fn pop_bool(&mut self, i: usize) -> Result<bool, String> {
        match self.pop(i) {
            Value::Bool(b) => Ok(b),
            other => Err(format!("a condition must be a boolean, got {}", other.type_name())),
        }
    }

    /// Condition of `if` and `while`. UR's own driver script uses a number (`if has_qnear:`), so a number other than
    /// zero is true. `and`, `or` and `not` accept booleans only.
    fn pop_condition(&mut self, i: usize) -> Result<bool, String> {
        match self.pop(i) {
            Value::Int(n) => Ok(n != 0),
            Value::Float(x) => Ok(x != 0.0),
            Value::Bool(b) => Ok(b),
            other => Err(format!("a condition must be a boolean, got {}", other.type_name())),
        }
    }

    fn jump(&mut self, i: usize, target: usize) {
        if let Some(frame) = self.threads[i].frames.last_mut() {
            frame.at = target;
        }
    }

    fn variable(&self, i: usize, name: NameId) -> Option<&Value> {
        let frame = self.threads[i].frames.last()?;
        frame.locals.iter().find(|(n, _)| *n == name).map(|(_, v)| v).or_else(|| self.globals.get(name)?.as_ref())
    }

    /// Assigns to a local of that name, else to a global, else to a new local. The top level of the program is global.
    fn assign(&mut self, i: usize, scope: Scope, name: NameId, value: Value) {
        let global_exists = self.globals.get(name).is_some_and(Option::is_some);
        let Some(frame) = self.threads[i].frames.last_mut() else { return };
        let top_level = self.program.routines.get(frame.routine).is_some_and(|r| r.top_level);
        let local = frame.locals.iter_mut().find(|(n, _)| *n == name);
        match (scope, local) {
            (Scope::Local | Scope::Free, Some((_, slot))) => *slot = value,
            (Scope::Local, None) if !top_level => frame.locals.push((name, value)),
            (Scope::Free, None) if !top_level && !global_exists => frame.locals.push((name, value)),
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

    fn kill(&mut self, target: &Value, host: &mut dyn Host) -> Result<(), String> {
        match target {
            Value::Thread(t) => {
                if let Some(f) = self.threads.iter_mut().find(|f| f.id == *t) {
                    f.end();
                    if self.mover == Some(*t) {
                        self.mover = None;
                        host.motion_abandon();
                    }
                }
                Ok(())
            }
            // Scripts use 0 for "no thread" and kill it unconditionally.
            Value::Int(0) => Ok(()),
            other => Err(format!("kill needs a thread, got {}", other.type_name())),
        }
    }

    fn call(&mut self, i: usize, callee: usize, names: &[Option<NameId>]) -> Result<(), String> {
        if self.threads[i].frames.len() >= MAX_CALL_DEPTH {
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
        self.threads[i].frames.push(Frame { routine: callee, at: 0, locals, statement: false });
        Ok(())
    }
}
