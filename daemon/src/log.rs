//! The daemon's log: a bounded queue of lines, written by a separate thread.
//!
//! Logging never waits: a stopped terminal, an unread or closed pipe or a full disk blocks the log thread only. Lines
//! that do not fit into the queue are dropped and counted; the count is in the status, in telemetry and, once writing
//! works again, in the log itself. Before [`start`], which the client commands never call, a line is written directly.

use crate::realtime::now_ns;
use crossbeam::queue::ArrayQueue;
use rustix::event::{PollFd, PollFlags, poll};
use rustix::io::Errno;
use std::os::fd::AsFd;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// Capacity of the queue, lines: minutes of a daemon in trouble, under 200 kB.
const MAX_QUEUED_LINES: usize = 1024;
/// Maximum length of a line, bytes: messages of a controller must not fill the memory.
const MAX_LINE_BYTES: usize = 4096;
/// Period with which the log thread reads the queue.
const PERIOD: Duration = Duration::from_millis(20);
/// Maximum duration of a write before the log counts as blocked, ns.
const MAX_WRITE_NS: u64 = 500_000_000;

/// The stream of a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stream {
    /// Standard output: the line that reports that the daemon is ready.
    Out,
    /// Standard error: everything else.
    Err,
}

#[derive(Debug)]
struct Log {
    lines: ArrayQueue<(Stream, String)>,
    dropped: AtomicU64,
    failed: AtomicU64,
    /// Start of the write in progress, ns; 0 without one.
    writing_since_ns: AtomicU64,
}

static LOG: OnceLock<Log> = OnceLock::new();

/// Lines that were not written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Lost {
    /// Lines dropped because the queue was full.
    pub dropped: u64,
    /// Lines that could not be written: full disk, closed pipe.
    pub failed: u64,
    /// Whether a write has been in progress for more than half a second.
    pub blocked: bool,
}

/// Starts the log thread. It is not joined: it may be blocked in a write forever.
///
/// # Errors
/// When the thread cannot be started.
pub fn start() -> std::io::Result<()> {
    let mut first = false;
    let log = LOG.get_or_init(|| {
        first = true;
        Log {
            lines: ArrayQueue::new(MAX_QUEUED_LINES),
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

/// Logs a message on standard error, with the program's name.
pub fn message(text: impl std::fmt::Display) {
    line(Stream::Err, format!("graspd: {text}"));
}

/// Logs a line on a stream.
pub fn line(stream: Stream, mut text: String) {
    if text.len() >= MAX_LINE_BYTES {
        let end = (0..MAX_LINE_BYTES).rev().find(|i| text.is_char_boundary(*i)).unwrap_or(0);
        text.truncate(end);
    }
    text.push('\n');
    match LOG.get() {
        Some(log) => {
            // A full queue drops the newest line: the lines that began the trouble are the more useful ones.
            if log.lines.push((stream, text)).is_err() {
                log.dropped.fetch_add(1, Ordering::Relaxed);
            }
        }
        None => drop(put(stream, text.as_bytes())),
    }
}

/// The lines lost so far.
pub fn lost() -> Lost {
    LOG.get().map_or_else(Lost::default, |log| {
        let since = log.writing_since_ns.load(Ordering::Relaxed);
        Lost {
            dropped: log.dropped.load(Ordering::Relaxed),
            failed: log.failed.load(Ordering::Relaxed),
            blocked: since != 0 && now_ns().saturating_sub(since) > MAX_WRITE_NS,
        }
    })
}

/// Waits until all lines are written, at most `limit`, so that the last lines of a process are not lost.
pub fn flush(limit: Duration) {
    let Some(log) = LOG.get() else { return };
    let until = Instant::now() + limit;
    while Instant::now() < until && !(log.lines.is_empty() && log.writing_since_ns.load(Ordering::Acquire) == 0) {
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// Sends panic messages to the log: the standard hook writes to standard error on the panicking thread, which may be a
/// real-time thread.
pub fn log_panics() {
    std::panic::set_hook(Box::new(|info| {
        let thread = std::thread::current();
        message(format_args!("thread {}: {info}", thread.name().unwrap_or("without a name")));
    }));
}

fn write_forever(log: &Log) {
    let mut reported = 0;
    loop {
        // Set before the queue is read, so that `flush` never finds an empty queue while a line is not yet written.
        log.writing_since_ns.store(now_ns().max(1), Ordering::Release);
        while let Some((stream, text)) = log.lines.pop() {
            log.writing_since_ns.store(now_ns().max(1), Ordering::Release);
            if put(stream, text.as_bytes()).is_err() {
                log.failed.fetch_add(1, Ordering::Relaxed);
            }
        }
        let lost = log.dropped.load(Ordering::Relaxed) + log.failed.load(Ordering::Relaxed);
        if lost > reported
            && put(Stream::Err, format!("graspd: {} log lines were lost\n", lost - reported).as_bytes()).is_ok()
        {
            reported = lost;
        }
        log.writing_since_ns.store(0, Ordering::Release);
        std::thread::sleep(PERIOD);
    }
}

/// Writes all bytes, without the locks and buffers of the standard library: a blocked write must not hold a lock that
/// the exit needs.
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
            // Another process may have made the stream non-blocking.
            Err(Errno::AGAIN) => drop(poll(&mut [PollFd::new(to, PollFlags::OUT)], None)),
            Err(e) => return Err(e),
        }
    }
    Ok(())
}
