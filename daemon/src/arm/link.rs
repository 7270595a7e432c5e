//! The contract between the command thread and an arm.

use std::fmt;

use graspd_rt::arm::{ArmCommand, RobotState};
use graspd_rt::rtde::{ClientError, ClockStep, FrameError};

/// Why a link is of no use any more. Latched: a link that failed once never moves an arm again; a new one is made on an
/// ordinary thread, and it starts unarmed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum LinkFault {
    /// The controller closed the connection.
    Closed,
    /// The operating system reports this error number on the socket.
    Io(i32),
    /// The byte stream is not RTDE.
    Framing(FrameError),
    /// A package that this session cannot have.
    Protocol(ClientError),
    /// The controller's clock went back: it restarted.
    ClockBack,
    /// The controller does not take our packages: the send buffer was full for this long, ns.
    SendBlocked(u64),
}

impl fmt::Display for LinkFault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            LinkFault::Closed => f.write_str("the controller closed the RTDE connection"),
            LinkFault::Io(code) => {
                write!(f, "the RTDE connection failed: {}", std::io::Error::from_raw_os_error(*code))
            }
            LinkFault::Framing(e) => write!(f, "the RTDE stream lost its framing: {e}"),
            LinkFault::Protocol(e) => write!(f, "the controller broke the RTDE protocol: {e}"),
            LinkFault::ClockBack => f.write_str("the controller's clock went back: it was restarted"),
            LinkFault::SendBlocked(ns) => write!(f, "the controller took no command for {} ms", ns / 1_000_000),
        }
    }
}

impl std::error::Error for LinkFault {}

/// What came from the arm since the last poll.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LinkPoll {
    /// The newest state, if any came.
    pub state: Option<RobotState>,
    /// How many packages came; all but the newest are superseded.
    pub packages: u32,
    /// How many the controller left out in between, by its own clock.
    pub missing: u32,
    /// How its clock stepped to the newest one.
    pub clock: Option<ClockStep>,
    /// Why the link has ended. A state that came before the end is still given.
    pub fault: Option<LinkFault>,
}

/// Counters of a link since it was made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LinkStats {
    /// State packages received.
    pub received: u64,
    /// State packages that the controller left out.
    pub missing: u64,
    /// Commands sent whole.
    pub sent: u64,
    /// Commands dropped because the send buffer was full.
    pub dropped: u64,
}

/// An arm, as the command thread sees it.
///
/// Every method returns at once, allocates nothing and takes no lock. Time is CLOCK_MONOTONIC in nanoseconds, given by the caller.
pub trait ArmLink: Send {
    /// Takes everything that has come.
    fn poll(&mut self, now_ns: u64) -> LinkPoll;

    /// Sends one command. A full send buffer drops and counts it; only after 20 ms of that it is a fault.
    fn send(&mut self, command: &ArmCommand) -> Result<(), LinkFault>;

    /// The session token that the control script must echo in [`RobotState::script_token`].
    fn token(&self) -> i32;

    /// State packages a second that the link asked for.
    fn rate_hz(&self) -> f64;

    /// Counters.
    fn stats(&self) -> LinkStats;

    /// Why it has ended, if it has.
    fn fault(&self) -> Option<LinkFault>;

    /// Waits for the robot's next package, at most until `deadline_ns`; true when something came. With this the robot is the
    /// clock: wait for its package, compute, write, and the write lands in its next step. The one call that sleeps.
    fn wait(&mut self, deadline_ns: u64) -> bool;
}
