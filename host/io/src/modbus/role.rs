//! The role that a client's certificate gives it (Modbus/TCP Security).
//!
//! Pure. Source: MODBUS/TCP Security protocol specification v21, section 8: one UTF-8 text under the object identifier
//! 1.3.6.1.4.1.50316.802.1 among the certificate's extensions; a certificate without it has no role. Never: says what a role
//! may do; the map does.

/// Where a certificate has the role: 1.3.6.1.4.1.50316.802.1, as X.690 section 8.19 writes it.
const ROLE: [u8; 11] = [0x2B, 6, 1, 4, 1, 0x83, 0x89, 0x0C, 0x86, 0x22, 1];

/// Tags of X.690 that are met on the way.
const SEQUENCE: u8 = 0x30;
const OBJECT: u8 = 0x06;
const OCTETS: u8 = 0x04;
const UTF8: u8 = 0x0C;
/// Of a certificate (RFC 5280, section 4.1): its extensions.
const EXTENSIONS: u8 = 0xA3;

/// Characters of a role; a longer one is none.
pub const ROLE_CHARS_MAX: usize = 64;

/// Can this text be a role? 1 to [`ROLE_CHARS_MAX`] characters, none of them a control character.
#[must_use]
pub fn is_role(text: &str) -> bool {
    (1..=ROLE_CHARS_MAX).contains(&text.chars().count()) && !text.chars().any(char::is_control)
}

/// The role in a certificate (DER), which the TLS handshake has verified before. None where there is none, or more than
/// one, or no text: whoever is not sure of its role has none.
#[must_use]
pub fn role_of(certificate: &[u8]) -> Option<String> {
    let signed = Parts(Parts(certificate).only(SEQUENCE)?)
        .find(|(tag, _)| *tag == SEQUENCE)?
        .1;
    let extensions = Parts(signed).find(|(tag, _)| *tag == EXTENSIONS)?.1;
    let mut roles = Parts(Parts(extensions).only(SEQUENCE)?).filter_map(|(_, extension)| {
        // Its name, perhaps whether it is critical, and its value.
        let mut parts = Parts(extension);
        let named = parts.next()? == (OBJECT, ROLE.as_slice());
        let (_, value) = parts.find(|(tag, _)| *tag == OCTETS)?;
        named.then_some(value)
    });
    let (role, None) = (roles.next()?, roles.next()) else {
        return None;
    };
    let text = std::str::from_utf8(Parts(role).only(UTF8)?).ok()?;
    is_role(text).then(|| text.to_owned())
}

/// The parts of some DER, one after the other: tag and content. What is cut off or has a longer tag ends it.
struct Parts<'a>(&'a [u8]);

impl<'a> Parts<'a> {
    /// The content of the only part, of this tag.
    fn only(mut self, tag: u8) -> Option<&'a [u8]> {
        let (found, content) = self.next()?;
        (found == tag && self.0.is_empty()).then_some(content)
    }
}

impl<'a> Iterator for Parts<'a> {
    type Item = (u8, &'a [u8]);

    fn next(&mut self) -> Option<Self::Item> {
        let (&tag, rest) = self.0.split_first()?;
        let (&first, mut rest) = rest.split_first()?;
        let mut length = usize::from(first);
        if first >= 0x80 {
            // So many bytes of length follow; a certificate needs no more than three.
            let (bytes, behind) = rest
                .split_at_checked(usize::from(first & 0x7f))
                .filter(|(b, _)| (1..=3).contains(&b.len()))?;
            length = bytes.iter().fold(0, |length, byte| length << 8 | usize::from(*byte));
            rest = behind;
        }
        let (content, behind) = rest.split_at_checked(length)?;
        self.0 = behind;
        Some((tag, content))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]

    use std::path::Path;

    use proptest::prelude::*;
    use tokio_rustls::rustls::pki_types::{CertificateDer, pem::PemObject as _};

    use super::*;

    fn certificate(name: &str) -> Vec<u8> {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/modbus/tls");
        CertificateDer::from_pem_file(folder.join(name)).unwrap().to_vec()
    }

    #[test]
    fn a_certificate_has_one_role_or_none() {
        for (name, role) in [
            ("operator.pem", Some("operator")),
            ("viewer.pem", Some("viewer")),
            ("host.pem", None),
        ] {
            assert_eq!(role_of(&certificate(name)).as_deref(), role, "{name}");
        }
        assert_eq!(role_of(b"no certificate"), None);
        assert!(is_role("Ingénieur 2") && !is_role("") && !is_role("a\nb") && !is_role(&"x".repeat(65)));
    }

    proptest! {
        #[test]
        fn bytes_that_are_no_certificate_are_no_role(position in 0_usize..2_000, bit in 0_u8..8, end in 0_usize..2_000) {
            let mut bytes = certificate("operator.pem");
            let length = bytes.len();
            if let Some(byte) = bytes.get_mut(position % length) {
                *byte ^= 1 << bit;
            }
            bytes.truncate(end.min(length));
            // Whatever it says, it does not panic and gives no text that is no role.
            prop_assert!(role_of(&bytes).is_none_or(|role| is_role(&role)));
        }
    }
}
