//! One thread of a script: its call frames, its value stack and what it waits for.

use super::compile::NameId;
use super::value::Value;
use super::wait::Wait;

/// A function call under way.
pub(super) struct Frame {
    /// Index of the routine in the program.
    pub(super) routine: usize,
    /// Next operation.
    pub(super) at: usize,
    pub(super) locals: Vec<(NameId, Value)>,
    /// Whether this is a statement of interpreter mode.
    pub(super) statement: bool,
}

/// A co-operative thread of a script.
pub(super) struct Thread {
    pub(super) id: u32,
    pub(super) frames: Vec<Frame>,
    pub(super) stack: Vec<Value>,
    pub(super) wait: Option<Wait>,
    /// Critical sections entered and not yet left.
    pub(super) critical: u32,
    pub(super) dead: bool,
}

impl Thread {
    pub(super) fn new(id: u32, routine: usize) -> Self {
        let frames = vec![Frame { routine, at: 0, locals: Vec::new(), statement: false }];
        Self { id, frames, stack: Vec::new(), wait: None, critical: 0, dead: false }
    }

    /// Marks the thread as ended and releases its critical sections.
    pub(super) fn end(&mut self) {
        self.dead = true;
        self.critical = 0;
    }
}
