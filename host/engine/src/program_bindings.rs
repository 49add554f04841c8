//! Generated host bindings of the world `program`. Private: only `program` sees them.
//!
//! Never: edited or extended here; the interfaces are the files in `wit/`.

#![allow(
    missing_docs,
    unreachable_pub,
    unused_qualifications,
    clippy::all,
    clippy::pedantic,
    reason = "generated code; its documentation is in the interface files"
)]

wasmtime::component::bindgen!({
    path: "../../wit",
    world: "program",
    imports: {
        "bumpless:control/points.read": async | trappable,
        "bumpless:control/points.write": async | trappable,
        "bumpless:control/clock.sleep-ns": async | trappable,
        "bumpless:control/clock.sleep-until-ns": async | trappable,
        "bumpless:control/topics.publish": async | trappable,
        "bumpless:control/topics.wait": async | trappable,
        "bumpless:control/components.step": async | trappable,
        "bumpless:control/checkpoint.save": async | trappable,
        default: trappable,
    },
    exports: { default: async },
    with: {
        "bumpless:control/types": crate::bindings::bumpless::control::types,
        "bumpless:control/log": crate::bindings::bumpless::control::log,
    },
});
