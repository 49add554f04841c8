//! What the author of a simulated plant uses: tables of signals and constants, the [`Plant`] trait and
//! [`export_plant!`](crate::export_plant).
//!
//! ```text
//!   begin(constants, seed) ──► plant ──► advance(dt, inputs) ──► view ──► advance …
//! ```
//! Unlike a controller, a plant keeps its state between calls: it is never replicated, and nobody takes it over.
//! Never: anything but constants, seed, inputs and times in what a plant shows.
//!
//! ```
//! use bumpless_sdk::plant::prelude::*;
//!
//! const SIGNALS: &[SignalSpec] = &[
//!     SignalSpec::measures("level", "cm", (0.0, 20.0), "Level of the tank"),
//!     SignalSpec::sets("inflow", "cm3/s", (0.0, 50.0), 0.0, "Into the tank"),
//! ];
//! const CONSTANTS: &[ConstantSpec] = &[ConstantSpec::new("area", "cm2", 28.0, 1.0, 1e4, "Cross section of the tank")];
//! const LEVEL: Signal = Signal::of(SIGNALS, "level");
//! const INFLOW: Signal = Signal::of(SIGNALS, "inflow");
//! const AREA: Constant = Constant::of(CONSTANTS, "area");
//!
//! /// A tank without an outlet.
//! struct Tank {
//!     area: f64,
//!     level: f64,
//! }
//!
//! impl Plant for Tank {
//!     const DESCRIPTION: PlantDescription = PlantDescription {
//!         name: "tank",
//!         version: "1.0.0",
//!         text: "A tank without an outlet",
//!         signals: SIGNALS,
//!         constants: CONSTANTS,
//!     };
//!
//!     fn begin(constants: &Constants<'_>, _: u64) -> Result<Self, Fault> {
//!         Ok(Self { area: constants.of(AREA), level: 0.0 })
//!     }
//!
//!     fn advance(&mut self, dt_s: f64, inputs: &Inputs<'_>) -> Result<(), Fault> {
//!         self.level += inputs.of(INFLOW) / self.area * dt_s;
//!         Ok(())
//!     }
//!
//!     fn show(&self, view: &mut View<'_>) {
//!         view.set(LEVEL, self.level);
//!     }
//! }
//!
//! bumpless_sdk::export_plant!(Tank);
//!
//! let mut tank = Running::<Tank>::begin(&[28.0], 0).unwrap();
//! tank.advance(2_000_000_000, &[0.0, 14.0]).unwrap();
//! assert_eq!(tank.truth(), [1.0, 14.0]);
//! ```

mod motion;
pub use motion::{noise, runge_kutta};

use crate::Fault;
#[doc(hidden)]
pub use crate::plant_bindings::exports::bumpless::control::process as wit;

/// Everything that a plant's file needs.
pub mod prelude {
    pub use super::{
        Constant, ConstantSpec, Constants, Inputs, Plant, PlantDescription, Role, Running, Signal, SignalSpec, View,
        noise, runge_kutta,
    };
    pub use crate::Fault;
}

/// Which way a signal goes, seen from the plant.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Role {
    /// An instrument shows it.
    Measures,
    /// A controller sets it.
    Sets,
    /// The world sets it.
    Disturbs,
}

/// One row of the table of signals.
#[derive(Debug, Clone, Copy)]
pub struct SignalSpec {
    /// 1 to 32 lower-case letters, digits, dots and dashes.
    pub name: &'static str,
    /// Which way it goes.
    pub role: Role,
    /// Unit as text; empty for none.
    pub unit: &'static str,
    /// Least and greatest value.
    pub range: (f64, f64),
    /// Value at the start, of one that is set.
    pub initial: f64,
    /// One line for people.
    pub text: &'static str,
}

impl SignalSpec {
    /// A measurement.
    #[must_use]
    pub const fn measures(name: &'static str, unit: &'static str, range: (f64, f64), text: &'static str) -> Self {
        Self {
            name,
            role: Role::Measures,
            unit,
            range,
            initial: 0.0,
            text,
        }
    }

    /// An actuator, with what it holds at the start.
    #[must_use]
    pub const fn sets(
        name: &'static str,
        unit: &'static str,
        range: (f64, f64),
        initial: f64,
        text: &'static str,
    ) -> Self {
        Self {
            name,
            role: Role::Sets,
            unit,
            range,
            initial,
            text,
        }
    }

