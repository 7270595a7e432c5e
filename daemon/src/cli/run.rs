//! `graspd run` and `graspd check`.

use super::args::RunArgs;
use crate::config::{Config, Kinematics};
use crate::exit::{Exit, Failure};
use crate::log;
use crate::realtime::ignore_background_writes;
use crate::wiring;

/// `graspd run`: the daemon.
///
/// # Errors
/// A wrong configuration, a failed link, or a bug of graspd.
pub fn run(args: &RunArgs) -> Result<Exit, Failure> {
    let config = Config::load(&args.config)?;
    log::log_panics();
    ignore_background_writes();
    wiring::run(&config, &args.config)
}

/// `graspd check`: reads the configuration and every file it names; changes nothing.
///
/// # Errors
/// The first wrong value, with its file and key.
pub fn check(args: &RunArgs) -> Result<Exit, Failure> {
    let config = Config::load(&args.config)?;
    println!("{}: valid", args.config.display());
    println!("  cell      {}", config.names.cell());
    println!("  rig       {} ({}x{})", config.rig.hash(), config.rig.rig.left.width, config.rig.rig.left.height);
    println!("  gripper   {} ({} marks)", config.gripper.hash(), config.gripper.gripper.marks.len());
    println!("  arm       {} at {}", config.arm.model.name(), config.arm.address);
    println!(
        "  dh table  {}",
        match &config.arm.kinematics {
            Kinematics::Controller => "the controller's own".to_owned(),
            Kinematics::Nominal => format!("nominal {}", config.arm.model.name()),
            Kinematics::File(path, _) => path.display().to_string(),
        }
    );
    let s = config.stop;
    println!(
        "  stop      from full speed: {:.0} ms, {:.1} degrees a joint, {:.1} mm of the gripper, after the arm's own reaction time",
        s.time_s * 1e3,
        s.joint_rad.to_degrees(),
        s.tcp_m * 1e3
    );
    Ok(Exit::Done)
}
