//! Which contour of the left view and which of the right are pictures of one rim, and whether the pictures themselves are in order.

pub mod correspondence;
pub mod order;
pub mod pairing;
pub mod propose;
