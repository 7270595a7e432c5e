//! Counts the allocations of this thread: the core cannot allocate by construction, and every cycle of every test
//! confirms it.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

thread_local! {
    static CALLS: Cell<u64> = const { Cell::new(0) };
}

/// Number of allocator calls by this thread.
pub(crate) fn calls() -> u64 {
    CALLS.get()
}

fn note() {
    let _ = CALLS.try_with(|c| c.set(c.get() + 1));
}

struct Counting;

// SAFETY: every call goes to the system's allocator unchanged; `note` touches only a const-initialised thread local.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        note();
        // SAFETY: as the caller promises.
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        note();
        // SAFETY: as the caller promises.
        unsafe { System.dealloc(at, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

#[test]
fn allocations_are_counted() {
    let before = calls();
    drop(std::hint::black_box(vec![1u8; 32]));
    assert_eq!(calls() - before, 2);
}
