//! An allocator that counts its calls, so that the program can say of itself that a stage made none.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

thread_local! {
    static CALLS: Cell<u64> = const { Cell::new(0) };
}

/// Calls of the heap by this thread so far; stays 0 in a program that does not allocate by [`Counting`].
pub fn calls() -> u64 {
    CALLS.with(Cell::get)
}

/// The system's allocator, counting.
pub struct Counting;

fn count() {
    // A thread that is being torn down has no counter any more, and nobody who asks for it.
    let _ = CALLS.try_with(|c| c.set(c.get() + 1));
}

// SAFETY: every call is handed on unchanged to the system's allocator; the counter neither allocates nor panics.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: the caller's promises are those of `System`.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: as above.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn realloc(&self, at: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count();
        // SAFETY: as above.
        unsafe { System.realloc(at, layout, size) }
    }

    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        count();
        // SAFETY: as above.
        unsafe { System.dealloc(at, layout) }
    }
}
