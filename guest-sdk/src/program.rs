//! What the author of a free-running program uses: the [`Program`] trait, [`export_program!`](crate::export_program), and what a
//! program may ask its host for.
//!
//! ```text
//!   run(script, checkpoint) ── reads, writes, waits, publishes, saves ── returns: the program has ended
//!        ▲                                                        │
//!        └──── started again, here or on another host ◄── last saved
//! ```
//! A program is stopped, paused and resumed from outside, at any instruction; it need not ask whether it shall.
//! Never: state that a later run needs and that was not saved.
//!
//! ```
//! use bumpless_sdk::program::{Fault, Program, clock, points};
//!
//! /// Lets a pump follow a level, twice a second.
//! struct Follow;
//!
//! impl Program for Follow {
//!     const NAME: &'static str = "follow";
//!     const VERSION: &'static str = "1.0.0";
//!     const TEXT: &'static str = "A pump follows a level";
//!
//!     fn run(_: Vec<u8>, _: Option<Vec<u8>>) -> Result<(), Fault> {
//!         let find = |name: &str| points::find(name).ok_or(Fault::Failed(format!("grant the point {name}")));
//!         let (level, pump) = (find("level")?, find("pump")?);
//!         let mut next_ns = clock::now_ns();
//!         loop {
//!             let seen = points::read(level);
//!             points::write(pump, seen.value / 2.0).map_err(Fault::Failed)?;
//!             next_ns += 500_000_000;
//!             clock::sleep_until_ns(next_ns);
//!         }
//!     }
//! }
//!
//! bumpless_sdk::export_program!(Follow);
//! ```

pub use crate::{
    bindings::bumpless::control::{
        log::{Level, write as log},
        types::{Fault, Mode, Quality},
    },
    program_bindings::bumpless::control::{checkpoint, clock, components, points, topics},
};

/// The generated interface, for [`export_program!`](crate::export_program).
#[doc(hidden)]
pub use crate::program_bindings::exports::bumpless::control::free_run as wit;

/// A free-running program.
pub trait Program {
    /// Short name, lower case, digits and dashes; 1 to 32 characters.
    const NAME: &'static str;
    /// Semantic version.
    const VERSION: &'static str;
    /// One line for people.
    const TEXT: &'static str;

    /// Does the work; to return is to end. `script` is what was uploaded with the component, empty for nothing; `checkpoint` what
    /// the last run saved.
    ///
    /// # Errors
    /// Why it cannot go on; the program is then in status Fault, with these words.
    fn run(script: Vec<u8>, checkpoint: Option<Vec<u8>>) -> Result<(), Fault>;
}

/// What a program says of itself.
#[doc(hidden)]
#[must_use]
pub fn describe<P: Program>() -> wit::ProgramDescription {
    wit::ProgramDescription {
        name: P::NAME.into(),
        version: P::VERSION.into(),
        text: P::TEXT.into(),
    }
}

/// Makes a [`Program`] the component of this crate.
#[macro_export]
macro_rules! export_program {
    ($program:ty) => {
        // So that it is looked at natively too.
        const _: fn(
            ::std::vec::Vec<u8>,
            ::std::option::Option<::std::vec::Vec<u8>>,
        ) -> ::std::result::Result<(), $crate::program::Fault> = <$program as $crate::program::Program>::run;

        #[cfg(target_arch = "wasm32")]
        #[allow(
            unsafe_code,
            reason = "the component model's exports are C functions; the generated code is their only user"
        )]
        const _: () = {
            struct Component;

            impl $crate::program::wit::Guest for Component {
                fn describe_program() -> $crate::program::wit::ProgramDescription {
                    $crate::program::describe::<$program>()
                }

                fn run(
                    script: ::std::vec::Vec<u8>,
                    checkpoint: ::std::option::Option<::std::vec::Vec<u8>>,
                ) -> ::std::result::Result<(), $crate::program::Fault> {
                    <$program as $crate::program::Program>::run(script, checkpoint)
                }
            }

    $crate::program_bindings::export_program_component!(Component with_types_in $crate::program_bindings);
        };
    };
}
