//! The daemon: configuration, threads, sockets and commands. It moves values between boxes and knows no mathematics.
//!
//! `graspd run` is the real-time daemon (two real-time threads, [`realtime`] and [`threads`]); every other subcommand is an ordinary
//! program that shares its files and formats.

pub mod arm;
pub mod cli;
pub mod config;
pub mod exit;
pub mod heap;
pub mod links;
pub mod log;
pub mod realtime;
pub mod stop;
pub mod threads;
pub mod wiring;
