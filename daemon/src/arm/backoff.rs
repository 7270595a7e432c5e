//! Reconnecting: on a thread of its own, with growing pauses, and never arming anything.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crossbeam::channel::{Receiver, Sender, bounded};

use super::link::ArmLink;
use super::ur_config::ArmError;

/// Pause before attempt `n` (from 0): 0.5 s doubling to 5 s.
pub fn backoff_delay(n: u32) -> Duration {
    Duration::from_millis(500 * (1u64 << n.min(4))).min(Duration::from_secs(5))
}

/// Makes links on an ordinary thread and hands them to the command thread through slots of one.
///
/// The command thread gives a failed link back by [`retire`](Connector::retire), which also asks for the next one: links are
/// closed and freed here, never on the command thread.
#[derive(Debug)]
pub struct Connector {
    ready: Receiver<Box<dyn ArmLink>>,
    retired: Sender<Box<dyn ArmLink>>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Connector {
    /// Starts connecting. `make` connects once; `tell` hears every failure, with the pause that follows.
    pub fn spawn(
        mut make: impl FnMut() -> Result<Box<dyn ArmLink>, ArmError> + Send + 'static,
        mut tell: impl FnMut(&ArmError, Duration) + Send + 'static,
    ) -> std::io::Result<Connector> {
        let (ready_tx, ready) = bounded(1);
        let (retired, retired_rx) = bounded::<Box<dyn ArmLink>>(1);
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = Arc::clone(&stop);
        let thread = std::thread::Builder::new().name("arm-connect".to_owned()).spawn(move || {
            while !stopped.load(Ordering::Relaxed) {
                let mut attempt = 0;
                let link = loop {
                    match make() {
                        Ok(link) => break link,
                        Err(e) => {
                            let delay = backoff_delay(attempt);
                            attempt += 1;
                            tell(&e, delay);
                            if !pause(delay, &stopped) {
                                return;
                            }
                        }
                    }
                };
                if ready_tx.send(link).is_err() {
                    return;
                }
                // The next one is made when this one comes back; a link that lives on ends with the daemon.
                loop {
                    match retired_rx.recv_timeout(Duration::from_millis(100)) {
                        Ok(link) => {
                            drop(link);
                            break;
                        }
                        Err(crossbeam::channel::RecvTimeoutError::Timeout) if !stopped.load(Ordering::Relaxed) => {}
                        Err(_) => return,
                    }
                }
                if !pause(backoff_delay(0), &stopped) {
                    return;
                }
            }
        })?;
        Ok(Connector { ready, retired, stop, thread: Some(thread) })
    }

    /// The next link, if it is ready. Never blocks.
    pub fn take(&self) -> Option<Box<dyn ArmLink>> {
        self.ready.try_recv().ok()
    }

    /// Gives a failed link back and asks for another. Never blocks; gives the link back to the caller when the thread has
    /// not taken the last one yet.
    pub fn retire(&self, link: Box<dyn ArmLink>) -> Result<(), Box<dyn ArmLink>> {
        self.retired.try_send(link).map_err(|e| e.into_inner())
    }
}

impl Drop for Connector {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Sleeps in small pieces; false when it is time to stop.
fn pause(total: Duration, stop: &AtomicBool) -> bool {
    let end = Instant::now() + total;
    while Instant::now() < end {
        if stop.load(Ordering::Relaxed) {
            return false;
        }
        std::thread::sleep(Duration::from_millis(20).min(end.saturating_duration_since(Instant::now())));
    }
    !stop.load(Ordering::Relaxed)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pauses_grow_to_five_seconds() {
        let all: Vec<_> = (0..6).map(|n| backoff_delay(n).as_millis()).collect();
        assert_eq!(all, [500, 1000, 2000, 4000, 5000, 5000]);
        assert_eq!(backoff_delay(u32::MAX).as_millis(), 5000);
    }
}
