//! What a blocked thread waits for, and whether a call has a value yet.

use super::value::Value;

/// What a thread waits for.
#[derive(Clone, Debug)]
pub(crate) enum Wait {
    /// Number of control steps left.
    Steps(u32),
    Motion,
    Popup,
    Thread(u32),
    Socket(SocketWait),
    /// The next statement of interpreter mode.
    Interpreter,
    /// Number of a remote procedure call.
    Remote(u32),
}

/// Result of a call so far: its value, or what it waits for.
#[derive(Clone, Debug)]
pub(crate) enum Flow {
    Value(Value),
    Wait(Wait),
}

/// A blocking socket call.
#[derive(Clone, Debug)]
pub(crate) enum SocketWait {
    Connect { name: String, address: String, port: u16, steps: u32 },
    Read { name: String, what: Read, steps: Option<u32> },
}

/// What a read returns.
#[derive(Clone, Debug)]
pub(crate) enum Read {
    Integers(usize),
    Bytes(usize),
    Floats(usize),
    Line,
    /// All received bytes, or the text between a prefix and a suffix.
    Any {
        prefix: String,
        suffix: String,
    },
    /// The number in a line `name number`.
    Variable(String),
}
