//! What the stop path and the command thread tell each other: atomics, nothing else.

use graspd_rt::mode::ModeName;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU8, AtomicU64, Ordering};

/// Number of a mode before the first cycle.
const STARTING: u8 = u8::MAX;

/// No exit code of ours.
const NO_VERDICT: u8 = u8::MAX;

/// Who asked for the last stop.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum By {
    /// The verb over shared memory.
    Verb = 1,
    /// The stop socket.
    Socket = 2,
    /// A second publisher on the frame topic (H06).
    SecondPublisher = 3,
    /// The daemon itself, because it ends.
    Ending = 4,
    /// Files of the shared memory are gone or were changed.
    Damage = 5,
}

impl By {
    /// In words.
    pub const fn words(self) -> &'static str {
        match self {
            By::Verb => "the stop verb",
            By::Socket => "the stop socket",
            By::SecondPublisher => "a second program publishes frames in this cell; end it",
            By::Ending => "the daemon's end",
            By::Damage => "the watch over the shared memory",
        }
    }

    const fn of(number: u8) -> Option<By> {
        match number {
            1 => Some(By::Verb),
            2 => Some(By::Socket),
            3 => Some(By::SecondPublisher),
            4 => Some(By::Ending),
            5 => Some(By::Damage),
            _ => None,
        }
    }
}

/// The command thread's state as it is now, and the latch that stops it.
#[derive(Debug)]
pub struct Live {
    /// Set to stop at the next cycle, ahead of every queued request. A signal handler sets it too.
    pub latch: Arc<AtomicBool>,
    /// Set to end the process; from then on every cycle asks for a stop, and no other request is taken.
    pub end: Arc<AtomicBool>,
    /// A signal was among what set the latch.
    pub by_signal: Arc<AtomicBool>,
    by: AtomicU8,
    mode: AtomicU8,
    moving: AtomicBool,
    linked: AtomicBool,
    cycles: AtomicU64,
    /// Exit code of the ordered end, once it has come about.
    verdict: AtomicU8,
    over: AtomicBool,
}

impl Default for Live {
    fn default() -> Self {
        Self {
            latch: Arc::default(),
            end: Arc::default(),
            by_signal: Arc::default(),
            by: AtomicU8::new(0),
            mode: AtomicU8::new(STARTING),
            moving: AtomicBool::new(false),
            linked: AtomicBool::new(false),
            cycles: AtomicU64::new(0),
            verdict: AtomicU8::new(NO_VERDICT),
            over: AtomicBool::new(false),
        }
    }
}

impl Live {
    /// Pulls the latch.
    pub fn stop(&self, by: By) {
        self.by.store(by as u8, Ordering::Relaxed);
        self.latch.store(true, Ordering::Release);
    }

    /// Whether this cycle has to ask for a stop. Takes the latch.
    pub fn take(&self) -> bool {
        self.latch.swap(false, Ordering::AcqRel) || self.ending()
    }

    /// Whether the process has to end.
    pub fn ending(&self) -> bool {
        self.end.load(Ordering::Acquire)
    }

    /// Who asked for the stop that has just been carried out, in words.
    pub fn who(&self) -> &'static str {
        let by = By::of(self.by.swap(0, Ordering::Relaxed));
        if self.by_signal.swap(false, Ordering::Relaxed) { "a signal" } else { by.map_or("a request", By::words) }
    }

    /// The arm rests and the process may end with this code, whichever threads are still on their way.
    pub fn settle(&self, code: u8) {
        self.verdict.store(code, Ordering::Release);
    }

    /// The code of the ordered end, once it has come about.
    pub fn settled(&self) -> Option<u8> {
        Some(self.verdict.load(Ordering::Acquire)).filter(|code| *code != NO_VERDICT)
    }

    /// The daemon has ended.
    pub fn close(&self) {
        self.over.store(true, Ordering::Release);
    }

    /// Whether the daemon has ended.
    pub fn over(&self) -> bool {
        self.over.load(Ordering::Acquire)
    }

    /// The command thread's note at the end of a cycle.
    pub fn note(&self, mode: ModeName, moving: bool, linked: bool) {
        self.mode.store(mode as u8, Ordering::Relaxed);
        self.moving.store(moving, Ordering::Relaxed);
        self.linked.store(linked, Ordering::Relaxed);
        // Released last: who sees the new count sees the cycle's mode.
        self.cycles.fetch_add(1, Ordering::Release);
    }

    /// Cycles noted.
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

    /// Whether the last command was to move.
    pub fn moving(&self) -> bool {
        self.moving.load(Ordering::Relaxed)
    }

    /// Whether a controller was at the other end of the last cycle.
    pub fn linked(&self) -> bool {
        self.linked.load(Ordering::Relaxed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_latch_is_taken_once_and_an_end_is_never_taken_back() {
        let live = Live::default();
        assert!(!live.take());
        live.stop(By::Socket);
        assert_eq!((live.take(), live.take(), live.who(), live.who()), (true, false, "the stop socket", "a request"));
        live.end.store(true, Ordering::Release);
        assert!(live.take() && live.take());
    }

    #[test]
    fn what_a_cycle_notes_is_what_is_read() {
        let live = Live::default();
        assert_eq!(live.mode(), None);
        live.note(ModeName::Servoing, true, true);
        assert_eq!(
            (live.mode(), live.moving(), live.linked(), live.cycles()),
            (Some(ModeName::Servoing), true, true, 1)
        );
        live.note(ModeName::Fault, false, false);
        assert_eq!(
            (live.mode(), live.moving(), live.linked(), live.cycles()),
            (Some(ModeName::Fault), false, false, 2)
        );
    }
}
