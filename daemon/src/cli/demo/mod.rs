//! `graspd demo`: the whole chain against a simulated world, each part a process of its own.

mod process;

pub use process::Part;
