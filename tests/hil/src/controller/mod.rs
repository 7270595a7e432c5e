//! A simulated Universal Robots controller.
//!
//! Layers, in reading order: [`Robot`] is the robot in memory, one control step per call; [`World`] adds the test
//! oracle ([`Judge`]), the wire record and the faults; [`Server`] puts it behind sockets. [`main_with_args`] is the
//! program.
//!
//! The controller's side of the wire formats shares no code with the daemon's client, so that an error in one of them
//! shows as a disagreement. Only the table of RTDE variables is shared.

mod cli;
mod command;
mod connection;
mod contact;
mod dashboard;
mod devices;
mod force;
#[cfg(test)]
mod fuzz;
mod host;
mod hosted;
mod judge;
mod link_faults;
mod measure;
mod memory;
mod message;
mod primary;
mod program;
mod programs;
mod questions;
mod record;
mod registers;
mod remote_calls;
mod report;
mod robot;
mod rtde_session;
mod safety;
mod server;
mod sockets;
mod state;
mod variables;
mod watchdog;
mod world;

pub use cli::{Args, main_with_args};
pub use command::{Command, Port, WireAction};
pub use contact::ContactPlane;
pub use hosted::{Hosted, HostedError};
pub use judge::{Episode, Judge, Limits, Rule, StepSample, Summary, Violation};
pub use link_faults::{RtdeFaults, WireFaults};
pub use message::{Message, MessageKind, Outbox};
pub use programs::Upload;
pub use record::{Entry, RecordError, Recorder, judge as judge_record, read as read_record};
pub use registers::{Registers, Signals};
pub use report::{Report, ReportFault};
pub use robot::{PROGRAM_STOP_DECEL, Payload, Robot, Setup};
pub use rtde_session::{ClientId, InputPackage, Ownership, RtdeSession};
pub use server::{ListenError, Server, now_ns};
pub use state::{RobotMode, RuntimeState, SafetyMode};
pub use world::World;
