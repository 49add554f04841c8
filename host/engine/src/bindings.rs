//! Generated host bindings of the world `controller`. Private: only `convert`, `imports` and `sandbox` see them.
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
    world: "controller",
    imports: { default: trappable },
});
