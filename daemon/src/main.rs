//! The graspd program.
fn main() {}
