//! Duration of a cycle of the command thread while it drives: 8 marks in two views, 500 Hz, in lock step with the
//! simulated world.
//!
//! Prints percentiles; a benchmark, not a test. `cargo bench -p graspd-rt --bench command_step`
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

#[path = "../tests/closed_loop/heap.rs"]
mod heap;
#[allow(dead_code)]
#[path = "../tests/closed_loop/world.rs"]
mod world;

use world::World;

fn main() {
    let mut ns = Vec::new();
    for seed in 0..8 {
        let mut w = World::new(seed, |_| {});
        w.start();
        w.step_ns.clear();
        for _ in 0..1_500 {
            w.cycle(None, false);
        }
        ns.append(&mut w.step_ns);
    }
    ns.sort_unstable();
    let at = |share: f64| ns[((ns.len() - 1) as f64 * share) as usize];
    println!("{:>10} {:>8} {:>8} {:>8} {:>8}", "cycles", "p50 ns", "p99 ns", "p99.9 ns", "max ns");
    println!("{:>10} {:>8} {:>8} {:>8} {:>8}", ns.len(), at(0.5), at(0.99), at(0.999), at(1.0));
    println!("{} bytes of state in the cycle", size_of::<graspd_rt::cycle::CommandCycle>());
}
