//! The form of the state bytes of every component that is built with this SDK.
//!
//! ```text
//!   offset  size  what
//!   0       1     mark and version of this form: 0xB1
//!   1       1     n, length of the component's name, 1 to 32
//!   2       n     the name
//!   2+n     4     state layout, little endian
//!   6+n     1     m, number of parameters, at most 128
//!   7+n     8·m   the parameters' values, IEEE 754, little endian, in the table's order
//!   7+n+8m  …     the law's state, postcard
//! ```
//! The front does not change from step to step, so a step decodes the rear, and writes it back behind the same front.
//! Never: trusts a length; every read is bounded, and bytes that are left over are an error.

use serde::{Serialize, de::DeserializeOwned};

use crate::{Description, Fault, Parameters};

/// First byte; another value is another form.
pub const MARK: u8 = 0xB1;

/// State bytes, taken apart in place.
#[derive(Debug, Clone, Copy)]
pub struct Envelope<'a> {
    /// Name of the component that wrote them.
    pub name: &'a [u8],
    /// Its state layout.
    pub layout: u32,
    /// The values that it ran with.
    pub parameters: Parameters<'a>,
    /// The law's state, postcard.
    pub law: &'a [u8],
}

fn split(bytes: &[u8], at: usize) -> Result<(&[u8], &[u8]), Fault> {
    bytes
        .split_at_checked(at)
        .ok_or_else(|| Fault::bad_state("the state ends too early"))
}

impl<'a> Envelope<'a> {
    /// Takes the bytes apart, or says with [`Fault::BadState`] why they are no state of this form.
    pub fn parse(bytes: &'a [u8]) -> Result<Self, Fault> {
        let (head, rest) = split(bytes, 2)?;
        let [MARK, name_length] = *head else {
            return Err(Fault::bad_state("the state is not of this SDK's form"));
        };
        let (name, rest) = split(rest, usize::from(name_length))?;
        let (layout, rest) = split(rest, 4)?;
        let (count, rest) = split(rest, 1)?;
        let count = count.first().copied().map_or(0, usize::from);
        let (values, law) = split(rest, 8 * count)?;
        let layout = layout.try_into().map_or(0, u32::from_le_bytes);
        Ok(Self {
            name,
            layout,
            parameters: Parameters::over(values),
            law,
        })
    }

    /// The law's state. Fails with [`Fault::BadState`] where it does not decode, or bytes are left over.
    pub fn law<T: DeserializeOwned>(&self) -> Result<T, Fault> {
        match postcard::take_from_bytes(self.law) {
            Ok((state, [])) => Ok(state),
            _ => Err(Fault::bad_state("the law's state does not decode")),
        }
    }

    /// Where the law's state begins.
    pub(crate) const fn law_offset(&self) -> usize {
        7 + self.name.len() + 8 * self.parameters.count()
    }

    /// Is it a state that a component of this description wrote, in its present layout?
    #[must_use]
    pub fn is_of(&self, description: &Description) -> bool {
        self.name == description.name.as_bytes()
            && self.layout == description.state_layout
            && self.parameters.count() == description.parameters.len()
    }
}

/// The front part for a component and its parameters; the law's state goes behind it.
pub(crate) fn front(description: &Description, parameters: &[f64]) -> Vec<u8> {
    // Checked while compiling (`Description::check`): a name has at most 32 bytes, and there are at most 128 parameters.
    let (name, count) = (description.name.as_bytes(), parameters.len().min(128));
    let mut bytes = Vec::with_capacity(7 + name.len() + 8 * count + 64);
    bytes.push(MARK);
    bytes.push(name.len().min(255) as u8);
    bytes.extend_from_slice(name);
    bytes.extend_from_slice(&description.state_layout.to_le_bytes());
    bytes.push(count as u8);
    for value in parameters.iter().take(count) {
        bytes.extend_from_slice(&value.to_le_bytes());
    }
    bytes
}

/// Puts the law's state behind a front part.
pub(crate) fn close<T: Serialize>(front: Vec<u8>, law: &T) -> Result<Vec<u8>, Fault> {
    postcard::to_extend(law, front).map_err(|_| Fault::bad_state("the law's state does not encode"))
}
