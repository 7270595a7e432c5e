//! A mailbox for one value between two threads: the newest value replaces an older one, and neither side waits.

use crossbeam::queue::ArrayQueue;

/// Holds the newest value that was put and not yet taken. Neither side allocates, locks or waits.
#[derive(Debug)]
pub struct Mailbox<T> {
    queue: ArrayQueue<T>,
}

impl<T> Default for Mailbox<T> {
    fn default() -> Self {
        Self { queue: ArrayQueue::new(1) }
    }
}

impl<T> Mailbox<T> {
    /// Puts a value. An older value that was not taken is dropped on the calling thread: a real-time thread may put
    /// only values whose drop is free.
    pub fn put(&self, value: T) {
        drop(self.queue.force_push(value));
    }

    /// Puts a value into an empty mailbox.
    ///
    /// # Errors
    /// The value, when the mailbox is full.
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
    fn the_newest_value_replaces_an_older_one_and_is_taken_once() {
        let mailbox = Mailbox::default();
        assert_eq!(mailbox.take(), None::<u32>);
        mailbox.put(1);
        mailbox.put(2);
        assert_eq!(mailbox.offer(3), Err(3));
        assert_eq!(mailbox.take(), Some(2));
        assert_eq!(mailbox.take(), None);
    }
}
