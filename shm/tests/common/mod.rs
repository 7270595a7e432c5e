//! A private root folder and prefix for each test, and the clock.
#![allow(dead_code, unreachable_pub, clippy::unwrap_used)]

use graspd_shm::{Names, ShmNode, create_node};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

static NEXT: AtomicU32 = AtomicU32::new(0);

/// A private root folder and prefix; their files are removed when dropped.
pub struct Place {
    pub names: Names,
}

impl Place {
    pub fn new() -> Self {
        let tag = format!("gt{}x{}_", std::process::id(), NEXT.fetch_add(1, Ordering::Relaxed));
        let root = std::env::temp_dir().join(format!("graspd-shm-{tag}"));
        Self { names: Names::new(root, &tag, "test").unwrap() }
    }

    pub fn node(&self, role: &str) -> ShmNode {
        create_node(&self.names, role).unwrap()
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(self.names.root());
        for f in std::fs::read_dir("/dev/shm").into_iter().flatten().flatten() {
            if f.file_name().to_string_lossy().starts_with(self.names.prefix()) {
                let _ = std::fs::remove_file(f.path());
            }
        }
    }
}

pub fn now_ns() -> u64 {
    let t = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    t.tv_sec as u64 * 1_000_000_000 + t.tv_nsec as u64
}

/// Polls `f` for at most `limit`, until it returns a value.
pub fn until<T>(limit: Duration, mut f: impl FnMut() -> Option<T>) -> Option<T> {
    let end = Instant::now() + limit;
    while Instant::now() < end {
        if let Some(v) = f() {
            return Some(v);
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    None
}