    /// A disturbance, with what it is at the start.
    #[must_use]
    pub const fn disturbs(
        name: &'static str,
        unit: &'static str,
        range: (f64, f64),
        initial: f64,
        text: &'static str,
    ) -> Self {
        Self {
            name,
            role: Role::Disturbs,
            unit,
            range,
            initial,
            text,
        }
    }
}

/// One row of the table of constants.
#[derive(Debug, Clone, Copy)]
pub struct ConstantSpec {
    /// 1 to 32 lower-case letters, digits and dashes.
    pub name: &'static str,
    /// Unit as text; empty for none.
    pub unit: &'static str,
    /// Value where nobody sets one.
    pub default: f64,
    /// Least value allowed.
    pub minimum: f64,
    /// Greatest value allowed.
    pub maximum: f64,
    /// One line for people.
    pub text: &'static str,
}

impl ConstantSpec {
    /// A number within a range.
    #[must_use]
    pub const fn new(
        name: &'static str,
        unit: &'static str,
        default: f64,
        minimum: f64,
        maximum: f64,
        text: &'static str,
    ) -> Self {
        Self {
            name,
            unit,
            default,
            minimum,
            maximum,
            text,
        }
    }
}

/// What a plant says of itself.
#[derive(Debug, Clone, Copy)]
pub struct PlantDescription {
    /// Name of the plant: 1 to 32 lower-case letters, digits and dashes.
    pub name: &'static str,
    /// Three numbers.
    pub version: &'static str,
    /// One line for people.
    pub text: &'static str,
    /// The signals, at most 64.
    pub signals: &'static [SignalSpec],
    /// The constants, at most 128.
    pub constants: &'static [ConstantSpec],
}

impl PlantDescription {
    /// Stops the build with the reason when a host would refuse the description. Made for `const` contexts.
    pub const fn check(&self) {
        assert!(self.signals.len() <= 64, "a plant may have at most 64 signals");
        assert!(self.constants.len() <= 128, "a plant may have at most 128 constants");
        let mut i = 0;
        while i < self.signals.len() {
            let s = &self.signals[i];
            assert!(
                s.range.0.is_finite() && s.range.1.is_finite() && s.range.0 < s.range.1,
                "a signal's range must be two finite numbers in order"
            );
            assert!(signal_index(self.signals, s.name) == i, "two signals share a name");
            if !matches!(s.role, Role::Measures) {
                assert!(
                    s.range.0 <= s.initial && s.initial <= s.range.1,
                    "a signal's initial value must lie in its range"
                );
            }
            i += 1;
        }
        let mut i = 0;
        while i < self.constants.len() {
            let c = &self.constants[i];
            assert!(
                constant_index(self.constants, c.name) == i,
                "two constants share a name"
            );
            assert!(
                c.minimum.is_finite() && c.maximum.is_finite() && c.minimum <= c.default && c.default <= c.maximum,
                "minimum <= default <= maximum must hold for a constant, all finite"
            );
            i += 1;
        }
    }
}

const fn signal_index(signals: &[SignalSpec], name: &str) -> usize {
    let mut i = 0;
    while i < signals.len() && !crate::table::same(signals[i].name, name) {
        i += 1;
    }
    i
}

const fn constant_index(constants: &[ConstantSpec], name: &str) -> usize {
    let mut i = 0;
    while i < constants.len() && !crate::table::same(constants[i].name, name) {
        i += 1;
    }
    i
}

/// Handle of a signal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Signal(usize);

impl Signal {
    /// Looks the signal up. In a `const`, a name that is not in the table stops the build.
    #[must_use]
    pub const fn of(signals: &[SignalSpec], name: &str) -> Self {
        let index = signal_index(signals, name);
        assert!(index < signals.len(), "no signal of that name");
        Self(index)
    }
}

/// Handle of a constant.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Constant(usize);

impl Constant {
    /// Looks the constant up. In a `const`, a name that is not in the table stops the build.
    #[must_use]
    pub const fn of(constants: &[ConstantSpec], name: &str) -> Self {
        let index = constant_index(constants, name);
        assert!(index < constants.len(), "no constant of that name");
        Self(index)
    }
}

/// The values of the constants.
#[derive(Debug, Clone, Copy)]
pub struct Constants<'a>(&'a [f64]);

