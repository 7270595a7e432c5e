//! Parts with a CAD model (paper section 3.1): every box handle that parallel claws could take, and which of them can be taken here.
//!
//! [`read`] reads STL and OBJ into a [`Mesh`], and [`topology`] mends its windings. [`faces`] finds its flat faces, [`handles`] enumerates the pairs that two claws can oppose with every way of coming in,
//! and [`filter`] drops those that this gripper, from here, cannot take, each with its reason. [`pose`] places the mesh from picked points.

pub mod bvh;
pub mod faces;
pub mod filter;
pub mod handles;
mod links;
mod mesh;
mod obj;
pub mod overlay;
mod place;
pub mod plan;
pub mod pose;
mod raster;
pub mod reach;
pub mod read;
pub mod report;
mod smooth;
mod stl;
pub mod topology;

pub use mesh::Mesh;
