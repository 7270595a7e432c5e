//! A stereo scene simulator.
fn main() {}
