//! Compiler from the syntax tree to code of a stack machine. The explicit stack lets a script block within nested
//! calls.

use super::ast::{Argument, BinaryOp, Expr, ExprKind, Function, FunctionKind, Scope, Stmt, StmtKind, UnaryOp};
use super::error::ScriptError;
use super::functions::{Support, support};
use super::value::Value;
use std::collections::{HashMap, HashSet};

/// Index into [`Program::names`].
pub(crate) type NameId = usize;

#[derive(Clone, Debug)]
pub(crate) enum Op {
    Push(Value),
    Load(NameId),
    Store(Scope, NameId),
    /// Operands: the value on top, `n` indices below it.
    StoreIndex(NameId, usize),
    MakeList(usize),
    MakePose,
    /// Names of the members, whose values are on the stack.
    MakeStruct(Vec<String>),
    Index(usize),
    Unary(UnaryOp),
    Binary(BinaryOp),
    Jump(usize),
    JumpIfFalse(usize),
    /// For `and` and `or`: if the top equals the flag, keeps it and jumps; otherwise drops it.
    ShortCircuit(bool, usize),
    /// Fails unless the top is a boolean (right operand of `and` and `or`).
    CheckBool,
    /// For default arguments: jumps if the parameter was given.
    JumpIfSet(NameId, usize),
    /// Callee, and the names of named arguments.
    CallUser(usize, Vec<Option<NameId>>),
    CallBuiltin(String, Vec<Option<String>>),
    /// Method name and number of arguments, which are above the value.
    CallMethod(String, usize),
    /// The same for an element of a variable: variable, number of indices (below the arguments), method, arguments.
    CallVariableMethod(NameId, usize, String, usize),
    Run(usize),
    Kill,
    Join,
    EnterCritical,
    ExitCritical,
    Pop,
    Return,
    Halt,
}

#[derive(Debug, Default)]
pub(crate) struct Routine {
    pub(crate) name: String,
    pub(crate) parameters: Vec<NameId>,
    /// Parameters with a default.
    pub(crate) optional: Vec<bool>,
    pub(crate) code: Vec<Op>,
    /// Line of each operation.
    pub(crate) lines: Vec<u32>,
    /// Whether its variables are global.
    pub(crate) top_level: bool,
    kind: Option<FunctionKind>,
    parent: Option<usize>,
    children: HashMap<String, usize>,
}

/// A compiled upload; routine 0 is the top level of the text.
#[derive(Debug)]
pub(crate) struct Program {
    pub(crate) routines: Vec<Routine>,
    pub(crate) names: Vec<String>,
    pub(crate) entry: usize,
    pub(crate) kind: Option<FunctionKind>,
    assigned: HashSet<NameId>,
    /// Routine whose functions are visible to the next statement of interpreter mode.
    scope: usize,
}

#[derive(Default)]
struct Compiler {
    routines: Vec<Routine>,
    names: Vec<String>,
    ids: HashMap<String, NameId>,
    /// Variables that are assigned somewhere, parameters included.
    assigned: HashSet<NameId>,
    /// Variables that are read, with their lines.
    reads: Vec<(NameId, u32)>,
    /// Functions that are called and neither defined nor built in, with their lines and the reason.
    missing: Vec<(String, u32, Support)>,
}

struct Loop {
    start: usize,
    breaks: Vec<usize>,
}

/// Compiles a statement of interpreter mode, which sees the program's global variables and functions. Returns its
/// routine.
pub(crate) fn extend(program: &mut Program, text: &[Stmt]) -> Result<usize, ScriptError> {
    let id = program.routines.len();
    let mut c = Compiler {
        routines: std::mem::take(&mut program.routines),
        ids: program.names.iter().enumerate().map(|(i, n)| (n.clone(), i)).collect(),
        names: std::mem::take(&mut program.names),
        assigned: program.assigned.clone(),
        ..Compiler::default()
    };
    c.routines.push(Routine {
        name: "statement".to_owned(),
        top_level: true,
        parent: Some(program.scope),
        ..Routine::default()
    });
    let result = c.body(id, text).and_then(|()| c.check_names());
    if result.is_err() {
        c.routines.truncate(id);
    } else {
        (program.assigned, program.scope) = (c.assigned, id);
    }
    (program.routines, program.names) = (c.routines, c.names);
    result.map(|()| id)
}

