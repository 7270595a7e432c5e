//! The command line: one file a subcommand.

mod answer;
mod args;
mod bench_track;
mod calibrate;
mod calibrate_gripper;
mod client;
mod client_args;
#[cfg(feature = "demo")]
pub mod demo;
mod mesh;
mod mesh_args;
mod plan;
mod reconstruct;
mod rig;
mod run;
mod sequence;
mod simulator;
mod study;

pub use args::{
    BenchArgs, BenchCommand, BenchTrackArgs, Cli, Command, DemoArgs, GripperArgs, PassThrough, PlanArgs,
    ReconstructArgs, RunArgs, SetpointArgs, StudyArgs,
};
pub use bench_track::bench_track;
pub use calibrate::{CalibrateCommand, calibrate};
pub use client::{recover, send, setpoint, stop};
pub use client_args::ClientArgs;
pub use mesh_args::MeshArgs;
pub use plan::plan;
pub use reconstruct::reconstruct;
pub use rig::{RigCommand, rig};
pub use run::{check, run};
pub use simulator::simulator;
pub use study::study;
