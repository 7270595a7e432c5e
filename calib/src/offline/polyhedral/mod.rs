//! Parts with a CAD model (paper section 3.1): all box handles that parallel claws can take, and which of them are
//! possible in the present situation.
//!
//! [`read`] reads STL and OBJ files into a [`Mesh`], and [`topology`] orients its triangles. [`faces`] finds the flat
//! faces. [`handles`] enumerates the pairs of opposed faces and their approach directions. [`filter`] drops the handles
//! that this gripper cannot take here, each with its [`constraints::Rejection`]. [`pose`] fits the pose of the mesh to
//! picked points, and [`plan`] makes the plan.

pub mod bvh;
pub mod constraints;
pub mod faces;
pub mod filter;
pub mod handles;
mod links;
mod mesh;
mod obj;
pub mod overlay;
mod placement;
pub mod plan;
pub mod pose;
mod problem;
mod raster;
pub mod reach;
pub mod read;
pub mod report;
mod smooth;
mod stl;
pub mod topology;

pub use mesh::Mesh;
