//! A small URScript interpreter: what a controller does with a text that was uploaded to ports 30001 to 30003.
//!
//! [`Machine::load`] reads a program (unknown syntax is refused with its line, as at upload), [`Machine::step`] runs
//! one control step of it: every thread goes on until it has used its controller time. All that a program can see or
//! move outside itself goes through [`Host`]: registers, joints, outputs, sockets. The interpreter starts no
//! operating-system threads and reads no clock.
//!
//! How to host it:
//! - feed each script connection's bytes to a [`Collector`]; it gives whole programs and the `stop program` line;
//! - a [`ProgramKind::Main`] or [`ProgramKind::Bare`] machine replaces the running one (call [`Machine::stop`] on that first), a
//!   [`ProgramKind::Secondary`] one is stepped once beside it;
//! - in each control step: update the plant and the registers, call [`Machine::step`] unless the program is paused, then move the
//!   plant by the motion last given to [`Host::motion_start`]. A motion is polled from the step after its start, so the shortest
//!   call takes one step;
//! - at any outcome but `Running`, at a watchdog's stop and at a safety stop the program is over: watchdogs go away and the host
//!   brings the arm to rest;
//! - functions that ask the controller for something that no motion program needs (`is_within_safety_limits`, `tool_contact`,
//!   `get_actual_joint_positions_history`, ...) arrive at [`Host::call`] with their arguments bound, and so does whatever name the
//!   interpreter does not know.
//!
//! Rules of the language come from UR's script manual and the behaviour of UR's and SDU's published scripts. Where a
//! robot's behaviour is not documented, the stricter reading is taken, so that a script which runs here has a better
//! chance there.

mod arithmetic;
mod ast;
mod builtins;
mod collector;
mod compile;
mod error;
mod execute;
mod expression;
mod host;
mod lexer;
mod machine;
mod parser;
mod pure;
mod signature;
mod sockets;
mod thread;
mod value;
mod wait;

pub use collector::{Collector, Upload};
pub use error::{HostError, RuntimeError, ScriptError};
pub use host::{
    Bank, Connect, Host, JOINTS, JointVector, KinematicsQuery, Motion, MotionStatus, OutputKind, Popup, PoseVector,
    Received, RobotView, StepOutcome, Target, WatchdogAction,
};
pub use machine::{MAX_CALL_DEPTH, MAX_INSTRUCTIONS, MAX_THREADS, Machine, ProgramKind};
pub use value::Value;
