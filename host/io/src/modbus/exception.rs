//! What a Modbus device says when it does not do what it was asked: one code, and its name.
//!
//! Pure. Source: Modbus application protocol V1.1b3, section 7.

use std::fmt;

/// An exception code. Devices send others than the standard's too, so any byte is one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Exception(pub u8);

impl Exception {
    /// The device does not have the function, or not in its present state.
    pub const FUNCTION: Self = Self(1);
    /// The device does not have the address.
    pub const ADDRESS: Self = Self(2);
    /// A number or a count that cannot be.
    pub const VALUE: Self = Self(3);
    /// The device tried and failed.
    pub const FAILURE: Self = Self(4);
    /// It is busy; later it may do.
    pub const BUSY: Self = Self(6);
    /// The gateway has no way to the unit.
    pub const PATH: Self = Self(10);
    /// The gateway's unit does not answer.
    pub const TARGET: Self = Self(11);

    /// The standard's name.
    #[must_use]
    pub const fn name(self) -> &'static str {
        bumpless_core::device_error_name(self.0)
    }
}

impl fmt::Display for Exception {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "exception {}, {}", self.0, self.name())
    }
}
