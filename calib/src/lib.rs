//! Everything that graspd computes before the arm moves.
//!
//! # Map
//! - [`files`]: `rig.toml`, `gripper.toml`, `plan.toml`, pose and pick files. They are parsed into checked values;
//!   nothing downstream validates again. Every key is described in `docs/FILES.md`.
//! - [`offline`]: the off-line stage, in the order of the paper. Two images of a rim become edges, contours, image
//!   ellipses, cones, a rim in space, a grasp and a set-point (`offline::plan`). A part with a CAD model takes
//!   `offline::polyhedral` (section 3.1) to the same set-point.
//! - [`calibrate`]: the calibration of a rig from images of a target, and of a gripper from an arm at rest.
//! - [`commands`]: the sub-commands `plan`, `plan --mesh`, `reconstruct`, `study`, `calibrate` and `rig` without their
//!   command line.
//!
//! Dependencies point one way: `commands` uses `offline` and `calibrate`, these use `files`, and `files` uses only value types of
//! `graspd_rt`.
//!
//! # Conventions
//! Lengths are metres and angles radians unless a name has a unit suffix (`_px`, `_mm`, `_deg`). A pose `a_from_b` maps
//! coordinates of frame b to frame a. Plans are given in the left camera's frame. The image origin is the centre of the
//! top-left pixel.
//!
//! # Example
//! A plan on the front wheel of the motorcycle pair, from one click in each view. `calib/examples/plan.rs` is the same
//! program with all its outputs.
//! ```
//! use graspd_calib::files::{GripperFile, RigFile};
//! use graspd_calib::offline::contour::select::Selection;
//! use graspd_calib::offline::edges::grey_image::GreyImage;
//! use graspd_calib::offline::plan::{PlanOptions, plan};
//! use graspd_rt::geom::Pixel;
//! use std::path::Path;
//!
//! let input = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/motorcycle");
//! let rig = RigFile::load(&input.join("rig.toml"))?;
//! let gripper = GripperFile::load(&input.join("gripper.toml"))?;
//! let left = GreyImage::load(&input.join("left.png"))?;
//! let right = GreyImage::load(&input.join("right.png"))?;
//!
//! let clicks = [Pixel::new(619.9, 435.0), Pixel::new(570.2, 435.0)].map(Selection::Click);
//! let plan = plan([&left, &right], [&clicks[0], &clicks[1]], &rig, &gripper, &PlanOptions::default())?;
//!
//! assert_eq!(plan.file.object.model, "circle");
//! assert!(plan.file.object.sigma_normal_deg < 2.0);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
#![forbid(unsafe_code)]

pub mod calibrate;
pub mod commands;
pub mod files;
pub mod offline;
