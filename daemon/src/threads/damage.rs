//! The watch over the files of the shared memory: an ordinary thread that checks whether they are still present and
//! unchanged.

use super::shared::Shared;
use crate::log;
use crate::stop::StopSource;
use graspd_shm::{ShmNode, Vital};
use std::path::PathBuf;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

/// Period of the check: the maximum time for which the daemon moves the arm without being reachable by its verbs.
const PERIOD: Duration = Duration::from_millis(200);
/// Time until every thread has created its ports; arming takes longer.
const STARTUP: Duration = Duration::from_millis(600);

/// Runs until shutdown, or until a file is damaged: then the arm is stopped and the process ends with that reason,
/// because its verbs may no longer reach it. `more` are the daemon's files in addition to the middleware's.
pub fn run(node: &ShmNode, more: &[PathBuf], shared: &Shared) {
    let sleep = |time: Duration| {
        let until = Instant::now() + time;
        while Instant::now() < until && !shared.ending() {
            std::thread::sleep(Duration::from_millis(20));
        }
    };
    sleep(STARTUP);
    let vital = Vital::of(node, more);
    while !shared.ending() {
        if let Some(damage) = vital.damage() {
            let reason = format!(
                "the shared memory was damaged: {} {}; the arm was stopped. Look for a program that cleans {} or /dev/shm (tmp cleaner, \
                 RemoveIPC), end all programs of this cell and start them again",
                damage.path.display(),
                damage.what,
                node.names().root().display()
            );
            shared.live.stop(StopSource::Damage);
            log::message(&reason);
            let _ = shared.damage.set(reason);
            shared.live.end.store(true, Ordering::Release);
            return;
        }
        sleep(PERIOD);
    }
}