/// Compiles an upload: one `def` or `sec`, or bare statements.
pub(crate) fn compile(text: &[Stmt]) -> Result<Program, ScriptError> {
    let mut c = Compiler::default();
    c.routines.push(Routine { name: "bare lines".to_owned(), ..Routine::default() });
    c.body(0, text)?;
    c.check_names()?;
    let functions: Vec<&Function> =
        text.iter().filter_map(|s| if let StmtKind::Def(f) = &s.kind { Some(f) } else { None }).collect();
    let (entry, kind) = match functions.as_slice() {
        [only] if text.len() == 1 => {
            if only.kind == FunctionKind::Thread {
                return Err(ScriptError::new(only.line, "a thread cannot be a program: def or sec is expected"));
            }
            if !only.parameters.is_empty() {
                return Err(ScriptError::new(only.line, format!("program '{}' cannot take parameters", only.name)));
            }
            (c.routines.first().and_then(|r| r.children.get(&only.name)).copied().unwrap_or(0), Some(only.kind))
        }
        _ if text.is_empty() => return Err(ScriptError::new(1, "the program has no statement")),
        _ => (0, None),
    };
    if let Some(r) = c.routines.get_mut(entry) {
        r.top_level = true;
    }
    Ok(Program { routines: c.routines, names: c.names, entry, kind, assigned: c.assigned, scope: entry })
}

impl Compiler {
    fn name(&mut self, text: &str) -> NameId {
        if let Some(id) = self.ids.get(text) {
            return *id;
        }
        self.names.push(text.to_owned());
        self.ids.insert(text.to_owned(), self.names.len() - 1);
        self.names.len() - 1
    }

    fn emit(&mut self, r: usize, line: u32, op: Op) -> usize {
        let routine = &mut self.routines[r];
        routine.code.push(op);
        routine.lines.push(line);
        routine.code.len() - 1
    }

    fn here(&self, r: usize) -> usize {
        self.routines[r].code.len()
    }

    fn patch(&mut self, r: usize, at: usize) {
        let target = self.here(r);
        match &mut self.routines[r].code[at] {
            Op::Jump(t) | Op::JumpIfFalse(t) | Op::ShortCircuit(_, t) | Op::JumpIfSet(_, t) => *t = target,
            _ => {}
        }
    }

    fn resolve(&self, from: usize, name: &str) -> Option<usize> {
        let mut scope = Some(from);
        while let Some(r) = scope {
            if let Some(found) = self.routines[r].children.get(name) {
                return Some(*found);
            }
            scope = self.routines[r].parent;
        }
        None
    }

    /// Declares the functions of a body before code is generated, because they are visible in the whole body.
    fn declare<'s>(&mut self, r: usize, body: &'s [Stmt], found: &mut Vec<(usize, &'s Function)>) {
        for s in body {
            match &s.kind {
                StmtKind::Def(f) => {
                    let id = self.routines.len();
                    self.routines.push(Routine {
                        name: f.name.clone(),
                        kind: Some(f.kind),
                        parent: Some(r),
                        ..Routine::default()
                    });
                    self.routines[r].children.insert(f.name.clone(), id);
                    found.push((id, f));
                }
                StmtKind::If { arms, otherwise } => {
                    for (_, b) in arms {
                        self.declare(r, b, found);
                    }
                    self.declare(r, otherwise, found);
                }
                StmtKind::While { body, .. } => self.declare(r, body, found),
                _ => {}
            }
        }
    }

