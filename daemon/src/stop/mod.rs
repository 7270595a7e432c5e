//! Ways to stop that need neither the middleware nor the log: signals and a Unix socket, both straight to the stop
//! latch.
//!
//! | way | what it goes through |
//! |---|---|
//! | SIGUSR1 | the signal handler stores into the latch; the command thread takes it at its next cycle |
//! | SIGTERM, SIGINT, SIGHUP | the same, and the process ends once the arm rests |
//! | `<cell>.stop` | a socket of mode 0600 in the runtime folder, served by the stop thread ([`serve`]) |
//! | the verb | shared memory and the service thread; the last resort of `graspd stop`, the way of consoles |
//!
//! The stop thread allocates, logs, locks and formats nothing. It is also the end of last resort: when the ordered end
//! does not come about (a thread that hangs in the middleware or in a connection), it ends the process.

mod client;
mod door;
mod live;
mod thread;

pub use client::{Heard, ask};
pub use door::{Door, socket_name};
pub use live::{By, Live};
pub use thread::{End, serve};

use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM, SIGUSR1};
use std::sync::Arc;

/// Lets the signals that stop and end reach the latch from here on.
///
/// # Errors
/// When a handler cannot be installed.
pub fn catch_signals(live: &Live) -> std::io::Result<()> {
    for signal in [SIGUSR1, SIGTERM, SIGINT, SIGHUP] {
        signal_hook::flag::register(signal, Arc::clone(&live.by_signal))?;
        signal_hook::flag::register(signal, Arc::clone(&live.latch))?;
        if signal != SIGUSR1 {
            signal_hook::flag::register(signal, Arc::clone(&live.end))?;
        }
    }
    Ok(())
}
