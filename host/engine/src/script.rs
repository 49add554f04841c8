//! Scripts that ride in a component: a custom section at the end of an interpreter's bytes.
//!
//! ```text
//! component ── wrap(component, name, version, script) ──► component + section ── split ──► component, script
//! ```
//! Owns: the section's form. A component with a script is a component like any other: it has a digest, and travels and is kept
//! like one. Its code is the interpreter's, so many scripts share what is compiled of it once.
//! Never: reads what the script says.

use crate::Error;

/// The section's name.
const SECTION: &str = "bumpless:script";
/// Bytes before the first section: magic, version, layer.
const PREAMBLE_BYTES: usize = 8;
/// Id of a custom section.
const CUSTOM: u8 = 0;
/// Bytes of a script: beyond it, what was uploaded is no script of a person.
pub const SCRIPT_BYTES_MAX: usize = 256 * 1024;
/// Bytes of a script's name, and of its version.
const NAME_BYTES_MAX: usize = 64;

/// A script with what it is called.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Script {
    /// Its name in the library.
    pub name: String,
    /// Its semantic version.
    pub version: String,
    /// Its text, byte by byte as it was uploaded.
    pub text: Vec<u8>,
}

/// An interpreter with a script.
///
/// # Errors
/// [`Error::Script`] for a component that has one already, and for a script that is too long.
pub fn wrap(component: &[u8], script: &Script) -> Result<Vec<u8>, Error> {
    let wrong = |reason: String| Err(Error::Script { reason });
    if split(component).1.is_some() {
        return wrong("the interpreter has a script in it already; use one without".to_owned());
    }
    if script.text.len() > SCRIPT_BYTES_MAX {
        return wrong(format!(
            "the script has {} bytes; at most {SCRIPT_BYTES_MAX} are accepted",
            script.text.len()
        ));
    }
    if script.name.len() > NAME_BYTES_MAX || script.version.len() > NAME_BYTES_MAX {
        return wrong(format!("name and version have at most {NAME_BYTES_MAX} bytes each"));
    }
    let mut payload = Vec::with_capacity(script.text.len() + 256);
    for text in [SECTION, &script.name, &script.version] {
        push_length(&mut payload, text.len());
        payload.extend_from_slice(text.as_bytes());
    }
    payload.extend_from_slice(&script.text);
    let mut wrapped = Vec::with_capacity(component.len() + payload.len() + 8);
    wrapped.extend_from_slice(component);
    wrapped.push(CUSTOM);
    push_length(&mut wrapped, payload.len());
    wrapped.extend_from_slice(&payload);
    Ok(wrapped)
}

/// A component without its script, and the script. Only a last section counts; bytes that are no component come back whole.
#[must_use]
pub fn split(bytes: &[u8]) -> (&[u8], Option<Script>) {
    let mut at = PREAMBLE_BYTES;
    while let Some(&id) = bytes.get(at) {
        let Some((size, payload_at)) = length(bytes, at + 1) else {
            return (bytes, None);
        };
        let Some(end) = payload_at.checked_add(size).filter(|end| *end <= bytes.len()) else {
            return (bytes, None);
        };
        if end == bytes.len() && id == CUSTOM {
            let script = bytes.get(payload_at..end).and_then(read);
            return match (script, bytes.get(..at)) {
                (Some(script), Some(code)) => (code, Some(script)),
                _ => (bytes, None),
            };
        }
        at = end;
    }
    (bytes, None)
}

fn read(payload: &[u8]) -> Option<Script> {
    let mut at = 0;
    let mut next = || {
        let (size, from) = length(payload, at)?;
        at = from.checked_add(size)?;
        std::str::from_utf8(payload.get(from..at)?).ok()
    };
    if next()? != SECTION {
        return None;
    }
    let (name, version) = (next()?.to_owned(), next()?.to_owned());
    Some(Script {
        name,
        version,
        text: payload.get(at..)?.to_vec(),
    })
}

/// LEB128 of at most 32 bits, as WebAssembly writes lengths.
fn length(bytes: &[u8], mut at: usize) -> Option<(usize, usize)> {
    let mut value = 0_u64;
    for shift in (0..35).step_by(7) {
        let byte = *bytes.get(at)?;
        at += 1;
        value |= u64::from(byte & 0x7f) << shift;
        if byte & 0x80 == 0 {
            return Some((usize::try_from(value).ok()?, at));
        }
    }
    None
}

fn push_length(out: &mut Vec<u8>, mut value: usize) {
    loop {
        let byte = (value & 0x7f) as u8;
        value >>= 7;
        if value == 0 {
            out.push(byte);
            return;
        }
        out.push(byte | 0x80);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use super::*;

    const EMPTY: &[u8] = b"\0asm\x0d\0\x01\0";

    fn script(text: &[u8]) -> Script {
        Script {
            name: "level".into(),
            version: "1.2.0".into(),
            text: text.to_vec(),
        }
    }

    #[test]
    fn a_script_comes_back_byte_by_byte() {
        for text in [&b""[..], b"print(1)\r\n\xff\0", &[b'x'; 100_000]] {
            let wrapped = wrap(EMPTY, &script(text)).unwrap();
            assert_eq!(split(&wrapped), (EMPTY, Some(script(text))));
        }
    }

    #[test]
    fn what_has_none_comes_back_whole_and_what_cannot_is_refused_in_words() {
        let wrapped = wrap(EMPTY, &script(b"x")).unwrap();
        for bytes in [EMPTY, b"", b"\0asm", wrapped.get(..wrapped.len() - 1).unwrap()] {
            assert_eq!(split(bytes), (bytes, None));
        }
        let error = wrap(&wrapped, &script(b"y")).unwrap_err().to_string();
        assert!(error.contains("has a script in it already"), "{error}");
        let error = wrap(EMPTY, &script(&vec![0; SCRIPT_BYTES_MAX + 1]))
            .unwrap_err()
            .to_string();
        assert!(error.contains("at most 262144"), "{error}");
    }
}