    fn body(&mut self, r: usize, body: &[Stmt]) -> Result<(), ScriptError> {
        let mut found = Vec::new();
        self.declare(r, body, &mut found);
        let parameters: Vec<Vec<NameId>> =
            found.iter().map(|(_, f)| f.parameters.iter().map(|p| self.name(&p.name)).collect()).collect();
        for ((id, f), names) in found.iter().zip(parameters) {
            self.routines[*id].optional = f.parameters.iter().map(|p| p.default.is_some()).collect();
            self.assigned.extend(&names);
            self.routines[*id].parameters = names;
        }
        for (id, f) in &found {
            for p in &f.parameters {
                if let Some(default) = &p.default {
                    let name = self.name(&p.name);
                    let skip = self.emit(*id, f.line, Op::JumpIfSet(name, 0));
                    self.expr(*id, default)?;
                    self.emit(*id, f.line, Op::Store(Scope::Local, name));
                    self.patch(*id, skip);
                }
            }
            self.body(*id, &f.body)?;
        }
        let mut loops = Vec::new();
        self.block(r, body, &mut loops)?;
        let line = body.last().map_or(1, |s| s.line);
        self.emit(r, line, Op::Push(Value::None));
        self.emit(r, line, Op::Return);
        Ok(())
    }

    fn block(&mut self, r: usize, body: &[Stmt], loops: &mut Vec<Loop>) -> Result<(), ScriptError> {
        body.iter().try_for_each(|s| self.statement(r, s, loops))
    }

    fn statement(&mut self, r: usize, s: &Stmt, loops: &mut Vec<Loop>) -> Result<(), ScriptError> {
        let line = s.line;
        match &s.kind {
            StmtKind::Def(_) => {}
            StmtKind::Assign { scope, name, path, value } => self.assignment(r, line, (*scope, name), path, value)?,
            StmtKind::Expr(e) => {
                self.expr(r, e)?;
                self.emit(r, line, Op::Pop);
            }
            StmtKind::If { arms, otherwise } => {
                let mut exits = Vec::new();
                for (condition, body) in arms {
                    self.expr(r, condition)?;
                    let skip = self.emit(r, condition.line, Op::JumpIfFalse(0));
                    self.block(r, body, loops)?;
                    exits.push(self.emit(r, line, Op::Jump(0)));
                    self.patch(r, skip);
                }
                self.block(r, otherwise, loops)?;
                exits.into_iter().for_each(|at| self.patch(r, at));
            }
            StmtKind::While { condition, body } => {
                let start = self.here(r);
                self.expr(r, condition)?;
                let leave = self.emit(r, line, Op::JumpIfFalse(0));
                loops.push(Loop { start, breaks: vec![leave] });
                self.block(r, body, loops)?;
                self.emit(r, line, Op::Jump(start));
                for at in loops.pop().map(|l| l.breaks).unwrap_or_default() {
                    self.patch(r, at);
                }
            }
            StmtKind::Break => {
                let at = self.emit(r, line, Op::Jump(0));
                if let Some(inner) = loops.last_mut() {
                    inner.breaks.push(at);
                }
            }
            StmtKind::Continue => {
                let start = loops.last().map_or(0, |l| l.start);
                self.emit(r, line, Op::Jump(start));
            }
            StmtKind::Return(value) => {
                match value {
                    Some(e) => self.expr(r, e)?,
                    None => {
                        self.emit(r, line, Op::Push(Value::None));
                    }
                }
                self.emit(r, line, Op::Return);
            }
            StmtKind::Halt => {
                self.emit(r, line, Op::Halt);
            }
            StmtKind::Kill(e) | StmtKind::Join(e) => {
                self.expr(r, e)?;
                if matches!(s.kind, StmtKind::Kill(_)) {
                    self.emit(r, line, Op::Kill);
                } else {
                    // Every wait leaves a value, including join.
                    self.emit(r, line, Op::Join);
                    self.emit(r, line, Op::Pop);
                }
            }
            StmtKind::EnterCritical => {
                self.emit(r, line, Op::EnterCritical);
            }
            StmtKind::ExitCritical => {
                self.emit(r, line, Op::ExitCritical);
            }
        }
        Ok(())
    }

