//! The simulator's programs as hidden subcommands, so that `graspd demo` needs no other executable.

use crate::exit::Exit;

/// Runs a program of the simulator with these arguments, and exits with its code.
pub fn simulator(main: fn(Vec<String>) -> i32, name: &str, args: &[String]) -> Exit {
    let all = std::iter::once(name.to_owned()).chain(args.iter().cloned()).collect();
    std::process::exit(main(all));
}
