//! graspd.toml, from text to valid values.
//!
//! [`Config::load`] reads the file and every file it names, checks them and converts them once; no other module
//! validates a value or compares a configuration string.
//!
//! | file | holds |
//! |---|---|
//! | `raw` | the file as serde reads it: keys and defaults |
//! | `renamed` | old names of keys |
//! | `ranges` | the range of every number |
//! | `limits` | the motion limits, built as the command cycle builds them |
//! | `settings` | [`Config`], the checked values |
//! | `load` | `raw` to `settings` |
//! | `cycle`, `ur` | `settings` to the configuration of the command cycle and of the controller link |

mod cycle;
mod kinematics;
mod limits;
mod load;
mod names;
mod ranges;
mod raw;
mod renamed;
mod settings;
mod trust;
mod ur;

pub use cycle::cycle_config;
pub use kinematics::load_kinematics;
pub use limits::limit_failure;
pub use names::{names, names_of};
pub use settings::{ArmSettings, Clock, Config, FrameSettings, Kinematics, LinkKind, LoopSettings, ReadFile};
pub use trust::check_trust;
pub use ur::ur_config;
