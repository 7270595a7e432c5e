//! The whole off-line stage as one pure function: two images, what was selected in them, a rig and a gripper in; a plan or a reason out.

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
