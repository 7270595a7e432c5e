//! What the two views determine about each other before any reconstruction (section 4.2): which points correspond, in
//! which order the images were given, and the error of the rig file.
//!
//! [`spots`] matches distinctive patches ([`epipolar::Match`]). [`rig_error`] estimates the error of the rig from
//! them, under the prior of [`rig_prior`], and carries its uncertainty. [`tangency`] is the paper's test on two
//! conics. This folder does not know rims or bars.

pub mod epipolar;
mod patches;
pub(in crate::offline) mod refine;
pub mod rig_error;
mod rig_fit;
pub mod rig_prior;
pub mod spots;
pub mod tangency;
