//! Compiler from the syntax tree to code of a stack machine. The explicit stack lets a script block within nested calls.

use super::ast::{BinaryOp, Expr, ExprKind, Function, FunctionKind, Scope, Stmt, StmtKind, UnaryOp};
use super::error::ScriptError;
use super::value::Value;
use std::collections::HashMap;

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
}

#[derive(Default)]
struct Compiler {
    routines: Vec<Routine>,
    names: Vec<String>,
    ids: HashMap<String, NameId>,
}

struct Loop {
    start: usize,
    breaks: Vec<usize>,
}

/// Compiles an upload: one `def` or `sec`, or bare statements.
pub(crate) fn compile(text: &[Stmt]) -> Result<Program, ScriptError> {
    let mut c = Compiler::default();
    c.routines.push(Routine { name: "bare lines".to_owned(), ..Routine::default() });
    c.body(0, text)?;
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
    Ok(Program { routines: c.routines, names: c.names, entry, kind })
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
            StmtKind::Assign { scope, name, path, value } => {
                path.iter().try_for_each(|e| self.expr(r, e))?;
                self.expr(r, value)?;
                let name = self.name(name);
                let op = if path.is_empty() { Op::Store(*scope, name) } else { Op::StoreIndex(name, path.len()) };
                self.emit(r, line, op);
            }
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

    fn expr(&mut self, r: usize, e: &Expr) -> Result<(), ScriptError> {
        let line = e.line;
        let op = match &e.kind {
            ExprKind::Literal(v) => Op::Push(v.clone()),
            ExprKind::Name(n) => Op::Load(self.name(n)),
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
                match self.resolve(r, name) {
                    Some(f) if self.routines[f].kind == Some(FunctionKind::Def) => {
                        let names = arguments.iter().map(|a| a.name.as_ref().map(|n| self.name(n))).collect();
                        Op::CallUser(f, names)
                    }
                    Some(_) => {
                        return Err(ScriptError::new(line, format!("'{name}' is a thread: start it with run")));
                    }
                    None => Op::CallBuiltin(name.clone(), arguments.iter().map(|a| a.name.clone()).collect()),
                }
            }
            ExprKind::Run(name) => match self.resolve(r, name) {
                Some(f) if self.routines[f].kind == Some(FunctionKind::Thread) => Op::Run(f),
                _ => return Err(ScriptError::new(line, format!("run: there is no thread '{name}' in this scope"))),
            },
        };
        self.emit(r, line, op);
        Ok(())
    }
}
