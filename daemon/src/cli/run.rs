//! `graspd run` and `graspd check`.

use super::args::RunArgs;
use crate::config::Config;
use crate::exit::{Exit, Failure};
use crate::log;
use crate::realtime::ignore_background_writes;
use crate::wiring;

/// `graspd run`: the daemon.
///
/// # Errors
/// Configuration, links, or a fault of our own.
pub fn run(args: &RunArgs) -> Result<Exit, Failure> {
    let config = Config::load(&args.config)?;
    log::take_panics();
    ignore_background_writes();
    wiring::run(&config, &args.config)
}

/// `graspd check`: reads the configuration and every file it names, and touches nothing.
///
/// # Errors
/// What is wrong, by file and key.
pub fn check(args: &RunArgs) -> Result<Exit, Failure> {
    let config = Config::load(&args.config)?;
    println!("{}: good", args.config.display());
    println!("  cell      {}", config.names.cell());
    println!("  rig       {} ({}x{})", config.rig.hash(), config.rig.rig.left.width, config.rig.rig.left.height);
    println!("  gripper   {} ({} marks)", config.gripper.hash(), config.gripper.gripper.marks.len());
    println!("  arm       {} at {}", config.raw.arm.model, config.raw.arm.address);
    Ok(Exit::Done)
}
