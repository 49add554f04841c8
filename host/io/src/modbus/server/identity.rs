//! Who a server is (function 43, type 14): texts by number.
//!
//! Pure. Source: Modbus application protocol V1.1b3, section 6.21.

use super::super::{exception::Exception, request::Answer};

/// Bytes of one text: all of them fit in one answer.
const TEXT_BYTES_MAX: usize = 30;
/// The objects that every device must have: maker, product code, revision.
const BASIC: usize = 3;
/// Regular objects, and each can be asked for alone.
const CONFORMITY: u8 = 0x82;

/// The texts; each is cut at 30 bytes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Identity {
    texts: Vec<Vec<u8>>,
}

impl Identity {
    /// In the order of the protocol: maker, product code, revision, address on the net, product name, model, application.
    #[must_use]
    pub fn new(texts: [&str; 7]) -> Self {
        let cut = |text: &str| {
            let end = (0..=TEXT_BYTES_MAX.min(text.len()))
                .rev()
                .find(|end| text.is_char_boundary(*end))
                .unwrap_or(0);
            text.as_bytes().get(..end).unwrap_or_default().to_vec()
        };
        Self {
            texts: texts.into_iter().map(cut).collect(),
        }
    }

    /// `depth` is 1 basic, 2 regular, 3 extended, 4 the one object `object`; below 4, from `object` on.
    pub(super) fn answer(&self, depth: u8, object: u8) -> Result<Answer, Exception> {
        let numbered = |(number, text): (usize, &Vec<u8>)| (number as u8, text.clone());
        let all = self.texts.iter().enumerate();
        let objects: Vec<(u8, Vec<u8>)> = match depth {
            4 => {
                let text = self.texts.get(usize::from(object)).ok_or(Exception::ADDRESS)?;
                vec![(object, text.clone())]
            }
            _ => {
                let count = if depth == 1 { BASIC } else { self.texts.len() };
                // One that is beyond begins anew.
                let first = Some(usize::from(object)).filter(|first| *first < count).unwrap_or(0);
                all.take(count).skip(first).map(numbered).collect()
            }
        };
        Ok(Answer::Identity {
            conformity: CONFORMITY,
            next: None,
            objects,
        })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::panic, reason = "tests")]
    use super::*;

    #[test]
    fn depths_and_single_objects() {
        let long = "ä".repeat(40);
        let identity = Identity::new(["maker", "code", "1", "", "name", &long, "app"]);
        let objects = |depth, object| match identity.answer(depth, object) {
            Ok(Answer::Identity { objects, .. }) => objects,
            other => panic!("{other:?}"),
        };
        assert_eq!(objects(1, 0).len(), 3);
        assert_eq!(objects(2, 4).iter().map(|(n, _)| *n).collect::<Vec<_>>(), [4, 5, 6]);
        assert_eq!(objects(3, 99).len(), 7);
        assert_eq!(objects(4, 5), [(5, "ä".repeat(15).into_bytes())]);
        assert_eq!(identity.answer(4, 7), Err(Exception::ADDRESS));
    }
}
