//! Links to an arm: the [`ArmLink`] trait, its implementation for a UR controller over TCP, and one for an arm in the
//! process.
//!
//! The command thread uses [`ArmLink`] only: poll for robot state, send a command; neither blocks nor allocates. Calls
//! that may block run on ordinary threads: [`UrLink::connect`], [`start_script`], [`recover`], [`read_identity`].

mod backoff;
mod dashboard;
mod link;
mod messages;
mod mock_link;
mod primary;
mod recover;
mod script;
mod status;
mod ur;
mod ur_config;

pub use backoff::backoff_delay;
pub use dashboard::Dashboard;
pub use link::{ArmLink, LinkFault, LinkPoll, LinkStats};
pub use messages::{MessageKind, MessageListener, RobotMessage, parse_message};
pub use mock_link::{MockLimits, MockLink};
pub use primary::{
    Identity, MAX_FLANGE_DISTANCE_M, SubPackages, check_kinematics, check_model, flange_distance, parse_identity,
    read_identity,
};
pub use recover::{RecoverStep, RecoverTimes, recover, walk_out};
pub use script::{render, start_script, stop_script};
pub use status::{SAFETY_STOPPED_BITS, robot_mode_text, safety_bits_text, safety_mode_text};
pub use ur::UrLink;
pub use ur_config::{ArmError, Motion, Port, UrConfig, fresh_token};
