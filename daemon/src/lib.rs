//! The graspd program: configuration, threads, sockets and commands. The mathematics is in `graspd_rt` and
//! `graspd_calib`.
//!
//! `graspd run` is the real-time daemon (two real-time threads, [`realtime`] and [`threads`]); the other subcommands
//! are ordinary programs that use the same files and formats.
//!
//! | module | contents |
//! |---|---|
//! | [`config`] | graspd.toml, from text to valid values |
//! | [`arm`] | links to a UR controller and to a simulated arm |
//! | [`stop`] | stop requests by signal and socket |
//! | [`threads`] | the daemon's threads, and what they share |
//! | [`links`] | the link manager |
//! | [`wiring`] | `graspd run`: starts all of it |
//! | [`cli`] | the subcommands |

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
