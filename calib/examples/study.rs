//! Prints the accuracy study's table: `cargo run --release -p graspd-calib --example study [trials] [seed] [part of a cell's name]`.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let number = |k: usize, default: u64| arguments.get(k).map_or(default, |a| a.parse().unwrap());
    let wanted = arguments.get(2).cloned().unwrap_or_default();
    let cells: Vec<_> = graspd_calib::montecarlo::cells().into_iter().filter(|c| c.name.contains(&wanted)).collect();
    print!(
        "{}",
        graspd_calib::montecarlo::table(&cells, number(0, 1000) as usize, number(1, 1), |name| eprintln!("{name}"))
    );
}
