//! The daemon's log: lines into a bounded queue, written by a thread of their own.
//!
//! Whoever logs pushes and goes on: a terminal that is stopped, a pipe that nobody reads, a full disk or a closed pipe
//! hold up the log thread alone. What does not fit is dropped and counted; the count is in the status, in telemetry
//! and, once writing goes on, in the log itself. Before [`start`] (the client commands never call it) a line goes
//! straight to its stream.

use crate::realtime::now_ns;
use crossbeam::queue::ArrayQueue;
use rustix::event::{PollFd, PollFlags, poll};
use rustix::io::Errno;
use std::os::fd::AsFd;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// Lines that may wait: some minutes of a daemon in trouble, under 200 kB.
const LINES: usize = 1024;
/// Longest line, bytes: what the controller says must not fill the memory.
const LINE_BYTES: usize = 4096;
/// How often the log thread looks at the queue.
const PERIOD: Duration = Duration::from_millis(20);
/// A write that takes longer than this is a log that is blocked.
const BLOCKED_NS: u64 = 500_000_000;

/// Where a line goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stream {
    /// Standard output: the line that says the daemon is ready.
    Out,
    /// Standard error: everything else.
    Err,
}

#[derive(Debug)]
struct Log {
    lines: ArrayQueue<(Stream, String)>,
    dropped: AtomicU64,
    failed: AtomicU64,
    /// When the write that is under way began, ns; 0 while none is.
    writing_since_ns: AtomicU64,
}

static LOG: OnceLock<Log> = OnceLock::new();

/// What became of lines that were not written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Lost {
    /// Lines dropped because the queue was full.
    pub dropped: u64,
    /// Lines that the stream refused: a full disk, a closed pipe.
    pub failed: u64,
    /// Whether a write has not returned for half a second.
    pub blocked: bool,
}

/// Starts the log thread. It is not joined: it may stand in a write that never returns.
///
/// # Errors
/// When the thread cannot be started.
pub fn start() -> std::io::Result<()> {
    let mut first = false;
    let log = LOG.get_or_init(|| {
        first = true;
        Log {
            lines: ArrayQueue::new(LINES),
            dropped: AtomicU64::new(0),
            failed: AtomicU64::new(0),
            writing_since_ns: AtomicU64::new(0),
        }
    });
    if first {
        std::thread::Builder::new().name("log".to_owned()).spawn(move || write_forever(log))?;
    }
    Ok(())
}

/// Logs a line.
pub fn say(text: impl std::fmt::Display) {
    line(Stream::Err, format!("graspd: {text}"));
}

/// Logs a line as it stands.
pub fn line(stream: Stream, mut text: String) {
    if text.len() >= LINE_BYTES {
        let end = (0..LINE_BYTES).rev().find(|i| text.is_char_boundary(*i)).unwrap_or(0);
        text.truncate(end);
    }
    text.push('\n');
    match LOG.get() {
        Some(log) => {
            // The newest line goes, not the oldest: what began the trouble is worth more than what followed.
            if log.lines.push((stream, text)).is_err() {
                log.dropped.fetch_add(1, Ordering::Relaxed);
            }
        }
        None => drop(put(stream, text.as_bytes())),
    }
}

/// What was lost so far.
pub fn lost() -> Lost {
    LOG.get().map_or_else(Lost::default, |log| {
        let since = log.writing_since_ns.load(Ordering::Relaxed);
        Lost {
            dropped: log.dropped.load(Ordering::Relaxed),
            failed: log.failed.load(Ordering::Relaxed),
            blocked: since != 0 && now_ns().saturating_sub(since) > BLOCKED_NS,
        }
    })
}

/// Waits until everything is written, at most `limit`: a process that ends takes its last words along unless its log is
/// stuck.
pub fn flush(limit: Duration) {
    let Some(log) = LOG.get() else { return };
    let until = Instant::now() + limit;
    while Instant::now() < until && !(log.lines.is_empty() && log.writing_since_ns.load(Ordering::Acquire) == 0) {
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// Sends panics through the log: the standard hook writes to standard error on the thread that panicked, which may be a
/// real-time one.
pub fn take_panics() {
    std::panic::set_hook(Box::new(|info| {
        let thread = std::thread::current();
        say(format_args!("thread {}: {info}", thread.name().unwrap_or("without a name")));
    }));
}

fn write_forever(log: &Log) {
    let mut told = 0;
    loop {
        // Set before the queue is looked at, so that `flush` never sees an empty queue and a line in the hand.
        log.writing_since_ns.store(now_ns().max(1), Ordering::Release);
        while let Some((stream, text)) = log.lines.pop() {
            log.writing_since_ns.store(now_ns().max(1), Ordering::Release);
            if put(stream, text.as_bytes()).is_err() {
                log.failed.fetch_add(1, Ordering::Relaxed);
            }
        }
        let lost = log.dropped.load(Ordering::Relaxed) + log.failed.load(Ordering::Relaxed);
        if lost > told && put(Stream::Err, format!("graspd: {} log lines were lost\n", lost - told).as_bytes()).is_ok()
        {
            told = lost;
        }
        log.writing_since_ns.store(0, Ordering::Release);
        std::thread::sleep(PERIOD);
    }
}

/// Writes all bytes, without the standard library's locks and buffers: a stuck write must not hold what the process's
/// end needs.
fn put(stream: Stream, bytes: &[u8]) -> Result<(), Errno> {
    match stream {
        Stream::Out => put_to(&std::io::stdout(), bytes),
        Stream::Err => put_to(&std::io::stderr(), bytes),
    }
}

fn put_to(to: &impl AsFd, mut bytes: &[u8]) -> Result<(), Errno> {
    while !bytes.is_empty() {
        match rustix::io::write(to, bytes) {
            Ok(0) => return Err(Errno::IO),
            Ok(n) => bytes = bytes.get(n..).unwrap_or_default(),
            Err(Errno::INTR) => {}
            // A stream that somebody else made non-blocking is waited for like any other.
            Err(Errno::AGAIN) => drop(poll(&mut [PollFd::new(to, PollFlags::OUT)], None)),
            Err(e) => return Err(e),
        }
    }
    Ok(())
}
