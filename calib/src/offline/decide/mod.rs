//! Which model of which contours is accepted.
//!
//! [`likelihood`] is the one likelihood (edge noise, smooth edge error, rig error). [`models`] and [`bars`] weigh in
//! it what two or four contours may be, [`average`] joins models that lead to the same grasp, [`result`] reports the
//! accepted one. [`pairing`] decides for two selections ([`judged`] weighs a pair, [`bar_or_plane`] decides between
//! plane rim and bar), [`propose`] works without a selection. [`reconstruct`] decides for edge points alone, without
//! images.

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
