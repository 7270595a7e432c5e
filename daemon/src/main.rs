//! The graspd program: parses the command line, runs one subcommand, exits with its code.

use clap::Parser;
use graspd::cli::{self, Cli, Command};
use graspd::exit::{Exit, Failure};
use graspd::log;
use graspd_shm::control::Verb;
use std::process::ExitCode;
use std::time::Duration;

/// Maximum time that the exit waits for a blocked log.
const LOG_FLUSH_TIMEOUT: Duration = Duration::from_millis(300);

/// So that `graspd bench` can say how often a stage asked for memory.
#[global_allocator]
static HEAP: graspd::heap::Counting = graspd::heap::Counting;

fn main() -> ExitCode {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(e) => {
            // Help and version are not errors; clap selects the stream.
            let code = if e.use_stderr() { Exit::Usage.code() } else { 0 };
            let _ = e.print();
            return ExitCode::from(code);
        }
    };
    match run(cli.command) {
        Ok(exit) => {
            log::flush(LOG_FLUSH_TIMEOUT);
            ExitCode::from(exit.code())
        }
        Err(failure) => {
            log::message(&failure);
            log::flush(LOG_FLUSH_TIMEOUT);
            ExitCode::from(failure.exit.code())
        }
    }
}

fn run(command: Command) -> Result<Exit, Failure> {
    match command {
        #[cfg(feature = "demo")]
        Command::Demo(args) => cli::demo::run(&args),
        #[cfg(not(feature = "demo"))]
        Command::Demo(_) => {
            Err(Failure { exit: Exit::Usage, message: "this build has no demo; build with the feature 'demo'".into() })
        }
        Command::Plan(args) => cli::plan(&args),
        Command::Run(args) => cli::run(&args),
        Command::Check(args) => cli::check(&args),
        Command::Calibrate(command) => cli::calibrate(&command),
        Command::Rig(command) => cli::rig(&command),
        Command::Status(args) => cli::send(&args, Verb::Status, b""),
        Command::Arm(args) => cli::send(&args, Verb::Arm, b""),
        Command::Servo(args) => cli::send(&args, Verb::Servo, b""),
        Command::Stop(args) => cli::stop(&args),
        Command::Reset(args) => cli::send(&args, Verb::Reset, b""),
        Command::Gripper(args) => cli::send(&args.client, Verb::Gripper, args.motion.as_bytes()),
        Command::Recover(args) => cli::recover(&args),
        Command::Setpoint(args) => cli::setpoint(&args),
        Command::Reconstruct(args) => cli::reconstruct(&args),
        Command::Study(args) => cli::study(&args),
        Command::Bench(args) => match args.stage {
            cli::BenchCommand::Track(args) => cli::bench_track(&args),
        },
        #[cfg(feature = "demo")]
        Command::MockUr(p) => Ok(cli::simulator(graspd_hil::controller::main_with_args, "graspd-mock-ur", &p.args)),
        #[cfg(feature = "demo")]
        Command::Scene(p) => Ok(cli::simulator(graspd_hil::scene_program::main_with_args, "graspd-scene", &p.args)),
    }
}
