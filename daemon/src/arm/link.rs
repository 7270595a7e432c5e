//! The contract between the command thread and an arm.

use std::fmt;

use graspd_rt::arm::{ArmCommand, RobotState};
use graspd_rt::rtde::{ClientError, ClockStep, FrameError};

/// Why a link has failed. Latched: a failed link never moves an arm again. A new link is made on an ordinary thread and
/// starts unarmed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum LinkFault {
    /// The controller closed the connection.
    Closed,
    /// Error number of the operating system on the socket.
    Io(i32),
    /// The byte stream is not RTDE.
    Framing(FrameError),
    /// A package that the session does not allow.
    Protocol(ClientError),
    /// The controller's clock went back: the controller restarted.
    ClockBack,
    /// The controller does not read our packages: the send buffer was full for this long, ns.
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

/// What arrived from the arm since the last poll.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LinkPoll {
    /// The newest state, if one arrived.
    pub state: Option<RobotState>,
    /// Number of packages that arrived; the newest supersedes the others.
    pub packages: u32,
    /// Number of packages that the controller left out in between, by its clock.
    pub missing: u32,
    /// The step of its clock to the newest package.
    pub clock: Option<ClockStep>,
    /// Why the link has ended. A state that arrived before is still returned.
    pub fault: Option<LinkFault>,
}

/// Counters of a link since its start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LinkStats {
    /// State packages received.
    pub received: u64,
    /// State packages that the controller left out.
    pub missing: u64,
    /// Commands sent completely.
    pub sent: u64,
    /// Commands dropped because the send buffer was full.
    pub dropped: u64,
}

/// A link to an arm, as the command thread uses it.
///
/// No method except [`ArmLink::wait`] blocks, and none allocates or takes a lock. Time is CLOCK_MONOTONIC in
/// nanoseconds, given by the caller.
pub trait ArmLink: Send {
    /// Receives everything that has arrived.
    fn poll(&mut self, now_ns: u64) -> LinkPoll;

    /// Sends one command. With a full send buffer the command is dropped and counted; after 20 ms of that the link
    /// fails.
    fn send(&mut self, command: &ArmCommand) -> Result<(), LinkFault>;

    /// The session token that the control script must echo in [`RobotState::script_token`].
    fn token(&self) -> i32;

    /// Requested rate of state packages, Hz.
    fn rate_hz(&self) -> f64;

    /// Counters.
    fn stats(&self) -> LinkStats;

    /// Why it has ended, if it has.
    fn fault(&self) -> Option<LinkFault>;

    /// Waits for the robot's next package until `deadline_ns` at the latest; true when data arrived. With the robot as
    /// the clock, a cycle waits for the package, computes and sends, and the command takes effect in the robot's next
    /// step. The only call that sleeps.
    fn wait(&mut self, deadline_ns: u64) -> bool;
}
