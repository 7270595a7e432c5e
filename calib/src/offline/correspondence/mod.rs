//! What the two views say about each other before anything is reconstructed (section 4.2): which places correspond,
//! in which order the views were given, and how far the rig file is off.
//!
//! [`spots`] matches distinctive patches, [`rig_error`] estimates the rig's error from them and carries what stays
//! unknown, [`tangency`] is the paper's test on two conics. Nothing here knows a rim or a bar.

pub mod epipolar;
pub(in crate::offline) mod refine;
pub mod rig_error;
mod rig_fit;
pub mod rig_prior;
pub mod spots;
pub mod tangency;
