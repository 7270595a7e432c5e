//! The off-line stage, one folder per step of the paper, in the order in which a click passes through them:
//!
//! 1. [`edges`]: from an image to sub-pixel edge points, and from the lens to ideal pixels.
//! 2. [`contour`]: from a click to the edge points of one contour.
//! 3. [`conic`]: from those points to an ellipse with its covariance.
//! 4. [`correspondence`]: which places of the two views belong together (section 4.2, equation 4), and how far the rig file is off.
//! 5. [`rim`]: from two ellipses to a circle or ellipse in space (section 4), refined, with its covariance; [`bar`]: the same for a round bar.
//! 6. [`decide`]: which model of which contours is accepted, by one likelihood.
//! 7. [`handle`]: from the rim to a grasp (section 3.2) and its set-point; [`polyhedral`]: from a CAD mesh to a grasp (section 3.1).
//! 8. [`plan`]: all of it as one pure function; [`drawing`]: what people look at.

pub mod bar;
pub mod conic;
pub mod contour;
pub mod correspondence;
pub mod decide;
pub mod drawing;
pub mod edges;
pub mod handle;
pub mod plan;
pub mod polyhedral;
pub mod rim;
pub(crate) mod statistics;
pub mod types;
