//! Content hashes: they identify the rig, the gripper and the images that a plan was made with.

use sha2::{Digest, Sha256};
use std::fmt;

/// A SHA-256 hash, printed as hexadecimal digits.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub struct ContentHash(pub [u8; 32]);

impl ContentHash {
    /// Hash of bytes.
    pub fn of(bytes: &[u8]) -> Self {
        Self(Sha256::digest(bytes).into())
    }

    /// The first eight bytes as a big-endian number: the short identity in frames and set-points.
    pub fn short(&self) -> u64 {
        self.0.iter().take(8).fold(0, |a, b| (a << 8) | u64::from(*b))
    }

    /// Parses 64 hexadecimal digits; `None` if the text is anything else.
    pub fn parse(text: &str) -> Option<Self> {
        let b = text.as_bytes();
        if b.len() != 64 {
            return None;
        }
        let mut out = [0u8; 32];
        for (o, pair) in out.iter_mut().zip(b.chunks_exact(2)) {
            let hi = char::from(*pair.first()?).to_digit(16)?;
            let lo = char::from(*pair.get(1)?).to_digit(16)?;
            *o = u8::try_from(hi * 16 + lo).ok()?;
        }
        Some(Self(out))
    }
}

impl fmt::Display for ContentHash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|b| write!(f, "{b:02x}"))
    }
}

impl fmt::Debug for ContentHash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{self}")
    }
}

/// A running hash over the bits of numbers. It identifies the values of a rig or gripper, not the comments of its file.
pub(super) struct Numbers(Sha256);

impl Numbers {
    pub(super) fn new(kind: &str) -> Self {
        let mut h = Sha256::new();
        h.update(kind.as_bytes());
        Self(h)
    }

    pub(super) fn add(&mut self, values: &[f64]) {
        for v in values {
            // Negative zero hashes as zero.
            self.0.update((v + 0.0).to_bits().to_le_bytes());
        }
    }

    pub(super) fn finish(self) -> ContentHash {
        ContentHash(self.0.finalize().into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_hash_and_its_text_form() {
        let h = ContentHash::of(b"abc");
        assert_eq!(h.to_string(), "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
        assert_eq!(h.short(), 0xba78_16bf_8f01_cfea);
        assert_eq!(ContentHash::parse(&h.to_string()), Some(h));
        assert_eq!(ContentHash::parse("ba78"), None);
        assert_eq!(ContentHash::parse(&"g".repeat(64)), None);
    }
}
