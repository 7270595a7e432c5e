//! The examples run and end where they should.
#![allow(clippy::unwrap_used)] // a test

#[allow(dead_code)]
#[path = "../examples/servo_in_memory.rs"]
mod servo_in_memory;

#[test]
fn the_servo_in_memory_converges_on_the_grasp() {
    let (seconds, error_m) = servo_in_memory::run();
    assert!(seconds < 8.0 && error_m < 0.0005, "{seconds} s, {error_m} m");
}
