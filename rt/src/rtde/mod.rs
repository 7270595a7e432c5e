//! RTDE, the real-time data exchange of Universal Robots controllers (TCP port 30004), without IO, clock or heap.
//!
//! The layers, in the order a reader should learn them:
//!
//! 1. [`Framer`] cuts a byte stream into [`Package`]s, however it was split or merged on the way.
//! 2. [`ClientMessage`] and [`ControllerMessage`] are the meanings of packages in both directions and both protocol
//!    [`Version`]s; `parse` borrows, `emit` writes into a caller's buffer.
//! 3. [`Field`] knows every variable of the protocol by name and type; a [`Recipe`] is an ordered choice of them, and a
//!    [`FieldSlot`] the resolved place of one value.
//! 4. [`Session`] is the client's half of the conversation: what to send next, and what an answer means.
//! 5. [`StateReader`] and [`CommandWriter`] are graspd's own recipes; [`GapMeter`] counts what the controller left out,
//!    and [`PhaseLock`] lets a cycle follow the controller's.
//!
//! All numbers are big-endian. A server is written with the same pieces as a client:
//!
//! ```
//! use graspd_rt::rtde::*;
//! let mut bytes = [0u8; 64];
//! let n = ClientMessage::RequestVersion(2).emit(Version::V1, &mut bytes).unwrap();
//! assert_eq!(bytes[..n], [0, 5, b'V', 0, 2]);
//!
//! // The controller's half reads it and answers.
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