    fn assignment(
        &mut self,
        r: usize,
        line: u32,
        (scope, name): (Scope, &str),
        path: &[Expr],
        value: &Expr,
    ) -> Result<(), ScriptError> {
        path.iter().try_for_each(|e| self.expr(r, e))?;
        self.expr(r, value)?;
        // `digital_out[2] = True` of manuals before software 3.0, which urx still uses.
        let legacy = match name {
            "digital_out" => Some("set_digital_out"),
            "analog_out" => Some("set_analog_out"),
            _ => None,
        };
        let name = self.name(name);
        if let (Some(function), [_]) = (legacy, path)
            && !self.assigned.contains(&name)
        {
            self.emit(r, line, Op::CallBuiltin(function.to_owned(), vec![None, None]));
            self.emit(r, line, Op::Pop);
        } else if path.is_empty() {
            self.assigned.insert(name);
            self.emit(r, line, Op::Store(scope, name));
        } else {
            self.reads.push((name, line));
            self.emit(r, line, Op::StoreIndex(name, path.len()));
        }
        Ok(())
    }

    fn expr(&mut self, r: usize, e: &Expr) -> Result<(), ScriptError> {
        let line = e.line;
        let op = match &e.kind {
            ExprKind::Literal(v) => Op::Push(v.clone()),
            ExprKind::Name(n) => {
                let name = self.name(n);
                self.reads.push((name, line));
                Op::Load(name)
            }
            ExprKind::List(items) => {
                items.iter().try_for_each(|i| self.expr(r, i))?;
                Op::MakeList(items.len())
            }
            ExprKind::Pose(items) => {
                items.iter().try_for_each(|i| self.expr(r, i))?;
                Op::MakePose
            }
            ExprKind::Index(base, path) => {
                self.expr(r, base)?;
                path.iter().try_for_each(|i| self.expr(r, i))?;
                Op::Index(path.len())
            }
            ExprKind::Unary(op, inner) => {
                self.expr(r, inner)?;
                Op::Unary(*op)
            }
            ExprKind::Binary(op, a, b) => {
                self.expr(r, a)?;
                self.expr(r, b)?;
                Op::Binary(*op)
            }
            ExprKind::And(a, b) | ExprKind::Or(a, b) => {
                self.expr(r, a)?;
                let stop_at = matches!(e.kind, ExprKind::Or(..));
                let skip = self.emit(r, line, Op::ShortCircuit(stop_at, 0));
                self.expr(r, b)?;
                self.emit(r, line, Op::CheckBool);
                self.patch(r, skip);
                return Ok(());
            }
            ExprKind::Call(name, arguments) => {
                arguments.iter().try_for_each(|a| self.expr(r, &a.value))?;
                self.callee(r, name, arguments, line)?
            }
            ExprKind::Method(base, name, arguments) => self.method(r, base, name, arguments, line)?,
            ExprKind::Run(name) => match self.resolve(r, name) {
                Some(f) if self.routines[f].kind == Some(FunctionKind::Thread) => Op::Run(f),
                _ => return Err(ScriptError::new(line, format!("run: there is no thread '{name}' in this scope"))),
            },
        };
        self.emit(r, line, op);
        Ok(())
    }

    /// Emits the operands of `base.name(arguments)` and returns the operation that calls it.
    fn method(
        &mut self,
        r: usize,
        base: &Expr,
        name: &str,
        arguments: &[Argument],
        line: u32,
    ) -> Result<Op, ScriptError> {
        if arguments.iter().any(|a| a.name.is_some()) {
            return Err(ScriptError::new(line, format!("method '{name}' cannot have named arguments")));
        }
        let none = Vec::new();
        let variable = match &base.kind {
            ExprKind::Name(variable) => Some((variable, &none)),
            ExprKind::Index(inner, path) => match &inner.kind {
                ExprKind::Name(variable) => Some((variable, path)),
                _ => None,
            },
            _ => None,
        };
        let Some((variable, path)) = variable else {
            self.expr(r, base)?;
            arguments.iter().try_for_each(|a| self.expr(r, &a.value))?;
            return Ok(Op::CallMethod(name.to_owned(), arguments.len()));
        };
        let variable = self.name(variable);
        self.reads.push((variable, line));
        path.iter().try_for_each(|i| self.expr(r, i))?;
        arguments.iter().try_for_each(|a| self.expr(r, &a.value))?;
        Ok(Op::CallVariableMethod(variable, path.len(), name.to_owned(), arguments.len()))
    }

