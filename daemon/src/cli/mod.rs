//! The command line: one file a subcommand.

mod args;

pub use args::{Cli, Command};
