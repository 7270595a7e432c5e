//! State shared by the stop path and the command thread: atomics only.

use graspd_rt::mode::ModeName;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU8, AtomicU64, Ordering};

/// Value of `mode` before the first cycle.
const NO_MODE: u8 = u8::MAX;

/// Value of `exit_code` before the regular end; no exit code of graspd.
const NO_EXIT_CODE: u8 = u8::MAX;

/// Source of the last stop request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum StopSource {
    /// The stop verb over shared memory.
    Verb = 1,
    /// The stop socket.
    Socket = 2,
    /// A second publisher on the frame topic.
    SecondPublisher = 3,
    /// The end of the daemon.
    Ending = 4,
    /// Files of the shared memory are missing or have changed.
    Damage = 5,
}

impl StopSource {
    /// The text for the log.
    pub const fn text(self) -> &'static str {
        match self {
            StopSource::Verb => "the stop verb",
            StopSource::Socket => "the stop socket",
            StopSource::SecondPublisher => "a second program publishes frames in this cell; end it",
            StopSource::Ending => "the end of the daemon",
            StopSource::Damage => "the watch over the shared memory",
        }
    }

    const fn of(number: u8) -> Option<StopSource> {
        match number {
            1 => Some(StopSource::Verb),
            2 => Some(StopSource::Socket),
            3 => Some(StopSource::SecondPublisher),
            4 => Some(StopSource::Ending),
            5 => Some(StopSource::Damage),
            _ => None,
        }
    }
}

/// The command thread's state after the last cycle, and the latch that stops it.
#[derive(Debug)]
pub struct LiveState {
    /// Set to stop in the next cycle, before every queued request. Signal handlers set it as well.
    pub latch: Arc<AtomicBool>,
    /// Set to end the process; from then on every cycle requests a stop, and no other request is taken.
    pub end: Arc<AtomicBool>,
    /// Whether a signal was among the sources that set the latch.
    pub by_signal: Arc<AtomicBool>,
    source: AtomicU8,
    mode: AtomicU8,
    moving: AtomicBool,
    linked: AtomicBool,
    cycles: AtomicU64,
    /// Exit code of the regular end, once it is reached.
    exit_code: AtomicU8,
    closed: AtomicBool,
}

impl Default for LiveState {
    fn default() -> Self {
        Self {
            latch: Arc::default(),
            end: Arc::default(),
            by_signal: Arc::default(),
            source: AtomicU8::new(0),
            mode: AtomicU8::new(NO_MODE),
            moving: AtomicBool::new(false),
            linked: AtomicBool::new(false),
            cycles: AtomicU64::new(0),
            exit_code: AtomicU8::new(NO_EXIT_CODE),
            closed: AtomicBool::new(false),
        }
    }
}

impl LiveState {
    /// Sets the latch.
    pub fn stop(&self, source: StopSource) {
        self.source.store(source as u8, Ordering::Relaxed);
        self.latch.store(true, Ordering::Release);
    }

    /// Whether this cycle has to request a stop. Clears the latch.
    pub fn take(&self) -> bool {
        self.latch.swap(false, Ordering::AcqRel) || self.ending()
    }

    /// Whether the process has to end.
    pub fn ending(&self) -> bool {
        self.end.load(Ordering::Acquire)
    }

    /// Text for the source of the stop that was just executed. Clears it.
    pub fn stop_source(&self) -> &'static str {
        let source = StopSource::of(self.source.swap(0, Ordering::Relaxed));
        if self.by_signal.swap(false, Ordering::Relaxed) {
            "a signal"
        } else {
            source.map_or("a request", StopSource::text)
        }
    }

    /// The arm is at rest, and the process may end with this code although threads are still running.
    pub fn finish(&self, code: u8) {
        self.exit_code.store(code, Ordering::Release);
    }

    /// Exit code of the regular end, once it is reached.
    pub fn finished(&self) -> Option<u8> {
        Some(self.exit_code.load(Ordering::Acquire)).filter(|code| *code != NO_EXIT_CODE)
    }

    /// The daemon has ended.
    pub fn close(&self) {
        self.closed.store(true, Ordering::Release);
    }

    /// Whether the daemon has ended.
    pub fn closed(&self) -> bool {
        self.closed.load(Ordering::Acquire)
    }

    /// Records the state at the end of a cycle; called by the command thread.
    pub fn record(&self, mode: ModeName, moving: bool, linked: bool) {
        self.mode.store(mode as u8, Ordering::Relaxed);
        self.moving.store(moving, Ordering::Relaxed);
        self.linked.store(linked, Ordering::Relaxed);
        // Released last: a reader that sees the new count sees the cycle's mode.
        self.cycles.fetch_add(1, Ordering::Release);
    }

    /// Number of recorded cycles.
    pub fn cycles(&self) -> u64 {
        self.cycles.load(Ordering::Acquire)
    }

    /// The mode after the last cycle; `None` before the first.
    pub fn mode(&self) -> Option<ModeName> {
        let number = self.mode.load(Ordering::Relaxed);
        [
            ModeName::Idle,
            ModeName::Tracking,
            ModeName::Armed,
            ModeName::Servoing,
            ModeName::Converged,
            ModeName::Stopping,
            ModeName::Fault,
        ]
        .into_iter()
        .find(|m| *m as u8 == number)
    }

    /// Whether the last command moves the arm.
    pub fn moving(&self) -> bool {
        self.moving.load(Ordering::Relaxed)
    }

    /// Whether the last cycle had a link to a controller.
    pub fn linked(&self) -> bool {
        self.linked.load(Ordering::Relaxed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_latch_is_taken_once_and_an_end_is_permanent() {
        let live = LiveState::default();
        assert!(!live.take());
        live.stop(StopSource::Socket);
        assert_eq!(
            (live.take(), live.take(), live.stop_source(), live.stop_source()),
            (true, false, "the stop socket", "a request")
        );
        live.end.store(true, Ordering::Release);
        assert!(live.take() && live.take());
    }

    #[test]
    fn the_state_of_a_cycle_is_read_as_recorded() {
        let live = LiveState::default();
        assert_eq!(live.mode(), None);
        live.record(ModeName::Servoing, true, true);
        assert_eq!(
            (live.mode(), live.moving(), live.linked(), live.cycles()),
            (Some(ModeName::Servoing), true, true, 1)
        );
        live.record(ModeName::Fault, false, false);
        assert_eq!(
            (live.mode(), live.moving(), live.linked(), live.cycles()),
            (Some(ModeName::Fault), false, false, 2)
        );
    }
}
