//! A single-value slot between threads: the newest value wins, nobody waits.

use crossbeam::queue::ArrayQueue;

/// Holds the newest value that was put and not yet taken. Neither side allocates, locks or waits.
#[derive(Debug)]
pub struct Slot<T> {
    queue: ArrayQueue<T>,
}

impl<T> Default for Slot<T> {
    fn default() -> Self {
        Self { queue: ArrayQueue::new(1) }
    }
}

impl<T> Slot<T> {
    /// Puts a value; an older one that nobody took is dropped (on this thread: put only values whose drop is free).
    pub fn put(&self, value: T) {
        drop(self.queue.force_push(value));
    }

    /// Puts a value unless one is waiting, which is handed back.
    ///
    /// # Errors
    /// The value, when the slot is taken.
    pub fn offer(&self, value: T) -> Result<(), T> {
        self.queue.push(value)
    }

    /// Takes the value, if there is one.
    pub fn take(&self) -> Option<T> {
        self.queue.pop()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_newest_wins_and_is_taken_once() {
        let s = Slot::default();
        assert_eq!(s.take(), None::<u32>);
        s.put(1);
        s.put(2);
        assert_eq!(s.offer(3), Err(3));
        assert_eq!(s.take(), Some(2));
        assert_eq!(s.take(), None);
    }
}
