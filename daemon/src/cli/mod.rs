//! The command line: one file a subcommand.

mod args;
mod client;
#[cfg(feature = "demo")]
mod demo;

pub use args::{
    Cli, ClientArgs, Command, DemoArgs, PassThrough, PlanArgs, ReconstructArgs, RunArgs, SetpointArgs, StudyArgs,
};
pub use client::{send, setpoint};
