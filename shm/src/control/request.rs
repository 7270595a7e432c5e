//! Requests to the daemon and its answers: a verb in a fixed header, and text as payload.

use iceoryx2::prelude::ZeroCopySend;

/// "GREQ" in ASCII.
pub const REQUEST_MAGIC: u32 = u32::from_le_bytes(*b"GREQ");
/// Layout version of both headers.
pub const REQUEST_VERSION: u32 = 1;
/// Longest payload of a request, bytes: a plan file.
pub const REQUEST_MAX_BYTES: usize = 128 * 1024;
/// Longest payload of an answer, bytes.
pub const ANSWER_MAX_BYTES: usize = 64 * 1024;

/// A request to the daemon.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verb {
    /// 1: report the state; changes nothing.
    Status,
    /// 2: allow motion to be started; moves nothing.
    Arm,
    /// 3: start servoing.
    Servo,
    /// 4: ramp down to rest; never refused.
    Stop,
    /// 5: clear a latched fault; moves nothing.
    Reset,
    /// 6: load a set-point; the payload is the text of a plan file.
    Setpoint,
    /// 7: bring the controller out of a protective stop; ends in mode idle.
    Recover,
    /// 8: move the gripper's fingers; the payload is `close` or `open`.
    Gripper,
}

impl Verb {
    /// The number in the header.
    pub fn number(self) -> u32 {
        match self {
            Verb::Status => 1,
            Verb::Arm => 2,
            Verb::Servo => 3,
            Verb::Stop => 4,
            Verb::Reset => 5,
            Verb::Setpoint => 6,
            Verb::Recover => 7,
            Verb::Gripper => 8,
        }
    }

    /// The verb of a number; `None` for an unknown one.
    pub fn from_number(n: u32) -> Option<Self> {
        [Verb::Status, Verb::Arm, Verb::Servo, Verb::Stop, Verb::Reset, Verb::Setpoint, Verb::Recover, Verb::Gripper]
            .into_iter()
            .find(|v| v.number() == n)
    }
}

/// User header of a request.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ZeroCopySend)]
#[type_name("GraspdRequestHeader")]
pub struct RequestHeader {
    /// [`REQUEST_MAGIC`].
    pub magic: u32,
    /// [`REQUEST_VERSION`].
    pub layout_version: u32,
    /// [`Verb::number`].
    pub verb: u32,
    /// Bytes of the payload in use; the rest is padding.
    pub length: u32,
    /// Time of the request, CLOCK_MONOTONIC nanoseconds. Verbs that may lead to motion are refused when older than 250
    /// ms.
    pub stamp_ns: u64,
}

/// User header of an answer.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ZeroCopySend)]
#[type_name("GraspdAnswerHeader")]
pub struct AnswerHeader {
    /// [`REQUEST_MAGIC`].
    pub magic: u32,
    /// [`REQUEST_VERSION`].
    pub layout_version: u32,
    /// 0 accepted, 1 refused, 2 malformed.
    pub status: u32,
    /// Bytes of the payload in use: one JSON object.
    pub length: u32,
}
