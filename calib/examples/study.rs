//! Prints the accuracy study's table: `cargo run --release -p graspd-calib --example study [trials] [seed]`.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

fn main() {
    let mut arguments = std::env::args().skip(1).filter_map(|a| a.parse::<u64>().ok());
    let trials = arguments.next().unwrap_or(1000);
    let seed = arguments.next().unwrap_or(1);
    print!("{}", graspd_calib::montecarlo::table(trials as usize, seed, |name| eprintln!("{name}")));
}
