//! The general-purpose registers through which clients and programs exchange values.
//!
//! Pure. Runs on the controller's thread, does not allocate, and cannot fail: callers check register numbers first.

/// Number of int registers and of double registers in each direction (UR's RTDE guide, "Field names and associated types").
pub const NUMBERS: usize = 48;
/// Number of bit registers in each direction (UR's RTDE guide, "Field names and associated types").
pub const BITS: usize = 128;

/// The values of all registers of one direction.
#[derive(Debug, Clone, PartialEq)]
pub struct Registers {
    /// The int registers 0 to 47.
    pub int: [i32; NUMBERS],
    /// The double registers 0 to 47.
    pub double: [f64; NUMBERS],
    /// The bit registers 0 to 127; bit n of this number is register n.
    pub bits: u128,
}

impl Default for Registers {
    fn default() -> Self {
        Self { int: [0; NUMBERS], double: [0.0; NUMBERS], bits: 0 }
    }
}

impl Registers {
    /// The bit register `n`, 0 to 127.
    pub fn bit(&self, n: usize) -> bool {
        self.bits >> n & 1 == 1
    }

    /// Sets the bit register `n`, 0 to 127.
    pub fn set_bit(&mut self, n: usize, on: bool) {
        self.bits = self.bits & !(1 << n) | (u128::from(on) << n);
    }

    /// The 32 bit registers from `first` (0 to 96) on; the lowest bit is register `first`.
    pub fn word(&self, first: u8) -> u32 {
        (self.bits >> first) as u32
    }

    /// Sets the 32 bit registers from `first` (0 to 96) on; the lowest bit goes to register `first`.
    pub fn set_word(&mut self, first: u8, word: u32) {
        self.bits = self.bits & !(0xFFFF_FFFF << first) | (u128::from(word) << first);
    }
}
