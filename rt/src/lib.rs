//! The allocation-free core of graspd: geometry, tracking, control law, limits, RTDE codec.
//!
//! Nothing here reads a clock, opens a file or a socket, starts a thread or touches a heap: the crate is `no_std` without
//! `alloc`, so that an allocation is a compile error. Time is an argument in integer nanoseconds (CLOCK_MONOTONIC), inputs are
//! values, and the same inputs give the same outputs to the bit.
#![no_std]
#![forbid(unsafe_code)]

pub mod arm;
pub mod cycle;
pub mod geom;
pub mod gripper;
pub mod guard;
pub mod image;
pub mod math;
pub mod mode;
pub mod online;
pub mod rtde;
pub mod setpoint;
