//! Robot messages for the primary interface.

/// Longest text of a message; longer ones are truncated.
const MAX_TEXT_BYTES: usize = 2048;
/// Queued messages; the oldest are dropped first.
const MAX_QUEUED: usize = 256;

/// One robot message.
#[derive(Clone, Debug, PartialEq)]
pub struct Message {
    /// Controller time, microseconds.
    pub time_us: u64,
    /// Content.
    pub kind: MessageKind,
}

/// Content of a message.
#[derive(Clone, Debug, PartialEq)]
pub enum MessageKind {
    /// `textmsg`.
    Text(String),
    /// Label of the program node under way.
    Label(i32, String),
    /// `popup`.
    Popup {
        /// Title.
        title: String,
        /// Body.
        text: String,
        /// Shown in yellow.
        warning: bool,
        /// Shown in red.
        error: bool,
    },
    /// The safety mode changed.
    Safety {
        /// Code of the report, `C<code>A<argument>`.
        code: i32,
        /// Argument of the code.
        argument: i32,
        /// New `safety_mode`.
        mode: u8,
    },
    /// A coded error.
    Error {
        /// Code of the report, `C<code>A<argument>`.
        code: i32,
        /// Argument of the code.
        argument: i32,
        /// 0 debug, 1 info, 2 warning, 3 violation, 4 fault.
        level: i32,
        /// Description.
        text: String,
    },
    /// A program failed.
    Runtime {
        /// Line of the script, from 1.
        line: i32,
        /// Column, from 1.
        column: i32,
        /// Description.
        text: String,
    },
}

/// Messages to be sent, bounded.
#[derive(Clone, Debug, Default)]
pub struct Outbox(std::collections::VecDeque<Message>);

impl Outbox {
    /// Adds a message, dropping the oldest when full.
    pub fn push(&mut self, time_us: u64, kind: MessageKind) {
        if self.0.len() == MAX_QUEUED {
            self.0.pop_front();
        }
        self.0.push_back(Message { time_us, kind });
    }

    /// Takes all messages.
    pub fn drain(&mut self) -> impl Iterator<Item = Message> + '_ {
        self.0.drain(..)
    }

    /// Whether there is no message.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }
}

/// Truncates a text at a character boundary so that its length fits every frame.
pub(super) fn cut(text: &str) -> &str {
    let mut end = text.len().min(MAX_TEXT_BYTES);
    while !text.is_char_boundary(end) {
        end -= 1;
    }
    &text[..end]
}
