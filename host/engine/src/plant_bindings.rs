//! Generated host bindings of the world `plant`. Private: only `plant` sees them. What both worlds import is implemented
//! once, for the bindings of `controller`.
//!
//! Never: edited or extended here; the interfaces are the files in `wit/`.

#![allow(
    missing_docs,
    unreachable_pub,
    unused_qualifications,
    clippy::all,
    reason = "generated code; its documentation is in the interface files"
)]

wasmtime::component::bindgen!({
    path: "../../wit",
    world: "plant",
    imports: { default: trappable },
    with: {
        "bumpless:control/types": crate::bindings::bumpless::control::types,
        "bumpless:control/log": crate::bindings::bumpless::control::log,
    },
});
