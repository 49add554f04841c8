//! A test guest: a controller that also wants an interface that no host gives.
//!
//! Never: used outside tests.

use bumpless_sdk::prelude::*;
use guest_countdown::{Countdown, Misdeed};

#[allow(missing_docs, unsafe_code, unused_qualifications, reason = "generated code")]
#[allow(clippy::all, clippy::allow_attributes_without_reason, reason = "generated code")]
mod bindings {
    wit_bindgen::generate!({
        inline: "
            package outside:disk@1.0.0;
            interface files {
                remove: func(path: string) -> u32;
            }
            world wants-files {
                import files;
            }
        ",
    });
}

struct ForbiddenImport;

impl Misdeed for ForbiddenImport {
    const NAME: &'static str = "forbidden-import";
    const TEXT: &'static str = "Imports what no host gives";

    fn strike(_: &Parameters<'_>, _: &mut Io<'_>, _: f64) -> Result<(), Fault> {
        match bindings::outside::disk::files::remove("/") {
            0 => Ok(()),
            _ => Err(Fault::failed("the files are still there")),
        }
    }
}

bumpless_sdk::export!(Countdown<ForbiddenImport>);
