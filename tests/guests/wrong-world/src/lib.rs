//! A test guest: a sound component, but no controller.
//!
//! Never: used outside tests.

#[allow(missing_docs, unsafe_code, unused_qualifications, reason = "generated code")]
#[allow(clippy::all, clippy::allow_attributes_without_reason, reason = "generated code")]
mod bindings {
    wit_bindgen::generate!({
        inline: "
            package outside:greeting@1.0.0;
            world greeter {
                export greet: func(name: string) -> string;
            }
        ",
    });

    struct Greeter;

    impl Guest for Greeter {
        fn greet(name: String) -> String {
            ["Hello, ", &name].concat()
        }
    }

    export!(Greeter with_types_in self);
}