impl Constants<'_> {
    /// The value of a constant, within its range; NaN for a handle from another, longer table.
    #[must_use]
    pub fn of(&self, constant: Constant) -> f64 {
        self.0.get(constant.0).copied().unwrap_or(f64::NAN)
    }
}

/// What acts on the plant while time passes.
#[derive(Debug, Clone, Copy)]
pub struct Inputs<'a>(&'a [f64]);

impl Inputs<'_> {
    /// The value of a signal that is set; NaN for a handle from another, longer table.
    #[must_use]
    pub fn of(&self, signal: Signal) -> f64 {
        self.0.get(signal.0).copied().unwrap_or(f64::NAN)
    }
}

/// What the plant shows.
#[derive(Debug)]
pub struct View<'a> {
    truth: &'a mut [f64],
    shown: &'a mut [f64],
}

impl View<'_> {
    /// A measurement whose instrument is perfect.
    pub fn set(&mut self, signal: Signal, value: f64) {
        self.set_shown(signal, value, value);
    }

    /// A measurement, and what its instrument makes of it: NaN for nothing.
    pub fn set_shown(&mut self, signal: Signal, truth: f64, shown: f64) {
        if let (Some(t), Some(s)) = (self.truth.get_mut(signal.0), self.shown.get_mut(signal.0)) {
            *t = truth;
            *s = shown;
        }
    }
}

