//! Stop requests that depend neither on the middleware nor on the log: signals and a Unix socket, both directly to the
//! stop latch.
//!
//! | source | path |
//! |---|---|
//! | SIGUSR1 | the signal handler stores into the latch; the command thread takes it at its next cycle |
//! | SIGTERM, SIGINT, SIGHUP | the same, and the process ends when the arm is at rest |
//! | `<cell>.stop` | a socket of mode 0600 in the runtime folder, served by the stop thread ([`serve`]) |
//! | the verb | shared memory and the service thread; for consoles, and for `graspd stop` when the others fail |
//!
//! The stop thread does not allocate, log, lock or format. It also ends the process when the regular end fails, for
//! example because a thread hangs in the middleware or in a connection.

mod client;
mod endpoint;
mod live;
mod thread;

pub use client::{StopAnswer, ask};
pub use endpoint::{StopEndpoint, socket_name};
pub use live::{LiveState, StopSource};
pub use thread::{ForcedExit, serve};

use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM, SIGUSR1};
use std::sync::Arc;

/// Installs handlers for the signals that stop the arm or end the process; they set the latch.
///
/// # Errors
/// When a handler cannot be installed.
pub fn catch_signals(live: &LiveState) -> std::io::Result<()> {
    for signal in [SIGUSR1, SIGTERM, SIGINT, SIGHUP] {
        signal_hook::flag::register(signal, Arc::clone(&live.by_signal))?;
        signal_hook::flag::register(signal, Arc::clone(&live.latch))?;
        if signal != SIGUSR1 {
            signal_hook::flag::register(signal, Arc::clone(&live.end))?;
        }
    }
    Ok(())
}
