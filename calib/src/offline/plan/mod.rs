//! The entire off-line stage as one pure function: two images, the selections in them, a rig and a gripper in; a plan
//! or a reason out.
//!
//! `options` and `error` are its interface, [`Prepared`] holds what two images give whatever is selected, `assemble`
//! and `records` write the plan file.

mod assemble;
mod error;
mod options;
mod prepared;
mod records;

pub use assemble::Plan;
pub use error::PlanError;
pub use options::PlanOptions;
pub use prepared::{Prepared, plan};
pub use records::model_name;
pub(in crate::offline) use records::{goal_record, worst};
