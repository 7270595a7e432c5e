//! General-purpose registers and I/O signals.

/// Number of integer and of float registers per direction.
pub(super) const REGISTERS: usize = 48;

/// General-purpose registers of one direction.
#[derive(Clone, Debug, PartialEq)]
pub struct Registers {
    /// Boolean registers 0 to 127, one bit each.
    pub bits: u128,
    /// Integer registers.
    pub ints: [i32; REGISTERS],
    /// Float registers.
    pub doubles: [f64; REGISTERS],
}

impl Default for Registers {
    fn default() -> Self {
        Registers { bits: 0, ints: [0; REGISTERS], doubles: [0.0; REGISTERS] }
    }
}

impl Registers {
    /// Boolean registers `32 * word` to `32 * word + 31`.
    pub fn word(&self, word: usize) -> u32 {
        (self.bits >> (32 * word.min(3))) as u32
    }

    /// Sets boolean registers `32 * word` to `32 * word + 31`.
    pub fn set_word(&mut self, word: usize, value: u32) {
        let shift = 32 * word.min(3);
        self.bits = self.bits & !(0xffff_ffff_u128 << shift) | u128::from(value) << shift;
    }

    /// One boolean register; false beyond 127.
    pub fn bit(&self, i: usize) -> bool {
        i < 128 && self.bits >> i & 1 == 1
    }

    /// Sets one boolean register; ignores numbers beyond 127.
    pub fn set_bit(&mut self, i: usize, value: bool) {
        if i < 128 {
            self.bits = self.bits & !(1 << i) | u128::from(value) << i;
        }
    }
}

/// Digital and analog signals of the control box and the tool.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct Signals {
    /// Digital inputs: 0..7 standard, 8..15 configurable, 16 and 17 tool.
    pub digital_in: u64,
    /// Digital outputs: 0..7 standard, 8..15 configurable, 16 and 17 tool.
    pub digital_out: u64,
    /// Standard analog inputs 0 and 1, A or V.
    pub analog_in: [f64; 2],
    /// Standard analog outputs 0 and 1, A or V.
    pub analog_out: [f64; 2],
    /// Bits 0, 1 inputs, 2, 3 outputs: 0 current, 1 voltage.
    pub analog_types: u32,
    /// Tool supply, V: 0, 12 or 24.
    pub tool_voltage: i32,
}

impl Signals {
    /// Sets the outputs selected by `mask` (starting at bit `shift`) to `values`.
    pub fn set_outputs(&mut self, shift: u32, mask: u8, values: u8) {
        let (mask, values) = (u64::from(mask) << shift, u64::from(values) << shift);
        self.digital_out = self.digital_out & !mask | values & mask;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_and_bits_access_the_same_registers() {
        let mut r = Registers::default();
        r.set_word(1, 0x8000_0001);
        assert!(r.bit(32) && r.bit(63) && !r.bit(33));
        r.set_bit(127, true);
        assert_eq!(r.word(3), 0x8000_0000);
        r.set_bit(128, true);
        assert!(!r.bit(128));
    }

    #[test]
    fn outputs_outside_the_mask_are_kept() {
        let mut s = Signals { digital_out: 0b1010, ..Signals::default() };
        s.set_outputs(0, 0b0011, 0b0001);
        assert_eq!(s.digital_out, 0b1001);
        s.set_outputs(16, 0b11, 0b10);
        assert_eq!(s.digital_out, 0b10_0000_0000_0000_1001);
    }
}
