//! The statements of interpreter mode that have not been executed, and their numbers.

use std::collections::VecDeque;

/// Statements accepted before `clear_interpreter()` must be called.
pub(super) const MAX_STATEMENTS: u32 = 10_000;

/// Queue of interpreter mode. Statements are numbered from 1.
#[derive(Debug, Default)]
pub(super) struct StatementQueue {
    /// Number and routine of each waiting statement.
    waiting: VecDeque<(u32, usize)>,
    /// Whether `interpreter_mode()` is being executed.
    active: bool,
    clear_on_end: bool,
    interpreted: u32,
    executed: u32,
    cleared: u32,
}

impl StatementQueue {
    /// Whether a built-in function controls interpreter mode.
    pub(super) fn has_function(name: &str) -> bool {
        matches!(name, "interpreter_mode" | "end_interpreter" | "clear_interpreter")
    }

    /// Begins interpreter mode.
    pub(super) fn enter(&mut self, clear_on_enter: bool, clear_on_end: bool) -> Result<(), String> {
        if self.active {
            return Err("interpreter_mode is already active".to_owned());
        }
        if clear_on_enter {
            self.clear_all();
        }
        (self.active, self.clear_on_end) = (true, clear_on_end);
        Ok(())
    }

    /// Ends interpreter mode after the present statement.
    pub(super) fn end(&mut self) {
        self.active = false;
        if self.clear_on_end {
            self.clear_all();
        }
    }

    /// Notes that the executed statements are cleared; statements accepted later stay in the queue.
    pub(super) fn clear(&mut self) {
        self.cleared = self.executed;
    }

    fn clear_all(&mut self) {
        self.waiting.clear();
        self.cleared = self.interpreted;
    }

    /// Removes the statements that have not been executed; returns their number.
    pub(super) fn skip(&mut self) -> u32 {
        let n = self.unexecuted();
        self.waiting.clear();
        n
    }

    /// Adds a statement and returns its number.
    pub(super) fn push(&mut self, routine: usize) -> u32 {
        self.interpreted += 1;
        self.waiting.push_back((self.interpreted, routine));
        self.interpreted
    }

    /// The next statement's routine, which is now executed.
    pub(super) fn next(&mut self) -> Option<usize> {
        let (id, routine) = self.waiting.pop_front()?;
        self.executed = id;
        Some(routine)
    }

    pub(super) fn is_active(&self) -> bool {
        self.active
    }

    pub(super) fn is_full(&self) -> bool {
        self.interpreted - self.cleared >= MAX_STATEMENTS
    }

    pub(super) fn last_interpreted(&self) -> u32 {
        self.interpreted
    }

    pub(super) fn last_executed(&self) -> u32 {
        self.executed
    }

    pub(super) fn last_cleared(&self) -> u32 {
        self.cleared
    }

    pub(super) fn unexecuted(&self) -> u32 {
        u32::try_from(self.waiting.len()).unwrap_or(u32::MAX)
    }
}
