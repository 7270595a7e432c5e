//! The allocation-free core of graspd: geometry, tracking, control law, limits, RTDE codec.
//!
//! Nothing here reads a clock, opens a file or a socket, starts a thread or uses a heap: the crate is `no_std` without
//! `alloc`, so an allocation is a compile error. Time is an argument in integer nanoseconds (CLOCK_MONOTONIC), inputs
//! are values, and the same inputs give the same outputs to the bit.
//!
//! # Map, in reading order
//!
//! | module | content |
//! |---|---|
//! | [`geom`] | poses `a_from_b`, velocity screws, cameras, the stereo rig and its error |
//! | [`gripper`], [`setpoint`] | the marks, and the pixels where they have to be |
//! | [`image`] | the borrowed image, and conversion to it |
//! | [`online`] | vision thread: stereo pair to marks and pose ([`online::VisionCycle`]); parts of the law |
//! | [`arm`] | kinematics, Jacobian, robot state and command |
//! | [`mode`] | the state machine; faults, holds and refusals |
//! | [`guard`] | the limits, and the last stage before the wire |
//! | [`cycle`] | command thread: robot state and vision result to a set-point ([`cycle::CommandCycle`]) |
//! | [`rtde`] | the protocol of Universal Robots controllers, as bytes |
//!
//! # Where is ...
//!
//! - **the sign of the interaction matrix?** [`online::interaction`], and only there. It is plus: the gripper moves,
//!   the cameras are fixed.
//! - **the control law?** [`online::screw`] solves the stacked marks for the correction, [`online::rates`] turns a
//!   screw into joint rates, `cycle/servo.rs` combines the two with the gain and the feed-forward of [`online::path`].
//! - **equation (4) of the paper,** Δ, and all others of the off-line stage? In `graspd-calib`; docs/PAPER.md lists
//!   each equation with its function.
//! - **the function that commands motion?** [`cycle::CommandCycle::step`]. Its rates come out of [`guard::Guard`], and
//!   [`mode::step`] alone decides whether it may drive.
//! - **the meaning of a fault code?** [`mode::FaultCause`] and [`mode::HoldCause`].
//! - **a new robot model?** [`arm::Model`]: one entry in each of its tables.
//!
//! # Examples
//!
//! `examples/servo_in_memory.rs` closes the loop around a simulated arm on a virtual clock. Reading a robot's state
//! from RTDE bytes:
//!
//! ```
//! use graspd_rt::rtde::{ControllerMessage, Framer, Recipe, STATE_FIELDS, Side, StateReader, Version};
//!
//! // The session asks for these variables; the reader resolves their offsets once.
//! let recipe = Recipe::<32>::resolve(Side::Output, &STATE_FIELDS)?;
//! let reader = StateReader::new(&recipe).expect("all required variables");
//!
//! // What a controller would send: a data package of recipe 1 with joint 0 at 0.5 rad.
//! let mut values = [0u8; 1024];
//! let values = &mut values[..recipe.size()];
//! recipe.slot("actual_q").unwrap().write(values, [0.5, -1.6, 1.9, -1.87, -1.57, 0.0]);
//! let mut bytes = [0u8; 1100];
//! let n = ControllerMessage::Data { recipe: Some(1), values }.emit(Version::V2, &mut bytes)?;
//!
//! // What graspd does with the bytes, however TCP split them.
//! let mut framer = Framer::new([0u8; 4096]);
//! for part in bytes[..n].chunks(100) {
//!     framer.feed(part);
//! }
//! let package = framer.next()?.expect("a complete package");
//! let ControllerMessage::Data { values, .. } = ControllerMessage::parse(Version::V2, package)? else { panic!() };
//! let received_ns = 12_345;
//! let state = reader.read(values, received_ns).expect("all values");
//! assert_eq!((state.q[0], state.received_ns), (0.5, 12_345));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
#![no_std]
#![forbid(unsafe_code)]

pub mod arm;
pub mod cycle;
pub mod geom;
pub mod gripper;
pub mod guard;
pub mod image;
pub mod math;
pub mod mode;
pub mod online;
pub mod rtde;
pub mod setpoint;
