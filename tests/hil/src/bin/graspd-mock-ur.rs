//! A mock UR controller.
fn main() {}
