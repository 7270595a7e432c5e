//! A URScript interpreter for programs uploaded to ports 30001 to 30003.
//!
//! [`Machine::load`] compiles a program; syntax errors and unknown names are refused with their line, as at upload.
//! [`Machine::step`] runs one control step: every thread continues until it has used its controller time. Everything
//! outside the program (registers, joints, outputs, sockets) is accessed through [`Host`]. The interpreter starts no
//! operating-system threads and reads no clock.
//!
//! How to host it:
//! - pass the bytes of each script connection to a [`Collector`]; it returns complete programs and `stop program`
//!   lines;
//! - a [`ProgramKind::Main`] or [`ProgramKind::Bare`] machine replaces the running one (call [`Machine::stop`] on that
//!   first); a [`ProgramKind::Secondary`] one runs in parallel for one step;
//! - in each control step: update the plant and the registers, call [`Machine::step`] unless the program is paused,
//!   then advance the plant with the motion last passed to [`Host::motion_start`]. A motion is polled from the step
//!   after its start, so the shortest call takes one step;
//! - any outcome except `Running`, a watchdog stop and a safety stop end the program: the host removes the watchdogs
//!   and brings the arm to rest;
//! - query functions of the controller that no motion program needs (`is_within_safety_limits`, `tool_contact`,
//!   `get_actual_joint_positions_history`, ...) are passed to [`Host::call`] with their arguments bound;
//! - [`Machine::interpret`] answers the lines of the interpreter port.
//!
//! Sources: UR's script manual, and UR's and SDU's published scripts. Where documents are silent the stricter reading
//! is implemented, so that a script that runs here is likely to run on a robot.

mod arithmetic;
mod ast;
mod builtins;
mod collector;
mod compile;
mod error;
mod execute;
mod expression;
mod functions;
mod host;
mod interpreter;
mod lexer;
mod machine;
mod methods;
mod parser;
mod pure;
mod queue;
mod rpc;
mod sockets;
mod thread;
mod value;
mod wait;

pub use collector::{Collector, Upload};
pub use error::{HostError, RuntimeError, ScriptError};
pub use functions::{accepted_without_effect, refused};
pub use host::{
    Bank, Connect, ForceMode, Host, JOINTS, JointVector, KinematicsQuery, Motion, MotionStatus, OutputKind, Popup,
    PoseVector, Received, Remote, RobotView, StepOutcome, Target, WatchdogAction,
};
pub use interpreter::no_program;
pub use machine::{MAX_CALL_DEPTH, MAX_INSTRUCTIONS, MAX_THREADS, Machine, ProgramKind};
pub use value::Value;
