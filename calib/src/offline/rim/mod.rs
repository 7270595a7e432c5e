//! From edge points in two views to a circle or ellipse in space: section 4 of the paper in closed form, then at
//! maximum likelihood.
//!
//! [`cone`] is section 4.1, [`pencil`] 4.2, [`plane`] 4.3.1 and 4.3.2, [`circle`] 4.3.3. [`planar`] runs them, [`ml`]
//! refines, [`choice`] chooses between circle and ellipse. [`model`] has the result types, [`refusal`] the reasons why
//! there is no result.

pub mod choice;
pub mod circle;
pub mod cone;
pub mod ml;
pub mod model;
pub mod pencil;
pub mod planar;
pub mod plane;
pub mod refusal;
pub mod synthetic;
