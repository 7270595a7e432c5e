//! The simulated world's programs inside this one, so that `graspd demo` needs nothing else on the disk.

use crate::exit::Exit;

/// Runs a program of the world with these arguments; its exit code is handed through as it is.
pub fn world(main: fn(Vec<String>) -> i32, name: &str, args: &[String]) -> Exit {
    let all = std::iter::once(name.to_owned()).chain(args.iter().cloned()).collect();
    std::process::exit(main(all));
}
