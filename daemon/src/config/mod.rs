//! graspd.toml: serde mirrors in `raw`, checked values in `settings`; nothing downstream validates again.

mod cycle;
mod kinematics;
mod raw;
mod settings;
mod trust;

pub use cycle::cycle_config;
pub use kinematics::load_kinematics;
pub use raw::{RawArm, RawConfig, RawConverged, RawFiles, RawGripper, RawLimits, RawLoop, RawServo, RawShm, RawVision};
pub use settings::{Config, Kinematics, LinkKind, ReadFile, names};
pub use trust::{check_trust, names_of};
