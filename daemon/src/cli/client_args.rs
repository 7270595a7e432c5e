//! The arguments of every command that talks to a running daemon.

use clap::Args;
use std::path::PathBuf;

/// Verbs sent to a running daemon.
#[derive(Debug, Args)]
pub struct ClientArgs {
    /// The daemon's configuration file: gives cell and shared-memory root
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Cell name, without a configuration file
    #[arg(long, default_value = "cell")]
    pub cell: String,
    /// Shared-memory root folder, without a configuration file
    #[arg(long, value_name = "DIR")]
    pub shm_root: Option<PathBuf>,
    /// Print one JSON object instead of text
    #[arg(long)]
    pub json: bool,
    /// Timeout of the daemon's answer, seconds
    #[arg(long, default_value_t = 2.0)]
    pub timeout: f64,
}