/// A simulated plant.
pub trait Plant: Sized + 'static {
    /// What it says of itself.
    const DESCRIPTION: PlantDescription;

    /// The plant at its start. The number of constants and their ranges are checked; a rule between them is the plant's to
    /// check ([`Fault::BadParameter`]).
    fn begin(constants: &Constants<'_>, seed: u64) -> Result<Self, Fault>;

    /// Lets `dt_s` seconds pass, which may be 0, a part of a millisecond or many seconds: how it cuts them is the plant's
    /// matter. The inputs act all the while.
    fn advance(&mut self, dt_s: f64, inputs: &Inputs<'_>) -> Result<(), Fault>;

    /// Fills in the measurements. What is set is filled in already.
    fn show(&self, view: &mut View<'_>);
}

/// A plant that runs: what the component does between the calls of its host, and what a native test does.
#[derive(Debug)]
pub struct Running<P> {
    plant: P,
    truth: Vec<f64>,
    shown: Vec<f64>,
}

impl<P: Plant> Running<P> {
    /// Checks the constants and begins.
    pub fn begin(constants: &[f64], seed: u64) -> Result<Self, Fault> {
        let d = &P::DESCRIPTION;
        if constants.len() != d.constants.len() {
            return Err(Fault::bad_parameter("one value per constant is needed"));
        }
        for (spec, value) in d.constants.iter().zip(constants) {
            if !(spec.minimum..=spec.maximum).contains(value) {
                let mut text = String::from(spec.name);
                text.push_str(" is out of its range");
                return Err(Fault::BadParameter(text));
            }
        }
        let plant = P::begin(&Constants(constants), seed)?;
        let initial: Vec<f64> = d.signals.iter().map(|s| s.initial).collect();
        let mut running = Self {
            plant,
            shown: initial.clone(),
            truth: initial,
        };
        running.show();
        Ok(running)
    }

    /// Lets time pass.
    pub fn advance(&mut self, dt_ns: u64, inputs: &[f64]) -> Result<(), Fault> {
        let signals = P::DESCRIPTION.signals;
        if inputs.len() != signals.len() {
            return Err(Fault::bad_input("one value per signal is needed"));
        }
        for (n, (spec, value)) in signals.iter().zip(inputs).enumerate() {
            let set = !matches!(spec.role, Role::Measures);
            if set && !value.is_finite() {
                return Err(Fault::bad_input("what is set must be a finite number"));
            }
            if let (true, Some(t), Some(s)) = (set, self.truth.get_mut(n), self.shown.get_mut(n)) {
                *t = *value;
                *s = *value;
            }
        }
        self.plant.advance(dt_ns as f64 * 1e-9, &Inputs(inputs))?;
        self.show();
        Ok(())
    }

    fn show(&mut self) {
        self.plant.show(&mut View {
            truth: &mut self.truth,
            shown: &mut self.shown,
        });
    }

    /// The plant itself.
    #[must_use]
    pub const fn plant(&self) -> &P {
        &self.plant
    }

    /// One value per signal, without noise.
    #[must_use]
    pub fn truth(&self) -> &[f64] {
        &self.truth
    }

    /// One value per signal, as the instruments show it.
    #[must_use]
    pub fn shown(&self) -> &[f64] {
        &self.shown
    }

    /// The view in the form of the interface.
    #[doc(hidden)]
    #[must_use]
    pub fn view(&self) -> wit::View {
        // Compared by bits: an instrument that shows nothing shows NaN.
        let same = self
            .truth
            .iter()
            .zip(&self.shown)
            .all(|(t, s)| t.to_bits() == s.to_bits());
        wit::View {
            truth: self.truth.clone(),
            shown: if same { Vec::new() } else { self.shown.clone() },
        }
    }
}

/// The description in the form of the interface.
#[doc(hidden)]
#[must_use]
pub fn describe<P: Plant>() -> wit::Description {
    let d = &P::DESCRIPTION;
    wit::Description {
        name: d.name.to_owned(),
        version: d.version.to_owned(),
        text: d.text.to_owned(),
        signals: d
            .signals
            .iter()
            .map(|s| wit::Signal {
                name: s.name.to_owned(),
                role: match s.role {
                    Role::Measures => wit::Role::Measures,
                    Role::Sets => wit::Role::Sets,
                    Role::Disturbs => wit::Role::Disturbs,
                },
                unit: s.unit.to_owned(),
                low: s.range.0,
                high: s.range.1,
                initial: s.initial,
                text: s.text.to_owned(),
            })
            .collect(),
        constants: d
            .constants
            .iter()
            .map(|c| wit::Constant {
                name: c.name.to_owned(),
                unit: c.unit.to_owned(),
                default: c.default,
                minimum: c.minimum,
                maximum: c.maximum,
                text: c.text.to_owned(),
            })
            .collect(),
    }
}

/// Makes a [`Plant`] the component of this crate. Does nothing but check the tables on targets other than `wasm32`.
#[macro_export]
macro_rules! export_plant {
    ($plant:ty) => {
        const _: () = <$plant as $crate::plant::Plant>::DESCRIPTION.check();

        #[cfg(target_arch = "wasm32")]
        const _: () = {
            ::std::thread_local! {
                static PLANT: ::std::cell::RefCell<::std::option::Option<$crate::plant::Running<$plant>>> =
                    const { ::std::cell::RefCell::new(::std::option::Option::None) };
            }

            struct Component;

            impl $crate::plant::wit::Guest for Component {
                fn describe_plant() -> $crate::plant::wit::Description {
                    $crate::plant::describe::<$plant>()
                }

                fn begin(
                    constants: ::std::vec::Vec<f64>,
                    seed: u64,
                ) -> ::std::result::Result<$crate::plant::wit::View, $crate::Fault> {
                    let running = $crate::plant::Running::<$plant>::begin(&constants, seed)?;
                    let view = running.view();
                    PLANT.with(|plant| *plant.borrow_mut() = ::std::option::Option::Some(running));
                    ::std::result::Result::Ok(view)
                }

                fn advance(
                    dt_ns: u64,
                    inputs: ::std::vec::Vec<f64>,
                ) -> ::std::result::Result<$crate::plant::wit::View, $crate::Fault> {
                    PLANT.with(|plant| match plant.borrow_mut().as_mut() {
                        ::std::option::Option::Some(running) => {
                            running.advance(dt_ns, &inputs)?;
                            ::std::result::Result::Ok(running.view())
                        }
                        ::std::option::Option::None => {
                            ::std::result::Result::Err($crate::Fault::failed("begin comes before advance"))
                        }
                    })
                }
            }

            $crate::export_plant_unchecked!(Component);
        };
    };
}

/// Makes an implementation of the generated `Guest` trait the component of this crate, without any check.
#[doc(hidden)]
#[macro_export]
macro_rules! export_plant_unchecked {
    ($guest:ident) => {
        #[cfg(target_arch = "wasm32")]
        #[allow(
            unsafe_code,
            reason = "the component model's exports are C functions; the generated code is their only user"
        )]
        const _: () = {
    $crate::plant_bindings::export_plant_component!($guest with_types_in $crate::plant_bindings);
        };
    };
}
