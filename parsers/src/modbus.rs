//! Modbus both ways: what clients ask of our server, what devices answer, and who a certificate says that it is.
//!
//! Never: a socket.

#![allow(clippy::expect_used, reason = "a target shows a fault by a panic")]

use bumpless_io::modbus::{
    Exception, Request,
    frame::{self, Cut},
    role,
};

/// A stream of a client, frame after frame. A request that was read is written, and read again as the same.
pub(crate) fn server(bytes: &[u8]) {
    let mut rest = bytes;
    while let Cut::Frame { pdu, end, .. } = frame::cut_header(rest) {
        if let Ok(request) = Request::parse(rest.get(pdu).expect("a frame lies within its stream")) {
            let again = Request::parse(&request.encode()).expect("what was written can be read");
            assert_eq!(again, request);
            let _refusal = request.respond(&Err(Exception::FUNCTION));
        }
        assert!(end > 0);
        rest = rest.get(end..).expect("a frame ends within its stream");
    }
    // Without a frame too, as it is on a serial line: then more inputs come so far.
    if let Ok(request) = Request::parse(bytes) {
        assert_eq!(Request::parse(&request.encode()).as_ref(), Ok(&request));
    }
}

/// A request, its length first, and what a device answers to it: behind a frame, and on a line with noise.
pub(crate) fn client(bytes: &[u8]) {
    let Some((&length, rest)) = bytes.split_first() else {
        return;
    };
    let Some((asked, answer)) = rest.split_at_checked(usize::from(length)) else {
        return;
    };
    let Ok(request) = Request::parse(asked) else { return };
    let _answer = request.answer(answer);
    if let Ok(answer) = request.answer(answer) {
        // What a device could say is what our server could say.
        let pdu = request.respond(&Ok(answer.clone()));
        assert_eq!(request.answer(&pdu).as_ref(), Ok(&answer));
    }
    let function = asked.first().copied().unwrap_or_default();
    let unit = answer.first().copied().unwrap_or_default();
    if let Some(found) = frame::find_answer(answer, unit, function) {
        let _answer = request.answer(answer.get(found).expect("an answer lies within its line"));
    }
    // The same with a good checksum, which is found by chance too seldom.
    let whole = frame::with_checksum(unit, answer);
    if let Some(found) = frame::find_answer(&whole, unit, function) {
        let _answer = request.answer(whole.get(found).expect("an answer lies within its line"));
    }
    if let Cut::Frame { pdu, .. } = frame::cut_header(answer) {
        let _answer = request.answer(answer.get(pdu).expect("a frame lies within its stream"));
    }
}

/// A certificate. A role that was found is one.
pub(crate) fn role(bytes: &[u8]) {
    if let Some(found) = role::role_of(bytes) {
        assert!(role::is_role(&found), "{found:?}");
    }
}
