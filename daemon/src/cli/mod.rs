//! The command line: one file a subcommand.

mod args;
mod client;
#[cfg(feature = "demo")]
pub mod demo;
mod mesh;
mod mesh_args;
mod plan;
mod reconstruct;
mod run;
mod simulator;
mod study;

pub use args::{
    Cli, ClientArgs, Command, DemoArgs, GripperArgs, PassThrough, PlanArgs, ReconstructArgs, RunArgs, SetpointArgs,
    StudyArgs,
};
pub use client::{recover, send, setpoint, stop};
pub use mesh_args::MeshArgs;
pub use plan::plan;
pub use reconstruct::reconstruct;
pub use run::{check, run};
pub use simulator::simulator;
pub use study::study;