    /// The operation that calls function `name`, whose arguments are on the stack.
    fn callee(&mut self, r: usize, name: &str, arguments: &[Argument], line: u32) -> Result<Op, ScriptError> {
        match self.resolve(r, name) {
            Some(f) if self.routines[f].kind == Some(FunctionKind::Def) => {
                let names = arguments.iter().map(|a| a.name.as_ref().map(|n| self.name(n))).collect();
                Ok(Op::CallUser(f, names))
            }
            Some(_) => Err(ScriptError::new(line, format!("'{name}' is a thread: start it with run"))),
            None if name == "struct" => arguments
                .iter()
                .map(|a| a.name.clone())
                .collect::<Option<Vec<_>>>()
                .map(Op::MakeStruct)
                .ok_or_else(|| ScriptError::new(line, "struct needs named members: struct(name=value, ...)")),
            None => {
                let support = support(name);
                if matches!(support, Support::Unknown | Support::Refused) {
                    self.missing.push((name.to_owned(), line, support));
                }
                Ok(Op::CallBuiltin(name.to_owned(), arguments.iter().map(|a| a.name.clone()).collect()))
            }
        }
    }

    /// Refuses a program with names that are not defined anywhere, all of them in one message.
    fn check_names(&self) -> Result<(), ScriptError> {
        let mut unknown: Vec<(String, Vec<u32>)> = Vec::new();
        let mut unsupported: Vec<(String, Vec<u32>)> = Vec::new();
        let note = |list: &mut Vec<(String, Vec<u32>)>, name: String, line: u32| match list
            .iter_mut()
            .find(|(n, _)| *n == name)
        {
            Some((_, lines)) if lines.contains(&line) => {}
            Some((_, lines)) => lines.push(line),
            None => list.push((name, vec![line])),
        };
        for (name, line, support) in &self.missing {
            let list = if *support == Support::Refused { &mut unsupported } else { &mut unknown };
            note(list, format!("{name}()"), *line);
        }
        for (id, line) in self.reads.iter().filter(|(id, _)| !self.assigned.contains(id)) {
            note(&mut unknown, self.names.get(*id).cloned().unwrap_or_default(), *line);
        }
        let first = unknown.iter().chain(&unsupported).flat_map(|(_, lines)| lines).min();
        let Some(&first) = first else { return Ok(()) };
        let mut parts = Vec::new();
        for (what, list) in [("unknown names", &unknown), ("functions that this mock does not simulate", &unsupported)]
        {
            if !list.is_empty() {
                let names: Vec<String> =
                    list.iter().take(MAX_NAMES).map(|(name, lines)| format!("{name} {}", place(lines))).collect();
                let rest = list.len().saturating_sub(MAX_NAMES);
                let more = if rest > 0 { format!(" and {rest} more") } else { String::new() };
                parts.push(format!("{what}: {}{more}", names.join(", ")));
            }
        }
        Err(ScriptError::new(first, format!("{}; nothing was started", parts.join("; "))))
    }
}

/// Names listed in one message.
const MAX_NAMES: usize = 50;
/// Lines listed for one name.
const MAX_LINES: usize = 5;

fn place(lines: &[u32]) -> String {
    let shown: Vec<String> = lines.iter().take(MAX_LINES).map(u32::to_string).collect();
    let more = if lines.len() > MAX_LINES { ", ..." } else { "" };
    format!("({} {}{more})", if lines.len() == 1 { "line" } else { "lines" }, shown.join(", "))
}
