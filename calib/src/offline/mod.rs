//! The off-line stage: one folder per step of the paper, in the order of the data flow. A folder uses only those above
//! it; a test over the `use` lines checks this.
//!
//! 1. [`types`]: value types that several steps share.
//! 2. [`edges`]: from an image to sub-pixel edge points, and from raw to ideal pixels.
//! 3. [`contour`]: from a click to the edge points of one contour.
//! 4. [`conic`]: from those points to an ellipse with its covariance.
//! 5. [`correspondence`]: which points of the two views correspond (section 4.2, equation 4), and the error of the rig
//!    file.
//! 6. [`rim`]: from two ellipses to a circle or ellipse in space (section 4), refined, with its covariance. [`bar`] is
//!    the same for a round bar.
//! 7. [`decide`]: which model of which contours is accepted, by one likelihood.
//! 8. [`handle`]: from the rim to a grasp (section 3.2) and its set-point. [`polyhedral`]: from a CAD mesh to a grasp
//!    (section 3.1).
//! 9. [`plan`]: all steps as one pure function. [`drawing`]: overlays and reports.

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
