//! RTDE, the real-time data exchange of Universal Robots controllers (TCP port 30004), without IO, clock or heap.
//!
//! The layers, in reading order:
//!
//! 1. [`Framer`] cuts a byte stream into [`Package`]s, however TCP split or merged it.
//! 2. [`ClientMessage`] and [`ControllerMessage`] are the messages of both directions in both protocol [`Version`]s;
//!    `parse` borrows, `emit` writes to the caller's buffer.
//! 3. [`Field`] is a variable of the protocol with name and type, a [`Recipe`] an ordered list of fields, and a
//!    [`FieldSlot`] the resolved offset of one value.
//! 4. [`Session`] is the client's half of the handshake: what to send next, and what an answer means.
//! 5. [`StateReader`] and [`CommandWriter`] read and write graspd's recipes, [`GapMeter`] counts packages that the
//!    controller left out, and [`PhaseLock`] synchronizes the command thread with the controller.
//!
//! All numbers are big-endian. A server uses the same parts as a client:
//!
//! ```
//! use graspd_rt::rtde::*;
//! let mut bytes = [0u8; 64];
//! let n = ClientMessage::RequestVersion(2).emit(Version::V1, &mut bytes).unwrap();
//! assert_eq!(bytes[..n], [0, 5, b'V', 0, 2]);
//!
//! // The controller reads it and answers.
//! let mut framer = Framer::new([0u8; 4096]);
//! framer.feed(&bytes[..n]);
//! let package = framer.next().unwrap().unwrap();
//! assert_eq!(ClientMessage::parse(Version::V1, package), Ok(ClientMessage::RequestVersion(2)));
//! let n = ControllerMessage::VersionAccepted(true).emit(Version::V1, &mut bytes).unwrap();
//! assert_eq!(bytes[..n], [0, 4, b'V', 1]);
//! ```

mod client;
mod fields;
mod frame;
mod message;
mod phase;
mod recipe;
mod robot;
mod value;

pub use client::{ClientError, Event, MAX_FIELDS, MAX_INPUT_RECIPES, MAX_NAME_LIST, Phase, Session, SessionRecipe};
pub use fields::{Field, INPUT_COUNT, OUTPUT_COUNT, Side};
pub use frame::{FrameError, Framer, HEADER, MAX_PACKAGE, Package};
pub use message::{
    ClientMessage, ControllerMessage, ControllerVersion, Kind, Level, MessageError, NoRoom, Text, Version,
};
pub use phase::PhaseLock;
pub use recipe::{Answer, Entry, FieldSlot, Recipe, RecipeError, answers, join, names};
pub use robot::{
    COMMAND_FIELDS, ClockStep, CommandWriter, GapMeter, NEEDED_FIELDS, SCRIPT_VERSION, STATE_FIELDS, StateReader,
    script_state,
};
pub use value::{FieldType, Value, Wire};
