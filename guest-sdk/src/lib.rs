//! What the author of a controller uses: tables of ports and parameters, the [`Controller`] trait, the [`export!`] macro,
//! control [`blocks`] and, on the author's own machine, a test [`mod@bench`]. Who writes a simulated plant uses [`plant`].
//!
//! Owns the form of the state bytes ([`envelope`]): the SDK keeps the component's name, the layout and the parameter values
//! in front of the law's own state, so that a step needs nothing else and a swap finds everything it may carry over.
//! Never: lets an author's crate see generated bindings, `unsafe` or a wasm target; a controller is an ordinary `rlib`
//! natively, and becomes a component only on `wasm32`.
//!
//! ```
//! use bumpless_sdk::prelude::*;
//! use serde::{Deserialize, Serialize};
//!
//! const PORTS: &[PortSpec] = &[
//!     PortSpec::analog_input("pv", "", "Measurement").required(),
//!     PortSpec::analog_output("out", "%", "To the actuator").required(),
//! ];
//! const PARAMETERS: &[ParameterSpec] = &[ParameterSpec::number("k", "%", 1.0, 0.0, 100.0, "Gain")];
//! // Looked up while compiling: a name that is not in the table does not build.
//! const PV: Input = Input::of(PORTS, "pv");
//! const OUT: Output = Output::of(PORTS, "out");
//! const K: Parameter = Parameter::of(PARAMETERS, "k");
//!
//! /// Integrates the error: state is the output itself.
//! struct Integrator;
//!
//! #[derive(Serialize, Deserialize)]
//! struct Sum(f64);
//!
//! impl Controller for Integrator {
//!     const DESCRIPTION: Description = Description {
//!         name: "integrator",
//!         version: "1.0.0",
//!         text: "Pure integral control",
//!         ports: PORTS,
//!         parameters: PARAMETERS,
//!         state_layout: 1,
//!     };
//!     type State = Sum;
//!
//!     fn start(_: &Parameters<'_>, track: &Track<'_>) -> Result<Sum, Fault> {
//!         Ok(Sum(track.of(OUT)))
//!     }
//!
//!     fn step(state: &mut Sum, parameters: &Parameters<'_>, cycle: &Cycle, io: &mut Io<'_>) -> Result<(), Fault> {
//!         let pv = io.read(PV).value;
//!         state.0 += parameters.of(K) * (cycle.setpoint - pv) * cycle.dt_s();
//!         io.write(OUT, state.0);
//!         Ok(())
//!     }
//! }
//!
//! bumpless_sdk::export!(Integrator);
//!
//! # #[cfg(not(target_arch = "wasm32"))] {
//! use bumpless_sdk::bench::Bench;
//! let mut bench = Bench::<Integrator>::start(&[("k", 2.0)], &[40.0]).unwrap();
//! bench.set(PV, 3.0);
//! bench.set_setpoint(5.0);
//! assert_eq!(bench.step(0.5).unwrap(), [42.0]);
//! # }
//! ```

// The generated export macro names this crate by its public name, also where the crate itself uses it.
extern crate self as bumpless_sdk;

mod table;
pub use table::{Description, Direction, Input, Kind, Output, Parameter, ParameterSpec, PortSpec, joined};

mod controller;
pub use controller::{Controller, Origin, Parameters, Track};

mod io;
pub use io::{Cycle, Fault, Io, Level, Message, Mode, Priority, Quality, Reading};

pub mod blocks;
pub mod envelope;
pub mod plant;
pub mod program;

#[doc(hidden)]
pub mod glue;

#[doc(hidden)]
pub mod bindings;

#[doc(hidden)]
pub mod plant_bindings;

#[doc(hidden)]
pub mod program_bindings;

#[cfg(target_arch = "wasm32")]
mod imports;

#[cfg(not(target_arch = "wasm32"))]
pub mod bench;

/// Everything that a controller's file needs.
pub mod prelude {
    pub use crate::{
        Controller, Cycle, Description, Fault, Input, Io, Level, Mode, Origin, Output, Parameter, ParameterSpec,
        Parameters, PortSpec, Priority, Quality, Reading, Track, joined,
    };
}

/// Makes a [`Controller`] the component of this crate. Does nothing but check the tables on targets other than `wasm32`.
///
/// The tables are checked while compiling: names, unique names, ranges, an output. A controller whose description the
/// host would refuse does not build.
#[macro_export]
macro_rules! export {
    ($controller:ty) => {
        const _: () = <$controller as $crate::Controller>::DESCRIPTION.check();

        #[cfg(target_arch = "wasm32")]
        const _: () = {
            type Component = $crate::glue::Glue<$controller>;
            $crate::export_unchecked!(Component);
        };
    };
}

/// Says what a controller's state consists of, for those who look at one: `bumpless loop step` then shows it by name. One text per
/// value, in the order of the type's fields: `"name: type"`, where a type is `bool`, `u8` to `u64`, `i8` to `i64`, `f32`, `f64`,
/// `text` (a `String`), `hex8` (a `u8` of bits), `option<T>`, `seq<T>` (a `Vec`), `3*T` (an array), `(T, T)` (a tuple, or a structure
/// within), `enum(a,b)` (without payloads). The text goes into a custom section of the component and costs nothing at run time.
///
/// ```
/// bumpless_sdk::state_form!("integral: f64", "last: option<f64>");
/// ```
#[macro_export]
macro_rules! state_form {
    ($($value:literal),+ $(,)?) => {
        #[cfg(target_arch = "wasm32")]
        #[allow(unsafe_code, reason = "a section of a component is named; nothing reads or writes it as memory")]
        const _: () = {
            const TEXT: &str = concat!("postcard 1\n", $($value, "\n"),+);
            #[used]
            #[unsafe(link_section = "bumpless:state")]
            static SECTION: [u8; TEXT.len()] = $crate::glue::bytes_of(TEXT);
        };
    };
}

/// Makes an implementation of the generated `Guest` trait the component of this crate, without any check.
#[doc(hidden)]
#[macro_export]
macro_rules! export_unchecked {
    ($guest:ident) => {
        #[cfg(target_arch = "wasm32")]
        #[allow(
            unsafe_code,
            reason = "the component model's exports are C functions; the generated code is their only user"
        )]
        const _: () = {
    $crate::bindings::export_component!($guest with_types_in $crate::bindings);
        };
    };
}
