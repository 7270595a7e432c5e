//! The watch over the files of the shared memory: an ordinary thread that looks whether they are still what they were.

use super::shared::Shared;
use crate::log;
use crate::stop::By;
use graspd_shm::{ShmNode, Vital};
use std::path::PathBuf;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

/// How often it looks: with it lies the longest time that a daemon drives without being found by its verbs.
const PERIOD: Duration = Duration::from_millis(200);
/// Until every thread has made its ports. An arming takes longer.
const SETTLE: Duration = Duration::from_millis(600);

/// Runs until shutdown, or until something is damaged: then the arm is stopped and the process ends with that reason,
/// for nothing that reaches it any more could start or end anything. `more` are files of ours beside the middleware's.
pub fn run(node: &ShmNode, more: &[PathBuf], shared: &Shared) {
    let sleep = |time: Duration| {
        let until = Instant::now() + time;
        while Instant::now() < until && !shared.ending() {
            std::thread::sleep(Duration::from_millis(20));
        }
    };
    sleep(SETTLE);
    let vital = Vital::of(node, more);
    while !shared.ending() {
        if let Some(damage) = vital.damage() {
            let reason = format!(
                "the shared memory was damaged: {} {}; the arm was stopped. Look for a program that cleans {} or /dev/shm (tmp cleaner, \
                 RemoveIPC), end every program of this cell and start again",
                damage.path.display(),
                damage.what,
                node.names().root().display()
            );
            shared.live.stop(By::Damage);
            log::say(&reason);
            let _ = shared.damage.set(reason);
            shared.live.end.store(true, Ordering::Release);
            return;
        }
        sleep(PERIOD);
    }
}
