//! Prints the table of the accuracy study:
//! `cargo run --release -p graspd-calib --example study [trials] [seed] [part of a cell's name]`.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

use graspd_calib::commands::study::{cells, table};

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let number = |k: usize, default: u64| arguments.get(k).map_or(default, |a| a.parse().unwrap());
    let name = arguments.get(2).cloned().unwrap_or_default();
    let cells: Vec<_> = cells().into_iter().filter(|c| c.name.contains(&name)).collect();
    print!("{}", table(&cells, number(0, 1000) as usize, number(1, 1), |cell| eprintln!("{cell}")));
}
