//! Framing: `u16 size` (of the package, header included), `u8 type`, body. TCP preserves no message boundaries, so
//! packages are cut by their size.

use core::fmt;

/// Bytes of a package's header.
pub const HEADER: usize = 3;

/// Largest package that the size field can state, bytes.
pub const MAX_PACKAGE: usize = u16::MAX as usize;

/// One complete package, borrowed from the receive buffer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Package<'a> {
    /// Type byte; see [`Kind::from_byte`](super::Kind::from_byte).
    pub kind: u8,
    /// Bytes after the header.
    pub body: &'a [u8],
}

/// Framing is lost: the rest of the stream cannot be interpreted, so the connection must be closed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FrameError {
    /// The stated size is smaller than the header.
    TooShort {
        /// Stated size, bytes.
        size: u16,
    },
    /// The stated size is larger than the receive buffer.
    TooLong {
        /// Stated size, bytes.
        size: u16,
        /// Size of the buffer, bytes.
        capacity: usize,
    },
}

impl fmt::Display for FrameError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            FrameError::TooShort { size } => {
                write!(f, "a package states {size} bytes, less than its header of {HEADER}: is this an RTDE port?")
            }
            FrameError::TooLong { size, capacity } => {
                write!(f, "a package states {size} bytes, the receive buffer holds {capacity}: is this an RTDE port?")
            }
        }
    }
}

impl core::error::Error for FrameError {}

/// Cuts a byte stream into packages, in the caller's buffer.
///
/// Receive into [`space`](Framer::space), report the number of bytes by [`commit`](Framer::commit), then take packages
/// with [`next`](Framer::next) until it returns `None`. A buffer of [`MAX_PACKAGE`] bytes holds every package; a
/// smaller one refuses packages that do not fit. Work per call is bounded by the size of the buffer.
///
/// ```
/// use graspd_rt::rtde::Framer;
/// let mut framer = Framer::new([0u8; 16]);
/// framer.feed(&[0, 4, 86]);
/// assert_eq!(framer.next(), Ok(None));
/// framer.feed(&[1]);
/// let package = framer.next().unwrap().unwrap();
/// assert_eq!((package.kind, package.body), (86, &[1u8][..]));
/// ```
#[derive(Clone, Debug)]
pub struct Framer<B> {
    buffer: B,
    start: usize,
    end: usize,
    lost: Option<FrameError>,
}

impl<B: AsRef<[u8]> + AsMut<[u8]>> Framer<B> {
    /// A framer at the start of a stream.
    pub fn new(buffer: B) -> Framer<B> {
        Framer { buffer, start: 0, end: 0, lost: None }
    }

    /// Clears the buffer and the error, for a new connection.
    pub fn clear(&mut self) {
        (self.start, self.end, self.lost) = (0, 0, None);
    }

    /// Number of received bytes that are not taken as packages yet.
    pub fn pending(&self) -> usize {
        self.end - self.start
    }

    /// Buffer for the next received bytes. Empty only while a complete package waits to be taken, or after an error.
    pub fn space(&mut self) -> &mut [u8] {
        let buffer = self.buffer.as_mut();
        if self.start > 0 {
            buffer.copy_within(self.start..self.end, 0);
            (self.start, self.end) = (0, self.end - self.start);
        }
        &mut buffer[self.end..]
    }

    /// Reports that `n` bytes were written to the start of [`space`](Framer::space); clamped to its length.
    pub fn commit(&mut self, n: usize) {
        self.end = (self.end + n).min(self.buffer.as_ref().len());
    }

    /// Copies as many of `bytes` as fit, and returns their number.
    pub fn feed(&mut self, bytes: &[u8]) -> usize {
        let space = self.space();
        let n = bytes.len().min(space.len());
        space[..n].copy_from_slice(&bytes[..n]);
        self.commit(n);
        n
    }

    /// The next complete package; `None` until more bytes arrive.
    ///
    /// # Errors
    /// The stated size is not possible. The framer repeats the error until [`clear`](Framer::clear).
    #[allow(clippy::should_implement_trait)] // lends from the buffer, which `Iterator` cannot
    pub fn next(&mut self) -> Result<Option<Package<'_>>, FrameError> {
        if let Some(error) = self.lost {
            return Err(error);
        }
        let buffer = self.buffer.as_ref();
        let Some(&[high, low, kind]) = buffer[self.start..self.end].first_chunk::<HEADER>() else {
            return Ok(None);
        };
        let size = u16::from_be_bytes([high, low]);
        let error = if (size as usize) < HEADER {
            Some(FrameError::TooShort { size })
        } else if size as usize > buffer.len() {
            Some(FrameError::TooLong { size, capacity: buffer.len() })
        } else {
            None
        };
        if let Some(error) = error {
            self.lost = Some(error);
            return Err(error);
        }
        if self.end - self.start < size as usize {
            return Ok(None);
        }
        let body = self.start + HEADER..self.start + size as usize;
        self.start = body.end;
        if self.start == self.end {
            (self.start, self.end) = (0, 0);
        }
        Ok(Some(Package { kind, body: &self.buffer.as_ref()[body] }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn merged_and_split_packages_come_out_alike() {
        let stream = [0u8, 3, 83, 0, 5, 85, 1, 2, 0, 4, 86, 1];
        for cut in 1..stream.len() {
            let mut framer = Framer::new([0u8; 12]);
            let mut kinds = heapless::Vec::<(u8, usize), 4>::new();
            for part in [&stream[..cut], &stream[cut..]] {
                assert_eq!(framer.feed(part), part.len());
                while let Some(p) = framer.next().unwrap() {
                    kinds.push((p.kind, p.body.len())).unwrap();
                }
            }
            assert_eq!(kinds[..], [(83, 0), (85, 2), (86, 1)], "cut at {cut}");
        }
    }

    #[test]
    fn impossible_sizes_are_latched() {
        let mut framer = Framer::new([0u8; 8]);
        framer.feed(&[0, 2, 85]);
        let short = Err(FrameError::TooShort { size: 2 });
        assert_eq!(framer.next(), short);
        framer.feed(&[0, 3, 83]);
        assert_eq!(framer.next(), short);
        framer.clear();
        framer.feed(&[0, 9, 85]);
        assert_eq!(framer.next(), Err(FrameError::TooLong { size: 9, capacity: 8 }));
    }

    #[test]
    fn space_never_runs_out_while_a_package_is_incomplete() {
        let mut framer = Framer::new([0u8; 8]);
        for round in 0..50u8 {
            for b in [0, 8, 85, round, 1, 2, 3, 4] {
                assert!(!framer.space().is_empty());
                assert_eq!(framer.feed(&[b]), 1);
            }
            assert_eq!(framer.next().unwrap().map(|p| p.body[0]), Some(round));
        }
    }
}
