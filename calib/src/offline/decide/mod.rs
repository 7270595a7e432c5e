//! Which model of which contours is accepted.
//!
//! [`likelihood`] is the one likelihood (edge noise, smooth edge error, rig error). [`models`] and [`bars`] weigh in
//! it what two or four contours may be, [`average`] joins models that lead to one grasp, [`result`] reports the
//! winner; [`pairing`] decides for two selections, [`propose`] does without a selection.

pub(in crate::offline) mod average;
mod bar_or_plane;
pub(in crate::offline) mod bars;
mod judged;
pub(in crate::offline) mod likelihood;
pub(in crate::offline) mod models;
pub mod pairing;
pub mod propose;
pub mod reconstruct;
pub(in crate::offline) mod result;
