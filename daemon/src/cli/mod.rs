//! The command line: one file a subcommand.

mod args;
mod calibrate;
mod client;
#[cfg(feature = "demo")]
pub mod demo;
mod mesh;
mod plan;
mod reconstruct;
mod rig;
mod run;
mod study;
mod world;

pub use args::{
    Cli, ClientArgs, Command, DemoArgs, GripperArgs, PassThrough, PlanArgs, ReconstructArgs, RunArgs, SetpointArgs,
    StudyArgs,
};
pub use calibrate::{CalibrateCommand, calibrate};
pub use client::{recover, send, setpoint, stop};
pub use mesh::MeshArgs;
pub use plan::plan;
pub use reconstruct::reconstruct;
pub use rig::{RigCommand, rig};
pub use run::{check, run};
pub use study::study;
pub use world::world;
