//! The arm's side of the daemon: one trait, a UR controller behind it over TCP, and a mock arm in the process.
//!
//! [`ArmLink`] is all that the command thread sees: poll for robot state, send a command; neither blocks nor allocates. What
//! may block happens on ordinary threads: [`UrLink::connect`], [`start_script`], [`recover`], [`read_identity`].

mod backoff;
mod dashboard;
mod link;
mod messages;
mod mock_link;
mod primary;
mod recover;
mod script;
mod ur;
mod ur_config;

pub use backoff::backoff_delay;
pub use dashboard::Dashboard;
pub use link::{ArmLink, LinkFault, LinkPoll, LinkStats};
pub use messages::{Ear, Said, SaidKind, parse_message, robot_mode, safety_mode, safety_words};
pub use mock_link::{MockArm, MockLimits};
pub use primary::{
    Identity, SAME_ARM, SubPackages, check_kinematics, check_model, flanges_apart, parse_identity, read_identity,
};
pub use recover::{RecoverStep, RecoverTimes, recover, walk_out};
pub use script::{render, start_script, stop_script};
pub use ur::UrLink;
pub use ur_config::{ArmError, Motion, Port, UrConfig, fresh_token};
